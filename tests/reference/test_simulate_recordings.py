"""The simulation against records of another simulator: other code, other integrator, the same equations."""

from __future__ import annotations

import json
from pathlib import Path

import numpy as np
import pandas as pd
import pytest

from flexid_cli.effects.base import EffectValues
from flexid_cli.simulate.engine import simulate_closed_loop
from flexid_cli.simulate.machine import Axis, Controller, Sensors

# Names in the labelled cases by the effect's parameters.
LABELS = {
    "stribeck_motor": {"stribeck_torque": "strib_f", "stribeck_velocity": "strib_v"},
    "stribeck_load": {"stribeck_torque": "lstrib_f", "stribeck_velocity": "lstrib_v"},
    "viscous_nonlinear": {"quadratic_friction": "quad", "power_friction": "pow_f"},
    "load_dependent_friction": {"load_friction_coefficient": "load"},
    "cogging": {"cogging_torque": "cog_a", "cogging_cycles": "cog_n", "cogging_phase": "cog_p"},
    "actuator_lag": {"lag": "lag"},
    "torque_saturation": {"torque_limit": "sat"},
    "thermal_drift": {"friction_change": "therm_gain", "warming_time": "therm_tau"},
    "joint_damping": {"joint_damping": "c"},
    "backlash": {"gap": "gap"},
    "hardening_stiffness": {"cubic_stiffness": "k3"},
    "hysteresis": {"hysteresis_torque": "hyst_f", "hysteresis_length": "hyst_d"},
    "transmission_error": {"error_amplitude": "te_a", "error_cycles": "te_n", "error_phase": "te_p"},
    "second_mode": {"second_inertia": "m2_J", "second_stiffness": "m2_K", "second_damping": "m2_c"},
    "payload_change": {"inertia_change": "jump_dJ", "time_of_change": "jump_t"},
    "clock_skew": {"skew": "skew"},
}


def torsion_errors(folder: Path, truth: dict) -> tuple[float, float]:
    """RMS difference of the torsion over its own RMS, with the hidden effects and without."""
    facts = json.loads((folder / "facts.json").read_text())
    data = {name: np.asarray(values) for name, values in pd.read_csv(folder / "a.csv.gz").items()}
    b, c = truth["base"], facts["controller"]
    axis = Axis(
        b["Jm"], b["K"], b["JL"], b["FVm"], b["FSm"], b["FV"], b["FS"], b["MX"], b["MY"],
        facts["gravity"], 0.0, b["v0"], b["v0l"],
    )  # fmt: skip
    controller = Controller(c["kp"], c["kv"], c["ki"])
    counts = 2.0 * np.pi / np.array([facts["motor_counts_per_rev"], facts["joint_counts_per_rev"]])
    gear = facts["gear_ratio"]  # 1 where the record is joint side
    sensors = Sensors(motor_resolution=counts[0] / gear, joint_resolution=counts[1])
    known = {**truth["extra"], "skew": truth["skew"]}
    effects = [
        EffectValues(k, {n: known.get(s, 0.0) for n, s in LABELS[k].items()})
        for k in truth["kinds"]
        if k in LABELS
    ]
    torsion = data["motor_position"] / gear - data["joint_position"]
    reference = data["reference_position"] / gear
    errors = []
    for given in (effects, ()):
        run = simulate_closed_loop(
            axis,
            controller,
            reference,
            facts["sample_rate_hz"],
            effects=given,
            sensors=sensors,
        )
        late = slice(200, None)  # where the other simulation started is not told
        difference = run.motor_position - run.joint_position - torsion
        errors.append(float(np.std(difference[late]) / np.std(torsion[late])))
    return errors[0], errors[1]


@pytest.mark.parametrize("group", ["single", "pairs"])
def test_hidden_effects_bring_the_simulation_to_the_record(recordings, group):
    """With the true effects all that is left is noise, of the size it has with nothing hidden."""
    truth = json.loads((recordings / "simulated" / group / "truth.json").read_text())
    single = json.loads((recordings / "simulated" / "single" / "truth.json").read_text())
    nothing = [case for case in single if single[case]["kinds"] == ["none"]]
    floor = max(
        torsion_errors(recordings / "simulated" / "single" / case, single[case])[0] for case in nothing
    )
    for case, facts in truth.items():
        if not set(facts["kinds"]) & set(LABELS):
            continue
        with_effects, without = torsion_errors(recordings / "simulated" / group / case, facts)
        assert with_effects < 0.8 * without, (case, facts["kinds"])
        assert with_effects < 2.0 * floor, (case, facts["kinds"])
