"""Text tables: every way to write them is read right, or refused with a clear word."""

from __future__ import annotations

import gzip
import math
import re
from collections.abc import Iterator, Sequence
from pathlib import Path

import numpy as np
import pytest
import zstandard
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st

from flexid_cli.errors import InputError
from flexid_cli.readers import csv as table
from flexid_cli.readers import rows as blocks
from flexid_cli.readers.base import DEFAULT_OPTIONS, RawLog, ReadOptions
from flexid_cli.readers.csv import CsvReader
from flexid_cli.readers.dialect import (
    Detect,
    Dialect,
    Field,
    detect,
    detect_encoding,
    is_number,
    is_whole,
    split_line,
    split_unit,
)
from flexid_cli.readers.registry import list_channels, read_log


@pytest.fixture(params=["pandas", "compiled"], scope="module", autouse=True)
def parser(request: pytest.FixtureRequest) -> Iterator[None]:
    """Small tables as small ones, and as large ones are read."""
    with pytest.MonkeyPatch.context() as patch:
        if request.param == "compiled":
            patch.setattr(table, "_COMPILED", 0)
            patch.setattr(table, "_THREADED", 0)
        yield


ROWS = [(0.0, 1.5, -2.25), (0.001, 1.625, -2.5), (0.002, 1.75, -2.75), (0.003, -1.0e-7, 3.0e8)]
NAMES = ("time", "motor_current", "motor_position")


def text(
    delimiter: str = ",",
    decimal: str = ".",
    header: str | None = "",
    end: str = "\n",
    rows: Sequence[Sequence[float]] = ROWS,
) -> str:
    lines = [] if header is None else [header or delimiter.join(NAMES)]
    lines += [delimiter.join(repr(float(value)).replace(".", decimal) for value in row) for row in rows]
    return end.join(lines) + end


def save(folder: Path, content: str | bytes, name: str = "log.csv", encoding: str = "utf-8") -> Path:
    path = folder / name
    path.write_bytes(content if isinstance(content, bytes) else content.encode(encoding))
    return path


def read(
    path: Path,
    sources: Sequence[str | int] = NAMES,
    csv: Detect | None = None,
    options: ReadOptions = DEFAULT_OPTIONS,
) -> RawLog:
    return CsvReader(csv).read([path], sources, options)


def checked_zstd(content: bytes) -> bytes:
    return zstandard.ZstdCompressor(write_checksum=True).compress(content)


def assert_rows(log: RawLog, rows: Sequence[Sequence[float]] = ROWS) -> None:
    for place, channel in enumerate(log.channels.values()):
        expected = np.array([row[place] for row in rows])
        assert np.array_equal(channel.values, expected, equal_nan=True), channel


RIGHT = {
    "plain": text(),
    "semicolon": text(";"),
    "semicolon and decimal comma": text(";", ","),
    "tab": text("\t"),
    "tab and decimal comma": text("\t", ","),
    "space": text(" "),
    "aligned by spaces": text("   ").replace("\n", "  \n  "),
    "pipe": text("|"),
    "comma and space": text(", "),
    "CRLF": text(end="\r\n"),
    "CR": text(end="\r"),
    "BOM": b"\xef\xbb\xbf" + text().encode(),
    "UTF-16": text().encode("utf-16"),
    "UTF-16 big-endian without mark": text().encode("utf-16-be"),
    "comment lines": "# drive 3\n% by hand\n// ok\n" + text(),
    "comments between samples": text().replace("\n0.002", "\n# a note, with commas\n\n0.002"),
    "blank lines": "\n\n" + text().replace("\n", "\n\n"),
    "header in a comment": "# made by a script\n# " + text(),
    "header like rostopic": "%" + text(),
    "header like numpy.savetxt": "# " + text(" "),
    "units in the header": text(header="time [s],motor_current [A],motor_position [rad]"),
    "round brackets": text(header="time (s),motor_current (A),motor_position (rad)"),
    "unit after a space, by spaces": text(" ", header="time [s] motor_current [A] motor_position [rad]"),
    "line of units": text(header="time,motor_current,motor_position\ns,A,rad"),
    "line of units in brackets": text(";", header="time;motor_current;motor_position\n[s];[A];[rad]"),
    "line of units in a comment": "# time motor_current motor_position\n# s A rad\n" + text(" ", header=None),
    "quoted names": text(header='"time","motor_current","motor_position"'),
    "quoted numbers": text().replace("1.5", '"1.5"'),
    "preamble": "Oscilloscope export\nserial number 12\n" + text(),
    "preamble as wide as the table": "made,by,hand\n" + text(),
    "delimiter at the end of each line": text().replace("\n", ",\n"),
    "delimiter at the end of each row": text().replace("\n", ",\n").replace("position,", "position"),
    "spaces around numbers": text().replace(",", " , "),
    "upper-case exponent": text().replace("e", "E").replace("timE", "time").replace("currEnt", "current"),
}  # fmt: skip


