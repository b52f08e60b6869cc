"""Strict YAML: the core schema of YAML 1.2, with the place of every node.

PyYAML reads YAML 1.1, where ``1e4`` is text, ``no`` is False, ``1:30`` is 90 and the last of two equal keys
wins silently. Only its scanner and parser are used here; what scalars mean is decided by the core schema
(https://yaml.org/spec/1.2.2/#103-core-schema). Anchors, aliases, tags and merge keys are refused: a
configuration of a page does not need them, and a value should mean what stands there.
"""

from __future__ import annotations

import re
from dataclasses import dataclass, field
from typing import TYPE_CHECKING, NoReturn, TypeAlias

from yaml.error import MarkedYAMLError
from yaml.events import (
    AliasEvent,
    DocumentStartEvent,
    Event,
    MappingEndEvent,
    MappingStartEvent,
    NodeEvent,
    ScalarEvent,
    SequenceEndEvent,
    SequenceStartEvent,
    StreamEndEvent,
)
from yaml.parser import Parser
from yaml.reader import Reader
from yaml.scanner import Scanner

from flexid_cli.errors import Problem

if TYPE_CHECKING:
    from yaml._yaml import Mark as CMark
    from yaml.error import Mark

Path: TypeAlias = tuple[str | int, ...]
Plain: TypeAlias = "bool | int | float | str | list[Plain] | dict[str, Plain] | None"

MAX_DEPTH = 20
MAX_DIGITS = 400  # more than the largest double has; Python refuses to read very long integers
_AnyMark: TypeAlias = "Mark | CMark"
_LINE_BREAK = re.compile("\r\n|[\n\r\x85\u2028\u2029]")
_NULL = frozenset({"null", "Null", "NULL", "~"})
_TRUE = frozenset({"true", "True", "TRUE"})
_FALSE = frozenset({"false", "False", "FALSE"})
_DECIMAL = re.compile(r"[-+]?[0-9]+")
_OCTAL = re.compile(r"0o[0-7]+")
_HEXADECIMAL = re.compile(r"0x[0-9a-fA-F]+")
_FLOAT = re.compile(r"[-+]?(\.[0-9]+|[0-9]+(\.[0-9]*)?)([eE][-+]?[0-9]+)?")
_INFINITE = re.compile(r"[-+]?\.(inf|Inf|INF)")
_NAN = frozenset({".nan", ".NaN", ".NAN"})


@dataclass(frozen=True)
class Place:
    """Where a node begins; line and column count from 1."""

    line: int
    column: int


@dataclass
class Document:
    """One YAML document as plain data, the places of its nodes, and the mistakes in its form.

    Attributes
    ----------
    data : plain data
        None where the text is no YAML at all.
    lines : list of str
        The text's lines.
    keys, values : dict of path to Place
        Where the key and the value of a node begin; list items have values only.
    problems : list of Problem
        Syntax errors, duplicate keys, empty values, anchors, aliases, tags.
    unreliable : set of path
        Nodes whose value is not what the author meant, because one of the problems is about it.
    """

    data: Plain
    lines: list[str]
    keys: dict[Path, Place] = field(default_factory=dict)
    values: dict[Path, Place] = field(default_factory=dict)
    problems: list[Problem] = field(default_factory=list)
    unreliable: set[Path] = field(default_factory=set)

    def problem(self, message: str, place: Place | None, path: Path = (), hint: str = "") -> Problem:
        """Describe a mistake at ``place``, with the line it is on."""
        if place is None:
            return Problem(message, path_text(path), hint=hint)
        line = self.lines[place.line - 1] if place.line <= len(self.lines) else ""
        return Problem(message, path_text(path), place.line, place.column, line, hint)


def path_text(path: Path) -> str:
    """Spell a path as people do: ``signals.motor_position.unit``, ``models[1]``."""
    text = ""
    for step in path:
        text += f"[{step}]" if isinstance(step, int) else f".{step}" if text else step
    return text


def read_yaml(text: str) -> Document:
    """Read one YAML 1.2 document.

    Parameters
    ----------
    text : str
        The text; a byte order mark at its start is ignored.

    Returns
    -------
    Document
        With ``data`` None where a syntax error stops the reading. Never raises for bad text: all mistakes
        are in ``problems``.
    """
    text = text.removeprefix("\ufeff")
    document = Document(None, _LINE_BREAK.split(text))
    unprintable = Reader.NON_PRINTABLE.search(text)
    if unprintable is not None:
        _report_unprintable(document, text, unprintable.start())
        return document
    try:
        document.data = _Builder(text, document).build()
    except MarkedYAMLError as error:
        document.data = None
        document.problems.append(_syntax_problem(error, document))
    except _GiveUpError:
        document.data = None
    return document


