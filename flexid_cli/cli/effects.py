"""``flexid effects``: the physics that a diagnosis can name."""

from __future__ import annotations

import json
import math
from typing import TYPE_CHECKING, Any

import click

from flexid_cli.cli.options import example, json_option

if TYPE_CHECKING:
    from collections.abc import Iterator

    from flexid_cli.effects.base import Effect, EffectParameter

WIDTH = 80
GAP = "  "


@click.command(
    short_help="List the effects that diagnose knows.",
    epilog=example("flexid effects", "flexid effects --json"),
)
@json_option
def effects(as_json: bool) -> None:
    """List every effect that `flexid diagnose` can name: code, name, family, the equation that it enters.

    `flexid explain NAME` says more about one of them.
    """
    from flexid_cli.effects.registry import effects as library

    if as_json:
        click.echo(
            json.dumps({"effects": [facts(effect) for effect in library()]}, indent=2, allow_nan=False)
        )
        return
    for line in _table(library()):
        click.echo(line)


def facts(effect: Effect) -> dict[str, Any]:
    """All that the library says of an effect, as plain data; units of a rotary and of a linear axis."""
    from flexid_cli.report.effect_text import effect_text

    text = effect_text(effect)
    return {
        "code": effect.code,
        "name": effect.name,
        "family": effect.family,
        "equation": effect.equation,
        "summary": text.summary,
        "term": effect.term,
        "parameters": [_parameter(parameter) for parameter in effect.parameters],
        "needs": list(effect.needs),
        "best_recording": effect.best_recording,
        "sections": [{"title": title, "paragraphs": list(parts)} for title, parts in text.sections],
    }


def _parameter(parameter: EffectParameter) -> dict[str, Any]:
    from flexid_cli.effects.base import unit_of

    return {
        "name": parameter.name,
        "symbol": parameter.symbol,
        "unit": unit_of(parameter.quantity),
        "unit_linear": unit_of(parameter.quantity, linear=True),
        "low": _bound(parameter.low),
        "high": _bound(parameter.high),
        "neutral": None if parameter.neutral is None else _bound(parameter.neutral),
    }


def _bound(value: float) -> float | None:
    """Return the bound, or None where there is none."""
    return value if math.isfinite(value) else None


def _table(library: tuple[Effect, ...]) -> Iterator[str]:
    from flexid_cli.report.effect_text import effect_text

    rows = [(e.code, e.name, e.family, e.equation) for e in library]
    titles = ("code", "name", "family", "equation")
    widths = [max(map(len, column)) for column in zip(titles, *rows, strict=True)]
    yield _row(titles, widths)
    yield GAP.join("-" * width for width in widths)
    for row, effect in zip(rows, library, strict=True):
        yield _row(row, widths)
        yield f"{' ' * (widths[0] + len(GAP))}{effect_text(effect).summary}"


def _row(cells: tuple[str, ...], widths: list[int]) -> str:
    return GAP.join(cell.ljust(width) for cell, width in zip(cells, widths, strict=True)).rstrip()
