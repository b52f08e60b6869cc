"""From a file to a checked configuration, or to all of its mistakes at once."""

from __future__ import annotations

import codecs
import hashlib
import json
import sys
from dataclasses import dataclass, field
from pathlib import Path
from typing import TYPE_CHECKING

from flexid_cli.config.explain import Finding, explain_errors
from flexid_cli.config.schema import Config, broken_rules, nearest_word
from flexid_cli.config.yaml12 import Document, Plain, path_text, read_yaml
from flexid_cli.config.yaml12 import Path as NodePath
from flexid_cli.errors import ConfigError, InputError, Problem

if TYPE_CHECKING:
    from collections.abc import Iterable, Sequence

MAX_BYTES = 1_000_000
STDIN = Path("-")


@dataclass(frozen=True)
class LoadedConfig:
    """A configuration that knows where its values came from, for mistakes that only a log brings to light."""

    config: Config
    file: str
    _source: _Source

    def problem(self, message: str, path: NodePath, hint: str = "") -> Problem:
        """Describe a mistake at the node ``path``, for a ConfigError."""
        return self._source.problem(message, path, hint)


def load_config(path: Path, overrides: Sequence[str] = ()) -> Config:
    """Read and check a configuration file.

    Parameters
    ----------
    path : Path
        A YAML file; ``-`` reads standard input.
    overrides : sequence of str
        ``path=value`` as given with ``--set``; the value is YAML 1.2.

    Returns
    -------
    Config
        The checked configuration.

    Raises
    ------
    ConfigError
        With every mistake, in the order of lines.
    InputError
        The file cannot be read.
    """
    return load_located(path, overrides).config


def load_located(path: Path, overrides: Sequence[str] = ()) -> LoadedConfig:
    """Read a configuration like `load_config`, and keep the place of every node."""
    file = "<stdin>" if path == STDIN else str(path)
    text = _decode(_read(path), file)
    return _load(text, file, overrides)


def parse_config(text: str, file: str = "<text>", overrides: Sequence[str] = ()) -> Config:
    """Check a configuration given as text; ``file`` is its name in messages."""
    return _load(text, file, overrides).config


def config_digest(config: Config) -> str:
    """SHA-256 of the resolved configuration as canonical JSON; comments and spelling do not count."""
    canonical = json.dumps(
        config.resolved(), sort_keys=True, separators=(",", ":"), ensure_ascii=False, allow_nan=False
    )
    return hashlib.sha256(canonical.encode("utf-8")).hexdigest()


@dataclass
class _Source:
    """The document, and which nodes came from ``--set`` instead."""

    document: Document
    options: dict[NodePath, str] = field(default_factory=dict)

    def problem(self, message: str, path: NodePath, hint: str = "", *, at_key: bool = False) -> Problem:
        """Describe a mistake; ``at_key`` where the key is meant and not its value."""
        for end in range(len(path), 0, -1):
            option = self.options.get(path[:end])
            if option is not None:
                return Problem(f"--set {option}: {message}", path_text(path), hint=hint)
        document = self.document
        place = document.values.get(path)
        if at_key or place is None or self._spans_lines(path):
            place = document.keys.get(path, place)
        for end in range(len(path) - 1, -1, -1):
            if place is not None:
                break
            place = document.keys.get(path[:end]) or document.values.get(path[:end])
        return document.problem(message, place, path, hint)

    def _spans_lines(self, path: NodePath) -> bool:
        """Whether the node is a block below its key; then the key's line says more."""
        key, value = self.document.keys.get(path), self.document.values.get(path)
        return key is not None and value is not None and value.line > key.line


def _load(text: str, file: str, overrides: Sequence[str]) -> LoadedConfig:
    document = read_yaml(text)
    if document.data is None and document.problems:
        raise ConfigError(file, document.problems)
    source = _Source(document)
    data, problems = _mapping_of(document, file), list(document.problems)
    problems += _apply_overrides(data, overrides, source)
    config, more = _validate(data, source)
    problems += more
    if problems or config is None:
        raise ConfigError(file, _sorted(problems))
    return LoadedConfig(config, file, source)


def _mapping_of(document: Document, file: str) -> dict[str, Plain]:
    """Return the top level; what is no mapping is refused at once, for nothing else can be checked."""
    if isinstance(document.data, dict):
        return document.data
    if document.data is None:
        problem = Problem(
            "the configuration is empty",
            hint="`flexid inspect LOG --write-config FILE` proposes one; configs/ has commented examples",
        )
    else:
        found = "a list" if isinstance(document.data, list) else "text"
        problem = document.problem(
            f"a configuration begins with keys such as `version: 1`, but this is {found}",
            document.values.get(()),
            hint="is this the configuration, or the log itself? each key ends in a colon and a space",
        )
    raise ConfigError(file, [problem])


