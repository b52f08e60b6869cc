"""The coverage benchmark itself, and a small version of it that can fail."""

from __future__ import annotations

import importlib.util
import json
import math
import sys

import numpy as np
import pytest
from scipy.stats import binom

SMALL = ("175/*/0.1%/white/multisine", "3/*/0.01%/coloured/multisine")
RECORDS = 3


@pytest.fixture(scope="module")
def benchmark(root):
    spec = importlib.util.spec_from_file_location("coverage_benchmark", root / "benchmarks" / "coverage.py")
    module = importlib.util.module_from_spec(spec)
    path = list(sys.path)
    sys.modules["coverage_benchmark"] = module
    spec.loader.exec_module(module)
    yield module
    sys.path[:] = path
    del sys.modules["coverage_benchmark"]


def line(
    benchmark, cell: str, seed: int, *, bias: float = 0.0, spread: float = 1.0, verdict: str = "identified"
):
    """A result line whose errors are ``bias`` and ``spread`` claimed standard errors of 1 % each."""
    machine, encoders, *_ = cell.split("/")
    truth = benchmark.BY_NAME[machine]
    rng = np.random.default_rng([seed, *map(ord, cell)])
    outcome = {"id": encoders, "method": "auto", "band": 5.0}
    for symbol in benchmark.SYMBOLS:
        value = getattr(truth, symbol)
        stderr = 0.01 * value
        estimate = value + stderr * (bias + spread * rng.standard_normal())
        outcome[symbol] = [estimate, stderr, estimate - 1.96 * stderr, estimate + 1.96 * stderr, verdict]
    return {"cell": cell, "seed": seed, "direct": outcome, "paper": outcome, "seconds": 0.5}


def lines(benchmark, records: int, **kwargs):
    cells = [s.cell(e) for s in benchmark.settings() for e in benchmark.ENCODERS]
    return [line(benchmark, cell, seed, **kwargs) for cell in cells for seed in range(records)]


def met(benchmark, records) -> dict[str, bool]:
    return {name: ok for name, ok, _ in benchmark.targets(benchmark.table(records))}


def test_there_are_as_many_cells_as_stated(benchmark):
    cells = {s.cell(e) for s in benchmark.settings() for e in benchmark.ENCODERS}
    assert len(cells) == 2 * 4 * 2 * 2 * 3


def test_right_intervals_meet_every_target(benchmark):
    assert all(met(benchmark, lines(benchmark, 60)).values())


@pytest.mark.parametrize(
    ("fault", "missed"),
    [
        ({"bias": 1.5}, "below 90 %"),
        ({"bias": 1.0}, "below a third"),
        ({"spread": 2.0}, "below 90 %"),
        ({"spread": 0.2}, "93 to 98 %"),
        ({"verdict": "weak"}, "identified in all cells"),
        ({"bias": 4.0}, "within 3 %"),
    ],
)
def test_each_fault_misses_its_target(benchmark, fault, missed):
    found = met(benchmark, lines(benchmark, 40, **fault))
    assert [ok for name, ok in found.items() if missed in name] == [False]


def test_one_bad_cell_is_found_among_many(benchmark):
    records = lines(benchmark, 40)
    bad = records[0]["cell"]
    records = [line(benchmark, bad, r["seed"], bias=3.0) if r["cell"] == bad else r for r in records]
    name, ok, text = benchmark.targets(benchmark.table(records))[0]
    assert not ok
    assert bad in text
    assert text.count("/chirp") + text.count("/multisine") <= 3, name


def test_holm_is_bonferroni_for_the_smallest_and_never_falls(benchmark):
    adjusted = benchmark.holm([0.03, 0.001, 0.5, 0.02])
    assert adjusted == pytest.approx([0.06, 0.004, 0.5, 0.06])


