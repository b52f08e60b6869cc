"""``flexid explain``: one effect of the library, in full."""

from __future__ import annotations

import json
import math
import textwrap
from typing import TYPE_CHECKING

import click

from flexid_cli.cli.effect_names import as_written, complete_effects
from flexid_cli.cli.options import example, json_option

if TYPE_CHECKING:
    from collections.abc import Iterator

    from flexid_cli.effects.base import Effect, EffectParameter

WIDTH = 80
INDENT = "  "
FAR = 1e6  # a bound from here on is none that physics sets


@click.command(
    short_help="Say what an effect is, and what to do about it.",
    epilog=example("flexid explain backlash", "flexid explain FX204"),
)
@click.argument("effect", shell_complete=complete_effects)
@json_option
def explain(effect: str, as_json: bool) -> None:
    """Print what the library says of EFFECT (a name or a code).

    What it is, what it looks like in the data, how to confirm it, what to do about it, its parameters, and the
    recording that shows it best.
    """
    from flexid_cli.cli.effects import facts
    from flexid_cli.effects.registry import effect as find

    found = find(as_written(effect))
    if as_json:
        click.echo(json.dumps(facts(found), indent=2, allow_nan=False))
        return
    for line in _lines(found):
        click.echo(line)


def _lines(effect: Effect) -> Iterator[str]:
    from flexid_cli.report.effect_text import effect_text

    text = effect_text(effect)
    yield f"{effect.code} {effect.name}"
    yield from _wrapped(text.summary, "")
    yield ""
    yield f"Family {effect.family}; enters the {effect.equation} equation."
    yield from textwrap.wrap(
        f"Term: {effect.term}",
        WIDTH,
        subsequent_indent=" " * 6,
        break_on_hyphens=False,
        break_long_words=False,
    )
    yield from _wrapped(f"Needs: {', '.join(effect.needs)}", "")
    for title, paragraphs in text.sections:
        yield from ("", title)
        for paragraph in paragraphs:
            yield from _wrapped(paragraph, INDENT)
    yield from ("", "Parameters")
    for parameter in effect.parameters:
        yield from _wrapped(_parameter(parameter), INDENT)
    yield from ("", "Best recording")
    yield from _wrapped(effect.best_recording, INDENT)


def _parameter(parameter: EffectParameter) -> str:
    from flexid_cli.effects.base import unit_of

    unit, linear = unit_of(parameter.quantity), unit_of(parameter.quantity, linear=True)
    shown = unit if unit == linear else f"{unit}, on a linear axis {linear}"
    role = "shape" if parameter.neutral is None else _neutral(parameter.neutral)
    return f"{parameter.symbol} {parameter.name} ({shown}): {_range(parameter)}{role}"


def _neutral(value: float) -> str:
    return f"no effect at {value:g}" if math.isfinite(value) else "no effect where infinite"


def _range(parameter: EffectParameter) -> str:
    """What physics admits; bounds that only keep numbers finite are left out."""
    low, high = (bound if abs(bound) < FAR else None for bound in (parameter.low, parameter.high))
    if low is None and high is None:
        return ""
    if high is None:
        return f"at least {low:g}, "
    return f"at most {high:g}, " if low is None else f"{low:g} to {high:g}, "


def _wrapped(text: str, indent: str) -> list[str]:
    return textwrap.wrap(
        text,
        WIDTH,
        initial_indent=indent,
        subsequent_indent=indent,
        break_on_hyphens=False,
        break_long_words=False,
    )
