"""What the readers of message logs share: from the messages of some files to the channels asked for."""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import AbstractContextManager
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Protocol

import numpy as np
from numpy.typing import NDArray

from flexid_cli.errors import InputError
from flexid_cli.readers.base import (
    DEFAULT_OPTIONS,
    ChannelInfo,
    Damage,
    Note,
    RawChannel,
    RawLog,
    ReadOptions,
    Window,
)
from flexid_cli.readers.batch import Batch
from flexid_cli.readers.damage import CURE, damaged, decoding
from flexid_cli.readers.decoders import Decoder, TopicType, make_decoder
from flexid_cli.readers.gather import TopicOutput
from flexid_cli.readers.layout import LayoutDecoder
from flexid_cli.readers.loss import Loss
from flexid_cli.readers.messages import leaves_of
from flexid_cli.readers.path import Leaf, canonical, may_name, resolve, spellings

CLOCKS = ("header_stamp", "log_time", "publish_time")
_LOOKED_AT = 100  # messages per topic and file that are decoded to see what a topic holds
_LOOKED_AT_BYTES = 1 << 20
_NS = 1_000_000_000
_MOST_REASONS = 20


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
    """One open file of a message log.

    Attributes
    ----------
    path : Path
        The file.
    notes : list of Note
        What a person should know.
    loss : Loss
        Damage that was met since the last call of ``batches`` began.
    """

    path: Path
    notes: list[Note]
    loss: Loss

    def probe(self) -> Probe:
        """Look at the file without decoding it."""
        ...

    def batches(self, wanted: Callable[[str], bool], window: Window) -> Iterator[Batch]:
        """Yield the messages of the topics that ``wanted`` accepts, in the order they were recorded.

        Messages outside the window may be among them where leaving them out would not save reading. A batch
        is valid until the next one is asked for.
        """
        ...


class MessageReader(ABC):
    """Base of the readers of MCAP, rosbag2 and ROS 1 bags."""

    name: str
    suffixes: tuple[str, ...]

    @abstractmethod
    def open_files(
        self, paths: Sequence[Path], options: ReadOptions = DEFAULT_OPTIONS
    ) -> AbstractContextManager[tuple[list[Container], list[Note]]]:
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

    def read(
        self, paths: Sequence[Path], sources: Sequence[str], options: ReadOptions = DEFAULT_OPTIONS
    ) -> RawLog:
        """Read the channels ``sources``, all files as one recording, ordered by their first log time.

        Raises
        ------
        InputError
            A channel is missing or ambiguous, nothing can be read, or the log is damaged and the options are
            strict.
        """
        with self.open_files(paths, options) as (files, notes):
            run = _Run(files, [str(source) for source in sources])
            leaves = run.resolve_all([str(source) for source in sources])
            channels, read_notes = run.read(leaves, options)
            damage = _by_path(paths, run.damage)
            found = [*notes, *(note for file in files for note in file.notes), *read_notes]
            first_ns = run.first_ns
        return RawLog(self.name, tuple(paths), channels, tuple(dict.fromkeys(found)), damage, first_ns)


def _by_path(paths: Sequence[Path], parts: Sequence[Damage]) -> tuple[Damage, ...]:
    """Give one account per path that was asked for; the files of a folder are added up."""
    accounts = []
    for path in paths:
        mine = [part for part in parts if part.path == path or path in part.path.parents]
        lost = [part.lost for part in mine]
        accounts.append(
            Damage(
                path,
                trusted=sum(part.trusted for part in mine),
                suspect=sum(part.suspect for part in mine),
                lost=None if None in lost else sum(count or 0 for count in lost),
                lost_bytes=sum(part.lost_bytes for part in mine),
                lost_chunks=sum(part.lost_chunks for part in mine),
                spans_s=tuple(span for part in mine for span in part.spans_s),
                reasons=tuple(reason for part in mine for reason in part.reasons),
            )
        )
    return tuple(accounts)


