"""Cleaning of clocks: resets, disorder, duplicates, rounding, gaps."""

from __future__ import annotations

import numpy as np
import pytest

from flexid_cli.errors import InputError
from flexid_cli.signals.timebase import (
    build_timelines,
    choose_clock,
    common_intervals,
    find_resets,
    fixed_rate_stamps,
    grid_instants,
    is_usable,
    make_track,
    to_nanoseconds,
)

MS = 1_000_000


def regular(samples: int, period: int = MS, start: int = 0) -> np.ndarray:
    return start + period * np.arange(samples, dtype=np.int64)


def clean(stamps: np.ndarray, max_gap_s: float | None = None):
    return build_timelines([("x", stamps, None)], max_gap_s)[0]


def track(stamps: np.ndarray, values: np.ndarray | None = None, max_gap_s: float | None = None):
    values = np.arange(stamps.size, dtype=float) if values is None else values
    return make_track("motor_position", "q", "column", clean(stamps, max_gap_s), values, max_gap_s)


class TestNanoseconds:
    def test_seconds_are_rounded_to_the_nanosecond(self):
        stamps, valid = to_nanoseconds(np.array([0.001000024, 0.3, np.nan, np.inf]), 1.0)
        assert stamps.tolist() == [1000024, 300000000, 0, 0]
        assert valid.tolist() == [True, True, False, False]

    @pytest.mark.parametrize("factor", [1.0, 1e-3, 1e-6, 1e-9])
    def test_all_units_give_the_same(self, factor):
        seconds = np.arange(1000) * 0.00285
        stamps, _ = to_nanoseconds(seconds / factor, factor)
        assert np.array_equal(stamps, np.arange(1000) * 2850000)

    def test_beyond_int64_is_not_valid(self):
        assert not to_nanoseconds(np.array([1.7e18]), 1.0)[1].any()


class TestChoice:
    good = regular(5, start=10**18)
    zero = np.zeros(5, dtype=np.int64)

    def test_header_stamp_is_the_default(self):
        name, reason = choose_clock({"a": {"log_time": self.good, "header_stamp": self.good}}, None)
        assert name == "header_stamp"
        assert "default" in reason

    @pytest.mark.parametrize("bad", [zero, np.full(5, 7)])
    def test_a_standing_header_clock_is_left(self, bad):
        name, reason = choose_clock({"a": {"header_stamp": bad, "log_time": self.good}}, None)
        assert name == "log_time"
        assert "header_stamp is not usable" in reason

    def test_one_signal_without_header_moves_all_to_log_time(self):
        both = {"header_stamp": self.good, "log_time": self.good}
        name, reason = choose_clock({"a": both, "b": {"log_time": self.good}}, None)
        assert name == "log_time"
        assert "b has none" in reason

    def test_configured_clock_must_exist_and_run(self):
        with pytest.raises(InputError, match="recorded without") as caught:
            choose_clock({"a": {"log_time": self.good}}, "header_stamp")
        assert "log_time" in caught.value.hint
        with pytest.raises(InputError, match="does not run"):
            choose_clock({"a": {"header_stamp": self.zero, "log_time": self.good}}, "header_stamp")

    def test_no_clock_at_all(self):
        with pytest.raises(InputError, match="no clock"):
            choose_clock({"a": {"log_time": self.zero}}, None)

    def test_mostly_unset_stamps_are_not_usable(self):
        assert not is_usable(np.array([0, 0, 0, 5], dtype=np.int64))
        assert is_usable(np.array([0, 1, 2, 5], dtype=np.int64))


