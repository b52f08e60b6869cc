"""``--start``, ``--end``, ``--strict``, ``--keep-suspect``, and what a person hears of damage."""

from __future__ import annotations

import json
import struct
from pathlib import Path
from typing import TYPE_CHECKING, Any

import jsonschema
import numpy as np
import pytest
from click.testing import CliRunner, Result
from mcap.reader import make_reader
from mcap.writer import Writer

from flexid_cli.cli import reading
from flexid_cli.cli.main import main
from flexid_cli.cli.options import Console
from flexid_cli.config.load import parse_config
from flexid_cli.errors import InputError, UsageError
from flexid_cli.readers.base import ReadOptions
from flexid_cli.signals.build import build_recording

if TYPE_CHECKING:
    from conftest import Columns, WriteLog

ROOT = Path(__file__).resolve().parents[2]
FIELDS = ("current", "motor", "joint", "reference")
CHUNK_ROWS = 40
START_NS, STEP_NS = 10**18, 5_000_000
CONFIG = """\
version: 1
axis: {name: short, gear_ratio: 50, torque_constant_nm_per_a: 0.35}
signals:
  motor_current:      {source: /drive.current, unit: A, hold: sample}
  motor_position:     {source: /drive.motor, unit: rad, side: motor}
  joint_position:     {source: /drive.joint, unit: rad}
  reference_position: {source: /drive.reference, unit: rad, side: motor}
"""


def run(*arguments: str | Path) -> Result:
    return CliRunner().invoke(main, [*map(str, arguments)])


def write_chunks(path: Path, columns: Columns, chunk_rows: int = CHUNK_ROWS) -> Path:
    """Write the record as MCAP in chunks of so many rows."""
    with path.open("wb") as stream:
        writer = Writer(stream, chunk_size=chunk_rows * 67)
        writer.start("ros2")
        schema = writer.register_schema(
            "test/Drive", "ros2msg", "\n".join(f"float64 {f}" for f in FIELDS).encode()
        )
        channel = writer.register_channel("/drive", "cdr", schema)
        for row in range(columns["time"].size):
            values = struct.pack("<4d", *(columns[field][row] for field in FIELDS))
            stamp = START_NS + row * STEP_NS
            writer.add_message(channel, stamp, b"\0\1\0\0" + values, stamp)
        writer.finish()
    return path


def damage_chunk(path: Path, number: int) -> int:
    """Make the checksum of one chunk wrong; returns how many messages the chunk has."""
    with path.open("rb") as stream:
        summary = make_reader(stream).get_summary()
    assert summary is not None
    index = sorted(summary.chunk_indexes, key=lambda one: one.chunk_start_offset)[number]
    content = bytearray(path.read_bytes())
    content[index.chunk_start_offset + 9 + 24] ^= 1
    path.write_bytes(content)
    return (index.message_end_time - index.message_start_time) // STEP_NS + 1


@pytest.fixture
def log(tmp_path: Path, short_run: Columns) -> Path:
    return write_chunks(tmp_path / "run.mcap", short_run)


@pytest.fixture
def config(tmp_path: Path) -> Path:
    path = tmp_path / "axis.yaml"
    path.write_text(CONFIG, encoding="utf-8")
    return path


def test_damage_is_reported_and_strict_refuses_it(log: Path, config: Path) -> None:
    suspect = damage_chunk(log, 30)
    arguments = ("identify", log, "-c", config, "--set", "models=[two_encoders]", "--json")
    result = run(*arguments)
    assert result.exit_code == 0, result.output
    assert "is damaged" in result.stderr
    assert f"{suspect} may be wrong and were left out" in " ".join(result.stderr.split())
    document: dict[str, Any] = json.loads(result.stdout)
    schema = json.loads((ROOT / "flexid_cli/schemas/report-1.schema.json").read_text("utf-8"))
    jsonschema.Draft202012Validator(schema).validate(document)
    damage = document["inputs"][0]["damage"]
    assert damage["suspect"] == suspect
    assert damage["trusted"] == 4000 - suspect
    assert document["recording"]["samples"] == damage["trusted"] - 2  # a held current costs one per segment
    assert damage["lost"] == 0
    assert len(damage["spans_s"]) == 1
    assert "checksum" in damage["reasons"][0]
    assert document["recording"]["segments"] == 2
    strict = run(*arguments, "--strict")
    assert strict.exit_code == 2
    assert "checksum" in strict.stderr
    assert strict.stdout == ""
    kept = run(*arguments, "--keep-suspect")
    assert "used nevertheless" in " ".join(kept.stderr.split())
    assert json.loads(kept.stdout)["recording"]["segments"] == 1


@pytest.mark.parametrize("command", ["identify", "inspect"])
def test_a_sound_log_is_silent(command: str, log: Path, config: Path) -> None:
    more = ("-c", config, "--set", "models=[two_encoders]") if command == "identify" else ()
    result = run(command, log, *more, "--strict", "--json")
    assert result.exit_code == 0
    assert "damaged" not in result.stderr


