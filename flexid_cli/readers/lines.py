"""A text cut into blocks of whole lines, which threads parse while the next ones are read."""

from __future__ import annotations

import codecs
from collections import deque
from collections.abc import Callable, Generator, Iterable, Iterator
from concurrent.futures import Future, ThreadPoolExecutor
from dataclasses import replace
from typing import Generic, NamedTuple, TypeVar

from flexid_cli.readers.dialect import Dialect, is_whole, split_line
from flexid_cli.readers.packed import Fault

T = TypeVar("T")
_CHECKED = 1 << 16  # bytes that are worth a block of their own
_LONGEST_LINE = 1 << 20
_TAIL = 1 << 12  # bytes of the last lines, to judge the very last by
_LONGEST_CHARACTER = 4  # bytes in UTF-8
_ASCII_LIKE = {"ascii", "utf-8", "iso8859-1", "iso8859-15", "cp1252"}


class Block(NamedTuple):
    """Whole lines of a file, and how many bytes of text there were up to their end."""

    text: bytes
    stop: int


def is_like_ascii(encoding: str) -> bool:
    """Whether what is a digit or a delimiter in ASCII is nothing else in ``encoding``."""
    return codecs.lookup(encoding).name.removesuffix("-sig") in _ASCII_LIKE


def unified(found: Iterator[bytes | Fault], encoding: str, *, returns: bool) -> Iterator[bytes | Fault]:
    """Yield a text with line feeds at its line ends, in a superset of ASCII.

    Parameters
    ----------
    found : iterator of bytes or Fault
        The text as it stands in the file.
    encoding : str
        Its encoding. What is no superset of ASCII becomes UTF-8.
    returns : bool
        Whether there are carriage returns.
    """
    decoder = None if is_like_ascii(encoding) else codecs.getincrementaldecoder(encoding)(errors="replace")
    mark = codecs.BOM_UTF8 if encoding == "utf-8-sig" else b""
    held = b""  # a carriage return whose line feed may follow
    for piece in found:
        if isinstance(piece, Fault):
            if held:
                yield b"\n"
            held = b""
            if decoder is not None:
                decoder.reset()
            yield piece if decoder is None else replace(piece, doubt=_LONGEST_CHARACTER * piece.doubt)
            continue
        text = held + (piece.removeprefix(mark) if decoder is None else decoder.decode(piece).encode())
        mark = b""
        if returns:
            held = b"\r" if text.endswith(b"\r") else b""
            text = text[: len(text) - len(held)].replace(b"\r\n", b"\n").replace(b"\r", b"\n")
        yield text
    if held:
        yield b"\n"


