"""Speed and memory of reading logs, against the limit of what must be done and against other readers.

Usage: ``python benchmarks/reading.py [--messages 200000] [--rounds 5] [--logs FOLDER] [NAME ...]``

Wanted are the stamps, and position and effort of one joint, of JointState messages that ``make_logs.py`` writes
into every container; of a table of ten times as many rows, three of four columns. Everything runs in a process
of its own, for its peak memory: it imports, reads a tiny log of the same kind so that nothing is loaded later,
and then reads the log once, which is timed; what was read is compared with what was written. In every round each
candidate runs once, one after the other, in an order that rotates, and ratios are taken within a round; a bound
is broken where the median of these and the ratio of the fastest runs both say so. Readers that take a thousand times
as long as a round of the others run in the first round only.

``limit`` is the work that no reader can avoid, in one thread: read the file, unpack its chunks, compare their
checksums; for sqlite3, fetch the payloads. ``flexid 1`` is this reader on one thread, ``flexid`` on all cores.

Exit codes: 0 all within their limits; 1 some are not; 2 a candidate failed or read something else.
"""

from __future__ import annotations

import argparse
import importlib.util
import json
import os
import resource
import statistics
import struct
import subprocess
import sys
import tempfile
import time
import zlib
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

ROOT = Path(__file__).resolve().parents[1]
sys.path[:0] = [str(ROOT), str(ROOT / "benchmarks")]

import make_logs  # noqa: E402 - beside this file

Read = tuple[list[NDArray[np.generic]], int]  # stamps, position, effort; and the bytes of all arrays kept
TINY = 300
SMALL = 200_000
# Opening a log, looking at its topics and compiling their layout does not grow with the log; where a log is
# read in less than a tenth of a second, this much is granted for it.
FIXED_S = 0.06
MEMORY_MB = 150.0
FORMATS = tuple(make_logs.MAKERS)
MCAP = tuple(name for name in FORMATS if name.startswith("mcap"))
ROS = tuple(name for name in FORMATS if name not in {"csv", "mcap_json"})


# --- the candidates ------------------------------------------------------------


def flexid(path: Path, threads: int | None = None) -> Read:
    """Read with this project's reader."""
    from flexid_cli.readers.base import ReadOptions
    from flexid_cli.readers.registry import read_log

    is_table = path.suffix == ".csv"
    sources = make_logs.WANTED_COLUMNS if is_table else make_logs.SOURCES
    log = read_log([path], sources, options=ReadOptions(threads=threads))
    channels = list(log.channels.values())
    arrays = [channel.values for channel in channels]
    if not is_table:
        arrays.insert(0, channels[0].stamps["log_time"])
    kept = {id(a): a.nbytes for c in channels for a in (c.values, *c.stamps.values())}
    return arrays, sum(kept.values())


def flexid_1(path: Path) -> Read:
    """Read with this project's reader on one thread."""
    return flexid(path, 1)


def _kept(arrays: Sequence[object]) -> Read:
    found = [np.asarray(values) for values in arrays]
    return found, sum(values.nbytes for values in found)


def mcap_library(path: Path) -> Read:
    """Read with the mcap package and its decoder, or with json."""
    from mcap.reader import make_reader

    stamps, position, effort = [], [], []
    with path.open("rb") as stream:
        if path.stem == "json":
            for _, _, raw in make_reader(stream).iter_messages(topics=[make_logs.TOPIC]):
                message = json.loads(raw.data)
                place = message["name"].index(make_logs.JOINTS[make_logs.JOINT])
                stamps.append(raw.log_time)
                position.append(message["position"][place])
                effort.append(message["effort"][place])
            return _kept((stamps, position, effort))
        from mcap_ros2.decoder import DecoderFactory

        reader = make_reader(stream, decoder_factories=[DecoderFactory()])
        for _, _, raw, message in reader.iter_decoded_messages(topics=[make_logs.TOPIC]):
            place = message.name.index(make_logs.JOINTS[make_logs.JOINT])
            stamps.append(raw.log_time)
            position.append(message.position[place])
            effort.append(message.effort[place])
    return _kept((stamps, position, effort))