def parse_scalar(text: str) -> Plain:
    """Value of a plain (unquoted) scalar by the core schema of YAML 1.2."""
    if not text or text in _NULL:
        return None
    if text in _TRUE or text in _FALSE:
        return text in _TRUE
    if len(text) > MAX_DIGITS:
        return text
    if _DECIMAL.fullmatch(text):
        return int(text)
    if _OCTAL.fullmatch(text) or _HEXADECIMAL.fullmatch(text):
        return int(text, 0)
    if _FLOAT.fullmatch(text):
        return float(text)
    if _INFINITE.fullmatch(text):
        return float(text.replace(".", ""))
    return float("nan") if text in _NAN else text


class _GiveUpError(Exception):
    """Reading stops; the reason is among the document's problems already."""


class _Events(Reader, Scanner, Parser):
    """PyYAML's reader, scanner and parser without its idea of what scalars mean."""

    def __init__(self, text: str) -> None:
        Reader.__init__(self, text)
        Scanner.__init__(self)
        Parser.__init__(self)

    def next(self) -> Event:
        """Return the next event, which there always is before the end of the stream."""
        event: Event = self.get_event()  # type: ignore[no-untyped-call]
        return event


class _Builder:
    """Turns events into plain data and notes every place."""

    def __init__(self, text: str, document: Document) -> None:
        self._events = _Events(text)
        self._document = document

    def build(self) -> Plain:
        self._events.next()  # start of the stream
        start = self._events.next()
        if isinstance(start, StreamEndEvent):
            return None
        if isinstance(start, DocumentStartEvent) and start.version not in {None, (1, 2)}:
            self._complain("only YAML 1.2 is read", start, (), "remove the %YAML line")
        data = self._node(self._events.next(), (), 0)
        self._events.next()  # end of the document
        rest = self._events.next()
        if not isinstance(rest, StreamEndEvent):
            self._complain(
                "a second document starts here", rest, (), "one file is one configuration: remove this ---"
            )
        return data

    def _node(self, event: Event, path: Path, depth: int) -> Plain:
        self._document.values[path] = _place(event.start_mark)
        if depth > MAX_DEPTH:
            self._stop("nested too deeply to be a configuration", event, path)
        if isinstance(event, NodeEvent):
            self._refuse_properties(event, path)
        if isinstance(event, MappingStartEvent):
            return self._mapping(path, depth)
        if isinstance(event, SequenceStartEvent):
            return self._sequence(path, depth)
        if isinstance(event, ScalarEvent):
            return self._scalar(event, path)
        return None

    def _mapping(self, path: Path, depth: int) -> dict[str, Plain]:
        data: dict[str, Plain] = {}
        while not isinstance(event := self._events.next(), MappingEndEvent):
            key = self._key(event, path)
            child = (*path, key)
            first = self._document.keys.get(child)
            if first is None:
                self._document.keys[child] = _place(event.start_mark)
                data[key] = self._node(self._events.next(), child, depth + 1)
            else:
                self._complain(
                    f"key {key!r} stands here a second time",
                    event,
                    child,
                    f"it stands in line {first.line} already: keep one of the two",
                )
                self._skip(child, depth)
        return data

    def _key(self, event: Event, path: Path) -> str:
        if not isinstance(event, ScalarEvent):
            self._stop(
                "a key has to be a word",
                event,
                path,
                "quote * and & where they belong to a name" if isinstance(event, AliasEvent) else "",
            )
        key = str(event.value)
        self._refuse_properties(event, (*path, key))
        if key == "<<":
            self._complain(
                "merge keys are not part of YAML 1.2", event, (*path, key), "write the keys out in full"
            )
            self._document.unreliable.add((*path, key))
        return key

    def _skip(self, path: Path, depth: int) -> None:
        """Read past a value without letting it replace places of its first namesake."""
        aside = Document(None, self._document.lines)
        kept, self._document = self._document, aside
        try:
            self._node(self._events.next(), path, depth + 1)
        finally:
            self._document = kept
            kept.problems += aside.problems

    def _sequence(self, path: Path, depth: int) -> list[Plain]:
        data: list[Plain] = []
        while not isinstance(event := self._events.next(), SequenceEndEvent):
            data.append(self._node(event, (*path, len(data)), depth + 1))
        return data

    def _scalar(self, event: ScalarEvent, path: Path) -> Plain:
        text = str(event.value)
        if event.style is not None:
            return text
        if not text and event.tag is None and event.anchor is None and path:
            self._complain_of_no_value(event, path)
            self._document.unreliable.add(path)
        return parse_scalar(text)

    def _complain_of_no_value(self, event: ScalarEvent, path: Path) -> None:
        head, colon, tail = str(path[-1]).partition(":")
        if colon and head and tail:
            hint = f"write a space after the colon: {head}: {tail}"
        else:
            hint = "give a value, or null (a section: {}) for `not given`, or remove the line"
            hint += "; quote text that starts with #"
        self._complain("there is no value here", event, path, hint, self._document.keys.get(path))

    def _refuse_properties(self, event: NodeEvent, path: Path) -> None:
        tag = getattr(event, "tag", None)
        if event.anchor is not None or tag is not None:
            self._document.unreliable.add(path)
        if isinstance(event, AliasEvent):
            self._complain(
                f"aliases (*{event.anchor}) are not read",
                event,
                path,
                "write the value out; quote text with *",
            )
        elif event.anchor is not None:
            self._complain(
                f"anchors (&{event.anchor}) are not read",
                event,
                path,
                "remove it; quote text that starts with &",
            )
        if tag is not None:
            short = str(tag).replace("tag:yaml.org,2002:", "!!")
            self._complain(
                f"tags ({short}) are not read", event, path, "remove it; quote text that starts with !"
            )

    def _complain(
        self, message: str, event: Event, path: Path, hint: str = "", place: Place | None = None
    ) -> None:
        place = place or _place(event.start_mark)
        self._document.problems.append(self._document.problem(message, place, path, hint))

    def _stop(self, message: str, event: Event, path: Path, hint: str = "") -> NoReturn:
        self._complain(message, event, path, hint)
        raise _GiveUpError


