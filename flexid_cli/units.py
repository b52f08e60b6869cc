"""The one place that converts units; everything inside the program is SI."""

from __future__ import annotations

import difflib
import math
from dataclasses import dataclass
from typing import Literal

from flexid_cli.errors import UsageError

Dimension = Literal["angle", "length", "torque", "force", "current", "voltage", "count", "time"]


@dataclass(frozen=True)
class Unit:
    """A unit of measurement.

    Attributes
    ----------
    name : str
        The spelling used in reports, for example ``N.m``.
    dimension : str
        What it measures. ``count`` and ``voltage`` need a factor of the machine (``counts_per_rev``,
        ``torque_per_volt``) to become SI.
    factor : float
        SI value of one unit (rad, m, N m, N, A, V, counts, s).
    """

    name: str
    dimension: Dimension
    factor: float


_UNITS = (
    Unit("rad", "angle", 1.0),
    Unit("mrad", "angle", 1e-3),
    Unit("deg", "angle", math.pi / 180.0),
    Unit("arcmin", "angle", math.pi / 10800.0),
    Unit("arcsec", "angle", math.pi / 648000.0),
    Unit("rev", "angle", 2.0 * math.pi),
    Unit("m", "length", 1.0),
    Unit("mm", "length", 1e-3),
    Unit("um", "length", 1e-6),
    Unit("nm", "length", 1e-9),
    Unit("N.m", "torque", 1.0),
    Unit("mN.m", "torque", 1e-3),
    Unit("kN.m", "torque", 1e3),
    Unit("N", "force", 1.0),
    Unit("mN", "force", 1e-3),
    Unit("kN", "force", 1e3),
    Unit("A", "current", 1.0),
    Unit("mA", "current", 1e-3),
    Unit("V", "voltage", 1.0),
    Unit("mV", "voltage", 1e-3),
    Unit("count", "count", 1.0),
    Unit("s", "time", 1.0),
    Unit("ms", "time", 1e-3),
    Unit("us", "time", 1e-6),
    Unit("ns", "time", 1e-9),
)
_BY_NAME = {unit.name: unit for unit in _UNITS}
_ALIASES = {
    "radian": "rad", "radians": "rad", "degree": "deg", "degrees": "deg", "°": "deg", "º": "deg",
    "revolution": "rev", "revolutions": "rev", "turn": "rev", "turns": "rev",
    "meter": "m", "metre": "m", "µm": "um", "μm": "um",
    "Nm": "N.m", "N m": "N.m", "N*m": "N.m", "N·m": "N.m", "N-m": "N.m", "newton_meter": "N.m",
    "mNm": "mN.m", "mN m": "mN.m", "mN*m": "mN.m", "mN·m": "mN.m",
    "kNm": "kN.m", "kN m": "kN.m", "kN*m": "kN.m", "kN·m": "kN.m",
    "ampere": "A", "amps": "A", "amp": "A", "volt": "V", "volts": "V",
    "counts": "count", "ticks": "count", "inc": "count", "increments": "count",
    "sec": "s", "second": "s", "seconds": "s", "msec": "ms", "usec": "us", "µs": "us", "μs": "us", "nsec": "ns",
}  # fmt: skip


def known_units(*dimensions: str) -> list[str]:
    """Names of the units of the given dimensions (all dimensions where none is given)."""
    return [unit.name for unit in _UNITS if not dimensions or unit.dimension in dimensions]


def parse_unit(text: str) -> Unit:
    """Return the unit that ``text`` names.

    Parameters
    ----------
    text : str
        A unit's name or one of its usual spellings (``Nm``, ``N*m``, ``degrees``). Case counts, for ``mN`` is
        not ``MN``.

    Raises
    ------
    UsageError
        The unit is not known; the hint names the nearest ones.
    """
    stripped = text.strip()
    name = _ALIASES.get(stripped, stripped)
    unit = _BY_NAME.get(name)
    if unit is not None:
        return unit
    near = difflib.get_close_matches(stripped, [*_BY_NAME, *_ALIASES], n=1, cutoff=0.5)
    by_case = [n for n in _BY_NAME if n.lower() == stripped.lower()]
    guess = (by_case or near or [""])[0]
    hint = f"did you mean {_ALIASES.get(guess, guess)!r}? " if guess else ""
    raise UsageError(f"unknown unit {text!r}", hint + "known units: " + ", ".join(_BY_NAME))
