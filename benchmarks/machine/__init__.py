"""A machine to measure flexid against: it simulates records, and shares no code with what is measured."""

from .axis import Axis, Controller, Record, Sensors, Truth, UnstableError, rms, simulate
from .trajectories import Limits, chirp, rich, triangles, updown

__all__ = [
    "Axis",
    "Controller",
    "Limits",
    "Record",
    "Sensors",
    "Truth",
    "UnstableError",
    "chirp",
    "rich",
    "rms",
    "simulate",
    "triangles",
    "updown",
]
