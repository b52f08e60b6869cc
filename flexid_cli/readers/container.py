"""What the readers of message logs share: from the messages of some files to the channels asked for."""

from __future__ import annotations

from abc import ABC, abstractmethod
from array import array
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import AbstractContextManager, ExitStack
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, NamedTuple, Protocol

import numpy as np
from numpy.typing import NDArray

from flexid_cli.errors import InputError
from flexid_cli.readers.base import ChannelInfo, Note, RawChannel, RawLog
from flexid_cli.readers.damage import damaged, decoding
from flexid_cli.readers.decoders import Decoder, TopicType, make_decoder
from flexid_cli.readers.messages import Column, leaves_of, needs_integers, stamp_ns
from flexid_cli.readers.path import Leaf, canonical, may_name, resolve, spellings

CLOCKS = ("header_stamp", "log_time", "publish_time")
_LOOKED_AT = 100  # messages per topic and file that are decoded to see what a topic holds
_LOOKED_AT_BYTES = 1 << 20


class Message(NamedTuple):
    """One message as it stands in the log; times in nanoseconds, ``publish_time`` where it is recorded."""

    kind: TopicType
    log_time: int
    publish_time: int | None
    data: bytes


@dataclass
class Probe:
    """What a quick look at one file shows: topics, their messages' number, and the first messages."""

    counts: dict[TopicType, int] = field(default_factory=dict)
    samples: dict[TopicType, list[bytes]] = field(default_factory=dict)
    first_log_time: int | None = None

    def add(self, kind: TopicType, log_time: int, data: bytes | memoryview) -> None:
        """Count one message, and keep it while there are few."""
        if self.first_log_time is None:
            self.first_log_time = log_time
        self.counts[kind] = self.counts.get(kind, 0) + 1
        kept = self.samples.setdefault(kind, [])
        if len(kept) < _LOOKED_AT and len(kept) * len(data) < _LOOKED_AT_BYTES:
            kept.append(bytes(data))


class Container(Protocol):
    """One open file of a message log."""

    path: Path
    notes: list[Note]

    def probe(self) -> Probe:
        """Look at the file without decoding it; raises InputError where it is damaged."""
        ...

    def messages(self, wanted: Callable[[str], bool]) -> Iterator[Message]:
        """Yield the messages of the topics that ``wanted`` accepts, in the order they were recorded."""
        ...


class MessageReader(ABC):
    """Base of the readers of MCAP, rosbag2 and ROS 1 bags."""

    name: str
    suffixes: tuple[str, ...]

    @abstractmethod
    def open_files(self, paths: Sequence[Path]) -> AbstractContextManager[tuple[list[Container], list[Note]]]:
        """Open all files of one run."""

    def channels(self, paths: Sequence[Path]) -> list[ChannelInfo]:
        """List the numbers in the messages; a count is -1 where a joint is missing in some messages.

        Raises
        ------
        InputError
            The log is damaged or empty.
        """
        with self.open_files(paths) as (files, _):
            run = _Run(files)
            return sorted(run.listing(), key=lambda info: info.source)

    def read(self, paths: Sequence[Path], sources: Sequence[str]) -> RawLog:
        """Read the channels ``sources``, all files as one recording, ordered by their first log time.

        Raises
        ------
        InputError
            The log is damaged, or a channel is missing or ambiguous.
        """
        with self.open_files(paths) as (files, notes):
            run = _Run(files)
            leaves = run.resolve_all([str(source) for source in sources])
            channels, read_notes = run.read(leaves)
            found = [*notes, *(note for file in files for note in file.notes), *read_notes]
        return RawLog(self.name, tuple(paths), channels, tuple(dict.fromkeys(found)))


