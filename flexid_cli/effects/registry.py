"""Every effect there is, found by looking into the family packages."""

from __future__ import annotations

import difflib
import importlib
import pkgutil
from functools import cache

from flexid_cli.effects.base import FAMILIES, Effect
from flexid_cli.errors import UsageError


@cache
def effects() -> tuple[Effect, ...]:
    """All effects, by code.

    Returns
    -------
    tuple of Effect
    """
    found: list[Effect] = []
    for family in FAMILIES:
        package = importlib.import_module(f"flexid_cli.effects.{family}")
        names = [f"{package.__name__}.{module.name}" for module in pkgutil.iter_modules(package.__path__)]
        found.extend(importlib.import_module(name).EFFECT for name in names)
    return tuple(sorted(found, key=lambda effect: effect.code))


def effect(name: str) -> Effect:
    """The effect of this name or code.

    Raises
    ------
    UsageError
        There is none.
    """
    known = {e.name: e for e in effects()} | {e.code: e for e in effects()}
    if name in known:
        return known[name]
    near = difflib.get_close_matches(name, known, n=1)
    names = ", ".join(e.name for e in effects())
    guess = f"did you mean {near[0]}? " if near else ""
    raise UsageError(f"there is no effect {name!r}", f"{guess}known: {names}")