@pytest.mark.parametrize("what", RIGHT)
def test_read_right(what: str, tmp_path: Path) -> None:
    content = RIGHT[what]
    log = read(save(tmp_path, content))
    assert_rows(log)
    assert log.damage[0].is_harmless
    units = [channel.unit for channel in log.channels.values()]
    assert units == (["s", "A", "rad"] if "unit" in what or "bracket" in what else [None] * 3)


@pytest.mark.parametrize("what", ["plain", "semicolon and decimal comma", "tab", "space", "CRLF", "UTF-16"])
def test_without_header_columns_are_numbered(what: str, tmp_path: Path) -> None:
    content = RIGHT[what]
    if isinstance(content, bytes):
        body = content.decode("utf-16").split("\n", 1)[1].encode("utf-16")
        path = save(tmp_path, body)
    else:
        path = save(tmp_path, content.split("\n", 1)[1])
    assert_rows(read(path, [1, "2", 3]))
    assert [info.source for info in list_channels([path])] == ["1", "2", "3"]
    with pytest.raises(InputError, match="no header"):
        read(path, ["time"])
    with pytest.raises(InputError, match="it has 3 columns"):
        read(path, [4])


@pytest.mark.parametrize("pack", ["gz", "zst", "two gzip members", "gzip with padding"])
def test_packed(pack: str, tmp_path: Path) -> None:
    content = text().encode()
    packed = {
        "gz": gzip.compress(content),
        "zst": zstandard.compress(content),
        "two gzip members": gzip.compress(content[:30]) + gzip.compress(content[30:]),
        "gzip with padding": gzip.compress(content) + b"\0" * 100,
    }[pack]
    log = read(save(tmp_path, packed, "log.anything"))
    assert_rows(log)
    assert log.damage[0].is_harmless


@pytest.mark.parametrize("pack", ["gz", "zst"])
@pytest.mark.parametrize("kept", [0.3, 0.6, 0.99])
def test_a_cut_packed_file_gives_whole_lines_and_an_account(pack: str, kept: float, tmp_path: Path) -> None:
    rng = np.random.default_rng(1)
    rows = [(k * 0.001, *rng.normal(size=2)) for k in range(20_000)]
    content = text(rows=rows).encode()
    packed = gzip.compress(content) if pack == "gz" else zstandard.compress(content)
    log = read(save(tmp_path, packed[: int(kept * len(packed))]))
    count = log.channels["time"].values.size
    assert 0 < count < 20_000
    assert_rows(log, rows[:count])
    (damage,) = log.damage
    assert (damage.trusted, damage.suspect, damage.lost) == (count, 0, None)
    assert "cut short" in damage.reasons[0]
    with pytest.raises(InputError, match="cut short"):
        read(tmp_path / "log.csv", options=ReadOptions(strict=True))


@pytest.mark.parametrize("pack", ["gz", "zst"])
def test_a_wrong_checksum_makes_all_it_covers_suspect(pack: str, tmp_path: Path) -> None:
    content = text().encode()
    packed = bytearray(gzip.compress(content) if pack == "gz" else checked_zstd(content))
    packed[-6 if pack == "gz" else -2] ^= 1
    path = save(tmp_path, bytes(packed))
    with pytest.raises(InputError, match="checksum") as caught:
        read(path)
    assert "--keep-suspect" in caught.value.hint
    log = read(path, options=ReadOptions(keep_suspect=True))
    assert_rows(log)
    assert log.channels["time"].suspect is not None
    assert log.channels["time"].suspect.all()
    assert (log.damage[0].trusted, log.damage[0].suspect, log.damage[0].lost) == (0, 4, 0)


