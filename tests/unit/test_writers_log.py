"""Writers: the same table gives the same bytes, nothing half-written, and other tools read the result."""

from __future__ import annotations

import gzip
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import zstandard
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st

from flexid_cli.errors import OutputError
from flexid_cli.readers.registry import read_log
from flexid_cli.writers.csv import write_csv
from flexid_cli.writers.registry import FORMATS, format_of, write_log
from flexid_cli.writers.table import LogTable, topics_of

ROWS = 25


def make_table() -> LogTable:
    rng = np.random.default_rng(3)
    names = (
        "/joint_states/motor/position",
        "/joint_states/motor/effort",
        "/joint_states/joint/position",
        "/motor/current",
    )
    channels = {name: rng.normal(size=ROWS) for name in names}
    channels["/joint_states/joint/position"][4] = np.nan
    stamps = np.arange(ROWS, dtype=np.int64) * 2_850_059 + 1_700_000_000_000_000_007
    return LogTable(stamps, channels, {"/motor/current": "A"})


TABLE = make_table()
OUTPUTS: list[tuple[str, dict[str, Any]]] = [
    ("log.csv", {}),
    ("log.csv.gz", {}),
    ("log.csv.zst", {}),
    ("log.mcap", {}),
    ("log.mcap", {"encoding": "ros2idl", "compression": "lz4"}),
    ("log.mcap", {"encoding": "ros1", "compression": "none"}),
    ("log.mcap", {"encoding": "json", "chunked": False}),
    ("log.bag", {}),
    ("log.bag", {"compression": "bz2"}),
    ("folder", {}),
    ("folder", {"storage": "mcap"}),
    ("folder", {"compression": "file"}),
    ("log.db3", {}),
]


def content(path: Path) -> dict[str, bytes]:
    files = sorted(path.rglob("*")) if path.is_dir() else [path]
    return {file.name: file.read_bytes() for file in files}


@pytest.mark.parametrize(("name", "options"), OUTPUTS)
def test_the_same_table_gives_the_same_bytes(name: str, options: dict[str, Any], tmp_path: Path) -> None:
    written = []
    for place in ("one", "another"):
        folder = tmp_path / place
        folder.mkdir()
        write_log(folder / name, TABLE, **options)
        written.append(content(folder / name))
        assert [path.name for path in folder.iterdir()] == [name]
    assert written[0] == written[1]


@pytest.mark.parametrize(("name", "options"), OUTPUTS)
def test_an_existing_output_is_kept_unless_told(name: str, options: dict[str, Any], tmp_path: Path) -> None:
    path = tmp_path / name
    write_log(path, TABLE, **options)
    before = content(path)
    changed = LogTable(TABLE.stamps_ns, {source: values * 2 for source, values in TABLE.channels.items()})
    with pytest.raises(OutputError, match="exists already"):
        write_log(path, changed, **options)
    assert content(path) == before
    write_log(path, changed, overwrite=True, **options)
    assert content(path) != before
    assert [one.name for one in tmp_path.iterdir()] == [name]