class _Run:
    """The files of one run, looked at and put in order.

    Parameters
    ----------
    files : sequence of Container
        The files.
    sources : sequence of str, optional
        Signal paths that will be asked for; topics that none of them can name are looked at only where one
        is not found. Without it all topics are looked at.
    """

    def __init__(self, files: Sequence[Container], sources: Sequence[str] | None = None) -> None:
        probes = [(file, file.probe()) for file in files]
        filled = [(file, probe) for file, probe in probes if probe.first_log_time is not None]
        if not filled:
            raise _nothing(files[0])
        self.files = sorted(filled, key=lambda pair: pair[1].first_log_time or 0)
        self.empty = [file for file, probe in probes if probe.first_log_time is None]
        self.first_ns = self.files[0][1].first_log_time or 0
        self.log = str(self.files[0][0].path)
        self.damage: list[Damage] = []
        self._decoders: dict[TopicType, Decoder | InputError] = {}
        self._failures: dict[str, InputError] = {}
        self._leaves: dict[str, dict[str, Leaf]] = {}
        self._seen: dict[str, dict[str, int]] = {}
        self._samples: dict[str, int] = {}
        self._looked_at: set[tuple[Path, TopicType]] = set()
        self._look_at_first(sources)

    def _look_at_first(self, sources: Sequence[str] | None) -> None:
        """Look at the first messages of the topics that ``sources`` can name, or of all."""
        for file, probe in self.files:
            for kind, samples in probe.samples.items():
                named = sources is None or any(may_name(source, kind.topic) for source in sources)
                if named and (file.path, kind) not in self._looked_at:
                    self._looked_at.add((file.path, kind))
                    self._look(file.path, kind, self._unlike(file.path, kind, samples))

    def _unlike(self, path: Path, kind: TopicType, samples: Sequence[bytes]) -> Sequence[bytes]:
        """Leave out samples that have the layout of another one, and so the same numbers in them."""
        lengths = np.array([len(data) for data in samples], dtype=np.int64)
        content = np.frombuffer(b"".join(samples), dtype=np.uint8)
        batch = Batch(kind, content, np.cumsum(lengths) - lengths, lengths, np.zeros_like(lengths), None)
        try:
            self.decoder(path, kind)
            return LayoutDecoder(kind, ()).unlike(batch)
        except InputError:
            return samples  # looking at them gives the reason

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
                try:
                    resolved[source] = self._resolve(source)
                except InputError:
                    self._look_at_first(None)  # so that the nearest channels of other topics are named too
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
        """Look at one message of every layout of the topics that ``source`` can name."""
        for file, _ in self.files:
            decoders: dict[TopicType, LayoutDecoder] = {}
            for batch in file.batches(lambda topic: may_name(source, topic), Window()):
                if not batch.trusted:
                    continue
                decoder = decoders.get(batch.kind)
                if decoder is None:
                    self.decoder(file.path, batch.kind)
                    decoder = decoders[batch.kind] = LayoutDecoder(batch.kind, ())
                self._look(file.path, batch.kind, decoder.unlike(batch))

    def read(
        self, resolved: Mapping[str, Leaf], options: ReadOptions = DEFAULT_OPTIONS
    ) -> tuple[dict[str, RawChannel], list[Note]]:
        """Read the resolved channels; keys are the spellings that were asked for."""
        unique = {canonical(leaf): leaf for leaf in resolved.values()}
        topics = list(dict.fromkeys(leaf.topic for leaf in unique.values()))
        outputs = {
            topic: TopicOutput(
                topic,
                [leaf for leaf in unique.values() if leaf.topic == topic],
                self._expected(topic, options),
            )
            for topic in topics
        }
        reading = _Reading(self, outputs, options)
        tallies = [reading.read_file(file) for file, _ in self.files]
        for topic, output in outputs.items():
            if output.size == 0:
                raise self._empty(topic, options)
        notes: list[Note] = []
        finished: dict[str, RawChannel] = {}
        for output in outputs.values():
            finished.update(output.finish(self.log, notes, keep_suspect=options.keep_suspect))
            for tally in tallies:
                tally.doubt(output)
        accounts = [(file, _Tally()) for file in self.empty]
        accounts += [(file, tally) for (file, _), tally in zip(self.files, tallies, strict=True)]
        self.damage = [_account(file, tally, self.first_ns, options) for file, tally in accounts]
        notes += self._schema_notes(outputs)
        return {source: finished[canonical(leaf)] for source, leaf in resolved.items()}, notes

    def _empty(self, topic: str, options: ReadOptions) -> InputError:
        """Return the error for a topic of which no message could be read."""
        for file, _ in self.files:
            if file.loss.reasons:
                return damaged(
                    file.path, f"no message of topic {topic!r} can be read; {file.loss.reasons[0]}"
                )
        if not options.window(self.first_ns).is_open:
            return InputError(
                f"{self.log}: topic {topic!r} has no messages in the time window",
                "--start and --end count seconds from the first message of the log",
            )
        return damaged(Path(self.log), f"no message of topic {topic!r} can be read")

    def _expected(self, topic: str, options: ReadOptions) -> int:
        """Number of messages that a topic seems to have; for a window it cannot be told."""
        if not options.window(self.first_ns).is_open:
            return 0
        counts = (probe.counts for _, probe in self.files)
        return sum(count for by_kind in counts for kind, count in by_kind.items() if kind.topic == topic)

    def _schema_notes(self, topics: Mapping[str, TopicOutput]) -> list[Note]:
        return [
            Note(
                f"{file.path}: the log does not describe message type {kind.msgtype!r} of topic "
                f"{kind.topic!r}; the definition of the current ROS 2 release was used"
            )
            for file, probe in self.files
            for kind in probe.counts
            if kind.topic in topics and kind.lacks_schema
        ]


