"""Parameters out of an earlier report, for ``flexid diagnose --report``."""

from __future__ import annotations

import json
from pathlib import Path
from typing import TYPE_CHECKING

from flexid_cli.errors import InputError

if TYPE_CHECKING:
    from flexid_cli.cli.options import Console
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


def _kind(torque_unit: object, linear: object) -> str:
    return f"{'linear' if linear else 'rotary'} axis with torque in {torque_unit}"


def known_input(path: Path) -> InputFile:
    """Entry of the report among the inputs."""
    from flexid_cli.readers.digest import digest
    from flexid_cli.report.document import SCHEMA, InputFile

    return InputFile(path=str(path), sha256=digest(path), format=SCHEMA, role="parameters")