def test_only_the_damaged_part_of_a_packed_file_is_suspect(tmp_path: Path) -> None:
    """Three packed stretches one after the other; a wrong checksum in the second says nothing of the rest."""
    rows = [(k / 1000, float(k % 7), -k / 3) for k in range(30)]
    lines = text(rows=rows).encode().splitlines(keepends=True)
    parts = [b"".join(lines[:11]), b"".join(lines[11:21]), b"".join(lines[21:])]
    packed = [bytearray(gzip.compress(part)) for part in parts]
    packed[1][-7] ^= 4
    path = save(tmp_path, b"".join(packed))
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr("flexid_cli.readers.csv._BLOCK", 1)
        log = read(path)
        assert_rows(log, rows[:10] + rows[20:])
        assert (log.damage[0].trusted, log.damage[0].suspect) == (20, 10)
        kept = read(path, options=ReadOptions(keep_suspect=True))
    assert_rows(kept, rows)
    assert kept.channels["time"].suspect is not None
    assert np.flatnonzero(kept.channels["time"].suspect).tolist() == list(range(10, 20))


@pytest.mark.parametrize("pack", ["gz", "zst"])
def test_what_follows_a_hole_in_a_packed_file_is_read(pack: str, tmp_path: Path) -> None:
    rng = np.random.default_rng(1)
    rows = [(k * 0.001, *rng.normal(size=2)) for k in range(120_000)]
    lines = text(rows=rows).encode().splitlines(keepends=True)
    compress = gzip.compress if pack == "gz" else checked_zstd
    packed = [bytearray(compress(b"".join(lines[first : first + 40_001]))) for first in (0, 40_001, 80_002)]
    middle = len(packed[1]) // 2
    packed[1][middle : middle + 3000] = bytes(3000)
    log = read(save(tmp_path, b"".join(packed)))
    times = log.channels["time"].values
    exact = {row[0]: row for row in rows}
    values = np.column_stack([channel.values for channel in log.channels.values()])
    assert all(tuple(row) == exact[row[0]] for row in values.tolist())
    assert (np.diff(times) > 0).all()
    assert (times < 40).sum() >= 40_000
    assert (times > 80.01).sum() >= 39_980  # the first line behind a hole may be cut, so it is left out
    assert log.damage[0].lost != 0
    assert log.damage[0].suspect > 0
    if pack == "zst":  # deflate finds its way again, and only the checksum tells
        assert log.damage[0].lost is None
        assert log.damage[0].lost_bytes > 0


@pytest.mark.parametrize("word", ["", "NaN", "nan", "N/A", "-", "null", "NA", "None", "-nan(ind)"])
def test_missing_values_are_nan(word: str, tmp_path: Path) -> None:
    rows = [*ROWS[:1], (0.001, math.nan, -2.5), *ROWS[2:]]
    assert_rows(read(save(tmp_path, text().replace("1.625", word))), rows)


def test_leading_missing_values_are_samples(tmp_path: Path) -> None:
    path = save(tmp_path, "time,a\nNaN,NaN\n,\n0.5,1.5\n")
    assert_rows(read(path, ["time", "a"]), [(math.nan, math.nan), (math.nan, math.nan), (0.5, 1.5)])


@pytest.mark.parametrize("cut", range(1, 14))
def test_a_cut_number_is_never_read_as_whole(cut: int, tmp_path: Path) -> None:
    content = text()[:-cut]
    log = read(save(tmp_path, content))
    assert_rows(log, ROWS[:3])
    (damage,) = log.damage
    assert (damage.trusted, damage.lost) == (3, 1)
    assert "last line was dropped" in damage.reasons[0]
    assert ":5:" in damage.reasons[0]


def test_a_whole_last_line_without_end_is_kept_where_that_is_sure(tmp_path: Path) -> None:
    fixed = "t,q\n0.001,12.345\n0.002,7.250\n0.003,-1.125"
    log = read(save(tmp_path, fixed), ["t", "q"])
    assert log.channels["q"].values.tolist() == [12.345, 7.25, -1.125]
    assert log.damage[0].is_harmless
    log = read(save(tmp_path, fixed[:-1]), ["t", "q"])
    assert log.channels["q"].values.tolist() == [12.345, 7.25]