@dataclass
class _Tally:
    """Messages of one file as they were read."""

    trusted: int = 0
    suspect: int = 0
    bad: int = 0
    reasons: list[str] = field(default_factory=list)
    spans_ns: list[tuple[int, int]] = field(default_factory=list)  # around bad messages and those in doubt
    bad_times: dict[str, list[NDArray[np.int64]]] = field(default_factory=dict)
    places: dict[str, tuple[int, int]] = field(default_factory=dict)  # its messages in the topics' outputs

    def doubt(self, output: TopicOutput) -> None:
        """Count this file's messages with samples that are not plausible as suspect, and note what they leave."""
        first, end = self.places.get(output.topic, (0, 0))
        mine = [doubt.rows[(doubt.rows >= first) & (doubt.rows < end)] for doubt in output.doubts]
        self.reasons += [doubt.reason for doubt, rows in zip(output.doubts, mine, strict=True) if rows.size]
        rows = np.unique(np.concatenate(mine)) if mine else np.empty(0, dtype=np.int64)
        self.trusted -= rows.size
        self.suspect += rows.size
        times = self.bad_times.get(output.topic, [])
        if rows.size or times:
            lost = np.concatenate(times) if times else np.empty(0, dtype=np.int64)
            self.spans_ns += output.spans_without(rows, lost)


