"""From a selection to a verdict, in numbers and in a sentence."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Literal

import numpy as np
from numpy.typing import NDArray

from flexid_cli.diagnose.location import Map
from flexid_cli.diagnose.problem import Problem
from flexid_cli.diagnose.result import NamedEffect, Verdict
from flexid_cli.diagnose.selection import Selection

Array = NDArray[np.float64]
Remainder = Literal["function", "size", ""]

# Calibrated, see docs/diagnosis.md: gain of a free function of one variable that nothing explains by chance, and
# RMS of whitened rows that the finite filters leave of a complete model.
UNEXPLAINED_GAIN = 0.25
UNEXPLAINED_RMS = 4.0
# Without a joint encoder the joint's motion is rebuilt, and its reversals are blurred.
UNEXPLAINED_GAIN_ALONE, UNEXPLAINED_RMS_ALONE = 0.5, 4.0
# Share of the mismatch on the other recording that named effects explain there.
CARRIED_OVER = 0.8
# A record whose torque stands less than this above its own noise cannot be judged.
LEAST_SIGNAL = 10.0

PLACES = {
    "motor": "in the motor equation",
    "transmission": "in the transmission",
    "load": "in the load equation",
    "measurement": "in the measurement",
}
VARIABLES = {
    "velocity": "velocity",
    "position": "position",
    "position_times_sign": "position times the sign of the velocity",
    "position_times_acceleration": "position times acceleration",
    "position_times_torsion": "position times torsion",
    "torsion": "torsion",
    "load_times_sign": "load times the sign of the velocity",
    "torque": "torque",
    "time": "time",
    "time_times_sign": "the friction's change with time",
    "time_times_velocity": "the viscous friction's change with time",
    "time_times_acceleration": "the inertia's change with time",
    "time_times_torsion": "the stiffness's change with time",
    "time_times_torque": "the torque's change with time",
    "frequency": "a fixed frequency",
}


def is_poor(problem: Problem) -> bool:
    """Whether a record's torque hardly stands above its own noise."""
    return problem.signal() < LEAST_SIGNAL


def remainder(rms: float, maps: Sequence[Map], *, both: bool) -> Remainder:
    """What a model leaves beside its noise: a function of some variable, more than noise anyhow, or nothing."""
    gain, most = (
        (UNEXPLAINED_GAIN, UNEXPLAINED_RMS) if both else (UNEXPLAINED_GAIN_ALONE, UNEXPLAINED_RMS_ALONE)
    )
    if maps and maps[0].gain > gain:
        return "function"
    return "size" if rms > most else ""


def decide(selection: Selection, left: Remainder) -> Verdict:
    """Verdict of a selection that leaves a function, more than noise, or nothing."""
    problem, chosen = selection.before.problem, selection.after.chosen
    # A start that could not be trusted, and nothing that explains the record: the baseline may stand anywhere.
    astray = not problem.settled and bool(left or not chosen)
    if is_poor(problem) or astray:
        return "inconclusive"
    if not selection.after.is_possible:  # a fit, but of no axis
        return "unexplained" if left or chosen else "inconclusive"
    if left == "function" or (left and not chosen):
        return "unexplained"
    if not chosen:
        return "adequate"
    if left:
        return "partly_explained"
    return "ambiguous" if any(selection.alternatives) else "explained"


def elsewhere(before: Array, after: Array) -> Verdict:
    """Verdict of effects that leave more than a complete model does on the other recording.

    Named are those that carry over all the same: of what the baseline leaves there above the noise (one a row) they
    explain most.
    """
    above = float(before @ before) - before.size
    explained = float(before @ before - after @ after) / max(above, 1e-300)
    return "partly_explained" if explained > CARRIED_OVER else "unexplained"


def sentence(
    verdict: Verdict, effects: Sequence[NamedEffect], equation: str, variable: str, share: float
) -> str:
    """What a person should take from it; ``share`` is what of the mismatch the effects explain."""
    if verdict == "adequate":
        return (
            "The model explains the recording down to the noise of its signals: nothing is missing that it could"
            " show."
        )
    if verdict == "inconclusive":
        return (
            "The recording is too poor to judge: its torque hardly stands above its own noise, or it shows no"
            " resonance."
        )
    if verdict == "unexplained":
        return (
            f"The recording holds something that no effect of the library explains; it sits {PLACES[equation]}, as a"
            f" function of {VARIABLES[variable]}."
        )
    names = " and ".join(e.name.replace("_", " ") for e in effects)
    text = f"The model left out {names}; with it {100.0 * share:.0f} % of the mismatch above the noise is explained."
    if verdict == "partly_explained":
        text += (
            " What stays is above the noise and no clear function of anything; most of it sits"
            f" {PLACES[equation]}, as a function of {VARIABLES[variable]}."
        )
    if any(e.alternatives for e in effects):
        open_ones = [e for e in effects if e.alternatives]
        others = "; ".join(f"{e.name} could also be {', '.join(e.alternatives)}" for e in open_ones)
        text += f" The recording cannot decide everything: {others}.".replace("_", " ")
    return text


def advice(
    effects: Sequence[NamedEffect], best_recordings: dict[str, str], verdict: Verdict, variable: str
) -> tuple[str, ...]:
    """What to record next."""
    if verdict == "inconclusive":
        return (
            "Move the axis with more acceleration, up to its first resonance: torque must outweigh noise.",
        )
    if verdict == "unexplained":
        again = "Repeat the recording with another trajectory, at half the speed and at half the amplitude"
        return (f"{again}: what stays a function of {VARIABLES[variable]} is its cause's.",)
    out = []
    for e in effects:
        if e.alternatives:
            names = (e.name, *e.alternatives)
            out += [f"To tell {' from '.join(names)}: {best_recordings[name]}" for name in names]
    return tuple(dict.fromkeys(out))