def _validate(data: dict[str, Plain], source: _Source) -> tuple[Config | None, list[Problem]]:
    from pydantic import ValidationError

    config, findings = None, []
    rule_text = ""
    try:
        config = Config.model_validate(data)
    except ValidationError as error:
        details = error.errors(include_url=False)
        findings = [
            f for f in explain_errors(details, data) if not _is_under(f.path, source.document.unreliable)
        ]
        rule_text = next((d["msg"] for d in details if d["type"] == "flexid_rule"), "")
    problems = [
        source.problem(f.message, f.path, f.hint, at_key=f.kind in {"unknown", "missing"}) for f in findings
    ]
    wrong = _wrong_paths(findings) | source.document.unreliable
    rules = list(broken_rules(data, frozenset(wrong)))
    problems += [source.problem(rule.message, rule.path, rule.hint) for rule in rules]
    if rule_text and not problems and not source.document.problems:
        problems.append(Problem(rule_text))
    return config, problems


def _wrong_paths(findings: Iterable[Finding]) -> set[NodePath]:
    """Nodes that rules must not judge by: wrong ones, and those that a misspelt key stands for."""
    wrong: set[NodePath] = set()
    for finding in findings:
        wrong.add(finding.path)
        if finding.meant:
            wrong.add((*finding.path[:-1], finding.meant))
    return wrong


def _is_under(path: NodePath, roots: set[NodePath]) -> bool:
    return any(path[:end] in roots for end in range(1, len(path) + 1))


def _sorted(problems: Iterable[Problem]) -> list[Problem]:
    return sorted(problems, key=lambda problem: (problem.line or sys.maxsize, problem.column))


def _apply_overrides(data: dict[str, Plain], overrides: Sequence[str], source: _Source) -> list[Problem]:
    problems = []
    for option in overrides:
        problem = _apply_override(data, option, source)
        if problem is not None:
            problems.append(problem)
    return problems


def _apply_override(data: dict[str, Plain], option: str, source: _Source) -> Problem | None:
    name, equals, text = option.partition("=")
    path: NodePath = tuple(name.strip().split("."))
    if not equals or "" in path:
        return _option_problem(option, "this is not KEY=VALUE", "for example --set axis.f1_hz=3.9")
    value = read_yaml(text)
    if value.problems:
        first = value.problems[0]
        return _option_problem(option, first.message, first.hint)
    if value.data is None and not value.values:
        return _option_problem(
            option, "there is no value after the =", 'write null for `not given`; quote text with # as "#"'
        )
    section = data
    for end, step in enumerate(path[:-1], start=1):
        child = section.get(str(step))
        if child is None:
            child = section[str(step)] = {}
            source.options[path[:end]] = option
        if not isinstance(child, dict):
            return _option_problem(
                option, f"{path_text(path[:end])} has no keys of its own", "set it as a whole"
            )
        section = child
    section[str(path[-1])] = value.data
    source.options[path] = option
    source.document.unreliable.discard(path)
    return None


def _option_problem(option: str, message: str, hint: str) -> Problem:
    return Problem(f"--set {option}: {message}", hint=hint)


def _read(path: Path) -> bytes:
    try:
        if path == STDIN:
            return sys.stdin.buffer.read(MAX_BYTES + 1)
        if path.is_dir():
            message = f"{path} is a folder, not a configuration file"
            raise InputError(message, "name the YAML file inside it")
        with path.open("rb") as stream:
            return stream.read(MAX_BYTES + 1)
    except FileNotFoundError as error:
        message = f"there is no configuration file {path}"
        raise InputError(message, _nearest_file(path)) from error
    except OSError as error:
        message = f"cannot read the configuration {path}: {error.strerror or error}"
        raise InputError(message) from error


def _nearest_file(path: Path) -> str:
    folder = path.parent
    names = sorted(p.name for p in folder.glob("*.y*ml")) if folder.is_dir() else []
    near = nearest_word(path.name, names)
    if near:
        return f"did you mean {folder / near}?"
    return "`flexid inspect LOG --write-config FILE` proposes one; configs/ has commented examples"


def _decode(data: bytes, file: str) -> str:
    cure = "is this the configuration, or the log itself?"
    if data.startswith((codecs.BOM_UTF16_LE, codecs.BOM_UTF16_BE)):
        raise ConfigError(file, [Problem("the file is in UTF-16", hint="save it as UTF-8")])
    if b"\0" in data:
        raise ConfigError(file, [Problem("this is a binary file, not a configuration", hint=cure)])
    if len(data) > MAX_BYTES:
        raise ConfigError(file, [Problem("the file is too large to be a configuration", hint=cure)])
    try:
        return data.decode("utf-8")
    except UnicodeDecodeError as error:
        before = data[: error.start].decode("utf-8").splitlines(keepends=False) or [""]
        if data[: error.start].endswith((b"\n", b"\r")):
            before.append("")
        line = data.splitlines()[len(before) - 1].decode("utf-8", errors="replace")
        problem = Problem(
            f"byte 0x{data[error.start]:02x} is not UTF-8",
            line=len(before),
            column=len(before[-1]) + 1,
            source_line=line,
            hint=f"save the file as UTF-8; {cure}",
        )
        raise ConfigError(file, [problem]) from error