@pytest.mark.parametrize(
    ("content", "word"),
    [
        (text().replace("1.625", "ERR"), r":3: column 'motor_current' has the text 'ERR'"),
        (text().replace("1.625", "1,5").replace(",", ";", 0), r":3: the line has 4 fields, not 3"),
        (text(";").replace("1.625", "1,625"), r":3: column 'motor_current' has the text '1,625'"),
        (text(";", ",").replace("1,625", "1.625"), r":3: column 'motor_current' has the text '1.625'"),
        (text().replace("\n0.002,1.75", "\n0.002"), r":4: the line has 2 fields, not 3"),
        (text().replace("1.625", "0x1A"), r":3: column 'motor_current' has the text '0x1A'"),
        (text().replace("1.625", "1_000"), r":3: column 'motor_current' has the text '1_000'"),
        (text(header="time,motor_current,time"), "'time' more than once"),
        (text(header="time,motor_current"), "header has 2 names, but the rows have 3 fields"),
        (text(header="a,b,c,d"), "header has 4 names, but the rows have 3 fields"),
        (text().split("\n")[0] + "\n", "no rows of numbers"),
        ("# only\n# comments\n", "no data rows"),
        ("no table at all\nbut some prose\n", "no rows of numbers"),
        (b"\xff\xfe\x00\x01\x02" * 50, "log.csv"),
    ],
)
def test_refused_with_a_clear_word(content: str | bytes, word: str, tmp_path: Path) -> None:
    with pytest.raises(InputError, match=word) as caught:
        read(save(tmp_path, content))
    assert "log.csv" in caught.value.message
    assert caught.value.hint


def test_an_unused_text_column_does_not_hurt(tmp_path: Path) -> None:
    lines = text().splitlines()
    path = save(tmp_path, "\n".join([lines[0] + ",mode", *(line + ",RUN" for line in lines[1:])]) + "\n")
    assert_rows(read(path))
    assert [info.source for info in list_channels([path])] == list(NAMES)
    with pytest.raises(InputError, match="'RUN'"):
        read(path, ["mode"])


def test_latin1_degrees(tmp_path: Path) -> None:
    path = save(tmp_path, text(header="time [s],motor_current [A],motor_position [°]"), encoding="latin-1")
    log = read(path)
    assert_rows(log)
    assert log.channels["motor_position"].unit == "°"


def test_a_late_foreign_character(tmp_path: Path) -> None:
    rows = [(k * 0.5, 1.0, 2.0) for k in range(40_000)]
    content = text(rows=rows).encode() + b"# 20 \xb0C\n"
    path = save(tmp_path, content)
    for csv in (None, Detect(encoding="latin-1")):
        log = read(path, NAMES, csv)
        assert_rows(log, rows)
        assert log.damage[0].is_harmless
    rows[39_000] = (19_500.0, 1.0, 2.0)
    foreign = content.replace(b"\n19500.0,", b"\n19500.\xb0,")
    log = read(save(tmp_path, foreign))
    assert_rows(log, rows[:39_000] + rows[39_001:])
    assert ":39002: the line holds bytes that are no text" in log.damage[0].reasons[0]


def test_epoch_nanoseconds_stay_exact(tmp_path: Path) -> None:
    stamps = [1_700_000_000_000_000_001 + 1_000_003 * k for k in range(50)]
    path = save(tmp_path, "time,q\n" + "".join(f"{stamp},{k}\n" for k, stamp in enumerate(stamps)))
    channel = read(path, ["time"]).channels["time"]
    assert channel.exact is not None
    assert channel.exact.dtype == np.int64
    assert channel.exact.tolist() == stamps
    assert channel.values.tolist() == [float(stamp) for stamp in stamps]
    assert read(path, ["q"]).channels["q"].exact is None


def test_columns_by_name_text_and_number(tmp_path: Path) -> None:
    path = save(tmp_path, text(header="time [s],2,motor_position [rad]"))
    for source in ("2", 2):
        assert read(path, [source]).channels["2"].values[0] == 1.5
    for source in ("motor_position", "motor_position [rad]", "3", 3):
        assert read(path, [source]).channels[str(source)].source == "motor_position"
    infos = list_channels([path])
    assert [(info.source, info.unit, info.count) for info in infos] == [
        ("time", "s", 4),
        ("2", None, 4),
        ("motor_position", "rad", 4),
    ]
    assert infos[2].aliases == ("motor_position [rad]", "3")


