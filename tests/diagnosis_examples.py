"""Made-up but realistic diagnoses for the tests of the report; loaded by path with runpy."""

from __future__ import annotations

import runpy
from dataclasses import replace
from pathlib import Path
from types import SimpleNamespace

import numpy as np

from flexid_cli.diagnose.result import (
    AngleLine,
    AngleSpectrum,
    Change,
    Diagnosis,
    Drift,
    Event,
    Evidence,
    HeldOut,
    Locality,
    LoopWidth,
    NamedEffect,
    ResidualMap,
    Reversals,
    Shape,
    SimulationError,
    Tested,
    Traces,
    Where,
)
from flexid_cli.report.document import InputFile, build_document

REPORT = SimpleNamespace(**runpy.run_path(str(Path(__file__).with_name("report_examples.py"))))
estimate = REPORT.estimate

BEFORE = (
    estimate("motor_inertia", "Jm", "kg.m2", 174.92, 0.31),
    estimate("joint_stiffness", "K", "N.m/rad", 18411.3, 120.5),
    estimate("load_inertia", "JL", "kg.m2", 44.61, 0.42),
)
AFTER = (
    estimate("motor_inertia", "Jm", "kg.m2", 174.80, 0.12),
    estimate("joint_stiffness", "K", "N.m/rad", 20338.2, 21.4),
    estimate("load_inertia", "JL", "kg.m2", 47.44, 0.06),
    estimate(
        "load_coulomb_friction", "FS", "N.m", 8.1, 2.6, "weak", "32 % relative deviation | see <friction>"
    ),
)
GAP = estimate("gap", "gap", "rad", 9.87e-4, 1.1e-5, method="profile likelihood")
EVIDENCE = Evidence(0.5312, 0.02, 1e-9, 0.4987, 1.0)
BACKLASH = NamedEffect(
    "backlash",
    "FX202",
    "transmission",
    (),
    (GAP,),
    EVIDENCE,
    Where("transmission", "torsion", None, (1.8, 7.25)),
)
HELD_OUT = HeldOut(
    {"motor": 9.234, "load": 8.871},
    {"motor": 3.3301, "load": 2.1},
    {"motor": 3.31, "load": 2.04},
    "blocks of the record",
    "N.m",
)
TESTED = (
    Tested("backlash", "FX202", 0.5312, ""),
    Tested("hardening_stiffness", "FX203", 0.2911, "leaves 27 % more than the effects that were named"),
    Tested("clock_skew", "FX401", None, "this record cannot show it, or the baseline holds it"),
    Tested("hysteresis", "FX204", 0.31, "explains too little | with <a> pipe"),
)
NOTE = "compared up to 41.2 Hz, where the encoders resolve the motion"


def traces(samples=3_000):
    time = np.arange(samples) / 1000.0
    random = np.random.default_rng(4)
    slow = 12.0 * np.sin(2.0 * np.pi * 0.4 * time) * (np.sin(2.0 * np.pi * 3.0 * time) > 0.7)
    after = {name: random.normal(0.0, 2.0, samples) for name in ("motor", "load")}
    before = {"motor": after["motor"] + slow, "load": after["load"] - slow}
    return Traces(time, before, after, "N.m")


def residual_map(variable="torsion"):
    x = np.linspace(-0.012, 0.012, 25)
    before = 11.0 * np.sin(x / 0.004) * np.exp(-((x / 0.006) ** 2))
    after = np.random.default_rng(5).normal(0.0, 0.3, x.size)
    return ResidualMap("transmission", variable, x, before, after, np.full(x.size, 0.8), "rad", "N.m")


def shape():
    x = np.linspace(-0.4, 0.4, 15)
    y = 5.0 * np.cos(8.0 * x)
    return Shape(x, y, y - 0.6, y + 0.6, "rad", "N.m")