class TestResets:
    def test_clock_that_starts_again(self):
        stamps = np.concatenate([regular(1000), regular(600)])
        assert find_resets(stamps, 3.5 * MS) == [1000]

    def test_clock_that_starts_far_before(self):
        stamps = np.concatenate([regular(500, start=10**11), regular(500)])
        assert find_resets(stamps, 3.5 * MS) == [500]

    def test_small_step_back_that_goes_on_from_there(self):
        stamps = np.concatenate([regular(1000), regular(1000, start=1000 * MS - 20 * MS)])
        assert find_resets(stamps, 3.5 * MS) == [1000]

    def test_long_stretch_that_ends_over_a_short_one(self):
        stamps = np.concatenate([regular(100), regular(1400, start=-400 * MS)])
        assert find_resets(stamps, 3.5 * MS) == [100]

    def test_step_back_of_two_samples_is_disorder(self):
        stamps = np.concatenate([regular(1000), regular(1000, start=998 * MS)])
        assert find_resets(stamps, 3.5 * MS) == []

    def test_late_sample_late_block_and_swapped_files_are_disorder(self):
        late = regular(1000)
        late[200:261] = np.concatenate([late[201:261], late[200:201]])
        assert find_resets(late, 3.5 * MS) == []
        blocks = regular(1000).reshape(10, 100)[[0, 2, 1, 3, 4, 5, 6, 7, 9, 8]].ravel()
        assert find_resets(blocks, 3.5 * MS) == []
        assert find_resets(np.concatenate([regular(500, start=500 * MS), regular(500)]), 3.5 * MS) == []

    def test_shuffled_record_is_sorted(self):
        order = np.random.default_rng(1).permutation(1000)
        line = clean(regular(1000)[order])
        assert line.starts == ()
        assert np.array_equal(line.stamps, regular(1000))
        assert np.array_equal(order[line.order], np.arange(1000))
        assert line.reordered > 900

    def test_reset_with_jitter_and_a_late_sample(self):
        rng = np.random.default_rng(2)
        first = regular(1000) + rng.integers(-200_000, 200_000, 1000)
        second = regular(700) + rng.integers(-200_000, 200_000, 700)
        second[[300, 305]] = second[[305, 300]]
        assert find_resets(np.concatenate([first, second]), 4 * MS) == [1000]

    def test_stretches_follow_each_other_by_the_same_shift_in_every_signal(self):
        fast = np.concatenate([regular(1000), regular(1000)])
        slow = np.concatenate([regular(500, 2 * MS, 300_000), regular(500, 2 * MS, 300_000)])
        lines = build_timelines([("fast", fast, None), ("slow", slow, None)])
        shifts = [
            int(line.stamps[half] - line.stamps[0]) for line, half in zip(lines, (1000, 500), strict=True)
        ]
        assert shifts[0] == shifts[1]
        assert all(np.all(np.diff(line.stamps) > 0) for line in lines)
        assert lines[0].stamps[1000] - lines[0].stamps[999] > 1e9 / 2

    def test_signals_that_disagree_about_resets_cannot_be_aligned(self):
        reset = np.concatenate([regular(1000), regular(1000)])
        with pytest.raises(InputError, match="different number of times") as caught:
            build_timelines([("a", reset, None), ("b", regular(2000), None)])
        assert "log_time" in caught.value.hint

    def test_reset_is_no_gap_in_the_statistics(self):
        statistics = track(np.concatenate([regular(1000), regular(600)])).statistics
        assert (statistics.resets, statistics.gaps, statistics.lost_s) == (1, 0, 0.0)

    def test_stamps_never_set_are_dropped(self):
        stamps = regular(100, start=17 * 10**17)
        stamps[:3] = 0
        line = clean(stamps)
        assert line.invalid == 3
        assert line.order[0] == 3


