"""The sqlite3 storage of rosbag2: messages in batches, from whole files and from damaged ones."""

from __future__ import annotations

import sqlite3
from collections.abc import Callable, Iterator, Sequence
from contextlib import ExitStack
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any
from urllib.parse import quote

import numpy as np
from numpy.typing import NDArray

from flexid_cli.errors import InputError
from flexid_cli.readers.base import Note, Progress, Window
from flexid_cli.readers.batch import Batch
from flexid_cli.readers.container import Probe
from flexid_cli.readers.damage import damaged, unreadable
from flexid_cli.readers.decoders import TopicType
from flexid_cli.readers.loss import Loss, TimeGaps
from flexid_cli.readers.memory import keep_freed_memory
from flexid_cli.readers.sqlite_pages import Columns, PageFile, Rows

_BLOCK_BYTES = 1 << 21  # pages that are looked at together; larger blocks fall out of the processor's cache
_JOINED_BYTES = 1 << 24  # contents of messages that are put together from chains of pages at a time
_USUAL = Columns(4, 1, 2, 3)
_DENSE = 0.5  # share of the row numbers that must be there for the missing ones to count as lost
_LOOKED_AT = 101  # messages per topic; what `Probe` keeps and one more

Ints = NDArray[np.int64]


@dataclass
class _Plan:
    """Which pages to read, in the order of their rows.

    ``keys`` are the largest row numbers that they may hold, or None where the tree does not tell.
    """

    pages: Ints
    keys: Ints | None
    found: int = 0


@dataclass
class _Schema:
    kinds: dict[int, TopicType] = field(default_factory=dict)
    root: int = 0
    columns: Columns = _USUAL
    time_index: str | None = None


