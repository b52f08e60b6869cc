"""Fuzz every reader with damaged logs: only the project's own errors may come out.

Usage: ``python tests/fuzz_readers.py [--seconds 60] [--seed 0] [--keep FOLDER] [READER ...]``

For each reader, small logs are written in all the ways it knows, then bytes are flipped, overwritten, zeroed,
removed, doubled, and files are cut, for the given time; each log is listed and read, with every option. What
fails is kept, with the seed that makes it again. Lengths in a file that are believed show as a MemoryError.

Exit codes: 0 nothing found; 1 some log made a reader fail.
"""

from __future__ import annotations

import argparse
import random
import resource
import shutil
import sys
import tempfile
import time
import traceback
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np

from flexid_cli.errors import FlexidError
from flexid_cli.readers.base import ReadOptions
from flexid_cli.readers.registry import list_channels, read_log
from flexid_cli.writers.registry import write_log
from flexid_cli.writers.table import LogTable

SOURCES = ("/joint_states/motor/position", "/joint_states/motor/effort", "/joint_states/joint/position")
ROWS = 120
ADDRESS_SPACE = 6 << 30  # bytes; what the libraries map is much, what they touch is not
LOGS: dict[str, list[tuple[str, dict[str, Any]]]] = {
    "csv": [("log.csv", {}), ("log.csv.gz", {}), ("log.csv.zst", {})],
    "mcap": [
        ("log.mcap", {}),
        ("log.mcap", {"compression": "lz4", "encoding": "ros2idl"}),
        ("log.mcap", {"compression": "none", "encoding": "json"}),
        ("log.mcap", {"chunked": False, "encoding": "ros1"}),
    ],
    "rosbag2": [
        ("folder", {}),
        ("folder", {"storage": "mcap"}),
        ("folder", {"compression": "file"}),
        ("folder", {"compression": "message"}),
        ("log.db3", {}),
    ],
    "rosbag1": [
        ("log.bag", {}),
        ("log.bag", {"compression": "lz4"}),
        ("log.bag", {"compression": "bz2"}),
    ],
}
OPTIONS = (
    ReadOptions(),
    ReadOptions(keep_suspect=True),
    ReadOptions(strict=True),
    ReadOptions(threads=1),
    ReadOptions(start_s=0.02, end_s=0.05),
)
NUMBERS = (0, 1, 0x7F, 0xFF, 0x7FFFFFFF, 0xFFFFFFFF, 0x7FFFFFFFFFFFFFFF, 0xFFFFFFFFFFFFFFFF)


@dataclass(frozen=True)
class Failure:
    """A log that made a reader fail, and how."""

    reader: str
    seed: int
    path: Path
    trace: str


def table() -> LogTable:
    """What the logs hold before they are damaged."""
    rng = np.random.default_rng(5)
    stamps = 1_700_000_000_000_000_000 + 1_000_000 * np.arange(ROWS, dtype=np.int64)
    return LogTable(stamps, {source: rng.normal(size=ROWS) for source in SOURCES})


# --- mutations ------------------------------------------------------------


def flip(data: bytearray, rng: random.Random) -> None:
    """Flip one bit."""
    data[rng.randrange(len(data))] ^= 1 << rng.randrange(8)


def number(data: bytearray, rng: random.Random) -> None:
    """Write a number that a length or an offset may be."""
    place, size = rng.randrange(len(data)), rng.choice((1, 2, 4, 8))
    value = rng.choice((*NUMBERS, len(data), len(data) - place, rng.getrandbits(64)))
    data[place : place + size] = (value & (1 << 8 * size) - 1).to_bytes(size, rng.choice(("little", "big")))


def overwrite(data: bytearray, rng: random.Random) -> None:
    """Overwrite a stretch by zeros, ones, or noise."""
    place, size = _stretch(data, rng)
    data[place : place + size] = rng.choice((bytes(size), b"\xff" * size, rng.randbytes(size)))


def remove(data: bytearray, rng: random.Random) -> None:
    """Remove a stretch."""
    place, size = _stretch(data, rng)
    del data[place : place + size]


def double(data: bytearray, rng: random.Random) -> None:
    """Put a stretch somewhere else too."""
    place, size = _stretch(data, rng)
    other = rng.randrange(len(data))
    data[other:other] = data[place : place + size]


def cut(data: bytearray, rng: random.Random) -> None:
    """Cut the end off."""
    del data[rng.randrange(len(data)) :]


def append(data: bytearray, rng: random.Random) -> None:
    """Append something."""
    data += rng.choice((bytes(rng.randrange(5000)), rng.randbytes(rng.randrange(200)), bytes(data[:300])))


