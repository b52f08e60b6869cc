"""The bytes of a text file, unpacked piece by piece, past places where the packing is damaged."""

from __future__ import annotations

import struct
import zlib
from collections import deque
from collections.abc import Callable, Generator, Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import BinaryIO

from flexid_cli.readers.checksum import crc32
from flexid_cli.readers.damage import explain, unreadable

GZIP_MAGIC = b"\x1f\x8b"
ZSTD_MAGIC = b"\x28\xb5\x2f\xfd"
_MEMBER = b"\x1f\x8b\x08"
_READ = 1 << 20
_BLOCK = 1 << 19
_PACKED = 1 << 16  # bytes given to zlib at once: what is lost where it fails
_PLAIN = 1 << 19  # bytes taken from zlib at once, however well they were packed
_TRIED = 1 << 12
_ZSTD_BLOCK = 1 << 17  # the format's largest block
# A wrong bit leads deflate and zstd astray within the block that holds it, and they notice there or at the
# start of the next one. Blocks of the usual packers hold less text than this, and fewer packed bytes than two
# pieces: deflate's have some 16 thousand symbols of at most 48 bits.
_DOUBT = 1 << 20


@dataclass(frozen=True)
class Fault:
    """A place where the text does not go on as it was written.

    Attributes
    ----------
    words : str
        What is wrong, as the end of a sentence that begins with the file.
    doubt : int
        Bytes of text before this place that may be wrong.
    lost : int or None
        Lines that are lost here; None where their number cannot be known.
    lost_bytes : int
        Bytes of the file that gave no text.
    at_line : bool
        Whether the sentence begins with the number of the line that comes next.
    """

    words: str
    doubt: int = 0
    lost: int | None = None
    lost_bytes: int = 0
    at_line: bool = False


class _Feed:
    """The bytes of a file in order, with a look ahead."""

    def __init__(self, stream: BinaryIO, advance: Callable[[int], None]) -> None:
        self._stream = stream
        self._advance = advance
        self._ahead = b""
        self.position = 0

    def peek(self, count: int) -> bytes:
        """Return the next ``count`` bytes, or fewer at the end, without taking them."""
        if len(self._ahead) < count:
            self._ahead += self._stream.read(max(_READ, count - len(self._ahead)))
        return self._ahead[:count]

    def take(self, count: int) -> bytes:
        """Take the next ``count`` bytes, or fewer at the end."""
        taken = self.peek(count)
        self._ahead = self._ahead[len(taken) :]
        self.position += len(taken)
        self._advance(len(taken))
        return taken

    def back(self, data: bytes) -> None:
        """Put bytes back that were taken last."""
        self._ahead = data + self._ahead
        self.position -= len(data)
        self._advance(-len(data))

    def seek(self, mark: bytes, fits: Callable[[bytes], bool]) -> int:
        """Go to the next place that begins with ``mark`` and ``fits``, or to the end; return the way there."""
        start = self.position
        while True:
            ahead = self.peek(_READ)
            place = ahead.find(mark)
            if place < 0:
                self.take(max(1, len(ahead) - len(mark) + 1) if len(ahead) == _READ else len(ahead))
                if not self.peek(1):
                    return self.position - start
                continue
            self.take(place)
            if fits(self.peek(_TRIED)):
                return self.position - start
            self.take(1)


def pieces(path: Path, advance: Callable[[int], None]) -> Generator[bytes | Fault]:
    """Yield the text of a file, plain or packed with gzip or zstd, and the places where it is damaged.

    An empty piece says that a checksum has confirmed all that came before it.

    Parameters
    ----------
    path : Path
        The file.
    advance : callable
        Called with the number of bytes of the file that were read since the last call.

    Raises
    ------
    InputError
        The system does not give the file out.
    """
    try:
        with path.open("rb") as stream:
            start = stream.read(4)
            stream.seek(0)
            if start.startswith(GZIP_MAGIC):
                yield from _gzip(_Feed(stream, advance))
            elif start == ZSTD_MAGIC:
                yield from _zstd(_Feed(stream, advance))
            else:
                while block := stream.read(_BLOCK):
                    advance(len(block))
                    yield block
    except OSError as error:
        raise unreadable(path, error) from error


def has_checksum(path: Path) -> bool:
    """Whether a checksum covers the text of a file: always with gzip, with zstd where its first frame says so."""
    try:
        with path.open("rb") as stream:
            head = stream.read(5)
    except OSError as error:
        raise unreadable(path, error) from error
    return head.startswith(GZIP_MAGIC) or (
        head.startswith(ZSTD_MAGIC) and len(head) == 5 and bool(head[4] & 4)
    )


# --- gzip (RFC 1952) ------------------------------------------------------------


def _gzip(feed: _Feed) -> Iterator[bytes | Fault]:
    while feed.peek(1):
        size = _member_header(feed.peek(_READ))
        if size is None:
            yield from _between(feed, _MEMBER, _is_member)
            continue
        feed.take(size)
        yield from _inflated(feed)


def _between(feed: _Feed, mark: bytes, fits: Callable[[bytes], bool]) -> Iterator[Fault]:
    """Pass over what is no packed text; zeros behind the last text are padding."""
    place = feed.position
    while (ahead := feed.peek(_READ)) and not ahead.strip(b"\0"):
        feed.take(len(ahead))
    if not ahead:
        return
    lost = feed.seek(mark, fits)
    yield Fault(f"{lost} bytes from byte {place} on are no packed text", lost_bytes=lost)