def test_names_that_differ_in_their_unit_only(tmp_path: Path) -> None:
    path = save(tmp_path, text(header="time,position [rad],position [deg]"))
    log = read(path, ["position [rad]", "position [deg]"])
    assert [channel.unit for channel in log.channels.values()] == ["rad", "deg"]
    with pytest.raises(InputError, match=r"no channel 'position'"):
        read(path, ["position"])


@pytest.mark.parametrize(
    ("options", "content"),
    [
        (Detect(delimiter=";"), text(";")),
        (Detect(delimiter="\\t"), text("\t")),
        (Detect(decimal=","), text(";", ",")),
        (Detect(comment="!"), "! remark\n" + text()),
        (Detect(header=True), text()),
        (Detect(skip_rows=2), "1,2,3\nx,y,z\n" + text()),
        (Detect(encoding="utf-16"), text().encode("utf-16")),
    ],
)
def test_options_of_the_configuration(options: Detect, content: str | bytes, tmp_path: Path) -> None:
    assert_rows(read(save(tmp_path, content), NAMES, options))


def test_header_false_where_there_is_one(tmp_path: Path) -> None:
    with pytest.raises(InputError, match="no row of numbers"):
        read(save(tmp_path, text()), [1], Detect(header=False))


def test_header_of_numbers(tmp_path: Path) -> None:
    path = save(tmp_path, text(header="time,1,2"))
    log = read(path, ["time", "1", "2"])
    assert_rows(log)


def test_files_with_other_columns_are_not_one_recording(tmp_path: Path) -> None:
    one = save(tmp_path, text(), "a.csv")
    two = save(tmp_path, text(header="time,b,c"), "b.csv")
    with pytest.raises(InputError, match="different columns"):
        read_log([one, two], ["time"])


