"""Rows of an SQLite 3 table straight from its b-tree pages, many pages at a time.

The format is described at https://www.sqlite.org/fileformat2.html. SQLite itself hands over one row at a time,
and nothing at all of a file whose first page is gone or whose end is missing; the pages of a table's rows
(the leaves of its tree) describe themselves, so that every one which is whole can be read.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass
from typing import Any, BinaryIO

import numpy as np
from numpy.typing import NDArray

LEAF, INTERIOR = 13, 5
HEADER = 100  # bytes before the b-tree on page 1
_PADDING = 1024  # bytes after the pages in a block: a cell's head may be looked for at a page's very end
_WIDTHS = np.array([0, 1, 2, 3, 4, 6, 8, 8, 0, 0], dtype=np.int64)  # bytes by serial type
_PAGE_SIZES = (512, 1024, 2048, 4096, 8192, 16384, 32768, 65536)
_TEXT = {1: "utf-8", 2: "utf-16-le", 3: "utf-16-be"}
_TOGETHER = 1024  # inner pages that are read at once
_FIELDS = 6  # columns of `Rows` that differ from row to row, the page aside
_SHAPES = 6  # sizes of messages that are looked for in a block before each cell is taken by itself
_DEEPEST = 20  # levels; a tree of 2**32 pages has fewer

Ints = NDArray[np.int64]
Bytes = NDArray[np.uint8]


@dataclass(frozen=True)
class Columns:
    """Places of the columns that are read, in a table of ``count`` columns."""

    count: int
    topic: int
    time: int
    data: int


@dataclass(frozen=True)
class Rows:
    """Rows whose cells are whole, in the order of the pages they come from.

    Attributes
    ----------
    page : ndarray of int64, shape (n,)
        Place of the row's page in the block.
    rowid, topic, time : ndarray of int64, shape (n,)
        The row's number, and two of its columns.
    starts, lengths : ndarray of int64, shape (n,)
        First byte of the content in the block, and its length.
    local : ndarray of int64, shape (n,)
        Bytes of the content that stand there; where fewer than ``lengths``, the rest stands in the chain of
        pages whose first number follows them.
    bad : ndarray of int64, shape (m,)
        Number of cells in each page of the block that are not whole; -1 where the page is no leaf.
    """

    page: Ints
    rowid: Ints
    topic: Ints
    time: Ints
    starts: Ints
    lengths: Ints
    local: Ints
    bad: Ints

    def take(self, chosen: NDArray[np.bool_] | Ints) -> Rows:
        """Return some of the rows."""
        parts = (self.page, self.rowid, self.topic, self.time, self.starts, self.lengths, self.local)
        page, rowid, topic, time, starts, lengths, local = (part[chosen] for part in parts)
        return Rows(page, rowid, topic, time, starts, lengths, local, self.bad)


@dataclass(frozen=True)
class _Shape:
    """How a row is built: serial type and place of two numbers, place of the content, end of the head."""

    topic: tuple[int, int]
    time: tuple[int, int]
    data: int
    stop: int


class PageFile:
    """The pages of one database file, numbered from 1.

    Parameters
    ----------
    stream : BinaryIO
        The file.
    """

    def __init__(self, stream: BinaryIO) -> None:
        self._stream = stream
        self.size = stream.seek(0, 2)
        head = self._at(0, HEADER)
        self.whole_head = head.startswith(b"SQLite format 3\x00") and len(head) == HEADER
        self.page_size = self._page_size(head)
        self.usable = self.page_size - (head[20] if self.whole_head and head[20] < 64 else 0)
        self.count = self.size // self.page_size
        self.text = _TEXT.get(int.from_bytes(head[56:60], "big"), "utf-8") if self.whole_head else "utf-8"
        self.declared = self._declared(head)

    def _at(self, position: int, count: int) -> bytes:
        self._stream.seek(position)
        return self._stream.read(count)

    def _declared(self, head: bytes) -> int:
        """Number of pages that the file says it has, or 0 where it does not say it."""
        valid = self.whole_head and head[24:28] == head[92:96]
        return int.from_bytes(head[28:32], "big") if valid else 0

    def _page_size(self, head: bytes) -> int:
        """Page size as the file's head tells it, or as its pages show it where the head is destroyed.

        No single flipped bit turns one power of two into another. Pages of a multiple of the true size look
        as right as those of the true size, so the smallest that looks right is taken.
        """
        told = int.from_bytes(head[16:18], "big") if len(head) >= 18 else 0
        told = 65536 if told == 1 else told
        if self.whole_head and told in _PAGE_SIZES:
            return told
        scores = {size: self._score(size) for size in _PAGE_SIZES}
        enough = 0.75 * max(scores.values())
        return next(size for size, score in scores.items() if score >= enough) if enough > 0 else 4096

    def _score(self, size: int) -> float:
        """Share of some pages that look like a b-tree's or a chain's, would they be ``size`` bytes long."""
        count = self.size // size
        looked_at = range(1, count, max(count // 100, 1))
        if not looked_at:
            return 0.0
        good = 0
        for page in looked_at:
            head = self._at(page * size, 12)
            cells, content = int.from_bytes(head[3:5], "big"), int.from_bytes(head[5:7], "big") or 65536
            good += head[0] in {2, 5, 10, 13} and 0 < cells < size // 5 and 8 + 2 * cells <= content <= size
        return good / len(looked_at)

    def page(self, number: int) -> bytes:
        """Return one page, shorter where the file ends in it, and empty beyond."""
        return self._at((number - 1) * self.page_size, self.page_size) if number > 0 else b""

    def block(self, first: int, count: int) -> Bytes:
        """Return ``count`` pages from ``first`` on with some zeros after them, shape (bytes,)."""
        wanted = count * self.page_size
        block = np.empty(wanted + _PADDING, dtype=np.uint8)
        self._stream.seek((first - 1) * self.page_size)
        got = self._stream.readinto(block.data[:wanted])  # type: ignore[attr-defined]
        block[got:] = 0
        return block

    def scattered(self, pages: Ints) -> Bytes:
        """Return pages that do not follow each other as one block, with some zeros after them."""
        parts = [self.page(number).ljust(self.page_size, b"\x00") for number in pages.tolist()]
        return np.frombuffer(b"".join([*parts, bytes(_PADDING)]), dtype=np.uint8)

    def leaves(self, root: int) -> tuple[Ints, Ints] | None:
        """Find the leaves of the table at ``root`` in the order of their rows.

        Returns
        -------
        pages, keys : ndarray of int64, shape (n,)
            The leaves, and the largest row number that each may hold. None where the tree is damaged.
        """
        level = np.array([root], dtype=np.int64)
        keys = np.array([2**63 - 1], dtype=np.int64)
        seen = level
        for _ in range(_DEEPEST):
            if self._kind(int(level[0])) == LEAF:
                return level, keys
            parts = [
                self._children(level[at : at + _TOGETHER], keys[at : at + _TOGETHER])
                for at in range(0, level.size, _TOGETHER)
            ]
            found = [part for part in parts if part is not None]
            if len(found) < len(parts):
                return None
            level = np.concatenate([pages for pages, _ in found])
            keys = np.concatenate([bounds for _, bounds in found])
            seen = np.concatenate([seen, level])
            inside = level.min() > 0 and level.max() <= self.count
            if not inside or np.unique(seen).size < seen.size or (np.diff(keys) <= 0).any():
                return None
        return None

    def _kind(self, number: int) -> int:
        start = HEADER if number == 1 else 0
        page = self.page(number)
        return page[start] if len(page) > start else -1

    def _children(self, level: Ints, keys: Ints) -> tuple[Ints, Ints] | None:
        """Pages below the inner pages ``level``, whose largest rows are ``keys``, and theirs."""
        pages = [self.page(number) for number in level.tolist()]
        if level[0] == 1:
            pages[0] = pages[0][HEADER:] + bytes(HEADER)  # then every page's tree begins at its first byte
        if any(len(page) < self.page_size or page[0] != INTERIOR for page in pages):
            return None
        block = np.frombuffer(b"".join([*pages, bytes(_PADDING)]), dtype=np.uint8)
        base = np.arange(level.size) * self.page_size
        count = _short(block, base + 3)
        if (12 + 2 * count > self.page_size).any():
            return None
        owner, within = _spread(count)
        cell = _short(block, base[owner] + 12 + 2 * within)
        if level[0] == 1:
            cell[owner == 0] -= HEADER
        if ((cell < 12) | (cell > self.page_size - 5)).any():
            return None
        cell += base[owner]
        child = _long(block, cell)
        bound, _ = _varints(block, cell + 4)
        last = np.cumsum(count)
        return np.insert(child, last, _long(block, base + 8)), np.insert(bound, last, keys)

    def free(self) -> set[int]:
        """Numbers of the pages that the file's head lists as free; their rows were deleted."""
        head = self._at(0, HEADER)
        trunk = int.from_bytes(head[32:36], "big") if self.whole_head else 0
        found: set[int] = set()
        while 0 < trunk <= self.count and trunk not in found:
            page = self.page(trunk)
            listed = min(int.from_bytes(page[4:8], "big"), self.page_size // 4 - 2)
            found.add(trunk)
            found.update(int.from_bytes(page[8 + 4 * k : 12 + 4 * k], "big") for k in range(listed))
            trunk = int.from_bytes(page[:4], "big")
        return found

    def table(self, root: int) -> list[tuple[int, list[Any]]]:
        """Return all rows of a small table as row number and values; none where its tree is damaged."""
        found = self.leaves(root) if 0 < root <= self.count else None
        if found is None:
            return []
        pages = found[0].tolist()
        return [row for number in pages for row in self.texts(number, self.page(number))]

    def chain(self, number: int, length: int) -> bytes | None:
        """Return ``length`` bytes from the chain of pages that begins at ``number``, or None."""
        parts: list[bytes] = []
        room = self.usable - 4
        if length > self.size:
            return None
        while length > 0:
            if not 0 < number <= self.count:
                return None
            page = self.page(number)
            parts.append(page[4 : 4 + min(room, length)])
            number = int.from_bytes(page[:4], "big")
            length -= room
        return b"".join(parts)

    def local(self, payload: Ints) -> Ints:
        """Bytes of payloads of ``payload`` bytes that stand in the leaf itself."""
        largest, least = self.usable - 35, (self.usable - 12) * 32 // 255 - 23
        kept = least + (payload - least) % (self.usable - 4)
        return np.where(payload <= largest, payload, np.where(kept <= largest, kept, least))

    def cell_count(self, block: Bytes, pages: Ints) -> int:
        """Number of cells that the leaves ``pages`` of ``block`` say they hold."""
        base = pages * self.page_size
        return int(_short(block, base + 3)[block[base] == LEAF].sum())

    def rows(self, block: Bytes, pages: Ints, columns: Columns) -> Rows:
        """Take the rows out of ``pages``, numbered from 0 in ``block``; cells that are not whole are left out.

        Of a block that begins with page 1 of the file, that page is taken as no leaf: it holds the schema.
        """
        cells, owner, bad = self._cells(block, pages)
        ends = pages[owner] * self.page_size + self.usable
        table = np.zeros((_FIELDS, cells.size), dtype=np.int64)
        whole = np.zeros(cells.size, dtype=np.bool_)
        left: Ints | slice = slice(None)
        for _ in range(_SHAPES):
            if not cells[left].size:
                break
            fits, found = self._like_first(block, cells[left], ends[left], columns)
            if found is None:
                break
            if fits.all():
                table[:, left], whole[left], left = found, True, cells[:0]
                break
            places = np.flatnonzero(fits) if isinstance(left, slice) else left[fits]
            table[:, places], whole[places] = found[:, fits], True
            left = np.flatnonzero(~fits) if isinstance(left, slice) else left[~fits]
        if cells[left].size:
            whole[left], table[:, left] = self._each(block, cells[left], ends[left], columns)
        if not whole.all():
            np.add.at(bad, owner[~whole], 1)
            owner, table = owner[whole], table[:, whole]
        rowid, topic, time, starts, lengths, local = table
        return Rows(owner, rowid, topic, time, starts, lengths, local, bad)

    def _like_first(
        self, block: Bytes, cells: Ints, ends: Ints, columns: Columns
    ) -> tuple[NDArray[np.bool_], NDArray[np.int64] | None]:
        """Take the cells that are built as the first one is: all sizes are the same, the row's number aside.

        Returns
        -------
        fits : ndarray of bool, shape (n,)
            Which cells are.
        table : ndarray of int64, shape (6, n), or None
            Their columns in the order of `Rows`, meaningless where a cell does not fit; None where the first
            cell is damaged, has its content in other pages too, or has too long a head.
        """
        first = int(cells[0])
        head = block[first : first + _PADDING].tobytes()
        payload, rowid_at = _varint(head, 0)
        _, body = _varint(head, rowid_at)
        shape = self._shape(head, body, payload, columns)
        none = np.zeros(cells.size, dtype=np.bool_)
        if shape is None or body > 8 or shape.stop > 16:
            return none, None
        want = np.frombuffer(head[:16], dtype=">u8").astype(np.uint64)
        fixed = (
            bytes([255]) * rowid_at + bytes([128]) * (body - rowid_at) + bytes([255]) * (shape.stop - body)
        )
        mask = np.frombuffer(fixed.ljust(16, b"\x00"), dtype=">u8").astype(np.uint64)
        heads: NDArray[np.void] = np.ndarray((block.size - 15,), "V16", block, 0, (1,))
        words = heads[cells].view(">u8").reshape(-1, 2).astype(np.uint64).T
        fits = (words[0] & mask[0]) == (want[0] & mask[0])
        fits &= (words[1] & mask[1]) == (want[1] & mask[1])
        fits &= cells + (body + payload) <= ends
        table = np.empty((_FIELDS, cells.size), dtype=np.int64)
        table[0] = _packed_number(words[0] >> np.uint64(64 - 8 * body), body - rowid_at)
        inside = np.where(fits, cells, first) + body
        for row, (serial, offset) in ((1, shape.topic), (2, shape.time)):
            table[row] = _integers_of(block, inside + offset, serial)
        table[3] = cells + (body + shape.data)
        table[4] = table[5] = payload - shape.data
        fits &= table[0] > 0
        return fits, table

    def _shape(self, head: bytes, body: int, payload: int, columns: Columns) -> _Shape | None:
        """Read the head of one row; None where it is damaged, or not all of it is in its page."""
        size, at = _varint(head, body)
        offset = size
        places = []
        for _ in range(columns.count):
            serial, at = _varint(head, at)
            if serial in {10, 11}:
                return None
            places.append((serial, offset))
            offset += int(_WIDTHS[serial]) if serial < 10 else (serial - 12) // 2
        data, start = places[columns.data]
        numbers = places[columns.topic], places[columns.time]
        sound = at - body == size and offset == payload and data >= 12 and data % 2 == 0
        sound = sound and columns.data == columns.count - 1 and payload <= self.usable - 35
        if not sound or any(serial not in {1, 2, 3, 4, 5, 6, 8, 9} for serial, _ in numbers):
            return None
        return _Shape(*numbers, start, at)

    def _each(
        self, block: Bytes, cells: Ints, ends: Ints, columns: Columns
    ) -> tuple[NDArray[np.bool_], NDArray[np.int64]]:
        """Take cells of any build; return which are whole, and the columns of `Rows`, shape (6, n)."""
        payload, at = _varints(block, cells)
        rowid, body = _varints(block, at)
        head, at = _varints(block, body)
        offset = head.copy()  # from the body's begin to the column at hand
        whole = payload > 0
        places: dict[int, tuple[Ints, Ints]] = {}
        for place in range(columns.count):
            serial, at = _varints(block, at)
            width, sound = _width(serial)
            whole &= sound
            if place in (columns.topic, columns.time, columns.data):
                places[place] = serial, offset
            offset = offset + width
        whole &= (head == at - body) & (offset == payload) & (rowid > 0)
        for place in (columns.topic, columns.time):
            whole &= (places[place][0] > 0) & (places[place][0] < 10) & (places[place][0] != 7)
        serial, begin = places[columns.data]
        whole &= (serial >= 12) & (serial % 2 == 0)
        local = self.local(np.where(whole, payload, 0))
        whole &= (body + local + np.where(local < payload, 4, 0) <= ends) & (begin <= local)
        good = np.flatnonzero(whole)
        table = np.zeros((_FIELDS, cells.size), dtype=np.int64)
        table[0] = rowid
        for row, place in ((1, columns.topic), (2, columns.time)):
            serial, offset = places[place]
            table[row, good] = _integers(block, (body + offset)[good], serial[good])
        begin, length = begin[good], (places[columns.data][0][good] - 12) // 2
        table[3, good] = body[good] + begin
        table[4, good] = length
        table[5, good] = np.minimum(length, local[good] - begin)
        return whole, table

    def _cells(self, block: Bytes, pages: Ints) -> tuple[Ints, Ints, Ints]:
        """Positions of all cells in ``block``, the page of each, and for every page 0, or -1: no leaf."""
        base = pages * self.page_size
        count = _short(block, base + 3)
        content = _short(block, base + 5)
        content[content == 0] = 65536
        leaf = (block[base] == LEAF) & (8 + 2 * count <= content) & (content <= self.usable)
        count[~leaf] = 0
        owner, within = _spread(count)
        cell = _short(block, base[owner] + 8 + 2 * within)
        return base[owner] + np.minimum(cell, self.page_size - 1), owner, np.where(leaf, 0, -1)

    def texts(self, number: int, page: bytes) -> Iterator[tuple[int, list[Any]]]:
        """Yield the rows of one leaf as row number and values, whatever table it belongs to."""
        start = HEADER if number == 1 else 0
        if len(page) < self.page_size or page[start] != LEAF:
            return
        count = int.from_bytes(page[start + 3 : start + 5], "big")
        for place in range(start + 8, min(start + 8 + 2 * count, self.page_size - 1), 2):
            row = self._row(page, int.from_bytes(page[place : place + 2], "big"))
            if row is not None:
                yield row

    def _row(self, page: bytes, cell: int) -> tuple[int, list[Any]] | None:
        payload, at = _varint(page, cell)
        rowid, at = _varint(page, at)
        local = int(self.local(np.array([payload]))[0])
        body = page[at : at + local]
        if not 0 < payload <= self.size or len(body) < local:
            return None
        if local < payload:
            rest = self.chain(int.from_bytes(page[at + local : at + local + 4], "big"), payload - local)
            if rest is None:
                return None
            body += rest
        return self._values(rowid, body)

    def _values(self, rowid: int, body: bytes) -> tuple[int, list[Any]] | None:
        head, at = _varint(body, 0)
        values: list[Any] = []
        place = head
        while at < min(head, len(body)):
            serial, at = _varint(body, at)
            width = int(_WIDTHS[serial]) if serial < 10 else (serial - 12) // 2
            part = body[place : place + width]
            if serial in {10, 11} or len(part) < width:
                return None
            values.append(_value(serial, part, self.text))
            place += width
        return (rowid, values) if at == head and place == len(body) else None


def _value(serial: int, part: bytes, text: str) -> Any:
    if serial == 0:
        return None
    if serial in {8, 9}:
        return serial - 8
    if serial == 7:
        return float(np.frombuffer(part, ">f8")[0])
    if serial < 7:
        return int.from_bytes(part, "big", signed=True)
    return part.decode(text, errors="replace") if serial % 2 else part


def _varint(data: bytes, at: int) -> tuple[int, int]:
    """Return the variable-length number at ``at`` and the place after it; 0 beyond the end of ``data``."""
    value = 0
    for place in range(at, min(at + 8, len(data))):
        value = value << 7 | data[place] & 127
        if data[place] < 128:
            return value, place + 1
    if at + 8 < len(data):
        value = value << 8 | data[at + 8]
    return value, at + 9


def _short(block: Bytes, at: Ints) -> Ints:
    pairs: NDArray[np.uint16] = np.ndarray((block.size - 1,), ">u2", block, 0, (1,))
    return pairs[at].astype(np.int64)


def _long(block: Bytes, at: Ints) -> Ints:
    return _short(block, at) << 16 | _short(block, at + 2)


def _spread(count: Ints) -> tuple[Ints, Ints]:
    """For ``count`` cells in each page: every cell's page, and its number in that page."""
    owner = np.repeat(np.arange(count.size), count)
    return owner, np.arange(owner.size) - np.repeat(np.cumsum(count) - count, count)


def _varints(block: Bytes, at: Ints) -> tuple[Ints, Ints]:
    """Return the variable-length numbers at ``at``, shape (n,), and the places after them."""
    byte = block[at]
    value = (byte & 127).astype(np.int64)
    after = at + 1
    more = np.flatnonzero(byte >= 128)
    for place in range(1, 9):
        if more.size == 0:
            break
        if more.size == at.size:  # the usual case: all numbers are of one length, and nothing is gathered
            byte = block[after]
            value <<= 7
            value |= byte & 127
            after += 1
            more = np.flatnonzero(byte >= 128)
            continue
        byte = block[after[more]]
        last = place == 8
        value[more] = (value[more] << 8 | byte) if last else (value[more] << 7 | byte & 127)
        after[more] += 1
        more = more[byte >= 128]
    return value, after


def _width(serial: Ints) -> tuple[Ints, NDArray[np.bool_]]:
    """Bytes of values by their serial types, and which types exist."""
    sound = (serial >= 0) & (serial != 10) & (serial != 11)
    small = serial < 10
    width = np.where(small, _WIDTHS[np.where(small & sound, serial, 0)], (serial - 12) >> 1)
    return width, sound & (width < 1 << 40)


def _packed_number(word: NDArray[np.uint64], count: int) -> Ints:
    """The variable-length number of ``count`` bytes that ends ``word``."""
    value = np.zeros(word.size, dtype=np.uint64)
    for place in range(count):
        value |= (word >> np.uint64(8 * place) & np.uint64(127)) << np.uint64(7 * place)
    return value.astype(np.int64)


def _integers_of(block: Bytes, at: Ints, serial: int) -> Ints:
    """Return the integers of one serial type at ``at``."""
    if serial in {8, 9}:
        return np.full(at.size, serial - 8, dtype=np.int64)
    if serial == 1:
        return block[at].view(np.int8).astype(np.int64)
    words: NDArray[np.int64] = np.ndarray((block.size - 7,), ">i8", block, 0, (1,))
    return words[at].astype(np.int64) >> (64 - 8 * int(_WIDTHS[serial]))


def _integers(block: Bytes, at: Ints, serial: Ints) -> Ints:
    """Return the integers of ``serial`` types, shape (n,), at ``at``."""
    out = np.empty(at.size, dtype=np.int64)
    for kind in np.flatnonzero(np.bincount(serial, minlength=10)).tolist():
        chosen = serial == kind
        out[chosen] = _integers_of(block, at[chosen], kind)
    return out