@pytest.mark.parametrize(("name", "options"), OUTPUTS)
def test_a_failure_leaves_nothing_behind(
    name: str, options: dict[str, Any], tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    def fail(*_: object) -> None:
        raise OSError(28, "No space left on device")

    monkeypatch.setattr("flexid_cli.writers.table._replace", fail)
    with pytest.raises(OutputError, match="no space left"):
        write_log(tmp_path / name, TABLE, **options)
    assert list(tmp_path.iterdir()) == []
    with pytest.raises(OutputError, match="cannot write"):
        write_log(tmp_path / "absent" / name, TABLE, **options)


def test_the_mcap_package_and_its_decoders_read_our_mcap(tmp_path: Path) -> None:
    from mcap.reader import make_reader
    from mcap_ros1.decoder import DecoderFactory as Ros1
    from mcap_ros2.decoder import DecoderFactory as Ros2

    for encoding, factory in (("ros2msg", Ros2()), ("ros1", Ros1())):
        path = tmp_path / f"{encoding}.mcap"
        write_log(path, TABLE, encoding=encoding)
        with path.open("rb") as stream:
            reader = make_reader(stream, validate_crcs=True, decoder_factories=[factory])
            found = [one.decoded_message for one in reader.iter_decoded_messages(topics=["/joint_states"])]
        assert [list(one.name) for one in found] == [["motor", "joint"]] * ROWS
        assert [one.position[0] for one in found] == TABLE.channels["/joint_states/motor/position"].tolist()
        assert all(np.isnan(one.effort[1]) and len(one.velocity) == 0 for one in found)


def test_rosbags_reads_our_bags_and_idl(tmp_path: Path) -> None:
    from rosbags.highlevel import AnyReader

    for name, options in (
        ("f", {}),
        ("m", {"storage": "mcap"}),
        ("l.bag", {}),
        ("i.mcap", {"encoding": "ros2idl"}),
    ):
        write_log(tmp_path / name, TABLE, **options)
        with AnyReader([tmp_path / name]) as reader:
            wanted = [one for one in reader.connections if one.topic == "/motor/current"]
            values = [reader.deserialize(raw, one.msgtype).data for one, _, raw in reader.messages(wanted)]  # type: ignore[attr-defined]
            times = [time for _, time, _ in reader.messages(wanted)]
        assert values == TABLE.channels["/motor/current"].tolist()
        assert times == TABLE.stamps_ns.tolist()


def test_csv_in_detail(tmp_path: Path) -> None:
    stamps = np.array([-1, 0, 1_500_000_000], dtype=np.int64)
    table = LogTable(stamps, {"q": np.array([0.1, np.nan, -0.0])}, {"q": "rad"})
    write_csv(tmp_path / "a.csv", table)
    assert (tmp_path / "a.csv").read_bytes() == b"time [s],q [rad]\n-0.000000001,0.1\n0.0,\n1.5,-0.0\n"
    write_csv(tmp_path / "b.csv", table, time_unit="ns", units_in_header=False, time_name="t")
    assert (tmp_path / "b.csv").read_bytes() == b"t,q\n-1,0.1\n0,\n1500000000,-0.0\n"
    write_csv(tmp_path / "a.csv.gz", table)
    assert gzip.decompress((tmp_path / "a.csv.gz").read_bytes()) == (tmp_path / "a.csv").read_bytes()
    assert (tmp_path / "a.csv.gz").read_bytes()[4:8] == bytes(4)
    write_csv(tmp_path / "a.csv.zst", table)
    packed = (tmp_path / "a.csv.zst").read_bytes()
    assert (
        zstandard.ZstdDecompressor().decompressobj().decompress(packed) == (tmp_path / "a.csv").read_bytes()
    )


@settings(max_examples=30, deadline=None, suppress_health_check=[HealthCheck.function_scoped_fixture])
@given(values=st.lists(st.floats(), min_size=1, max_size=5), first=st.integers(0, 2**62))
def test_csv_gives_back_what_was_written(tmp_path: Path, values: list[float], first: int) -> None:
    stamps = np.arange(len(values), dtype=np.int64) * 1_000_000 + first
    write_csv(tmp_path / "a.csv", LogTable(stamps, {"q": np.array(values)}), overwrite=True)
    log = read_log([tmp_path / "a.csv"], ["time", "q"])
    assert np.array_equal(log.channels["q"].values, np.array(values), equal_nan=True)
    time = log.channels["time"]
    exact = time.exact if time.exact is not None else time.values
    scale = 1 if time.unit == "ns" else 1e9
    assert [round(value * scale) for value in exact.tolist()] == stamps.tolist()


def test_topics_of_a_table() -> None:
    topics = topics_of(TABLE, "/axis")
    assert [(one.name, one.joints) for one in topics] == [
        ("/joint_states", ("motor", "joint")),
        ("/motor/current", ()),
    ]
    assert topics[0].arrays["effort"].shape == (ROWS, 2)
    assert topics[0].arrays["velocity"].shape == (ROWS, 0)
    plain = LogTable(TABLE.stamps_ns, {"motor_current": np.zeros(ROWS)})
    assert topics_of(plain, "/axis")[0].name == "/axis/motor_current"


def test_formats_by_name(tmp_path: Path) -> None:
    assert [format_of(Path(name)) for name in ("a.csv", "a.csv.gz", "b.MCAP", "c.bag", "d", "e.db3")] == [
        "csv",
        "csv",
        "mcap",
        "rosbag1",
        "rosbag2",
        "db3",
    ]
    assert set(FORMATS) == {"csv", "mcap", "rosbag1", "rosbag2", "db3"}
    with pytest.raises(OutputError, match="names no format"):
        write_log(tmp_path / "a.parquet", TABLE)
    with pytest.raises(OutputError, match="not known"):
        write_log(tmp_path / "a.mcap", TABLE, encoding="cbor")
    with pytest.raises(OutputError, match="not known"):
        write_log(tmp_path / "a.x", TABLE, "parquet")


def test_impossible_tables(tmp_path: Path) -> None:
    with pytest.raises(OutputError, match="shape"):
        LogTable(np.zeros(2, np.int64), {"a": np.zeros(3)})
    with pytest.raises(OutputError, match="int64"):
        LogTable(np.zeros(2), {"a": np.zeros(2)})  # type: ignore[arg-type]
    with pytest.raises(OutputError, match="without channels"):
        LogTable(np.zeros(2, np.int64), {})
    early = LogTable(np.array([-5], np.int64), {"a": np.zeros(1)})
    for name in ("a.mcap", "a.bag", "a", "a.db3"):
        with pytest.raises(OutputError, match="shift the stamps"):
            write_log(tmp_path / name, early)
    infinite = LogTable(np.array([5], np.int64), {"a": np.array([np.inf])})
    with pytest.raises(OutputError, match="infinite"):
        write_log(tmp_path / "a.mcap", infinite, encoding="json")
    with pytest.raises(OutputError, match="both the time's"):
        write_csv(tmp_path / "a.csv", LogTable(np.zeros(1, np.int64), {"time": np.zeros(1)}))
    assert list(tmp_path.iterdir()) == []