class _Run:
    """The files of one run, looked at and put in order."""

    def __init__(self, files: Sequence[Container]) -> None:
        probes = [(file, file.probe()) for file in files]
        filled = [(file, probe) for file, probe in probes if probe.first_log_time is not None]
        if not filled:
            raise InputError(f"{files[0].path} holds no messages", "check that the recorder was subscribed")
        self.files = sorted(filled, key=lambda pair: pair[1].first_log_time or 0)
        self.log = str(self.files[0][0].path)
        self._decoders: dict[TopicType, Decoder | InputError] = {}
        self._failures: dict[str, InputError] = {}
        self._leaves: dict[str, dict[str, Leaf]] = {}
        self._seen: dict[str, dict[str, int]] = {}
        self._samples: dict[str, int] = {}
        for file, probe in self.files:
            for kind, samples in probe.samples.items():
                self._look(file.path, kind, samples)

    @property
    def topics(self) -> list[str]:
        """Topics with messages, in the order they were met."""
        return list(dict.fromkeys(kind.topic for _, probe in self.files for kind in probe.counts))

    def decoder(self, path: Path, kind: TopicType) -> Decoder:
        """Return the decoder of ``kind``; raise InputError where there is none."""
        if kind not in self._decoders:
            try:
                with decoding(path, f"the description of message type {kind.msgtype!r}"):
                    self._decoders[kind] = make_decoder(kind)
            except InputError as error:
                self._decoders[kind] = error
        decoder = self._decoders[kind]
        if isinstance(decoder, InputError):
            raise decoder
        return decoder

    def _look(self, path: Path, kind: TopicType, samples: Sequence[bytes]) -> None:
        """Note which numbers ``samples`` hold; a topic that cannot be decoded is left for who asks for it."""
        found = self._leaves.setdefault(kind.topic, {})
        seen = self._seen.setdefault(kind.topic, {})
        try:
            decode = self.decoder(path, kind)
            for data in samples:
                with decoding(path, f"a message of topic {kind.topic!r}"):
                    message = decode(data)
                self._samples[kind.topic] = self._samples.get(kind.topic, 0) + 1
                for leaf in leaves_of(kind.topic, message):
                    name = canonical(leaf)
                    found.setdefault(name, leaf)
                    seen[name] = seen.get(name, 0) + 1
        except InputError as error:
            self._failures.setdefault(kind.topic, error)

    def listing(self) -> list[ChannelInfo]:
        """List all channels met."""
        counts: dict[str, int] = {}
        kinds: dict[str, str] = {}
        for _, probe in self.files:
            for kind, count in probe.counts.items():
                counts[kind.topic] = counts.get(kind.topic, 0) + count
                kinds.setdefault(kind.topic, kind.msgtype or kind.encoding)
        infos = []
        for topic, leaves in self._leaves.items():
            for name, leaf in leaves.items():
                always = self._seen[topic][name] == self._samples[topic]
                count = counts[topic] if always else -1
                infos.append(ChannelInfo(name, count, None, kinds[topic], spellings(leaf)))
        return infos

    def resolve_all(self, sources: Sequence[str]) -> dict[str, Leaf]:
        """Find each of ``sources``; where the first messages lack one, look at all messages."""
        resolved: dict[str, Leaf] = {}
        for source in sources:
            try:
                resolved[source] = self._resolve(source)
            except InputError:
                self._refuse_undecodable(source)
                self._look_at_all(source)
                resolved[source] = self._resolve(source)
        return resolved

    def _resolve(self, source: str) -> Leaf:
        leaves = [leaf for found in self._leaves.values() for leaf in found.values()]
        return resolve(source, leaves, self.topics, log=self.log)

    def _refuse_undecodable(self, source: str) -> None:
        for topic, error in self._failures.items():
            if may_name(source, topic):
                raise error

    def _look_at_all(self, source: str) -> None:
        for file, _ in self.files:
            for message in file.messages(lambda topic: may_name(source, topic)):
                self._look(file.path, message.kind, [message.data])

    def read(self, resolved: Mapping[str, Leaf]) -> tuple[dict[str, RawChannel], list[Note]]:
        """Read the resolved channels; keys are the spellings that were asked for."""
        unique = {canonical(leaf): leaf for leaf in resolved.values()}
        gathered = {leaf.topic: _Topic(leaf.topic) for leaf in unique.values()}
        for name, leaf in unique.items():
            gathered[leaf.topic].columns[name] = Column(leaf)
        for file, _ in self.files:
            for message in file.messages(gathered.__contains__):
                decode = self.decoder(file.path, message.kind)
                gathered[message.kind.topic].add(file.path, decode, message)
        notes: list[Note] = []
        finished: dict[str, RawChannel] = {}
        for topic in gathered.values():
            finished.update(topic.finish(self.log, notes))
        notes += self._schema_notes(gathered)
        return {source: finished[canonical(leaf)] for source, leaf in resolved.items()}, notes

    def _schema_notes(self, topics: Mapping[str, Any]) -> list[Note]:
        return [
            Note(
                f"{file.path}: the log does not describe message type {kind.msgtype!r} of topic "
                f"{kind.topic!r}; the definition of the current ROS 2 release was used"
            )
            for file, probe in self.files
            for kind in probe.counts
            if kind.topic in topics and kind.lacks_schema
        ]


