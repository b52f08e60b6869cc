"""The docstring of an effect as sections, for the report and for ``flexid explain``."""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from flexid_cli.effects.base import Effect


@dataclass(frozen=True)
class EffectText:
    """What the library says of an effect.

    Attributes
    ----------
    summary : str
        One sentence.
    sections : tuple of (str, tuple of str)
        Headings in their order, each with its paragraphs; line breaks of the source are gone.
    """

    summary: str
    sections: tuple[tuple[str, tuple[str, ...]], ...]


def effect_text(effect: Effect) -> EffectText:
    """Split the effect's text at its headings, the lines that are not indented."""
    summary, *lines = effect.text.strip().splitlines()
    bodies: dict[str, list[str]] = {}
    heading = ""
    for line in lines:
        if line and not line.startswith(" "):
            heading = line.strip()
            bodies[heading] = []
        elif heading:
            bodies[heading].append(line.strip())
    return EffectText(summary.strip(), tuple((title, _paragraphs(body)) for title, body in bodies.items()))


def _paragraphs(lines: list[str]) -> tuple[str, ...]:
    parts = "\n".join(lines).strip().split("\n\n")
    return tuple(" ".join(part.split()) for part in parts if part.strip())