def rosbags(path: Path) -> Read:
    """Read with rosbags."""
    from rosbags.highlevel import AnyReader
    from rosbags.typesys import Stores, get_typestore

    stamps, position, effort = [], [], []
    with AnyReader([path], default_typestore=get_typestore(Stores.ROS2_HUMBLE)) as reader:
        wanted = [one for one in reader.connections if one.topic == make_logs.TOPIC]
        for connection, stamp, data in reader.messages(wanted):
            message = reader.deserialize(data, connection.msgtype)
            place = message.name.index(make_logs.JOINTS[make_logs.JOINT])
            stamps.append(stamp)
            position.append(message.position[place])
            effort.append(message.effort[place])
    return _kept((stamps, position, effort))


def pandas(path: Path) -> Read:
    """Read a table with pandas."""
    import pandas as pd

    frame = pd.read_csv(path, usecols=list(make_logs.WANTED_COLUMNS))
    return _kept([frame[name].to_numpy() for name in make_logs.WANTED_COLUMNS])


def pandas_chunks(path: Path) -> Read:
    """Read a table with pandas, half a million rows at a time."""
    import pandas as pd

    parts: dict[str, list[NDArray[np.generic]]] = {name: [] for name in make_logs.WANTED_COLUMNS}
    for frame in pd.read_csv(path, usecols=list(parts), chunksize=500_000):
        for name, values in parts.items():
            values.append(frame[name].to_numpy())
    return _kept([np.concatenate(parts.pop(name)) for name in make_logs.WANTED_COLUMNS])


def polars(path: Path) -> Read:
    """Read a table with polars."""
    import polars as pl

    frame = pl.read_csv(path, columns=list(make_logs.WANTED_COLUMNS))
    return _kept([frame[name].to_numpy() for name in make_logs.WANTED_COLUMNS])


def pyarrow(path: Path) -> Read:
    """Read a table with pyarrow."""
    from pyarrow import csv

    options = csv.ConvertOptions(include_columns=list(make_logs.WANTED_COLUMNS))
    table = csv.read_csv(path, convert_options=options)
    return _kept([table[name].to_numpy() for name in make_logs.WANTED_COLUMNS])


# --- the limit ------------------------------------------------------------


def limit(path: Path) -> Read:
    """Do what every reader must do."""
    if "unchunked" in path.stem:
        with path.open("rb", buffering=0) as stream:
            while stream.read(1 << 20):
                pass
    elif path.suffix == ".mcap":
        _limit_mcap(path)
    elif path.suffix == ".bag":
        _limit_bag(path)
    else:
        _limit_sqlite(path)
    return [], 0


def _limit_mcap(path: Path) -> None:
    import lz4.frame
    import zstandard

    unpack: dict[bytes, Callable[[bytes], bytes]] = {
        b"zstd": zstandard.ZstdDecompressor().decompress,
        b"lz4": lz4.frame.decompress,
        b"": bytes,
    }
    with path.open("rb", buffering=0) as stream:
        stream.seek(8)
        while len(head := stream.read(9)) == 9:
            size = int.from_bytes(head[1:], "little")
            if head[0] != 6:
                stream.seek(size, os.SEEK_CUR)
                continue
            _, _, _, crc, length = struct.unpack("<QQQII", (record := stream.read(size))[:32])
            codec = record[32 : 32 + length]
            plain = unpack[codec](memoryview(record)[40 + length :])
            if crc and zlib.crc32(plain) != crc:
                raise ValueError("wrong checksum")


def _limit_bag(path: Path) -> None:
    import bz2

    import lz4.frame

    unpack: dict[bytes, Callable[[bytes], bytes]] = {
        b"lz4": lz4.frame.decompress,
        b"bz2": bz2.decompress,
        b"none": bytes,
    }
    with path.open("rb", buffering=0) as stream:
        stream.seek(13)
        while len(size := stream.read(4)) == 4:
            header = stream.read(int.from_bytes(size, "little"))
            data = stream.read(int.from_bytes(stream.read(4), "little"))
            if b"op=\x05" in header:
                start = header.index(b"compression=") + len(b"compression=")
                unpack[next(name for name in unpack if header.startswith(name, start))](data)