def _member_header(head: bytes) -> int | None:
    """Return the length of the member's header at the start of ``head``, or None where there is none."""
    if len(head) < 10 or not head.startswith(_MEMBER) or head[3] & 0xE0:
        return None
    size, flags = 10, head[3]
    if flags & 4:
        size += 2 + int.from_bytes(head[size : size + 2], "little")
    for _ in range(bool(flags & 8) + bool(flags & 16)):  # name and comment end in a zero
        size = head.find(b"\0", size) + 1
        if size == 0:
            return None
    return size + 2 * bool(flags & 2)


def _is_member(head: bytes) -> bool:
    size = _member_header(head)
    if size is None:
        return False
    try:
        return bool(zlib.decompressobj(wbits=-15).decompress(head[size:], _TRIED))
    except zlib.error:
        return False


def _inflated(feed: _Feed) -> Iterator[bytes | Fault]:
    """Yield the text of one member, whose header was taken, and compare its checksum and length."""
    start, crc, size = feed.position, 0, 0
    sizes: deque[int] = deque([0], maxlen=3)  # of the text before each of the last pieces
    body = zlib.decompressobj(wbits=-15)
    while not body.eof:
        packed = body.unconsumed_tail
        if not packed:
            packed = feed.take(_PACKED)
            sizes.append(size)
        try:
            plain = body.decompress(packed, _PLAIN)
        except zlib.error as error:
            place = feed.position
            feed.back(packed)
            lost = feed.seek(_MEMBER, _is_member)
            why = explain(error).rpartition(": ")[2]
            yield Fault(
                f"its packing is damaged before byte {place} ({why}); {lost} bytes are lost",
                max(min(_DOUBT, size), size - sizes[0]), None, lost,
            )  # fmt: skip
            return
        if not packed and not plain:
            yield Fault("the file is cut short; what comes before was read")
            return
        crc, size = crc32(plain, crc), size + len(plain)
        if plain:
            yield plain
    feed.back(body.unused_data)
    stored = feed.take(8)
    if len(stored) < 8:
        yield Fault("the file is cut short inside its checksum", lost=0)
    elif struct.unpack("<II", stored) != (crc, size & 0xFFFFFFFF):
        words = f"the checksum of its packed content from byte {start} on is wrong, so any of it may be"
        yield Fault(words, size, 0)
    else:
        yield b""


# --- zstd (RFC 8878) ------------------------------------------------------------


def _zstd(feed: _Feed) -> Iterator[bytes | Fault]:
    while head := feed.peek(18):
        if head[1:4] == b"\x2a\x4d\x18" and head[0] >> 4 == 5 and len(head) >= 8:
            feed.take(8)
            _skip(feed, int.from_bytes(head[4:8], "little"))
            continue
        size = _frame_header(head)
        if size is None:
            yield from _between(feed, ZSTD_MAGIC, _is_frame)
            continue
        yield from _frame(feed, size)


def _skip(feed: _Feed, count: int) -> None:
    while count > 0 and (skipped := feed.take(min(count, _READ))):
        count -= len(skipped)


def _frame_header(head: bytes) -> int | None:
    """Return the length of the frame's header at the start of ``head``, or None where there is none."""
    if len(head) < 6 or not head.startswith(ZSTD_MAGIC) or head[4] & 0x08:
        return None
    flags = head[4]
    single = flags >> 5 & 1
    content = (single, 2, 4, 8)[flags >> 6]
    return 5 + (not single) + (0, 1, 2, 4)[flags & 3] + content


def _is_frame(head: bytes) -> bool:
    size = _frame_header(head)
    return size is not None and _block_size(head[size : size + 3]) is not None


def _block_size(header: bytes) -> int | None:
    """Bytes that follow a block's header, or None where it cannot be one."""
    if len(header) < 3:
        return None
    word = int.from_bytes(header, "little")
    kind, size = word >> 1 & 3, word >> 3
    if kind == 3 or size > _ZSTD_BLOCK:
        return None
    return 1 if kind == 1 else size


def _frame(feed: _Feed, header: int) -> Iterator[bytes | Fault]:
    """Yield the text of one frame block by block, so that one block at most is in memory."""
    import zstandard

    checked = bool(feed.peek(5)[4] & 4)
    frame = zstandard.ZstdDecompressor().decompressobj()
    start, size, last = feed.position, 0, False
    try:
        frame.decompress(feed.take(header))
        while not last:
            word = feed.take(3)
            length = _block_size(word)
            block = feed.take(length or 0)
            if len(word) < 3 or (length is not None and len(block) < length):
                yield Fault("the file is cut short; what comes before was read")
                return
            last = bool(word[0] & 1)
            plain = frame.decompress(word + block)  # fails where the size is impossible
            size += len(plain)
            if plain:
                yield plain
    except zstandard.ZstdError as error:
        place = feed.position
        lost = feed.seek(ZSTD_MAGIC, _is_frame)
        words = f"its packing is damaged before byte {place} ({explain(error)}); {lost} bytes are lost"
        yield Fault(words, min(_DOUBT, size), None, lost)
        return
    if not checked:
        return
    try:
        plain = frame.decompress(feed.take(4))
    except zstandard.ZstdError:
        words = f"the checksum of its packed content from byte {start} on is wrong, so any of it may be"
        yield Fault(words, size, 0)
        return
    yield b"" if frame.eof else Fault("the file is cut short inside its checksum", lost=0)