MUTATIONS: Sequence[Callable[[bytearray, random.Random], None]] = (
    flip, flip, flip, number, number, overwrite, remove, double, cut, append,
)  # fmt: skip


def _stretch(data: bytearray, rng: random.Random) -> tuple[int, int]:
    return rng.randrange(len(data)), rng.choice((1, 2, 8, 50, 400, 4096, len(data) // 3 + 1))


def damage(content: bytes, rng: random.Random) -> bytes:
    """Return a damaged copy."""
    data = bytearray(content)
    for _ in range(rng.choice((1, 1, 1, 2, 5))):
        if data:
            rng.choice(MUTATIONS)(data, rng)
    return bytes(data)


# --- the loop ------------------------------------------------------------


def write_logs(reader: str, folder: Path) -> list[Path]:
    """Write a log in every way that a reader knows."""
    logs = []
    for place, (name, options) in enumerate(LOGS[reader]):
        home = folder / reader / str(place)
        home.mkdir(parents=True)
        write_log(home / name, table(), **options)
        logs.append(home / name)
    return logs


def damaged_copy(log: Path, folder: Path, rng: random.Random) -> Path:
    """Copy a log to ``folder`` and damage the copy, or one file of it."""
    target = folder / log.name
    if log.is_dir():
        shutil.copytree(log, target)
    else:
        shutil.copy(log, target)
    files = sorted(target.iterdir()) if target.is_dir() else [target]
    chosen = rng.choice([*files, max(files, key=lambda file: file.stat().st_size)])
    chosen.write_bytes(damage(chosen.read_bytes(), rng))
    return target


def try_reading(path: Path, rng: random.Random) -> str | None:
    """List and read a log; return the trace of what may not come out."""
    for call in (
        partial(list_channels, [path]),
        partial(read_log, [path], SOURCES, options=rng.choice(OPTIONS)),
    ):
        try:
            call()
        except FlexidError:
            continue
        except (Exception, RecursionError):  # noqa: BLE001 - that is what is looked for
            return traceback.format_exc()
    return None


def fuzz(reader: str, seconds: float, seed: int, folder: Path, keep: Path | None = None) -> list[Failure]:
    """Fuzz one reader for a time.

    Parameters
    ----------
    reader : str
        Its name, a key of ``LOGS``.
    seconds : float
        How long; at least one log is read.
    seed : int
        Of the first log; every further one has the next.
    folder : Path
        For the logs.
    keep : Path, optional
        Where logs that made the reader fail are kept.
    """
    logs = write_logs(reader, folder)
    failures: list[Failure] = []
    end = time.monotonic() + seconds
    while True:
        rng = random.Random(seed)
        home = Path(tempfile.mkdtemp(dir=folder))
        path = damaged_copy(rng.choice(logs), home, rng)
        trace = try_reading(path, rng)
        if trace is not None:
            kept = path if keep is None else keep / f"{reader}_{seed}"
            if keep is not None:
                shutil.copytree(home, kept, dirs_exist_ok=True)
            failures.append(Failure(reader, seed, kept, trace))
        shutil.rmtree(home)
        seed += 1
        if time.monotonic() >= end:
            break
    return failures


def main() -> int:
    """Fuzz the readers, and say by the exit code whether something was found."""
    parser = argparse.ArgumentParser(description=(__doc__ or "").splitlines()[0])
    parser.add_argument("readers", nargs="*", metavar="READER", help=", ".join(LOGS))
    parser.add_argument("--seconds", type=float, default=60.0, help="for each reader; default: 60")
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--keep", type=Path, help="folder for logs that made a reader fail")
    options = parser.parse_args()
    if set(options.readers) - set(LOGS):
        parser.error(f"there is no reader {min(set(options.readers) - set(LOGS))!r}")
    resource.setrlimit(resource.RLIMIT_AS, (ADDRESS_SPACE, ADDRESS_SPACE))
    found: list[Failure] = []
    for reader in options.readers or LOGS:
        with tempfile.TemporaryDirectory() as temporary:
            failures = fuzz(reader, options.seconds, options.seed, Path(temporary), options.keep)
        print(f"{reader}: {len(failures)} failures in {options.seconds:g} s")
        found += failures
    distinct = {one.trace.rpartition("\n  File")[2].partition("\n")[0]: one for one in found}
    for one in distinct.values():
        print(f"\n{one.reader}, seed {one.seed}, {one.path}\n{one.trace}")
    return int(bool(found))


if __name__ == "__main__":
    sys.exit(main())