def _limit_sqlite(path: Path) -> None:
    import sqlite3

    (storage,) = path.glob("*.db3")
    database = sqlite3.connect(storage)
    cursor = database.execute("SELECT data FROM messages")
    while cursor.fetchmany(1000):
        pass
    database.close()


@dataclass(frozen=True)
class Candidate:
    """Something that reads a log."""

    name: str
    read: Callable[[Path], Read]
    formats: Sequence[str]
    needs: str | None = None
    slow: bool = False


CANDIDATES = (
    Candidate("limit", limit, [name for name in FORMATS if name != "csv"]),
    Candidate("flexid 1", flexid_1, FORMATS),
    Candidate("flexid", flexid, FORMATS),
    Candidate("mcap", mcap_library, MCAP, "mcap_ros2", slow=True),
    Candidate("rosbags", rosbags, ROS, slow=True),
    Candidate("pandas", pandas, ["csv"]),
    Candidate("pandas chunks", pandas_chunks, ["csv"]),
    Candidate("polars", polars, ["csv"], "polars"),
    Candidate("pyarrow", pyarrow, ["csv"], "pyarrow"),
)


# --- one measurement ------------------------------------------------------------


@dataclass(frozen=True)
class Measured:
    """One run of one candidate."""

    seconds: float
    peak_mb: float
    kept_mb: float


def measure(candidate: Candidate, path: Path, tiny: Path, messages: int) -> None:
    """Run a candidate in this process, and print what was measured as JSON.

    pandas loads pyarrow where it is there, for nothing that is measured here: only who needs it gets to see it.
    """
    if candidate.needs != "pyarrow":
        sys.modules["pyarrow"] = None  # type: ignore[assignment]
    candidate.read(tiny)
    start = time.perf_counter()
    arrays, kept = candidate.read(path)
    seconds = time.perf_counter() - start
    peak = peak_mb()  # before the truth is made
    if arrays and not agrees(arrays, path, messages):
        raise SystemExit(f"{candidate.name} read something else than was written")
    print(json.dumps({"seconds": seconds, "peak_mb": peak, "kept_mb": kept / 1e6}))


def peak_mb() -> float:
    """Peak memory of this process since it was started."""
    status = Path("/proc/self/status")
    if status.exists():  # the other one counts what the parent had before this program was loaded
        (line,) = (line for line in status.read_text().splitlines() if line.startswith("VmHWM:"))
        return int(line.split()[1]) * 1024 / 1e6
    unit = 1 if sys.platform == "darwin" else 1024
    return resource.getrusage(resource.RUSAGE_SELF).ru_maxrss * unit / 1e6


def agrees(arrays: Sequence[NDArray[np.generic]], path: Path, messages: int) -> bool:
    """Whether what was read is what was written: bit by bit, or as rounded in the text of a table."""
    if path.suffix == ".csv":
        start = 0
        for rows in make_logs.table_rows(make_logs.ROWS_PER_MESSAGE * messages):
            stop = start + len(rows)
            for values, column in zip(arrays, (0, 1, 3), strict=True):
                if not np.allclose(values[start:stop], rows[:, column], rtol=1e-15, atol=1e-12):
                    return False
            start = stop
        return all(values.size == start for values in arrays)
    count = messages // 5 if path.stem == "mixed" else messages
    return all(map(np.array_equal, arrays, make_logs.truth(count)))


def run(candidate: Candidate, name: str, path: Path, tiny: Path, messages: int) -> Measured:
    """Run a candidate in a process of its own."""
    vector = [sys.executable, __file__, "--messages", str(messages), "--measure", candidate.name, name]
    done = subprocess.run([*vector, str(path), str(tiny)], capture_output=True, text=True, check=False)
    if done.returncode:
        raise RuntimeError(f"{candidate.name} on {name} failed:\n{done.stderr}")
    return Measured(**json.loads(done.stdout))