def locality(model="baseline"):
    """Something of every kind."""
    lag, cycles = np.linspace(-0.1, 0.1, 21), np.linspace(5.0, 200.0, 120)
    lines = (
        AngleLine(2.0, 100.0, 3.2, 0.08, 0.31, -1.2, 1e-9),
        AngleLine(0.46, 23.0, 1.1, 0.08, 0.04, 0.3, 0.002),
    )
    mean = 4.0 * np.tanh(lag / 0.02)
    turned = Reversals("load", 41, 0.22, 0.71, 0.66, 0.76, 1e-6, lag, mean, np.full(21, 0.4), "N.m")
    hardly = replace(turned, equation="motor", energy_share=0.23, low=0.17, high=0.29, p_value=0.4)
    amplitude = 0.2 + 3.0 * np.exp(-(((cycles - 100.0) / 3.0) ** 2))
    frequency = np.array([0.4, 1.2, 3.6, 10.8])
    stiffness = np.array([61.0, 58.0, 66.0, 60.0])
    return Locality(
        model,
        changes=(Change("JL", 17.31, 17.28, 17.36, 4.12, 0.07, 0.63, 1e-12, ("MY",), "kg.m2"),),
        events=(Event("load", 31.2, 31.4, 212.0, 0.02),),
        reversals=(hardly, turned),
        angle=(AngleSpectrum("motor", cycles, amplitude, np.full(120, 0.6), lines, "N.m"),),
        loop=LoopWidth(
            frequency, stiffness, np.array([20.0, 6.0, 2.0, 3.0]), np.full(4, 2e-3), 4e-3 * stiffness,
            0.02, 0.05, 0.31, "N.m/rad", "N.m",
        ),
        drift=(
            Drift("FVm", -3.1, 0.4, -1.3, 0.08, 1e-5, "N.m.s/rad"),
            Drift("load_offset", 0.1, 0.1, None, 1e-5, 0.9, "N.m"),
        ),
    )  # fmt: skip


def explained():
    return Diagnosis(
        verdict="explained",
        sentence="The joint has play: backlash of 0.00099 rad explains 41 % of what the model had left over.",
        model="two_encoders",
        effects=(BACKLASH,),
        location=None,
        held_out=HELD_OUT,
        simulation=SimulationError(0.00213, 0.00031, "joint position", "rad"),
        parameters_before=BEFORE,
        parameters_after=AFTER,
        tested=TESTED,
        next_recording=(),
        notes=(NOTE,),
        traces=traces(),
        maps=(residual_map(), residual_map("motor_velocity")),
    )


def ambiguous():
    effect = replace(BACKLASH, alternatives=("hardening_stiffness", "hysteresis"))
    advice = (
        "Small motions with many changes of the torque's sign, without a constant load, both encoders.",
    )
    return replace(
        explained(),
        verdict="ambiguous",
        sentence="Something in the joint is not linear: backlash, hardening_stiffness or hysteresis.",
        effects=(effect,),
        next_recording=advice,
    )


def pair():
    name = "load_dependent_friction"
    friction = NamedEffect(
        name,
        "FX105",
        "motor",
        (),
        (estimate("load_friction_coefficient", "mu", "1", 0.081, 0.004),),
        replace(EVIDENCE, statistic=0.11, held_out_gain=None, stability=float("nan")),
        Where("motor", "load_times_sign", (3.0, 41.5), None),
    )
    return replace(
        explained(),
        verdict="partly_explained",
        effects=(BACKLASH, friction),
        location=Where("load", "position"),
        locality=locality("with the named effects"),
    )


def unexplained():
    return replace(
        explained(),
        verdict="unexplained",
        sentence="Something that is not in the library acts in the load equation, over the position.",
        effects=(),
        location=Where(
            "load",
            "position",
            (17.31, 99.9),
            (0.1, 2.0),
            shape(),
            (
                "from 17.31 s on the load's inertia differs by +4.12 kg.m2",
                "it stands at the upper end of the travel",
            ),
        ),
        locality=locality(),
        parameters_after=BEFORE,
        tested=tuple(replace(t, reason=t.reason or "explains too little") for t in TESTED),
    )


def adequate():
    return replace(
        explained(),
        verdict="adequate",
        sentence="The model explains the record down to its noise: nothing is missing.",
        effects=(),
        parameters_after=BEFORE,
        tested=(),
        maps=(),
        locality=locality(),
    )


def inconclusive():
    return Diagnosis(
        verdict="inconclusive",
        sentence="The record is too short to judge.",
        model="motor_only",
        effects=(),
        location=None,
        held_out=None,
        simulation=None,
        parameters_before=(),
        parameters_after=(),
        tested=(),
        next_recording=("Thirty seconds of a chirp around the first resonance.",),
        notes=(),
    )


CASES = {f.__name__: f for f in (explained, ambiguous, pair, unexplained, adequate, inconclusive)}


def document(diagnosis, record=None, inputs=(REPORT.INPUT,), validation=None):
    made = build_document(
        recording=REPORT.recording() if record is None else record,
        inputs=inputs,
        config_digest="cd" * 32,
        config_resolved=REPORT.CONFIG,
        diagnosis=diagnosis,
        validation=validation,
    )
    made["tool"]["version"] = "0.0.0"  # so that a release leaves the goldens alone
    return made


def other_input(role):
    return InputFile(f"logs/{role}.mcap", "ef" * 32, "mcap", role=role)


def case(name):
    """Diagnosis and document of a named case."""
    diagnosis = CASES[name]()
    return diagnosis, document(diagnosis)