class SqliteFile:
    """One sqlite3 storage file, read page by page.

    Parameters
    ----------
    path : Path
        The file; a database in WAL mode must have been checkpointed.
    shown : Path
        The file that messages name, where ``path`` is a copy of it.
    stack : ExitStack
        Closes the file.
    progress : Progress, optional
        Is told what has been read.

    Raises
    ------
    InputError
        It is no recording, or nothing can be read of it.
    """

    def __init__(self, path: Path, shown: Path, stack: ExitStack, progress: Progress | None = None) -> None:
        self.path = shown
        self.notes: list[Note] = []
        self.loss = Loss()
        self._file = path
        self._progress = progress
        try:
            self._pages = PageFile(stack.enter_context(path.open("rb", buffering=0)))
        except OSError as error:
            raise unreadable(shown, error) from error
        self._salvage: _Plan | None = None
        self._schema = self._read_schema()
        self._opened = Loss()
        self._check_size()
        self._begin()

    def _begin(self) -> None:
        """Forget what an earlier pass over the file counted."""
        self.loss = replace(self._opened, reasons=list(self._opened.reasons))
        self._salvage = None

    def report(self, reason: str, lost: int | None) -> None:
        """Count damage that was met before the pages were read."""
        self._opened.add(reason, lost)
        self._begin()

    def _check_size(self) -> None:
        pages = self._pages
        if not pages.whole_head:
            self._opened.add(f"{self.path}: its first bytes are not those of an SQLite file", None)
        lacking = pages.declared * pages.page_size - pages.size
        if lacking > 0:
            self._opened.add(
                f"{self.path} is cut short: {pages.size} bytes of {pages.declared * pages.page_size} are there",
                None,
                lacking,
                -(-lacking // pages.page_size),
            )
        elif pages.size % pages.page_size:
            self._opened.add(f"{self.path} is cut short at byte {pages.size}, within a page", None)

    # -- schema and topics

    def _read_schema(self) -> _Schema:
        tables, schema = self._tables()
        found = [row for row in self._pages.table(tables.get("topics", 0)) if _is_topic(row[1])]
        rows = self._pages.table(tables.get("message_definitions", 0))
        definitions = [values for _, values in rows if _is_definition(values)]
        if not found:
            found, definitions = self._search_topics()
        if not found and tables and not {"topics", "messages"} <= set(tables):
            raise InputError(
                f"{self.path} is an sqlite3 file, but no rosbag2 recording", "it has no table of messages"
            )
        if not found:
            raise damaged(self.path, "its table of topics cannot be found")
        schema.kinds = _kinds(found, definitions)
        return schema

    def _tables(self) -> tuple[dict[str, int], _Schema]:
        """Return the tables' first pages, and what the file says of the table of messages."""
        schema = _Schema()
        tables: dict[str, int] = {}
        for _, values in self._pages.table(1) if self._pages.whole_head else []:
            kind, name, root, sql = (
                (values[0], values[1], values[3], values[4]) if len(values) == 5 else [None] * 4
            )
            if kind == "table" and isinstance(root, int):
                tables[str(name)] = root
                if name == "messages":
                    schema.root, schema.columns = root, _columns(str(sql)) or _USUAL
            elif kind == "index" and values[2] == "messages" and "(timestamp" in str(sql).replace(" ", ""):
                schema.time_index = str(name)
        return tables, schema

    def _search_topics(self) -> tuple[list[tuple[int, list[Any]]], list[list[Any]]]:
        """Look for the topics and their definitions in all pages."""
        topics: dict[int, list[Any]] = {}
        definitions: list[list[Any]] = []
        for number in self._foreign_leaves():
            for rowid, values in self._pages.texts(number, self._pages.page(number)):
                if _is_topic(values):
                    topics.setdefault(rowid, values)
                elif _is_definition(values):
                    definitions.append(values)
        return list(topics.items()), definitions

    def _foreign_leaves(self) -> Iterator[int]:
        """Yield the leaves that hold no messages."""
        for first, block, pages in self._blocks_of_all():
            rows = self._pages.rows(block, pages, _USUAL)
            count = np.bincount(rows.page, minlength=pages.size)
            for place in np.flatnonzero((rows.bad > 0) & (count == 0)).tolist():
                yield first + place
            if first == 1 and rows.bad[0] < 0:
                yield 1

    def _blocks_of_all(self) -> Iterator[tuple[int, NDArray[np.uint8], Ints]]:
        together = max(_BLOCK_BYTES // self._pages.page_size, 1)
        for first in range(1, self._pages.count + 1, together):
            count = min(together, self._pages.count + 1 - first)
            yield first, self._pages.block(first, count), np.arange(count, dtype=np.int64)

    # -- which pages

    def _plan(self) -> _Plan:
        if self._salvage is not None:
            return self._salvage
        found = self._pages.leaves(self._schema.root) if 0 < self._schema.root <= self._pages.count else None
        if found is None:
            return self._survey("the tree of its table of messages is damaged")
        return _Plan(*found)

    def _survey(self, reason: str) -> _Plan:
        """Find every page that holds messages, whether the tree leads there or not."""
        parts = [self._survey_block(first, block, pages) for first, block, pages in self._blocks_of_all()]
        table = np.concatenate([part for part in parts if part.size] or [np.empty((0, 5), dtype=np.int64)])
        free = self._pages.free()
        if free:
            table = table[~np.isin(table[:, 0], list(free))]
        table = table[np.argsort(table[:, 1], kind="stable")]
        table = table[~_superseded(table)]
        pages = self._pages.count
        self.loss.add(f"{self.path}: {reason}; {table.shape[0]} of its {pages} pages hold whole messages", 0)
        self._salvage = _Plan(table[:, 0], None, int(table[:, 4].sum()))
        self._count_missing(table)
        return self._salvage

    def _survey_block(self, first: int, block: NDArray[np.uint8], pages: Ints) -> Ints:
        """For the pages with messages: number, middle, smallest and largest row number, and count."""
        rows = self._pages.rows(block, pages, self._schema.columns)
        rows = rows.take(self._known(rows))
        count = np.bincount(rows.page, minlength=pages.size)
        held = np.flatnonzero(count)
        if not held.size:
            return np.empty((0, 5), dtype=np.int64)
        order = np.lexsort((rows.rowid, rows.page))
        sorted_ids = rows.rowid[order]
        start = (np.cumsum(count) - count)[held]
        size = count[held]
        aside = (size >= 4).astype(np.int64)  # one wrong row number must not decide what the page holds
        middle = sorted_ids[start + size // 2]
        low, high = sorted_ids[start + aside], sorted_ids[start + size - 1 - aside]
        return np.stack([held + first, middle, low, high, size], axis=1)

    def _count_missing(self, table: Ints) -> None:
        """Count the row numbers that no page holds: a recorder counts its messages from 1 without gaps."""
        if not table.size:
            self.loss.add(f"{self.path}: no page holds messages", None)
            return
        begin = int(table[0, 1] - table[0, 4] // 2)
        first = 1 if begin <= 1000 else begin
        span = int(table[-1, 1] + (table[-1, 4] - 1) // 2) - first + 1
        kept = int(table[:, 4].sum())
        if kept >= _DENSE * span:
            if span > kept:
                self.loss.add(f"{self.path}: {span - kept} of {span} rows are missing", span - kept)
        else:
            self.loss.add(f"{self.path}: its row numbers do not tell how many rows are missing", None)

    def _windowed(self, plan: _Plan, window: Window) -> _Plan:
        """Leave out the pages that the file's index of times rules out."""
        if window.is_open or plan.keys is None or self._schema.time_index is None:
            return plan
        bounds = self._rows_within(window)
        if bounds is None:
            return plan
        if bounds[0] is None:
            return _Plan(plan.pages[:0], plan.keys[:0])
        first = int(np.searchsorted(plan.keys, bounds[0]))
        last = int(np.searchsorted(plan.keys, bounds[1]))
        return _Plan(plan.pages[first : last + 1], plan.keys[first : last + 1])

    def _rows_within(self, window: Window) -> tuple[Any, Any] | None:
        low = -(2**63) if window.start_ns is None else window.start_ns
        high = 2**63 - 1 if window.end_ns is None else window.end_ns
        name = str(self._schema.time_index).replace('"', '""')
        query = (
            f'SELECT min(rowid), max(rowid) FROM messages INDEXED BY "{name}" '  # noqa: S608 - quoted above
            "WHERE timestamp >= ? AND timestamp < ?"
        )
        try:
            database = sqlite3.connect(f"file:{quote(str(self._file))}?immutable=1", uri=True)
            try:
                found: tuple[Any, Any] = database.execute(query, (low, high)).fetchone()
            finally:
                database.close()
        except (sqlite3.Error, OverflowError, UnicodeDecodeError):  # its message may hold the damaged bytes
            return None
        return found

    # -- messages

    def batches(self, wanted: Callable[[str], bool], window: Window) -> Iterator[Batch]:
        """Yield the messages of the wanted topics and times in the order of their row numbers."""
        numbers = [number for number, kind in self._schema.kinds.items() if wanted(kind.topic)]
        self._begin()
        if not numbers:
            return
        gaps = TimeGaps(self.loss)
        last: int | None = None
        for block, rows in self._rows(window):
            gaps.take(rows.time, [] if self._salvage is None else _jumps(rows.rowid, last))
            last = int(rows.rowid[-1]) if rows.rowid.size else last
            inside = np.ones(rows.time.size, dtype=np.bool_) if window.is_open else window.holds(rows.time)
            for number in numbers:
                chosen = inside & (rows.topic == number)
                if chosen.any():
                    mine = rows if chosen.all() else rows.take(chosen)
                    yield from self._batches(self._schema.kinds[number], block, mine)
            if self._progress is not None:
                self._progress.advance(block.size)

    def _batches(self, kind: TopicType, block: NDArray[np.uint8], rows: Rows) -> Iterator[Batch]:
        if bool((rows.local == rows.lengths).all()):
            yield Batch(kind, block, rows.starts, rows.lengths, rows.time, None)
            return
        total = np.cumsum(rows.lengths)
        groups = total // _JOINED_BYTES
        for group in np.unique(groups):
            batch = self._joined(kind, block, rows.take(groups == group))
            if batch is not None:
                yield batch

    def _joined(self, kind: TopicType, block: NDArray[np.uint8], rows: Rows) -> Batch | None:
        """Put the contents together that go on in other pages."""
        parts: list[bytes] = []
        whole: list[int] = []
        gaps = TimeGaps(self.loss)
        columns = (rows.rowid, rows.starts, rows.lengths, rows.local)
        for place, (rowid, start, length, local) in enumerate(
            zip(*(column.tolist() for column in columns), strict=True)
        ):
            part = block[start : start + local].tobytes()
            if local < length:
                following = int.from_bytes(block[start + local : start + local + 4].tobytes(), "big")
                rest = self._pages.chain(following, length - local)
                if rest is None:
                    self.loss.add(f"{self.path}: the content of row {rowid} is not whole", 1)
                    gaps.take(rows.time[:0], [0])
                    continue
                part += rest
            parts.append(part)
            gaps.take(rows.time[place : place + 1])
            whole.append(place)
        if not parts:
            return None
        lengths = rows.lengths[whole]
        buffer = np.frombuffer(b"".join(parts), dtype=np.uint8)
        return Batch(kind, buffer, np.cumsum(lengths) - lengths, lengths, rows.time[whole], None)

    def _rows(self, window: Window) -> Iterator[tuple[NDArray[np.uint8], Rows]]:
        """Yield blocks with their whole rows; where the tree turns out damaged, go on by a survey."""
        keep_freed_memory()
        plan = self._plan()
        done = 0
        if plan.keys is not None:
            plan = self._windowed(plan, window)
            for at, count in self._groups(plan.pages):
                block, rows = self._read(plan.pages[at : at + count])
                reason = self._fault(rows, plan, at, count, done)
                if reason is not None:
                    break
                done = int(rows.rowid[-1]) if rows.rowid.size else done
                yield block, rows
            else:
                return
            plan = self._survey(reason)
        yield from self._salvaged(plan, done)

    def _salvaged(self, plan: _Plan, done: int) -> Iterator[tuple[NDArray[np.uint8], Rows]]:
        """Yield the rows of the surveyed pages that come after row ``done``, in the order of each page."""
        for at, count in self._groups(plan.pages):
            block, rows = self._read(plan.pages[at : at + count])
            broken = np.flatnonzero(rows.bad > 0)
            for place in broken.tolist():
                number = int(plan.pages[at + place])
                self.loss.add(
                    f"{self.path}: page {number} (byte {(number - 1) * self._pages.page_size}) holds "
                    f"{rows.bad[place]} damaged rows"
                )
            known = self._known(rows)
            if done:
                known &= rows.rowid > done
            yield block, rows.take(known)

    def _fault(self, rows: Rows, plan: _Plan, at: int, count: int, done: int) -> str | None:
        """Say what is wrong with the rows of a group of pages, or None."""
        wrong = np.flatnonzero(rows.bad)
        if wrong.size:
            number = int(plan.pages[at + wrong[0]])
            what = "is no page of messages" if rows.bad[wrong[0]] < 0 else "holds damaged rows"
            return f"page {number} (byte {(number - 1) * self._pages.page_size}) {what}"
        if rows.rowid.size and plan.keys is not None:
            ordered = int(rows.rowid[0]) > done and bool((np.diff(rows.rowid) > 0).all())
            if not ordered or bool((rows.rowid > plan.keys[at : at + count][rows.page]).any()):
                return "its row numbers are out of order"
        if not self._known(rows).all():
            return "some messages belong to no topic"
        return None

    def _known(self, rows: Rows) -> NDArray[np.bool_]:
        """Which rows belong to a topic that the file describes."""
        kinds = list(self._schema.kinds)
        return rows.topic == kinds[0] if len(kinds) == 1 else np.isin(rows.topic, kinds)

    def _groups(self, pages: Ints) -> Iterator[tuple[int, int]]:
        """Split ``pages`` into stretches that are read together."""
        together = max(_BLOCK_BYTES // self._pages.page_size, 1)
        for at in range(0, pages.size, together):
            yield at, min(together, pages.size - at)

    def _read(self, pages: Ints) -> tuple[NDArray[np.uint8], Rows]:
        block, places = self._block(pages)
        return block, self._pages.rows(block, places, self._schema.columns)

    def _block(self, pages: Ints) -> tuple[NDArray[np.uint8], Ints]:
        """Return a block that holds ``pages``, and their numbers from 0 in it."""
        first, last = int(pages.min()), int(pages.max())
        try:
            if last - first < 2 * pages.size + 8:
                return self._pages.block(first, last - first + 1), pages - first
            return self._pages.scattered(pages), np.arange(pages.size)
        except OSError as error:
            raise unreadable(self.path, error) from error

    def probe(self) -> Probe:
        """Count the messages, and keep every topic's first."""
        probe = Probe()
        self._begin()
        counts = dict.fromkeys(self._schema.kinds, 0)
        for block, rows, more in self._looks():
            if probe.first_log_time is None and rows.time.size:
                probe.first_log_time = int(rows.time[0])
            for number, kind in self._schema.kinds.items():
                mine = rows.topic == number
                count = int(np.count_nonzero(mine))
                if count and counts[number] < _LOOKED_AT:
                    self._keep(probe, kind, block, rows.take(np.flatnonzero(mine)[:_LOOKED_AT]))
                counts[number] += count + more
        probe.counts = {self._schema.kinds[number]: count for number, count in counts.items() if count}
        self._begin()
        return probe

    def _looks(self) -> Iterator[tuple[NDArray[np.uint8], Rows, int]]:
        """Yield blocks with rows; of a sound file with one topic the first ones, then numbers of rows only."""
        keep_freed_memory()
        plan = self._plan()
        if plan.keys is None or len(self._schema.kinds) > 1:
            yield from ((block, rows, 0) for block, rows in self._rows(Window()))
            return
        seen = 0
        for at, count in self._groups(plan.pages):
            block, places = self._block(plan.pages[at : at + count])
            rows = self._pages.rows(block, places[: count if seen < _LOOKED_AT else 0], self._schema.columns)
            more = self._pages.cell_count(block, places) if seen >= _LOOKED_AT else 0
            seen += rows.rowid.size
            yield block, rows, more

    def _keep(self, probe: Probe, kind: TopicType, block: NDArray[np.uint8], rows: Rows) -> None:
        for batch in self._batches(kind, block, rows):
            for place, start in enumerate(batch.starts.tolist()):
                data = batch.buffer[start : start + int(batch.lengths[place])].tobytes()
                probe.add(kind, int(batch.log_time[place]), data)


def _jumps(rowid: Ints, last: int | None) -> list[int]:
    """Places at which row numbers do not go on from the one before; ``last`` came before the first."""
    before = 0 if last is None else last
    return np.flatnonzero(np.diff(rowid, prepend=before) != 1).tolist()


def _superseded(table: Ints) -> NDArray[np.bool_]:
    """Which surveyed pages hold the rows of the page before them: copies that SQLite has given up."""
    drop = np.zeros(table.shape[0], dtype=np.bool_)
    before, after = table[:-1], table[1:]
    drop[1:] = (after[:, 2] <= before[:, 1]) & (before[:, 1] <= after[:, 3])
    drop[1:] &= (before[:, 2] <= after[:, 1]) & (after[:, 1] <= before[:, 3])
    return drop


def _columns(sql: str) -> Columns | None:
    """Return the columns' places in the table that ``sql`` creates, or None."""
    if not sql.upper().startswith("CREATE TABLE"):
        return None
    database = sqlite3.connect(":memory:")
    try:
        database.execute(sql)
        names = [row[1] for row in database.execute("PRAGMA table_info(messages)")]
    except sqlite3.Error:
        return None
    finally:
        database.close()
    if not {"topic_id", "timestamp", "data"} <= set(names) or len(names) > 50:
        return None
    return Columns(len(names), *(names.index(name) for name in ("topic_id", "timestamp", "data")))


def _is_topic(values: Sequence[Any]) -> bool:
    """Whether a row is one of the table of topics: id, name, type, serialization format, and more."""
    texts = values[1:4]
    return len(texts) == 3 and all(isinstance(text, str) and text for text in texts) and texts[0][0] == "/"


def _is_definition(values: Sequence[Any]) -> bool:
    """Whether a row is one of the message definitions: id, type, encoding, text, and more."""
    texts = values[1:4]
    return len(texts) == 3 and all(isinstance(text, str) for text in texts) and "/" in texts[0][1:]


def _kinds(
    topics: Sequence[tuple[int, Sequence[Any]]], definitions: Sequence[Sequence[Any]]
) -> dict[int, TopicType]:
    described = {values[1]: (values[2], values[3]) for values in definitions}
    kinds = {}
    for number, values in topics:
        topic, msgtype, encoding = values[1:4]
        schema_encoding, text = described.get(msgtype, ("", ""))
        if not text.strip():
            schema_encoding = ""
        kinds[number] = TopicType(topic, msgtype, encoding, schema_encoding, text.encode())
    return kinds