@pytest.mark.parametrize("suffix", ["mcap", "csv"])
def test_windows(suffix: str, log: Path, tmp_path: Path, short_run: Columns, write_log: WriteLog) -> None:
    path = log if suffix == "mcap" else write_log(short_run, "table.csv")
    source = "/drive.motor" if suffix == "mcap" else "motor"
    result = run("inspect", path, "--json", "--start", 5, "--end", 7.5)
    assert result.exit_code == 0, result.output
    channels = {one["source"]: one for one in json.loads(result.stdout)["channels"]}
    time = short_run["time"] - short_run["time"][0]
    inside = short_run["motor"][(time >= 5 - 1e-9) & (time < 7.5 - 1e-9)]
    assert channels[source]["samples"] == inside.size == 500
    assert channels[source]["minimum"] == inside.min()
    text = CONFIG if suffix == "mcap" else CONFIG.replace("/drive.", "")
    recording, _ = build_recording([path], parse_config(text), ReadOptions(start_s=5.0, end_s=7.5))
    assert recording.samples == 499  # a held current costs one sample


@pytest.mark.parametrize("suffix", ["mcap", "csv"])
def test_an_empty_window(suffix: str, log: Path, short_run: Columns, write_log: WriteLog) -> None:
    path = log if suffix == "mcap" else write_log(short_run, "table.csv")
    result = run("inspect", path, "--start", 1000)
    assert result.exit_code == 2
    assert "--start" in result.stderr
    assert "damaged" not in result.stderr


@pytest.mark.parametrize(
    "arguments",
    [("--start", "nan"), ("--end", "inf"), ("--start", "3", "--end", "3"), ("--end", "0"), ("--start", "-1"),
     ("--strict", "--keep-suspect")],
)  # fmt: skip
def test_windows_that_cannot_be(arguments: tuple[str, ...], log: Path) -> None:
    result = run("inspect", log, *arguments)
    assert result.exit_code == 2
    assert result.stdout == ""


def test_few_lost_samples_are_a_gap_too(tmp_path: Path, columns: Columns) -> None:
    """A gap this short would otherwise be bridged by interpolation."""
    path = write_chunks(tmp_path / "run.mcap", columns, chunk_rows=1)
    lost = damage_chunk(path, 300)
    assert lost == 2
    recording, raw = build_recording([path], parse_config(CONFIG))
    assert raw.damage[0].suspect == lost
    assert len(recording.segments) == 2
    assert recording.samples == columns["time"].size - lost - 2
    clock = recording.clocks[0]
    assert (clock.gaps, clock.bridged) == (1, 0)
    whole, _ = build_recording([path], parse_config(CONFIG), ReadOptions(keep_suspect=True))
    assert len(whole.segments) == 1
    joined = np.concatenate([segment.motor_position for segment in recording.segments])
    assert np.isin(joined, whole.segments[0].motor_position).all()


def test_a_fixed_rate_cannot_place_what_follows_lost_samples(log: Path) -> None:
    text = CONFIG.replace("signals:\n", "signals:\n  time: {rate_hz: 200}\n")
    build_recording([log], parse_config(text))
    damage_chunk(log, 20)
    with pytest.raises(InputError, match="fixed rate_hz"):
        build_recording([log], parse_config(text))


class Terminal:
    """A standard error that is a terminal."""

    def __init__(self) -> None:
        self.text = ""

    def isatty(self) -> bool:
        return True

    def write(self, text: str) -> int:
        self.text += text
        return len(text)

    def flush(self) -> None:
        pass


@pytest.mark.parametrize(
    ("verbosity", "patience", "shown"), [(0, 0.0, True), (0, 60.0, False), (1, 0.0, False), (-1, 0.0, False)]
)
def test_the_progress_bar(
    monkeypatch: pytest.MonkeyPatch, verbosity: int, patience: float, *, shown: bool
) -> None:
    terminal, console = Terminal(), Console()
    monkeypatch.setattr("sys.stderr", terminal)
    monkeypatch.setattr(reading, "PATIENCE_S", patience)
    monkeypatch.setenv("TERM", "xterm")
    console.verbosity = verbosity
    with reading.reading(console, None, None, strict=False, keep_suspect=False) as options:
        for done in range(0, 101, 10):
            if options.progress is not None:
                options.progress(done, 100)
    assert ("reading" in terminal.text) == shown


def test_a_pipe_gets_no_bar(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(Terminal, "isatty", lambda _: False)
    monkeypatch.setattr("sys.stderr", Terminal())
    with reading.reading(Console(), None, None, strict=False, keep_suspect=False) as options:
        assert options.progress is None
    with pytest.raises(UsageError), reading.reading(Console(), 1.0, 1.0, strict=False, keep_suspect=False):
        pass