# --- rounds ------------------------------------------------------------

Table = dict[tuple[str, str], list[Measured]]


def installed(candidate: Candidate) -> bool:
    """Whether what it needs is installed."""
    return candidate.needs is None or importlib.util.find_spec(candidate.needs) is not None


def measure_all(names: Sequence[str], options: argparse.Namespace, folder: Path) -> Table:
    """Run all rounds; a list in the table has one entry per round in which the candidate ran."""
    logs = {name: make_logs.make(name, folder, options.messages) for name in names}
    tiny = {name: make_logs.make(name, folder, TINY) for name in names}
    table: Table = {}
    for number in range(options.rounds):
        for name in names:
            here = [one for one in CANDIDATES if name in one.formats and installed(one)]
            here = [one for one in here if not one.slow or (number == 0 and not options.fast_only)]
            turn = number % len(here)
            for one in here[turn:] + here[:turn]:
                measured = run(one, name, logs[name], tiny[name], options.messages)
                table.setdefault((name, one.name), []).append(measured)
    return table


def ratio(table: Table, name: str, one: str, other: str, spare_s: float = 0.0) -> float:
    """Median over the rounds of the ratio of two candidates' times."""
    pairs = zip(table[name, one], table[name, other], strict=False)
    return statistics.median(max(a.seconds - spare_s, 1e-9) / b.seconds for a, b in pairs)


def surely(table: Table, name: str, one: str, other: str, spare_s: float = 0.0) -> float:
    """Ratio that a bound is compared with: the median over the rounds, or that of the fastest runs if it is less.

    Whatever else a machine does makes single runs longer, never shorter: what is slow by itself is slow in its
    fastest run too. A log read in a tenth of a second differs by a factor of three from round to round.
    """
    fastest, least = (min(entry.seconds for entry in table[name, who]) for who in (one, other))
    return min(ratio(table, name, one, other, spare_s), max(fastest - spare_s, 1e-9) / least)


def show(table: Table, names: Sequence[str], messages: int) -> None:
    """Print the table."""
    print(f"{messages} messages, {os.cpu_count()} cores; medians; memory in MB")
    print(f"{'log':<16}{'reader':<15}{'s':>9}{'x limit':>9}{'x flexid':>9}{'peak':>8}{'- arrays':>9}")
    for name in names:
        for one in CANDIDATES:
            runs = table.get((name, one.name))
            if runs is None:
                if name in one.formats:
                    print(f"{name:<16}{one.name:<15}  {'' if installed(one) else 'not installed, '}skipped")
                continue
            seconds = statistics.median(entry.seconds for entry in runs)
            peak = statistics.median(entry.peak_mb for entry in runs)
            above = statistics.median(entry.peak_mb - entry.kept_mb for entry in runs)
            to_limit = f"{ratio(table, name, one.name, 'limit'):.2f}" if (name, "limit") in table else ""
            to_flexid = f"{ratio(table, name, one.name, 'flexid'):.2f}"
            print(
                f"{name:<16}{one.name:<15}{seconds:>9.3f}{to_limit:>9}{to_flexid:>9}{peak:>8.0f}{above:>9.0f}"
            )


# --- what must hold ------------------------------------------------------------


@dataclass(frozen=True)
class Bound:
    """``one`` takes at most ``most`` times as long as ``other``."""

    log: str
    one: str
    most: float
    other: str


BOUNDS = (
    Bound("mcap_zstd", "flexid 1", 1.3, "limit"),
    Bound("mcap_zstd", "flexid", 1.0, "limit"),
    Bound("mcap_zstd", "flexid", 1 / 30, "rosbags"),
    Bound("mcap_zstd", "flexid", 1 / 50, "mcap"),
    Bound("mcap_lz4", "flexid 1", 1.5, "limit"),
    Bound("mcap_none", "flexid 1", 1.5, "limit"),
    Bound("sqlite3", "flexid", 1.1, "limit"),
    Bound("bag_lz4", "flexid 1", 1.3, "limit"),
    Bound("mcap_mixed", "flexid 1", 1.8, "limit"),
    Bound("mcap_json", "flexid", 1 / 5, "mcap"),
    Bound("csv", "flexid", 1.2, "pandas"),
    Bound("csv", "flexid", 1.2, "pandas chunks"),
    Bound("csv", "flexid", 1.2, "polars"),
    Bound("csv", "flexid", 1.2, "pyarrow"),
)
UNCHUNKED_S = 0.6  # for a million messages