def test_a_long_file_crosses_blocks(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("flexid_cli.readers.csv._BLOCK", 500)
    monkeypatch.setattr("flexid_cli.readers.packed._BLOCK", 64)
    rows = [(k / 1000, float(k % 7), -k / 3) for k in range(500)]
    assert_rows(read(save(tmp_path, text(rows=rows, end="\r\n"))), rows)
    for damaged, words, count in (
        (text(rows=rows).replace("\n0.4,", "\nX,"), ":402: column 'time' has the text 'X'", 1),
        (text(rows=rows).replace("\n0.4,", "\n"), ":402: the line has 2 fields", 1),
        (
            text(rows=rows).replace("\n0.4,", "\n").replace("\n0.401,", "\n0.401,0.401,"),
            ":402: the line has 2 fields",
            2,
        ),
        (text(rows=rows).replace("\n0.4,", '\n"0.4,'), ":402: the line has", 1),
        (text(rows=rows).replace("\n0.4,", "\n0.4\0,"), ":402: the line holds zero bytes", None),
    ):
        path = save(tmp_path, damaged)
        log = read(path)
        assert_rows(log, rows[:400] + rows[400 + (count or 1) :])
        assert words in log.damage[0].reasons[0]
        assert log.damage[0].lost == count
        with pytest.raises(InputError, match=re.escape(words)):
            read(path, options=ReadOptions(strict=True))


def test_zeros_at_the_end_as_after_a_loss_of_power(tmp_path: Path) -> None:
    path = save(tmp_path, text().encode()[:-5] + bytes(5000))
    log = read(path)
    assert_rows(log, ROWS[:3])
    assert (log.damage[0].lost, log.damage[0].lost_bytes) == (None, 5000)
    assert "zero bytes" in log.damage[0].reasons[0]


def test_a_hole_of_zeros(tmp_path: Path) -> None:
    rows = [(k / 1000, float(k % 7), -k / 3) for k in range(1000)]
    content = bytearray(text(rows=rows).encode())
    content[5000:9000] = bytes(4000)
    log = read(save(tmp_path, bytes(content)))
    first = content[:5000].count(b"\n") - 1
    last = content[9000:].count(b"\n") - 1
    assert_rows(log, rows[:first] + rows[-last:])
    assert (log.damage[0].lost, log.damage[0].lost_bytes) == (None, 4000)


def test_a_stretch_without_line_ends_is_left_out(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("flexid_cli.readers.csv._BLOCK", 4096)
    monkeypatch.setattr("flexid_cli.readers.packed._BLOCK", 4096)
    monkeypatch.setattr("flexid_cli.readers.lines._LONGEST_LINE", 20_000)
    rows = [(k / 1000, float(k % 7), -k / 3) for k in range(2000)]
    lines = text(rows=rows).splitlines(keepends=True)
    for rest in (lines[1001:], []):
        log = read(save(tmp_path, "".join([*lines[:1001], "7" * 100_000, *rest])))
        assert_rows(log, rows[:1000] + (rows[1001:] if rest else []))
        assert log.damage[0].lost is None
        assert log.damage[0].lost_bytes >= 100_000


def test_many_bad_lines_mean_another_kind_of_table(tmp_path: Path) -> None:
    rows = [(k / 1000, float(k % 7), -k / 3) for k in range(1000)]
    lines = text(rows=rows).splitlines(keepends=True)
    few = "".join(line if k % 20 or not k else "1,2\n" for k, line in enumerate(lines))
    many = "".join(line if k % 5 or not k else "1,2\n" for k, line in enumerate(lines))
    log = read(save(tmp_path, few))
    assert (log.damage[0].trusted, log.damage[0].lost) == (950, 50)
    assert len(log.damage[0].reasons) == 6
    assert "45 more lines" in log.damage[0].reasons[-1]
    with pytest.raises(InputError, match=":6: the line has 2 fields"):
        read(save(tmp_path, many))


@pytest.mark.parametrize("threads", [1, 3])
def test_threads_and_progress(threads: int, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("flexid_cli.readers.csv._BLOCK", 4096)
    monkeypatch.setattr("flexid_cli.readers.packed._BLOCK", 4096)
    rows = [(k / 1000, float(k % 7), -k / 3) for k in range(5000)]
    path = save(tmp_path, text(rows=rows))
    seen: list[tuple[int, int]] = []
    options = ReadOptions(threads=threads, progress=lambda done, total: seen.append((done, total)))
    assert_rows(read(path, options=options), rows)
    assert seen[-1] == (path.stat().st_size,) * 2
    assert len(seen) > 10


NUMBERS = st.from_regex(r"[-+]?[0-9]{0,4}[.,]?[0-9]{0,3}([eE][-+]?[0-9]{0,2})?", fullmatch=True)


@settings(max_examples=300, deadline=None)
@given(field=NUMBERS | st.text("0123456789+-.eExXnNaAiIfFdD_ ", max_size=6), decimal=st.sampled_from(".,"))
def test_the_parser_takes_for_a_number_what_the_dialect_does(field: str, decimal: str) -> None:
    """Blocks of plain numbers and lines that are looked at one by one are read by the same rules."""
    dialect = Dialect(";", decimal, ("#",), (Field("a", None, "a"), Field("b", None, "b")), 1)
    block = f"1;2\n{field};7\n{field};8\n".encode()
    plain = blocks._read_plain(block, dialect, [0, 1])
    any_ = blocks._read_any(block, dialect, "utf-8", [0, 1])
    if plain is not None:
        assert any_.count == plain.count
        for place in (0, 1):
            one, two = plain.columns[place], any_.columns[place]
            assert np.array_equal(one.astype(float), two.astype(float), equal_nan=True)
            assert np.array_equal(np.signbit(one.astype(float)), np.signbit(two.astype(float)))


def test_helpers() -> None:
    assert split_unit("position [rad]") == ("position", "rad")
    assert split_unit("velocity (rad/s)") == ("velocity", "rad/s")
    assert split_unit("position (filtered)") == ("position (filtered)", None)
    assert split_unit("/joint_states.position[2]") == ("/joint_states.position[2]", None)
    assert split_line('1, "a,b" ,3', ",") == ["1", "a,b", "3"]
    assert is_number("-1,5e-3", ",")
    assert not is_number("1.234,5", ",")
    assert not is_whole("12", ["123", "7"], ".")
    assert is_whole("1.25", ["0.50", "10.75"], ".")
    assert detect_encoding(b"caf\xc3", whole=False) == "utf-8"
    assert detect_encoding(b"caf\xe9 1,2", whole=True) == "cp1252"
    assert detect_encoding(bytes(range(256)), whole=True) is None


FLOATS = st.floats(allow_nan=True, allow_infinity=False)


@settings(max_examples=60, deadline=None, suppress_health_check=[HealthCheck.function_scoped_fixture])
@given(
    rows=st.lists(st.tuples(FLOATS, FLOATS, FLOATS), min_size=1, max_size=8),
    style=st.sampled_from(
        [(",", "."), (";", "."), (";", ","), ("\t", "."), ("\t", ","), ("|", "."), (" ", ".")]
    ),
    end=st.sampled_from(["\n", "\r\n", "\r"]),
    encoding=st.sampled_from(["utf-8", "utf-8-sig", "utf-16"]),
    written=st.sampled_from([repr, "{:.17g}".format, "{:.6f}".format, "{:+.3e}".format]),
    header=st.booleans(),
)
def test_numbers_equal_pythons_own(  # type: ignore[no-untyped-def]
    tmp_path: Path, rows, style, end, encoding, written, header
) -> None:
    delimiter, decimal = style
    cells = [[written(value) for value in row] for row in rows]
    lines = [delimiter.join(cell.replace(".", decimal) for cell in row) for row in cells]
    content = end.join(([delimiter.join(NAMES)] if header else []) + lines) + end
    path = save(tmp_path, content, encoding=encoding)
    sources = list(NAMES) if header else [1, 2, 3]
    try:
        log = CsvReader().read([path], sources)
    except InputError:
        assert all(math.isnan(value) for row in rows for value in row)
        return
    for place, channel in enumerate(log.channels.values()):
        expected = np.array([float(row[place]) for row in cells])
        assert np.array_equal(np.isnan(channel.values), np.isnan(expected))
        good = ~np.isnan(expected)
        assert np.array_equal(channel.values[good].view(np.int64), expected[good].view(np.int64))


@settings(max_examples=60, deadline=None, suppress_health_check=[HealthCheck.function_scoped_fixture])
@given(
    content=st.one_of(
        st.binary(max_size=300), st.text('0123456789.,;\t \n\r#"-eEnaxy', max_size=200).map(str.encode)
    )
)
def test_any_bytes_give_numbers_or_an_input_error(tmp_path: Path, content: bytes) -> None:
    path = save(tmp_path, content)
    try:
        infos = list_channels([path])
        read(path, [info.source for info in infos])
    except InputError:
        return


CELLS = st.sampled_from(
    ["1", "-2.5", "1e+05", "", "NaN", '"7"', "x", "#", "// 1", " 3", "0.25", "-0", "\r", "\0"]
)
LINES = st.lists(CELLS, max_size=4).map(",".join) | st.just("1,2.5,3") | st.just("4,-5,1e+06")


@settings(max_examples=400, deadline=None)
@given(lines=st.lists(LINES, min_size=1, max_size=8), wanted=st.sampled_from([(0,), (1,), (2,), (0, 1, 2)]))
def test_blocks_and_single_lines_are_read_alike(lines: list[str], wanted: tuple[int, ...]) -> None:
    """Whatever stands in a block, the parser's fast way gives what the lines give one by one, or gives up."""
    fields = tuple(Field(name, None, name) for name in "abc")
    dialect = Dialect(",", ".", ("#", "%", "//"), fields, 1)
    read_rows = blocks.RowReader(dialect, "utf-8", wanted, compiled=table._COMPILED == 0)
    sound = b"8,9.5,10\n" * 5
    for block in (sound, ("\n".join(lines) + "\n").encode(), sound):
        rows = read_rows(block)
        slow = blocks._read_any(block, dialect, "utf-8", wanted)
        assert (rows.count, rows.lines, list(rows.bad)) == (slow.count, slow.lines, list(slow.bad))
        for place in wanted:
            one, two = (each.columns[place].astype(float) for each in (rows, slow))
            assert np.array_equal(one, two, equal_nan=True)
            assert np.array_equal(np.signbit(one), np.signbit(two)) or np.isnan(one).any()


@pytest.mark.parametrize(
    ("lines", "fields", "decimal"),
    [
        (
            ["x", "1,5", "2", "3,25", "4"],
            1,
            ",",
        ),  # one column: no semicolon, tab or space tells it from the comma
        (["x", "1.5", "2", "3.25", "4"], 1, "."),
        (["x y", "1,5 2", "2 3", "3,25 4"], 2, ","),
        (["x\ty", "1,5\t2,0", "2,5\t3,0"], 2, ","),
        (["x|y", "1.5|2", "2.5|3"], 2, "."),
    ],
)
def test_delimiters_that_stand_nowhere_are_looked_at_but_once(
    lines: list[str], fields: int, decimal: str
) -> None:
    found = detect(lines, Detect())
    assert (len(found.fields), found.decimal) == (fields, decimal)
