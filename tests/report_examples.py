"""Made-up but realistic results for the tests of the report; loaded by path with runpy."""

from __future__ import annotations

import os
from dataclasses import replace
from pathlib import Path

import numpy as np

from flexid_cli.estimate.result import (
    Estimate,
    Fit,
    Identification,
    Interval,
    ModelResult,
    PipelineSummary,
    Skipped,
    Spectrum,
    Trace,
)
from flexid_cli.report.document import Damage, InputFile, build_document
from flexid_cli.signals.recording import ClockStatistics, Recording, Segment

HAC = "HAC (Newey-West, 40 lags), Student t"


def estimate(name, symbol, unit, value, stderr, verdict="identified", reason="", method=HAC):
    if value is None:
        return Estimate(name, symbol, unit, None, None, None, None, verdict, reason)
    interval = Interval(value - 1.96 * stderr, value + 1.96 * stderr, 0.95, method)
    relative = 100.0 * stderr / abs(value)
    return Estimate(name, symbol, unit, value, stderr, interval, relative, verdict, reason)


# Values and half the 2 sigma column of the paper's Table 1.
TABLE_1 = (
    estimate("motor_inertia", "Jm", "kg.m2", 174.7996, 1.38705),
    estimate("joint_stiffness", "K", "N.m/rad", 20341.0458, 218.57845),
    estimate("load_inertia", "JL", "kg.m2", 47.4458, 0.81405),
    estimate("motor_coulomb_friction", "FSm", "N.m", 41.4254, 2.76965),
    estimate("motor_viscous_friction", "FVm", "N.m.s/rad", 235.91, 63.964, "weak", "27 % relative deviation"),
    estimate(
        "load_viscous_friction", "FV", "N.m.s/rad", 83.1508, 20.70565, "weak", "25 % relative deviation"
    ),
    estimate(
        "gravity_moment_x", "MX", "kg.m", -0.7241, 0.5974, "weak", "its interval holds zero | see <gravity>"
    ),
    estimate("gravity_moment_y", "MY", "kg.m", -53.4201, 5.18295),
    estimate("load_coulomb_friction", "FS", "N.m", 8.4612, 1.2863),
)
# Values and half the 2 sigma column of the paper's Table 2.
TABLE_2 = (
    estimate("X1", "X1", "s2", 0.0021, 5.455e-5),
    estimate("X2", "X2", "s", 0.0046, 0.001087, "weak", "24 % relative deviation"),
    estimate("X3", "X3", "kg.m2.s2", 0.3554, 0.0088),
    estimate("X4", "X4", "kg.m2.s", 3.1739, 0.17845),
    estimate("X5", "X5", "kg.m2", 205.4558, 3.96105),
    estimate("X6", "X6", "N.m.s/rad", 1246.569, 82.56795),
    estimate("X7", "X7", "N.m", 5.1624, 3.7116, "weak", "72 % relative deviation"),
)
TOO_SMALL = "the record does not excite it: its column lies 0.02 % of the torque above the others"
PHYSICAL = (
    estimate("motor_inertia", "Jm", "kg.m2", 174.21, 0.9, method="delta method on HAC"),
    estimate("joint_stiffness", "K", "N.m/rad", 20255.0, 160.0, method="delta method on HAC"),
    estimate("load_inertia", "JL", "kg.m2", 47.3, 0.7, method="delta method on HAC"),
    estimate("motor_viscous_friction", "FVm", "N.m.s/rad", 301.0, 120.0, "weak", "40 % relative deviation"),
    estimate("load_viscous_friction", "FV", "N.m.s/rad", None, None, "not_identifiable", TOO_SMALL),
    estimate("motor_coulomb_friction", "FSm", "N.m", None, None, "not_identifiable", "negative: -3 N.m"),
)
RIGID = (
    estimate("load_inertia", "JL", "kg", 95.1089, 0.0412),
    estimate("motor_viscous_friction", "FVm", "N.s/m", 203.5034, 0.66),
    estimate("motor_coulomb_friction", "FSm", "N", 20.3935, 0.12),
    estimate("torque_offset", "offset", "N", -3.1648, 0.081),
)
AMPERE = (
    estimate("motor_inertia", "Jm", "A.s2/rad", 1.2e-5, 3.0e-7),
    estimate("motor_coulomb_friction", "FSm", "A", 0.31, 0.004),
)


def pipeline(**changes):
    frequency = np.geomspace(0.01, 175.0, 400)
    summary = PipelineSummary(
        sample_rate_hz=350.87,
        steps=(
            "zero-phase Butterworth low-pass, order 4 in each direction, 28.0 Hz, on every column",
            "exact band-limited derivatives",
            "parallel decimation by 26 (Chebyshev I, order 8, 0.05 dB, 5.398 Hz)",
            "0.5 s cut off at each edge",
        ),
        lowpass_order=4,
        lowpass_cutoff_hz=28.0,
        derivative="exact",
        decimation=26,
        effective_band_hz=(0.05, 5.398),
        limited_by="decimation",
        sign_cutoff_hz=80.0,
        reversal_velocity=0.0021,
        rows=1337,
        trimmed_s=0.5,
        f1_hz=3.9,
        f1_source="configuration",
        magnitude_hz=frequency,
        magnitude=1.0 / (1.0 + (frequency / 5.398) ** 16),
    )
    return replace(summary, **changes)


def trace(unit, samples=1337, rate=13.495):
    time = np.arange(samples) / rate
    phase = 2.0 * np.pi * (0.05 * time + 0.02 * time**2)
    measured = 60.0 * np.sin(phase) + np.random.default_rng(1).normal(0.0, 3.0, samples)
    return Trace(time, measured, 60.0 * np.sin(phase), unit)