def test_a_run_is_taken_up_where_it_was_left(benchmark, tmp_path):
    results = tmp_path / "coverage.jsonl"
    first = line(benchmark, "3/two_encoders/1%/white/chirp", 0)
    results.write_text(json.dumps(first) + "\n" + json.dumps(first)[:40], encoding="utf-8")
    assert benchmark.read(results) == [first]
    assert benchmark.pending("3/two_encoders/1%/white/chirp", 1, results) == []
    waiting = benchmark.pending("3/two_encoders/1%/white/chirp", 2, results)
    assert [(seed, wanted) for _, seed, wanted in waiting] == [(1, ("two_encoders",))]


def test_a_row_says_what_the_records_say(benchmark):
    records = [line(benchmark, "3/motor_only/1%/white/chirp", seed) for seed in range(400)]
    row = next(r for r in benchmark.table(records) if r.symbol == "K" and r.route == "direct")
    assert (row.records, row.identified) == (400, 400)
    assert abs(row.bias) < 4.0 * row.bias_error
    assert row.spread == pytest.approx(1.0, rel=0.2)
    assert row.claimed == pytest.approx(1.0, rel=1e-9)
    low, high = binom.interval(1.0 - 1e-4, 400, 0.95)
    assert low <= row.held <= high
    assert math.isnan(benchmark.table([line(benchmark, row.cell, 0, verdict="weak")])[0].coverage)


def test_cells_measured_anew_replace_theirs(benchmark, tmp_path):
    old = benchmark.table([line(benchmark, "3/motor_only/1%/white/chirp", 0)])
    other = benchmark.table([line(benchmark, "175/motor_only/1%/white/chirp", s) for s in range(3)])
    path = tmp_path / "coverage.csv"
    benchmark.keep([*old, *other], path)
    new = benchmark.table([line(benchmark, "3/motor_only/1%/white/chirp", s) for s in range(5)])
    rows = benchmark.merged(new, path)
    assert {r.cell: r.records for r in rows} == {
        "175/motor_only/1%/white/chirp": 3,
        "3/motor_only/1%/white/chirp": 5,
    }
    assert rows == sorted(rows, key=lambda r: r.cell)
    kept = next(r for r in rows if r.records == 3 and r.symbol == "K")
    assert kept.spread == pytest.approx(next(r for r in other if r.symbol == "K").spread, rel=1e-5)
    assert benchmark.targets([r for r in rows if r.symbol in benchmark.JUDGED])


def small_version(benchmark, records: int):
    found = []
    for setting in benchmark.settings():
        from fnmatch import fnmatch

        wanted = tuple(e for e in benchmark.ENCODERS if any(fnmatch(setting.cell(e), p) for p in SMALL))
        for seed in range(records if wanted else 0):
            found += benchmark.measure(setting, 10_000 + seed, wanted)
    return found


@pytest.mark.slow
def test_the_small_version_holds(benchmark):
    records = small_version(benchmark, RECORDS)
    rows = [r for r in benchmark.table(records) if r.route == "direct" and r.symbol in benchmark.JUDGED]
    assert all(r.identified == r.records for r in rows)
    # Errors of K and JL go together: a record counts as if its three parameters were two.
    held, trials = sum(r.held for r in rows), sum(r.identified for r in rows)
    missed = (trials - held) * 2 // 3
    assert missed <= binom.ppf(0.999, trials * 2 // 3, 0.10)
    assert all(abs(r.bias) < 1.0 for r in rows)


def test_one_record_goes_through_both_models_and_both_routes(benchmark):
    setting = next(
        s for s in benchmark.settings() if s.cell("two_encoders") == "175/two_encoders/0.1%/white/multisine"
    )
    both = benchmark.measure(setting, 77, benchmark.ENCODERS)
    assert [x["direct"]["id"] for x in both] == ["two_encoders", "motor_only"]
    for found in both:
        value, stderr, low, high, verdict = found["direct"]["K"]
        assert verdict == "identified"
        # Five standard errors and t's longer tail: a rare miss is no failure, a bias is.
        assert abs(value - benchmark.BY_NAME["175"].K) < 6.0 * stderr
        assert low < value < high
    paper = both[1]["paper"]["K"]
    assert (
        not paper[2] <= benchmark.BY_NAME["175"].K <= paper[3] or paper[1] > 10.0 * both[1]["direct"]["K"][1]
    )
