"""The one family of errors that reaches the user: a message, its cure and an exit code."""

from __future__ import annotations

from dataclasses import dataclass


class FlexidError(Exception):
    """What is wrong, and how to cure it.

    Parameters
    ----------
    message : str
        What is wrong and where (file, line, channel, time), in one or two sentences.
    hint : str, optional
        How to cure it.
    """

    exit_code = 2

    def __init__(self, message: str, hint: str = "") -> None:
        super().__init__(message)
        self.message = message
        self.hint = hint

    def __str__(self) -> str:
        return f"{self.message}\n  hint: {self.hint}" if self.hint else self.message


class UsageError(FlexidError):
    """The command line asks for something impossible."""


class InputError(FlexidError):
    """A log cannot be read, or lacks what the configuration asks for."""


class OutputError(FlexidError):
    """A result cannot be written."""


class DataError(FlexidError):
    """The log is readable, but its data cannot decide the question (exit code 3)."""

    exit_code = 3


@dataclass(frozen=True)
class Problem:
    """One mistake in a configuration.

    Attributes
    ----------
    message : str
        What is wrong.
    path : str
        Dotted path of the node, for example ``signals.motor_position.unit``.
    line, column : int
        Position in the file, from 1; 0 where unknown.
    source_line : str
        The offending line as it stands in the file.
    hint : str
        The cure: nearest right word, the permitted values.
    """

    message: str
    path: str = ""
    line: int = 0
    column: int = 0
    source_line: str = ""
    hint: str = ""


class ConfigError(FlexidError):
    """A configuration with one or more mistakes; all of them are reported at once."""

    def __init__(self, file: str, problems: list[Problem]) -> None:
        self.file = file
        self.problems = tuple(problems)
        super().__init__("\n".join(self._describe(problem) for problem in problems))

    def _describe(self, problem: Problem) -> str:
        where = f"{self.file}:{problem.line}:{problem.column}" if problem.line else self.file
        text = f"{where}: {problem.message}"
        if problem.path:
            text += f"  ({problem.path})"
        if problem.source_line:
            margin = " " * len(str(problem.line))
            line, indent = _excerpt(problem.source_line, problem.column)
            text += f"\n {problem.line} | {line}"
            text += f"\n {margin} | {indent}^"
        if problem.hint:
            text += f"\n  hint: {problem.hint}"
        return text


def _excerpt(line: str, column: int, width: int = 100) -> tuple[str, str]:
    """Return the part of a long line around ``column``, and the white space that leads to that column."""
    start = max(0, column - 1 - width // 2) if len(line) > width else 0
    head, tail = "..." if start else "", "..." if start + width < len(line) else ""
    before = line[start : column - 1]
    indent = " " * len(head) + "".join("\t" if character == "\t" else " " for character in before)
    return head + line[start : start + width] + tail, indent
