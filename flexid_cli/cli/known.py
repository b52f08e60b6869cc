"""Parameters out of an earlier report or of a simulator's log, for ``flexid diagnose``."""

from __future__ import annotations

import json
from pathlib import Path
from typing import TYPE_CHECKING

from flexid_cli.errors import InputError

if TYPE_CHECKING:
    from flexid_cli.cli.options import Console
    from flexid_cli.config.schema import Config
    from flexid_cli.report.document import InputFile
    from flexid_cli.signals.recording import Recording


def known_parameters(path: Path, recording: Recording, console: Console) -> dict[str, float]:
    """Estimates of a report by symbol (SI, joint side), for a recording in the same units.

    Raises
    ------
    InputError
        The file is no report, is of an axis with other units, or does not hold a flexible axis.
    """
    from flexid_cli.simulate.parameters import from_report

    given = from_report(path)
    reported = json.loads(path.read_bytes()).get("recording") or {}
    theirs = (reported.get("torque_unit"), reported.get("linear"))
    if theirs != (recording.torque_unit, recording.linear):
        ours = _kind(recording.torque_unit, recording.linear)
        raise InputError(
            f"{path} is of a {_kind(*theirs)}, the recording of a {ours}",
            "give a report that was made with the same kind of configuration",
        )
    for note in given.notes:
        console.warning(note)
    return dict(given.values)


def simulated_parameters(
    path: Path, simulated: Recording, config: Config, console: Console
) -> dict[str, float]:
    """Estimates by symbol (SI, joint side) of the log of a simulator, which may hold more than the model does.

    Raises
    ------
    DataError
        The log is too short, or shows no flexible axis at all.
    """
    from flexid_cli.diagnose.diagnose import diagnose

    found = diagnose(simulated, config)
    if found.verdict != "adequate":
        console.warning(
            f"{path}: the simulation is not the plain model itself. {found.sentence} What recording and simulation"
            " share is not what your simulator leaves out."
        )
    return {e.symbol: e.value for e in found.parameters_after if e.value is not None}


def _kind(torque_unit: object, linear: object) -> str:
    return f"{'linear' if linear else 'rotary'} axis with torque in {torque_unit}"


def known_input(path: Path) -> InputFile:
    """Entry of the report among the inputs."""
    from flexid_cli.readers.digest import digest
    from flexid_cli.report.document import SCHEMA, InputFile

    return InputFile(path=str(path), sha256=digest(path), format=SCHEMA, role="parameters")