def spectrum(unit, samples=4000, rate=350.87):
    frequency = np.linspace(0.0, rate / 2.0, samples)
    peak = 30.0 / np.sqrt((1.0 - (frequency / 3.9) ** 2) ** 2 + (0.1 * frequency / 3.9) ** 2)
    noise = np.abs(np.random.default_rng(2).normal(0.02, 0.005, samples))
    return Spectrum(frequency, peak / (1.0 + frequency**2) + noise, f"{unit}/sqrt(Hz)")


def model(id_="two_encoders", parameters=TABLE_1, unit="N.m", **changes):
    estimated = [p.symbol for p in parameters if p.value is not None]
    correlation = np.eye(len(estimated))
    if len(estimated) > 2:
        correlation[0, 2] = correlation[2, 0] = -0.934
    result = ModelResult(
        id=id_,
        method="wls",
        method_reason="the equations have unequal residuals",
        equation="Gm = Jm qm'' + FVm qm' + FSm sgn(qm') + K (qm - q)\n"
        "0 = JL q'' + FV q' + FS sgn(q') + MX g cos(q) + MY g sin(q) - K (qm - q)",
        parameters=parameters,
        regression=(),
        derived=(estimate("resonance_frequency", "f1", "Hz", 3.716, 0.021, method="delta method"),),
        correlation_names=tuple(estimated),
        correlation=correlation,
        condition_number=37.2,
        rank=len(parameters),
        columns=len(parameters),
        fit=Fit(torque_rms=41.2, residual_rms=3.04, fit_percent=92.6, unit=unit),
        pipeline=pipeline(),
        trace=trace(unit),
        spectrum=spectrum(unit),
        added_terms=(),
        tests={"whiteness": {"statistic": 812.4, "p_value": 3e-12, "verdict": "correlated residuals"}},
        warnings=(),
    )
    return replace(result, **changes)


def recording(**changes):
    n = 4096
    zeros = np.zeros(n)
    clocks = tuple(
        ClockStatistics(signal, "header_stamp", 35087, 0.00285006, 2.4e-5, bridged=3, duplicates=1)
        for signal in ("motor_current", "motor_position", "joint_position")
    )
    made = Recording(
        sample_rate_hz=350.87,
        segments=(Segment(0.0, zeros, zeros, zeros),),
        duration_s=100.0,
        clocks=clocks,
        history=(
            "clock: header_stamp (it runs for every signal)",
            "aligned to the stamps of motor_position",
            "resampled to 350.87 Hz",
        ),
        notes=("motor_position: 3 missing samples were filled in by interpolation",),
    )
    return replace(made, **changes)


INPUT = InputFile("logs/run_3|a.mcap", "ab" * 32, "mcap", damage=Damage(35087), notes=("no summary section",))
CONFIG = {
    "version": 1,
    "axis": {"name": "axis3", "gear_ratio": 50.0, "torque_constant_nm_per_a": 0.3475},
    "signals": {"motor_position": {"source": "/joint_states/axis3/position", "unit": "rad", "unwrap": True}},
    "models": ["two_encoders", "motor_only"],
    "pipeline": {},
}


def document(identification, record=None, inputs=(INPUT,), config=None):
    return build_document(
        identification=identification,
        recording=recording() if record is None else record,
        inputs=inputs,
        config_digest="cd" * 32,
        config_resolved=CONFIG if config is None else config,
    )


def flexible():
    motor_only = model(
        "motor_only",
        PHYSICAL,
        method="structured",
        regression=TABLE_2,
        equation="Gm = -X1 Gm'' - X2 Gm' + X3 qm'''' + X4 qm''' + X5 qm'' + X6 qm' + X7 sgn(qm')",
        added_terms=("gravity", "torque_offset"),
        tests={},
        warnings=("the motor-only friction estimates are biased on records of small amplitude",),
    )
    return Identification(
        (model(), motor_only), (), ("f1 was not far enough below the upper edge of the band",)
    )


def rigid():
    result = model("rigid", RIGID, "N", derived=(), equation="F = JL q'' + FVm q' + FSm sgn(q') + offset")
    skipped = Skipped("two_encoders", "the log has no joint_position")
    return Identification((result,), (skipped,), ())


def ampere():
    result = model("rigid", AMPERE, "A", derived=(), pipeline=pipeline(f1_hz=None, f1_source=""))
    return Identification((result,), (), ("the torque constant is unknown: parameters are per ampere",))


def nothing():
    return Identification((), (Skipped("two_encoders", "the axis does not move"),), ())


CASES = {"flexible": flexible, "rigid": rigid, "ampere": ampere, "nothing": nothing}


def case(name):
    """Identification and document of a named case."""
    identification = CASES[name]()
    linear = name == "rigid"
    unit = {"rigid": "N", "ampere": "A"}.get(name, "N.m")
    made = document(identification, recording(linear=linear, torque_unit=unit))
    made["tool"]["version"] = "0.0.0"  # so that a release leaves the goldens alone
    return identification, made


GOLDEN = Path(__file__).with_name("golden")


def check_golden(name, text):
    """Compare with a file under tests/golden; FLEXID_UPDATE_GOLDEN=1 writes it instead."""
    path = GOLDEN / name
    if os.environ.get("FLEXID_UPDATE_GOLDEN") == "1":
        path.parent.mkdir(exist_ok=True)
        path.write_bytes(text.encode("utf-8"))
    expected = path.read_bytes().decode("utf-8")
    assert text == expected, f"differs from {path.name}: look at it, then set FLEXID_UPDATE_GOLDEN=1"