def _place(mark: _AnyMark | None) -> Place:
    if mark is None:
        return Place(1, 1)
    return Place(mark.line + 1, mark.column + 1)


def _report_unprintable(document: Document, text: str, index: int) -> None:
    before = _LINE_BREAK.split(text[:index])
    place = Place(len(before), len(before[-1]) + 1)
    document.problems.append(
        Problem(
            f"character U+{ord(text[index]):04X} cannot stand in a text file",
            line=place.line,
            column=place.column,
            hint="is this the configuration, or the log itself?",
        )
    )


def _syntax_problem(error: MarkedYAMLError, document: Document) -> Problem:
    """PyYAML's complaint in plain words, at the place where the cure belongs."""
    what, context = error.problem or "", error.context or ""
    here, start = error.problem_mark, error.context_mark
    if here is None:
        return document.problem(f"not YAML: {what or context}", None)
    place = _place(here)
    line = document.lines[here.line] if here.line < len(document.lines) else ""
    character = line[here.column : here.column + 1]
    if "\t" in line[: here.column + 1] and ("\\t" in what or not line[: here.column].strip()):
        tab = Place(place.line, line.index("\t") + 1)
        return document.problem("a tab cannot indent YAML", tab, hint="use spaces")
    if what.startswith(("expected ',' or '}'", "expected ',' or ']'")):
        return _flow_problem(document, place, start, character, "}" if "'}'" in what else "]")
    if "mapping values are not allowed" in what:
        return document.problem(
            "this colon cannot stand here",
            place,
            hint="indent the line like its neighbours; write `key: value`, with a space, in the line above;"
            " quote text that contains ': '",
        )
    if "could not find expected ':'" in what:
        return document.problem(
            "this is neither `key: value` nor a list item",
            _place(start) if start is not None else place,
            hint="write a colon and a space after the key",
        )
    if "unexpected end of stream" in what or "unexpected document separator" in what:
        opening = _place(start) if start is not None else place
        return document.problem("this quotation is never closed", opening, hint="add the closing quote")
    if "expected <block end>" in what:
        return document.problem(
            "this does not fit the lines above it", place, hint="check the indentation and the quotes"
        )
    if "cannot start any token" in what:
        return document.problem(f"text cannot start with {character!r}", place, hint="put the text in quotes")
    if "expected the node content" in what:
        return document.problem(
            f"no value can start with {character!r}" if character else "a value is missing here",
            place,
            hint="put text with brackets or commas in quotes",
        )
    if "sequence entries are not allowed" in what:
        return document.problem(
            "a list item cannot stand here",
            place,
            hint="start it on a line of its own, or put text in quotes",
        )
    if "unknown escape character" in what:
        return document.problem(
            what.replace("found ", ""),
            place,
            hint="use 'single quotes', in which \\ is an ordinary character",
        )
    return document.problem(f"not YAML: {what}" + (f" ({context})" if context else ""), place)


def _flow_problem(
    document: Document, place: Place, start: _AnyMark | None, character: str, closing: str
) -> Problem:
    if character in {"[", "{"} and start is not None:
        return document.problem(
            f"{character!r} cannot stand unquoted inside {{...}} or [...]",
            place,
            hint='put text with brackets in quotes, for example {source: "/topic/effort[2]"}',
        )
    opening = _place(start) if start is not None else place
    if opening.line != place.line:
        return document.problem(
            f"this bracket is not closed: there is no {closing!r} before line {place.line}",
            opening,
            hint=f"add {closing!r}; text with #, brackets or commas has to be quoted",
        )
    return document.problem(
        f"a comma or {closing!r} is missing here",
        place,
        hint="separate the entries by commas; quote text with brackets, commas or ': '",
    )
