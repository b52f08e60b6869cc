"""Samples that physics does not allow: found where they are damage, and nearly never on sound recordings."""

from __future__ import annotations

import csv
import gzip
from pathlib import Path

import numpy as np
import pytest

from flexid_cli.readers.plausibility import lone_jumps, misplaced_stamps

RNG = np.random.default_rng(3)
TIME = np.arange(5000) * 1e-3
SIGNALS = {
    "encoder": np.round(4000 * np.sin(3 * TIME)) / 4000,
    "noisy torque": np.sign(np.cos(3 * TIME)) + 0.1 * RNG.normal(size=TIME.size),
    "heavy tails": RNG.standard_t(3, size=TIME.size),
    "steps": np.floor(TIME * 3),
    "wrapping angle": np.mod(7 * TIME, 2 * np.pi),
    "at rest, then moving": np.where(TIME > 4, np.sin(9 * (TIME - 4)), 0.0),
    "pulses of one sample": (np.arange(TIME.size) % 100 == 0) * 1.0,
    "constant": np.zeros(TIME.size),
    "missing values": np.where(np.arange(TIME.size) % 7 == 0, np.nan, np.sin(TIME)),
}


def flipped(values: np.ndarray, place: int, bit: int) -> np.ndarray:
    changed = values.copy()
    changed.view(np.uint64)[place] ^= np.uint64(1 << bit)
    return changed


@pytest.mark.parametrize("name", SIGNALS)
def test_sound_signals_are_left_alone(name: str) -> None:
    assert not lone_jumps(SIGNALS[name]).any()


@pytest.mark.parametrize("name", ["encoder", "noisy torque", "wrapping angle", "missing values"])
@pytest.mark.parametrize("bit", [62, 61, 60])
def test_flipped_exponents_are_found_alone(name: str, bit: int) -> None:
    values = SIGNALS[name]
    place = 2501
    changed = flipped(values, place, bit)
    if np.isnan(changed[place]) or abs(changed[place]) < 30:
        changed[place] = 1e9
    assert np.flatnonzero(lone_jumps(changed)).tolist() == [place]


def test_neighbours_that_are_both_wrong_are_found() -> None:
    values = SIGNALS["encoder"].copy()
    values[[700, 701, 3000]] = [1e200, 1e150, -np.inf]
    assert np.flatnonzero(lone_jumps(values)).tolist() == [700, 701, 3000]


def test_few_samples_are_not_judged() -> None:
    assert not lone_jumps(np.array([0.0] * 100 + [1e9] + [0.0] * 100)).any()
    assert lone_jumps(np.empty(0)).size == 0


def test_stamps() -> None:
    stamps = (np.arange(5000) * 1_000_000 + RNG.integers(0, 300_000, 5000)).astype(np.int64)
    assert not misplaced_stamps(stamps).any()
    set_back = stamps.copy()
    set_back[2000:] -= 5_000_000_000
    assert not misplaced_stamps(set_back).any()
    overtaking = stamps.copy()
    overtaking[1::2] -= 1_500_000
    assert not misplaced_stamps(overtaking).any()
    for bit in (40, 50, 62):
        changed = stamps.copy()
        changed[1234] ^= 1 << bit
        assert np.flatnonzero(misplaced_stamps(changed)).tolist() == [1234]


def columns(path: Path) -> dict[str, np.ndarray]:
    with gzip.open(path, "rt", encoding="utf-8") as stream:
        rows = csv.reader(stream)
        names = next(rows)
        table = np.array([[float(cell) if cell else np.nan for cell in row] for row in rows])
    return {name: np.ascontiguousarray(table[:, k]) for k, name in enumerate(names)}


def test_real_recordings_raise_no_alarm_and_hide_few_flips(recordings: Path) -> None:
    """No sample of the real recordings is suspect; of the flips that change a sample by a tenth, 9 of 10 are."""
    rng = np.random.default_rng(11)
    large = found = 0
    for path in sorted((recordings / "real").glob("*.csv.gz")):
        for name, values in columns(path).items():
            assert not lone_jumps(values).any(), (path.name, name)
            for _ in range(12):
                place = int(rng.integers(2, values.size - 2))
                changed = flipped(values, place, int(rng.integers(50, 64)))
                with np.errstate(over="ignore", invalid="ignore"):
                    if abs(changed[place] - values[place]) > 0.1 * np.nanstd(values):
                        large += 1
                        found += bool(lone_jumps(changed)[place])
    assert large > 100
    assert found > 0.85 * large


@pytest.mark.slow
def test_simulated_recordings_raise_no_alarm(recordings: Path) -> None:
    for path in sorted((recordings / "simulated").glob("*/*/*.csv.gz")):
        for name, values in columns(path).items():
            assert not lone_jumps(values).any(), (path.parent.name, path.name, name)
