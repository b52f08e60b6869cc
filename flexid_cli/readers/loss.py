"""What a container could not give: counted while it is read."""

from __future__ import annotations

from dataclasses import dataclass, field

_MOST_REASONS = 20  # a file that is damaged everywhere needs no longer list


@dataclass
class Loss:
    """Damage that a container met in the messages it was asked for.

    Attributes
    ----------
    messages : int or None
        Messages that are lost; None where their number cannot be known.
    size : int
        Bytes of the file that gave nothing.
    chunks : int
        Chunks (pages) that gave nothing.
    spans_ns : list of (int, int)
        Log times before and after each lost stretch, where they are known.
    reasons : list of str
        One sentence each, with positions in the file.
    """

    messages: int | None = 0
    size: int = 0
    chunks: int = 0
    spans_ns: list[tuple[int, int]] = field(default_factory=list)
    reasons: list[str] = field(default_factory=list)

    def add(self, reason: str, messages: int | None = 0, size: int = 0, chunks: int = 0) -> None:
        """Count one damaged place."""
        if self.messages is not None:
            self.messages = None if messages is None else self.messages + messages
        self.size += size
        self.chunks += chunks
        if reason not in self.reasons:
            if len(self.reasons) < _MOST_REASONS:
                self.reasons.append(reason)
            elif len(self.reasons) == _MOST_REASONS:
                self.reasons.append("more places are damaged")

    @property
    def any(self) -> bool:
        """Whether anything is damaged."""
        return bool(self.reasons)