class TestTrack:
    def test_regular(self):
        result = track(regular(100))
        assert result.period_ns == MS
        assert result.is_uniform
        assert result.segments == ((0, 100),)
        assert result.statistics.jitter_s == 0.0

    def test_nan_runs_become_gaps_and_are_counted(self):
        values = np.arange(1000.0)
        values[100:103] = np.nan  # four periods
        values[500:502] = np.inf  # three: bridged
        result = track(regular(1000), values)
        assert result.statistics.invalid == 5
        assert result.statistics.gaps == 1
        assert result.statistics.lost_s == pytest.approx(0.004)
        assert result.statistics.bridged == 2
        assert [stop - first for first, stop in result.segments] == [100, 895]

    def test_duplicates_keep_the_first(self):
        result = track(np.repeat(regular(50), 2), np.arange(100.0))
        assert result.statistics.duplicates == 50
        assert np.array_equal(result.values, np.arange(0.0, 100.0, 2.0))

    def test_duplicate_without_a_value_does_not_hide_the_one_with_it(self):
        values = np.array([np.nan, 1.0, 2.0, 3.0])
        assert track(np.array([0, 0, MS, 2 * MS]), values).values.tolist() == [1.0, 2.0, 3.0]

    def test_disorder_is_sorted_and_counted(self):
        stamps = regular(100)
        stamps[[40, 41]] = stamps[[41, 40]]
        result = track(stamps, stamps / MS)
        assert result.statistics.reordered == 1
        assert np.array_equal(result.values, np.arange(100.0))

    def test_jitter_is_that_of_single_steps(self):
        rng = np.random.default_rng(3)
        stamps = regular(20_000) + np.rint(rng.normal(0, 50_000, 20_000)).astype(np.int64)
        stamps = np.delete(stamps, [500, 900, 901, 5000])
        result = track(stamps)
        assert result.statistics.jitter_s == pytest.approx(50e-6 * np.sqrt(2), rel=0.03)
        assert result.statistics.bridged == 4
        assert not result.is_uniform

    def test_jittery_log_is_not_split(self):
        rng = np.random.default_rng(4)
        stamps = np.cumsum(rng.integers(MS // 20, 4 * MS, 5000))
        assert len(track(stamps).segments) == 1

    def test_max_gap(self):
        stamps = np.delete(regular(1000), slice(400, 410))
        assert len(track(stamps, max_gap_s=0.0105).segments) == 2
        assert len(track(stamps, max_gap_s=0.0111).segments) == 1
        assert len(track(regular(1000), max_gap_s=1e-6).segments) == 1

    @pytest.mark.parametrize("values", [[], [1.0], [np.nan, np.nan], [np.nan, 2.0]])
    def test_too_few_samples(self, values):
        with pytest.raises(InputError, match="motor_position: the channel 'q'"):
            track(regular(len(values)), np.array(values))


class TestRounding:
    @pytest.mark.parametrize("quantum", [100_000, 1_000_000])
    def test_rounded_stamps_of_a_uniform_clock_are_put_back(self, quantum):
        true = np.arange(5000) * (1e9 / 350.87)
        rounded = (np.rint(true / quantum) * quantum).astype(np.int64)
        result = track(rounded)
        assert result.is_uniform
        assert clean(rounded).quantum_ns == quantum
        assert 1e9 / result.period_ns == pytest.approx(350.87, rel=1e-6)
        assert np.abs(result.stamps - true).max() < 0.05 * quantum

    def test_missing_samples_and_gaps_survive(self):
        true = np.delete(np.arange(5000) * (1e9 / 350.87), [7, 2000, *range(3000, 3050)])
        rounded = (np.rint(true / MS) * MS).astype(np.int64)
        result = track(rounded)
        assert result.statistics.bridged == 2
        assert result.statistics.gaps == 1
        assert result.is_uniform

    def test_true_jitter_in_coarse_stamps_is_kept(self):
        rng = np.random.default_rng(5)
        stamps = (
            np.rint((np.arange(2000) * 2.85e6 + rng.normal(0, 6e5, 2000)) / 2e5).astype(np.int64) * 200_000
        )
        stamps = np.unique(stamps)
        assert clean(stamps).quantum_ns == 0
        assert np.array_equal(clean(stamps).stamps, stamps)


class TestGrid:
    def test_missing_samples_are_put_between(self):
        result = track(np.delete(regular(100), [10, 11, 50]))
        assert np.array_equal(grid_instants(result, 0, 99 * MS), regular(100))

    def test_irregular_master_gives_a_uniform_grid(self):
        rng = np.random.default_rng(6)
        result = track(regular(1000) + rng.integers(-300_000, 300_000, 1000))
        grid = grid_instants(result, int(result.stamps[0]), int(result.stamps[-1]))
        assert np.ptp(np.diff(grid)) < 1e-3
        assert grid[0] == result.stamps[0]
        assert result.stamps[-1] - result.period_ns < grid[-1] <= result.stamps[-1] + 0.01 * MS

    def test_intervals_are_the_intersection(self):
        one = track(np.delete(regular(1000), slice(300, 320)))
        other = track(np.delete(regular(900, start=50 * MS), slice(500, 530)))
        found = [(round(start / MS), round(stop / MS)) for start, stop in common_intervals([one, other])]
        assert found == [(50, 299), (320, 549), (580, 949)]

    def test_fixed_rate(self):
        assert fixed_rate_stamps(4, 350.87).tolist() == [0, 2850058, 5700117, 8550175]
