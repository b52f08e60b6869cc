"""How often the intervals hold the truth, over many records of the sample logs' axis with fresh torque noise.

One record's intervals say little: of nineteen 95 % intervals one misses more often than not.
"""

from __future__ import annotations

import importlib.util
import math
from dataclasses import asdict

import numpy as np
import pytest
from scipy.stats import binom

from flexid_cli.config.load import load_config
from flexid_cli.estimate.identify import identify
from flexid_cli.readers.base import RawChannel, RawLog
from flexid_cli.signals.build import recording_from_raw

FIRST_SEED = 1000
# The noise is drawn once a record and moves several parameters together: a miss is rarely alone. The test asks
# whether misses are significantly above 10 %, each record's share counted as if its parameters were three.
TOLERATED = 0.10
INDEPENDENT = 3


@pytest.fixture(scope="module")
def samples(root):
    spec = importlib.util.spec_from_file_location(
        "make_sample_logs", root / "sample_logs" / "make_sample_logs.py"
    )
    module = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(module)
    return module


def _misses(samples, config, seed):
    """Shares of identified parameters whose interval misses the truth, by model."""
    table = samples.record(seed)
    stamps = {"header_stamp": table.stamps_ns}
    channels = {name: RawChannel(name, values, stamps) for name, values in table.channels.items()}
    recording = recording_from_raw(RawLog("memory", (), channels), config)
    truth = {**asdict(samples.AXIS), "z": 0.0}
    motor = recording.segments[0].motor_position
    centre = 0.5 * (motor.min() + motor.max())
    g, MX, MY = truth["gravity"], truth["MX"], truth["MY"]
    truth["Q0"] = g * (MX * math.cos(centre) + MY * math.sin(centre))
    truth["kg"] = g * (MY * math.cos(centre) - MX * math.sin(centre))
    shares = {}
    for model in identify(recording, config).models:
        sure = [e for e in model.parameters if e.verdict == "identified"]
        missed = [e for e in sure if not e.interval.low <= truth[e.symbol] <= e.interval.high]
        shares[model.id] = len(missed) / len(sure)
    return shares


def _check(root, samples, records):
    config = load_config(root / "configs" / "axis3.yaml")
    shares = [_misses(samples, config, FIRST_SEED + k) for k in range(records)]
    for model in ("two_encoders", "motor_only"):
        mean = float(np.mean([s[model] for s in shares]))
        trials = INDEPENDENT * records
        limit = binom.ppf(0.999, trials, TOLERATED) / trials
        assert mean <= limit, f"{model}: {100 * mean:.1f} % of the intervals miss, limit {100 * limit:.1f} %"


def test_coverage(root, samples):
    _check(root, samples, 5)


@pytest.mark.slow
def test_coverage_over_many_records(root, samples):
    _check(root, samples, 60)