class _Topic:
    """The messages of one topic: stamps by clock, and the columns asked for."""

    def __init__(self, topic: str) -> None:
        self.topic = topic
        self.columns: dict[str, Column] = {}
        self._log = array("q")
        self._publish: array[int] | None = array("q")
        self._header: array[int] | None = array("q")

    def add(self, path: Path, decode: Decoder, message: Message) -> None:
        """Decode one message and take its numbers."""
        row = len(self._log)
        with decoding(path, f"message {row + 1} of topic {self.topic!r} at {message.log_time} ns"):
            content = decode(message.data)
        self._log.append(message.log_time)
        self._header = _extended(self._header, stamp_ns(content))
        self._publish = _extended(self._publish, message.publish_time)
        for column in self.columns.values():
            column.take(content, row)

    def finish(self, log: str, notes: list[Note]) -> dict[str, RawChannel]:
        """Return the channels, and add to ``notes`` what a person should know."""
        stamps = {"log_time": np.array(self._log, dtype=np.int64)}
        if self._publish is not None:
            stamps["publish_time"] = np.array(self._publish, dtype=np.int64)
        if self._header is not None:
            header = np.array(self._header, dtype=np.int64)
            if header.any():
                stamps["header_stamp"] = header
            else:
                notes.append(
                    Note(f"{log}: the header stamps of topic {self.topic!r} are all zero, so not used")
                )
        return {
            name: self._channel(name, column, stamps, log, notes) for name, column in self.columns.items()
        }

    def _channel(
        self,
        name: str,
        column: Column,
        stamps: Mapping[str, NDArray[np.int64]],
        log: str,
        notes: list[Note],
    ) -> RawChannel:
        rows = column.rows
        if rows.size == 0:
            raise damaged(Path(log), f"no message of topic {self.topic!r} has channel {name!r}")
        if rows.size < len(self._log):
            lacking = len(self._log) - rows.size
            notes.append(Note(f"{log}: {lacking} of {len(self._log)} messages lack channel {name!r}"))
            stamps = {clock: times[rows] for clock, times in stamps.items()}
        integers = column.integers
        exact = integers if integers is not None and needs_integers(integers) else None
        if exact is not None:
            notes.append(
                Note(f"{log}: channel {name!r} holds integers beyond 2^53; as numbers they are rounded")
            )
        return RawChannel(name, column.values, dict(stamps), exact=exact)


def _extended(times: array[int] | None, time: int | None) -> array[int] | None:
    """Append ``time``, or give the clock up where one message lacks it."""
    if times is None or time is None:
        return None
    times.append(time)
    return times


def enter_all(stack: ExitStack, opened: Sequence[AbstractContextManager[Container]]) -> list[Container]:
    """Enter all files into ``stack``."""
    return [stack.enter_context(file) for file in opened]