class Cutter:
    """Cuts a text below its header into blocks of whole lines.

    A block has at least ``block`` bytes, or ends where a checksum confirms what came before, for doubts go back to
    the start of a block.
    """

    def __init__(self, dialect: Dialect, block: int) -> None:
        self._dialect = dialect
        self._block = block
        self._parts: list[bytes] = []
        self._size = 0
        self._done = 0
        self._skip = dialect.first_line - 1
        self._tail = b""
        self._too_long = 0  # bytes of a line without an end that were thrown away

    def feed(self, text: bytes) -> Iterator[Block | Fault]:
        """Take the next text; yield a block where there is enough of it."""
        self._parts.append(text)
        self._size += len(text)
        enough = self._block if text else _CHECKED
        if self._size >= enough or self._skip:
            yield from self._whole_lines()

    def fault(self, fault: Fault) -> Iterator[Block | Fault]:
        """Pass a fault on; no line goes on from before it to behind it, unless nothing is lost there."""
        yield from self._whole_lines()
        yield replace(fault, doubt=max(0, fault.doubt - self._size))
        if fault.lost is None:
            self._keep(b"")
            self._too_long = 0
            self._skip = max(self._skip, 1)

    def end(self) -> Iterator[Block | Fault]:
        """Yield what is left."""
        yield from self._whole_lines()
        rest = b"".join(self._parts)
        if self._too_long:
            yield self._no_line(len(rest))
        elif rest.strip():
            yield from self._last(rest)

    def _keep(self, rest: bytes) -> None:
        self._parts, self._size = [rest], len(rest)

    def _whole_lines(self) -> Iterator[Block | Fault]:
        """Yield the lines that have an end, and keep the rest."""
        rest: list[bytes] = []
        while self._parts and not (cut := self._parts[-1].rfind(b"\n") + 1):
            rest.insert(0, self._parts.pop())
        text = b""
        if self._parts:
            last = self._parts.pop()
            text = b"".join([*self._parts, memoryview(last)[:cut]])
            rest.insert(0, last[cut:])
        self._parts = rest
        self._size = sum(map(len, self._parts))
        start = 0
        while self._skip and (end := text.find(b"\n", start) + 1):
            start, self._skip = end, self._skip - 1
        if self._too_long and (end := text.find(b"\n", start) + 1):
            yield self._no_line(end - start)
            self._too_long, start = 0, end
        self._done += len(text)
        if start < len(text):
            self._tail = text[max(start, len(text) - _TAIL) :]
            yield Block(text[start:] if start else text, self._done)
        if self._size > _LONGEST_LINE:
            self._too_long += self._size
            self._done += self._size
            self._keep(b"")

    def _no_line(self, more: int) -> Fault:
        count = self._too_long + more
        return Fault(f"{count} bytes without a line end were left out", lost_bytes=count, at_line=True)

    def _last(self, rest: bytes) -> Iterator[Block | Fault]:
        """Yield the last line, which has no line end, if it is surely whole, else a fault."""
        zeros = len(rest) - len(rest.rstrip(b"\0"))
        if zeros:
            words = f"the file ends in {zeros} zero bytes, as after a loss of power"
            yield Fault(words, lost_bytes=zeros, at_line=True)
            return
        line = rest.decode("utf-8", "replace")
        if line.lstrip().startswith(self._dialect.comments):
            return
        if not self._skip and self._is_whole(line):
            yield Block(rest + b"\n", self._done + len(rest))
        else:
            words = "the last line was dropped, for it has no line end and it may be cut"
            yield Fault(words, lost=1, lost_bytes=len(rest), at_line=True)

    def _is_whole(self, line: str) -> bool:
        delimiter = self._dialect.delimiter
        before = self._tail.decode("utf-8", "replace").split("\n")[-21:-1]
        cells = split_line(line, delimiter)
        recent = [split_line(other, delimiter)[-1] for other in before if other.strip()]
        whole = len(cells) == len(self._dialect.fields)
        return whole and is_whole(cells[-1], recent, self._dialect.decimal)


def in_order(
    parse: Callable[[bytes], T], items: Iterable[Block | Fault], threads: int
) -> Generator[tuple[T, int] | Fault]:
    """Parse blocks in threads, a few of them at a time, and yield the results in order.

    The thread that takes the results is one of them: one more would stand in its way.
    """
    if threads == 1:
        for item in items:
            yield item if isinstance(item, Fault) else (parse(item.text), item.stop)
        return
    with ThreadPoolExecutor(threads - 1) as pool:
        waiting: deque[_Ahead[T] | Fault] = deque()
        for item in items:
            if isinstance(item, Fault):
                waiting.append(item)
            else:
                waiting.append(_Ahead(item, pool.submit(parse, item.text)))
            # One more than are parsed, so that no thread has to wait for the next.
            while len(waiting) > threads:
                yield _next(waiting, parse)
        while waiting:
            yield _next(waiting, parse)


class _Ahead(Generic[T]):
    """A block that waits for its turn; a thread parses it, if nobody else does before."""

    def __init__(self, block: Block, future: Future[T]) -> None:
        self.stop = block.stop
        self._text = [block.text]
        self.future = future
        self.result: list[T] = []

    def parse(self, parse: Callable[[bytes], T]) -> None:
        """Parse the block here, unless a thread has begun to."""
        if self.future.cancel():
            self.result.append(parse(self._text.pop()))
        else:
            self._text.clear()  # the thread that parses it lets go of it in its turn

    @property
    def is_done(self) -> bool:
        return bool(self.result) or self.future.done()


def _next(waiting: deque[_Ahead[T] | Fault], parse: Callable[[bytes], T]) -> tuple[T, int] | Fault:
    """Take the first result; until it is there, parse blocks that no thread has begun with."""
    first = waiting[0]
    if isinstance(first, Fault):
        waiting.popleft()
        return first
    for ahead in waiting:
        if first.is_done:
            break
        if isinstance(ahead, _Ahead) and not ahead.result:
            ahead.parse(parse)
    waiting.popleft()
    return first.result[0] if first.result else first.future.result(), first.stop
