"""Names of effects as a user gives them: on the command line, and in the configuration."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING

from flexid_cli.errors import ConfigError, UsageError

if TYPE_CHECKING:
    from collections.abc import Sequence

    import click
    from click.shell_completion import CompletionItem

    from flexid_cli.config.schema import Config

WHERE_THEY_ARE = "`flexid effects` lists them, `flexid explain NAME` prints one"


def as_written(word: str) -> str:
    """Name or code as the library writes it, however the user did."""
    plain = word.strip().lower().replace("-", "_").replace(" ", "_")
    return plain.upper() if plain.startswith("fx") else plain


def complete_effects(
    _context: click.Context, _parameter: click.Parameter, incomplete: str
) -> list[CompletionItem]:
    """Names that the last one of a list of names with commas may become."""
    from click.shell_completion import CompletionItem

    from flexid_cli.effects.registry import effects

    before, comma, last = incomplete.rpartition(",")
    return [CompletionItem(before + comma + e.name) for e in effects() if e.name.startswith(last)]


def with_override(options: Sequence[str]) -> list[str]:
    """``--with`` as a value for the configuration, in whose place it stands.

    Raises
    ------
    UsageError
        There is no effect of such a name, or none is named.
    """
    if not options:
        return []
    words = [word for option in options for word in option.split(",")]
    names = [_name(word, f"--with {','.join(options)}: ") for word in words if word.strip()]
    if not names:
        raise UsageError("--with names no effect", WHERE_THEY_ARE)
    return [f"estimate.with=[{', '.join(dict.fromkeys(names))}]"]


def load_config_with_effects(path: Path, overrides: Sequence[str]) -> Config:
    """Read a configuration whose effects exist.

    Raises
    ------
    ConfigError
        Something in it is wrong, or an effect is named that there is none of.
    InputError
        It cannot be read.
    """
    from flexid_cli.config.load import load_located

    loaded = load_located(path, overrides)
    problems = []
    for k, name in enumerate(loaded.config.estimate.effects or ()):
        try:
            _name(name, "")
        except UsageError as error:
            problems.append(loaded.problem(error.message, ("estimate", "with", k), error.hint))
    if problems:
        raise ConfigError(loaded.file, problems)
    return loaded.config


def _name(word: str, option: str) -> str:
    """The library's name for a word."""
    from difflib import get_close_matches

    from flexid_cli.effects.registry import effects

    name = as_written(word)
    known = {e.name: e.name for e in effects()} | {e.code: e.name for e in effects()}
    if name in known:
        return known[name]
    near = get_close_matches(name, known, n=2)
    guess = f"did you mean {' or '.join(near)}? " if near else ""
    raise UsageError(f"{option}there is no effect {word.strip()!r}", guess + WHERE_THEY_ARE)
