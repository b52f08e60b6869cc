"""Two encoders that are not read together: found with an interval, offered, and never a narrow wrong friction."""

from __future__ import annotations

import re
from dataclasses import replace

import numpy as np
import pytest
from scipy.interpolate import make_interp_spline

from flexid_cli.config.load import parse_config
from flexid_cli.estimate.identify import identify
from flexid_cli.signals.recording import Recording, Segment
from flexid_cli.simulate.axis import Axis, Controller, chirp, simulate

RATE, DURATION = 250.0, 24.0
AXIS = Axis(reversal_velocity=0.01, MX=0.0, MY=0.0)
TEXT = """
version: 1
axis: {{name: axis, gear_ratio: 1, f1_hz: 4.0}}
signals:
  joint_torque: {{source: u, unit: N.m, hold: instant}}
  motor_position: {{source: qm, unit: rad}}
  joint_position: {{source: q, unit: rad{delay}}}
models: [{model}]
"""


@pytest.fixture(scope="module")
def run():
    t = np.arange(round(DURATION * RATE)) / RATE
    reference = 0.06 * chirp(0.1, 8.0, DURATION, RATE) + 0.05 * np.sin(2.0 * np.pi * 0.31 * t)
    return simulate(AXIS, Controller(8.0, 6000.0, 8000.0), reference, RATE)


def record(run, age_samples: float, seed: int = 0) -> Recording:
    """The joint position as an encoder sends it that was read ``age_samples`` before the stamp."""
    rng = np.random.default_rng(seed)
    t = np.arange(run.torque.size) / RATE
    torque = np.concatenate([run.torque[:1], 0.5 * (run.torque[1:] + run.torque[:-1])])
    torque[1:-1] -= np.diff(torque, 2) / 12.0
    torque += 10.0 * rng.standard_normal(t.size)
    old = make_interp_spline(t, run.joint_position, k=5)(t - age_samples / RATE)
    motor, joint = (x + 2e-6 * rng.standard_normal(t.size) for x in (run.motor_position, old))
    return Recording(RATE, (Segment(0.0, torque, motor, joint),), duration_s=DURATION)


def solve(recording, model="two_encoders", delay=""):
    return identify(recording, parse_config(TEXT.format(model=model, delay=delay))).models[0]


@pytest.mark.parametrize("age", [-0.5, 0.3, 0.5])
def test_the_age_is_found_and_offered(run, age):
    found = solve(record(run, age))
    test = found.tests["encoder_skew"]
    assert test["value_samples"] == pytest.approx(age, abs=0.02)
    assert abs(test["value_s"] - age / RATE) < 5.0 * test["stderr_s"]
    (warning,) = [w for w in found.warnings if "joint position" in w]
    assert "damping in the joint" in warning
    assert ("before its stamp" in warning) == (age > 0.0)
    line = re.search(r"signals\.joint_position\.delay_s: (\S+)", warning)
    assert float(line[1]) == pytest.approx(age / RATE, rel=0.05)


def test_what_is_offered_is_added_to_what_is_set(run):
    # `delay_s` was applied when the record was built; what is left is seen on top of it.
    found = solve(record(run, 0.5), delay=", delay_s: 0.01")
    (warning,) = [w for w in found.warnings if "joint position" in w]
    line = re.search(r"delay_s: (\S+)", warning)
    assert float(line[1]) == pytest.approx(0.01 + 0.5 / RATE, rel=0.02)


def test_encoders_read_together_show_none(run):
    found = solve(record(run, 0.0))
    assert abs(found.tests["encoder_skew"]["value_samples"]) < 0.01
    assert not [w for w in found.warnings if "joint position" in w]


def friction_errors(found):
    values = {e.symbol: e for e in found.parameters}
    return {
        s: (values[s].value - getattr(AXIS, s)) / values[s].stderr for s in ("FVm", "FV", "FSm", "FS", "JL")
    }


def test_an_undeclared_age_widens_what_it_biases(run):
    skewed, together = solve(record(run, 0.5)), solve(record(run, 0.0))
    assert max(abs(z) for z in friction_errors(skewed).values()) < 2.5
    sizes = [{e.symbol: e.stderr for e in found.parameters} for found in (skewed, together)]
    assert sizes[0]["FV"] > 3.0 * sizes[1]["FV"]
    shares = together.tests["bias_budget"]["parameters"]["FV"]["systematic_percent"]
    assert shares["the encoders' timing"] < 1.0
    # Declared, it is believed: the same record then has the same friction with a narrow interval.
    declared = solve(record(run, 0.5), delay=", delay_s: 0.0")
    assert (
        "the encoders' timing" not in declared.tests["bias_budget"]["parameters"]["FV"]["systematic_percent"]
    )
    assert max(abs(z) for z in friction_errors(declared).values()) > 3.0


def test_without_a_joint_encoder_there_is_nothing_to_compare(run):
    recording = record(run, 0.5)
    segments = tuple(replace(s, joint_position=None) for s in recording.segments)
    found = solve(replace(recording, segments=segments), "motor_only")
    assert "encoder_skew" not in found.tests
    assert not [w for w in found.warnings if "joint position" in w]
