"""The fuzz targets run for a moment; ``python tests/fuzz_readers.py --seconds 60`` is for the night."""

from __future__ import annotations

import random
import sys
from pathlib import Path

import pytest

sys.path.insert(0, str(Path(__file__).resolve().parents[1]))

import fuzz_readers


@pytest.mark.parametrize("reader", fuzz_readers.LOGS)
def test_only_own_errors_come_out(reader: str, tmp_path: Path) -> None:
    failures = fuzz_readers.fuzz(reader, 1.0, 0, tmp_path)
    assert not failures, failures[0].trace


@pytest.mark.parametrize("reader", fuzz_readers.LOGS)
def test_sound_logs_are_read(reader: str, tmp_path: Path) -> None:
    """Otherwise the fuzzing would only exercise the first error."""
    for path in fuzz_readers.write_logs(reader, tmp_path):
        log = fuzz_readers.read_log([path], fuzz_readers.SOURCES)
        assert all(channel.values.size == fuzz_readers.ROWS for channel in log.channels.values())


def test_a_failure_is_found_and_kept(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    def fail(_paths: object) -> None:
        raise KeyError("a mistake")

    monkeypatch.setattr(fuzz_readers, "list_channels", fail)
    found = fuzz_readers.fuzz("csv", 0.0, 7, tmp_path / "work", tmp_path / "kept")
    assert [one.seed for one in found] == [7]
    assert "a mistake" in found[0].trace
    assert any(found[0].path.iterdir())


def test_every_mutation_changes_something() -> None:
    for mutate in set(fuzz_readers.MUTATIONS):
        rng = random.Random(4)
        content = bytes(range(1, 201))
        changed = [bytearray(content) for _ in range(20)]
        for data in changed:
            mutate(data, rng)
        assert any(data != content for data in changed), mutate
