"""The walk through an MCAP file from its first byte to its last, over damaged places too."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from dataclasses import dataclass, replace

from flexid_cli.readers.byte_source import ByteSource
from flexid_cli.readers.mcap_records import (
    CHANNEL,
    CHUNK,
    CHUNK_HEAD_BYTES,
    CODECS,
    DATA_END,
    FOOTER,
    INDEX_HEAD,
    LARGEST_CHUNK,
    MAGIC,
    MESSAGE,
    MESSAGE_INDEX,
    RECORD,
    SCHEMA,
    Chunk,
    Located,
    is_possible,
    parse_chunk,
    scan,
)
from flexid_cli.readers.mcap_salvage import Seeker
from flexid_cli.readers.mcap_summary import Summary

_FIRST_BLOCK, _BLOCK = 1 << 16, 1 << 22


@dataclass(frozen=True)
class ChunkPiece:
    """A chunk, the end of the message index records after it, and what was wrong with its head."""

    chunk: Chunk
    index_end: int
    reason: str = ""


@dataclass(frozen=True)
class LoosePiece:
    """Records outside chunks: ``messages`` lie in ``buffer``, which begins at byte ``position``.

    The last message is not to be trusted where ``last_is_doubtful``: what follows it is no record, so its
    length may be wrong.
    """

    buffer: bytes
    position: int
    messages: Located
    last_is_doubtful: bool = False
    follows_damage: bool = False


@dataclass(frozen=True)
class HolePiece:
    """Bytes that hold no record that can be read."""

    begin: int
    end: int
    reason: str


Piece = ChunkPiece | LoosePiece | HolePiece


class Walk:
    """Walks through a file.

    Parameters
    ----------
    source : ByteSource
        The file.
    summary : Summary
        Its end; not needed, but it tells a real end of the data from a damaged byte.
    seeker : Seeker
        Finds the next record behind damage.
    skips : callable
        Whether nothing is wanted of a chunk, which is then left out.

    Attributes
    ----------
    reached_end : bool
        Whether the end of the data was met.
    trailing : int
        Bytes after the end of the file's content.
    """

    def __init__(
        self, source: ByteSource, summary: Summary, seeker: Seeker, skips: Callable[[Chunk], bool]
    ) -> None:
        self.reached_end = False
        self.trailing = 0
        self._source = source
        self._summary = summary
        self._seeker = seeker
        self._skips = skips
        self._after_hole = False

    def pieces(self) -> Iterator[Piece]:
        """Yield all pieces in the order of the file."""
        place: int = len(MAGIC)
        while place < self._source.size and not self._is_end(place):
            head = self._source.peek(place, CHUNK_HEAD_BYTES)
            chunk = self._chunk(head, place)
            if chunk is not None:
                self._after_hole = False
                place = self._index_end(chunk.chunk)
                if not self._skips(chunk.chunk):
                    yield replace(chunk, index_end=place)
            elif len(head) >= RECORD.size and head[0] in {SCHEMA, CHANNEL, MESSAGE}:
                pieces = self._loose(place)
                yield from pieces
                last = pieces[-1]
                place = last.end if isinstance(last, HolePiece) else last.position + last.messages.stop
            else:
                following = self._plain_end(head, place)
                if following is None:
                    hole = self._hole(place, place + 1)
                    yield hole
                    following = hole.end
                place = following

    def indexed(self) -> Iterator[Piece]:
        """Yield the chunks that the summary lists, without a look at what lies between them."""
        self.reached_end = True
        for place, entry in sorted(self._summary.chunks.items()):
            end = place + entry.length
            if self._skips(_as_chunk(entry.position, end, entry.first_ns, entry.last_ns)):
                continue
            piece = self._chunk(self._source.peek(place, CHUNK_HEAD_BYTES), place)
            if piece is None:
                yield HolePiece(place, end, f"there is no chunk at byte {place}, where the index says")
            else:
                yield replace(piece, index_end=self._index_end(piece.chunk))

    def _is_end(self, place: int) -> bool:
        """Whether the data section ends at ``place``; notes what follows the file's own end."""
        head = self._source.peek(place, RECORD.size)
        if len(head) < RECORD.size:
            return False
        opcode, length = RECORD.unpack(head)
        if (opcode, length) == (DATA_END, 4) and (
            place == self._summary.data_end or self._seeker.leads_on(place + RECORD.size + 4)
        ):
            self.reached_end = True
            if self._summary.problem:
                self._find_trailing(place + RECORD.size + 4)
            return True
        if (opcode, length) == (FOOTER, 20):
            if self._source.peek(place + RECORD.size + 20, len(MAGIC)) != MAGIC:
                return False
            self.reached_end = True
            self.trailing = self._source.size - place - RECORD.size - 20 - len(MAGIC)
            return True
        return False

    def _find_trailing(self, place: int) -> None:
        """Walk over the summary to the closing magic, where the file has one but more follows."""
        while True:
            head = self._source.peek(place, RECORD.size)
            if len(head) < RECORD.size:
                return
            opcode, length = RECORD.unpack(head)
            if not is_possible(opcode, length):
                return
            place += RECORD.size + length
            if opcode == FOOTER:
                if self._source.peek(place, len(MAGIC)) == MAGIC:
                    self.trailing = self._source.size - place - len(MAGIC)
                return

    def _chunk(self, head: bytes, place: int) -> ChunkPiece | None:
        """Return the chunk at ``place``, if one of its damaged length fields can be replaced, too."""
        if len(head) < RECORD.size:
            return None
        opcode = head[0]
        chunk = parse_chunk(head, place, self._source.size)
        if chunk is not None and opcode == CHUNK:
            return ChunkPiece(chunk, chunk.end)
        if chunk is not None:
            known = chunk.codec in CODECS and not chunk.is_cut and chunk.packed > 0
            if known and self._seeker.leads_on(chunk.end):
                return ChunkPiece(chunk, chunk.end, "the kind of its record is damaged")
            return None
        if opcode != CHUNK:
            return None
        return self._repaired(head, place)

    def _repaired(self, head: bytes, place: int) -> ChunkPiece | None:
        name = int.from_bytes(head[37:41], "little")
        fixed = 40 + name
        if name > 32 or len(head) < 41 + name + 8:
            return None
        packed = int.from_bytes(head[41 + name : 49 + name], "little")
        length = RECORD.unpack_from(head)[1]
        for known, inner in ((packed + fixed, packed), (length, length - fixed)):
            if inner < 0 or inner > LARGEST_CHUNK or place + RECORD.size + known > self._source.size:
                continue
            mended = bytearray(head)
            mended[1:9] = known.to_bytes(8, "little")
            mended[41 + name : 49 + name] = inner.to_bytes(8, "little")
            chunk = parse_chunk(bytes(mended), place, self._source.size)
            if chunk is not None and chunk.end < self._source.size and self._seeker.leads_on(chunk.end):
                return ChunkPiece(chunk, chunk.end, "a length in its head is damaged")
        return None

    def _goes_on(self, place: int) -> bool:
        """Whether the file ends at ``place``, or a record begins there that can be read or repaired."""
        if place >= self._source.size or self._seeker.leads_on(place, depth=1):
            return True
        return self._chunk(self._source.peek(place, CHUNK_HEAD_BYTES), place) is not None

    def _known_index_end(self, chunk: Chunk) -> int | None:
        """Return the end of its message index records, where they are what a checked summary says; else None."""
        entry = self._summary.chunks.get(chunk.position) if self._summary.lists_all else None
        if entry is None or entry.position + entry.length != chunk.end or entry.indexes is None:
            return None
        for channel, (first, end) in entry.indexes.items():
            head = self._source.peek(first, INDEX_HEAD.size)
            size = end - first - INDEX_HEAD.size
            if head != INDEX_HEAD.pack(MESSAGE_INDEX, size + 6, channel, size):
                return None
        end = chunk.end + entry.index_bytes
        following = self._summary.chunks.get(end)
        if following is not None and self._source.peek(end, RECORD.size) == RECORD.pack(
            CHUNK, following.length - RECORD.size
        ):
            return end
        return end if self._goes_on(end) else None

    def _index_end(self, chunk: Chunk) -> int:
        """Return the end of the message index records after a chunk."""
        known = self._known_index_end(chunk)
        if known is not None:
            return known
        place = chunk.end
        while True:
            head = self._source.peek(place, RECORD.size + 6)
            if len(head) < RECORD.size + 6 or head[0] != MESSAGE_INDEX:
                return place
            length = RECORD.unpack_from(head)[1]
            inner = int.from_bytes(head[11:15], "little")
            end = place + RECORD.size + length
            if inner != length - 6 or inner % 16 or end > self._source.size:
                return place
            if not self._goes_on(end):  # some of its bytes are missing
                return place
            place = end

    def _plain_end(self, head: bytes, place: int) -> int | None:
        """Return the end of a record of no interest at ``place``, or None where none can be there."""
        if len(head) < RECORD.size:
            return None
        opcode, length = RECORD.unpack_from(head)
        end = place + RECORD.size + length
        unwanted = opcode in {CHUNK, DATA_END, FOOTER} or not is_possible(opcode, length)
        if unwanted or end > self._source.size or not self._goes_on(end):
            return None
        return int(end)

    def _loose(self, place: int) -> list[LoosePiece | HolePiece]:
        """Return the records outside chunks from ``place`` on, as many as one block holds."""
        count = _FIRST_BLOCK if self._source.peek(place, 1)[0] != MESSAGE else _BLOCK
        while True:
            buffer = self._source.read(place, count)
            located = scan(buffer, 0, len(buffer), loose=True)
            if located.stop:
                break
            length = RECORD.unpack_from(buffer)[1] if len(buffer) >= RECORD.size else 0
            whole = RECORD.size + length
            if not count < whole <= min(LARGEST_CHUNK, self._source.size - place):
                return [self._hole(place, place + 1)]
            count = whole
        stop = place + located.stop
        leads_on = self._goes_on(stop)
        piece = LoosePiece(buffer, place, located, not leads_on and located.count > 0, self._after_hole)
        if leads_on:
            return [piece]
        begin = place
        if located.count:
            begin = place + int(located.starts[-1])
        return [piece, self._hole(stop, min(begin, stop) + 1)]

    def _hole(self, begin: int, search_from: int) -> HolePiece:
        """Return the hole from ``begin`` to the next record, which is looked for from ``search_from`` on."""
        self._after_hole = True
        size = self._source.size
        found = self._seeker.next_record(search_from)
        end = size if found is None else found
        begin = min(begin, end)
        if found is not None:
            reason = f"bytes {begin} to {end} are no records"
        elif not any(self._source.read(begin, 1 << 16)):
            reason = f"the file holds only zeros from byte {begin} on"
        else:
            reason = f"the file is cut short or damaged from byte {begin} of {size} on"
        return HolePiece(begin, end, reason)


def _as_chunk(position: int, end: int, first_ns: int, last_ns: int) -> Chunk:
    return Chunk(position, end, first_ns, last_ns, 0, 0, "", position, 0)