def failures(table: Table, messages: int, looser: float) -> Iterator[str]:
    """Yield what does not hold."""
    spare = FIXED_S if messages < SMALL else 0.0
    for bound in BOUNDS:
        if (bound.log, bound.one) not in table or (bound.log, bound.other) not in table:
            continue
        found = surely(table, bound.log, bound.one, bound.other, spare)
        if found > looser * bound.most:
            yield f"{bound.log}: {bound.one} / {bound.other} is {found:.3g}, above {looser * bound.most:.3g}"
    yield from _slow_unchunked(table, messages, spare, looser)
    yield from _much_memory(table, messages)


def _slow_unchunked(table: Table, messages: int, spare: float, looser: float) -> Iterator[str]:
    runs = table.get(("mcap_unchunked", "flexid"))
    if runs:
        seconds = (statistics.median(one.seconds for one in runs) - spare) * 1e6 / messages
        if seconds > looser * UNCHUNKED_S:
            yield f"mcap_unchunked: {seconds:.3g} s for a million messages, above {looser * UNCHUNKED_S:g} s"


def _much_memory(table: Table, messages: int) -> Iterator[str]:
    for (name, one), runs in table.items():
        above = statistics.median(entry.peak_mb - entry.kept_mb for entry in runs)
        if one.startswith("flexid") and above > MEMORY_MB:
            yield f"{name}: {one} takes {above:.0f} MB beside its arrays, above {MEMORY_MB:g} MB"
    peaks = {
        one: statistics.median(entry.peak_mb for entry in runs)
        for (name, one), runs in table.items()
        if name == "csv"
    }
    others = [peak for one, peak in peaks.items() if not one.startswith("flexid")]
    if messages >= SMALL and others and peaks["flexid"] > min(others):  # else it is that of the imports
        yield f"csv: flexid's peak is {peaks['flexid']:.0f} MB, above the leanest other's {min(others):.0f} MB"


def main() -> int:
    """Measure, print a table, and say by the exit code whether the limits hold."""
    parser = argparse.ArgumentParser(description=(__doc__ or "").splitlines()[0])
    parser.add_argument("names", nargs="*", metavar="NAME", help=", ".join(FORMATS))
    parser.add_argument("--messages", type=int, default=SMALL, help=f"default: {SMALL}")
    parser.add_argument("--rounds", type=int, default=5, help="default: 5")
    parser.add_argument("--logs", type=Path, help="folder that keeps the logs; default: a temporary one")
    parser.add_argument("--looser", type=float, default=1.0, help="factor on all limits, for a busy machine")
    parser.add_argument("--fast-only", action="store_true", help="leave out mcap and rosbags")
    parser.add_argument("--measure", metavar="CANDIDATE", help=argparse.SUPPRESS)
    options = parser.parse_args()
    if options.measure:
        candidate = next(one for one in CANDIDATES if one.name == options.measure)
        measure(candidate, Path(options.names[1]), Path(options.names[2]), options.messages)
        return 0
    names = options.names or FORMATS
    if set(names) - set(FORMATS):
        parser.error(f"there is no log {min(set(names) - set(FORMATS))!r}")
    with tempfile.TemporaryDirectory() as temporary:
        try:
            table = measure_all(names, options, options.logs or Path(temporary))
        except RuntimeError as error:
            sys.stderr.write(f"{error}\n")
            return 2
    show(table, names, options.messages)
    failed = list(failures(table, options.messages, options.looser))
    for line in failed:
        print(f"FAILED {line}")
    return int(bool(failed))


if __name__ == "__main__":
    sys.exit(main())
