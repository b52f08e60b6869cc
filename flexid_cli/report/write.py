"""Every requested output rendered, before anything is written."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any
from urllib.parse import quote

from flexid_cli.errors import UsageError
from flexid_cli.report.json import render_json
from flexid_cli.report.markdown import FIGURE_KINDS, render_markdown

if TYPE_CHECKING:
    from collections.abc import Mapping, Sequence
    from pathlib import Path

    from flexid_cli.diagnose.result import Diagnosis
    from flexid_cli.estimate.result import Identification

SUFFIXES = (".json", ".md")


def check_formats(outputs: Sequence[Path]) -> None:
    """Refuse formats that do not exist and files named twice, before any work is done.

    Raises
    ------
    UsageError
        A suffix is not one of `SUFFIXES`, or two outputs are the same file.
    """
    seen: set[Path] = set()
    for path in outputs:
        if path.suffix.lower() not in SUFFIXES:
            why = (
                f"the suffix {path.suffix!r} is that of no report"
                if path.suffix
                else "its name has no suffix"
            )
            message = f"cannot write {path}: {why}"
            raise UsageError(message, "supported: " + ", ".join(SUFFIXES))
        if path.absolute() in seen:
            message = f"the output {path} is asked for twice"
            raise UsageError(message, "give each -o its own file name")
        seen.add(path.absolute())


def render_outputs(
    document: Mapping[str, Any], result: Identification | Diagnosis, outputs: Sequence[Path]
) -> dict[Path, str]:
    """Render each output in the format that its suffix names.

    The figures of a Markdown report are files beside it, ``<stem>_<model>_<kind>.svg`` or
    ``<stem>_diagnosis_<kind>.svg``, with relative links.

    Parameters
    ----------
    document : mapping
        From `build_document`.
    result : Identification or Diagnosis
        Where the figures' curves come from.
    outputs : sequence of Path
        Files to make. Nothing is written here.

    Returns
    -------
    dict of Path to str
        Content of every file, to be handed to `flexid_cli.writers.files.write_files` at once.

    Raises
    ------
    UsageError
        As `check_formats`.
    """
    check_formats(outputs)
    contents: dict[Path, str] = {}
    figures = _figures(result) if any(_is_markdown(path) for path in outputs) else {}
    for path in outputs:
        if _is_markdown(path):
            files = {key: path.with_name(f"{path.stem}_{key}.svg") for key in figures}
            links = {key: quote(file.name) for key, file in files.items()}
            contents[path] = render_markdown(document, links)
            contents.update({files[key]: figures[key] for key in figures})
        else:
            contents[path] = render_json(document)
    return contents


def _is_markdown(path: Path) -> bool:
    return path.suffix.lower() == ".md"


def _figures(result: Identification | Diagnosis) -> dict[str, str]:
    """Every figure by the key that `render_markdown` expects; each is drawn once."""
    from flexid_cli.diagnose.result import Diagnosis
    from flexid_cli.report.figures import diagnosis_figures, model_figures

    if isinstance(result, Diagnosis):
        return diagnosis_figures(result)
    drawn = {model.id: model_figures(model) for model in result.models}
    return {f"{id_}_{kind}": figures[kind] for id_, figures in drawn.items() for kind in FIGURE_KINDS}