class _Reading:
    """One pass over the files of a run.

    Parameters
    ----------
    run : _Run
        Whose files are read.
    outputs : dict of str to TopicOutput
        Where the samples go, by topic.
    options : ReadOptions
        The window, and what is done with damage.
    """

    def __init__(self, run: _Run, outputs: Mapping[str, TopicOutput], options: ReadOptions) -> None:
        self._run = run
        self._outputs = outputs
        self._options = options
        self._window = options.window(run.first_ns)
        self._named: dict[Leaf, str] = {}
        self._decoders: dict[tuple[TopicType, bool], LayoutDecoder] = {}

    def read_file(self, file: Container) -> _Tally:
        """Read one file and return what was found in it."""
        tally = _Tally()
        before = {topic: output.size for topic, output in self._outputs.items()}
        for batch in file.batches(self._outputs.__contains__, self._window):
            self._add(file.path, within(batch, self._window), tally)
            del batch  # its buffer is used again for the next one, while it is in the processor's cache
        tally.places = {topic: (before[topic], output.size) for topic, output in self._outputs.items()}
        return tally

    def _add(self, path: Path, batch: Batch, tally: _Tally) -> None:
        count = batch.starts.size
        if not batch.trusted:
            tally.suspect += count
            if not self._options.keep_suspect:
                return
        if count == 0:
            return
        output = self._outputs[batch.kind.topic]
        decoded = self._decoder(path, batch).decode(batch)
        bad = int(np.count_nonzero(decoded.bad))
        if bad:
            self._lose(batch, decoded.bad, decoded.reason, tally)
        if batch.trusted:
            tally.trusted += count - bad
        output.add(batch, decoded)

    def _lose(self, batch: Batch, bad: NDArray[np.bool_], reason: str, tally: _Tally) -> None:
        if not batch.trusted:
            return
        count = int(np.count_nonzero(bad))
        tally.bad += count
        tally.bad_times.setdefault(batch.kind.topic, []).append(batch.log_time[bad])
        first = int(batch.log_time[bad][0])
        noun = "message" if count == 1 else "messages"
        tally.reasons.append(
            f"{count} {noun} of topic {batch.kind.topic!r} from {first} ns on cannot be decoded ({reason})"
        )

    def _decoder(self, path: Path, batch: Batch) -> LayoutDecoder:
        key = batch.kind, batch.trusted
        if key not in self._decoders:
            self._run.decoder(path, batch.kind)  # raises what is wrong with the type
            # what stands in messages that may be wrong must not decide about the others
            named = self._named if batch.trusted else {}
            leaves = self._outputs[batch.kind.topic].leaves
            self._decoders[key] = LayoutDecoder(batch.kind, leaves, named)
        return self._decoders[key]


def within(batch: Batch, window: Window) -> Batch:
    """Return the messages of ``batch`` whose log time lies in ``window``."""
    if window.is_open:
        return batch
    inside = window.holds(batch.log_time)
    if bool(inside.all()):
        return batch
    published = None if batch.publish_time is None else batch.publish_time[inside]
    return replace(
        batch,
        starts=batch.starts[inside],
        lengths=batch.lengths[inside],
        log_time=batch.log_time[inside],
        publish_time=published,
        stride=0,
    )


def _account(file: Container, tally: _Tally, first_ns: int, options: ReadOptions) -> Damage:
    """Return what could be read of ``file`` and what was lost; raise it where the options are strict."""
    loss = file.loss
    spans_ns = sorted({*loss.spans_ns, *tally.spans_ns})
    damage = Damage(
        file.path,
        trusted=tally.trusted,
        suspect=tally.suspect,
        lost=None if loss.messages is None else loss.messages + tally.bad,
        lost_bytes=loss.size,
        lost_chunks=loss.chunks,
        spans_s=tuple(((first - first_ns) / _NS, (last - first_ns) / _NS) for first, last in spans_ns),
        reasons=(*loss.reasons, *tally.reasons[:_MOST_REASONS]),
    )
    if options.strict and (damage.reasons or not damage.is_harmless):
        detail = damage.reasons[0] if damage.reasons else f"{damage.suspect} messages may be wrong"
        raise InputError(f"{file.path} is damaged: {detail}", CURE)
    return damage


def _nothing(file: Container) -> InputError:
    if file.loss.reasons:
        return damaged(file.path, f"nothing in it can be read; {file.loss.reasons[0]}")
    return InputError(f"{file.path} holds no messages", "check that the recorder was subscribed")
