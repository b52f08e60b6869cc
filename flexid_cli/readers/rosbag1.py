"""ROS 1 bags, version 2.0: plain, lz4 and bz2."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from contextlib import ExitStack, contextmanager
from pathlib import Path
from typing import TYPE_CHECKING

from flexid_cli.errors import InputError
from flexid_cli.readers.base import Note
from flexid_cli.readers.container import Container, Message, MessageReader, Probe
from flexid_cli.readers.damage import decoding
from flexid_cli.readers.decoders import TopicType

if TYPE_CHECKING:
    from rosbags.interfaces import Connection
    from rosbags.rosbag1 import Reader

MAGIC = b"#ROSBAG V"
_VERSION = MAGIC + b"2.0\n"


class Rosbag1Reader(MessageReader):
    """Reader of ROS 1 bags; messages come by log time, as the format's index gives them."""

    name = "rosbag1"
    suffixes: tuple[str, ...] = (".bag",)

    def sniff(self, path: Path, head: bytes) -> bool:  # noqa: ARG002 - the protocol asks for it
        """Whether ``path`` begins as a ROS 1 bag."""
        return head.startswith(MAGIC)

    @contextmanager
    def open_files(self, paths: Sequence[Path]) -> Iterator[tuple[list[Container], list[Note]]]:
        """Open all files of one run."""
        with ExitStack() as stack:
            yield [stack.enter_context(_opened(path)) for path in paths], []


@contextmanager
def _opened(path: Path) -> Iterator[Container]:
    from rosbags.rosbag1 import Reader

    with decoding(path, "its head"):
        with path.open("rb") as stream:
            start = stream.read(len(_VERSION))
        if start != _VERSION and start.startswith(MAGIC):
            raise InputError(
                f"{path} is a ROS 1 bag of version {start[len(MAGIC) :].split()[0].decode()}, not 2.0",
                "convert it with `rosbag fix`",
            )
        reader = Reader(path)
    with decoding(path, "its index"):
        reader.open()
    try:
        yield _BagFile(path, reader)
    finally:
        reader.close()


class _BagFile:
    """One open ROS 1 bag."""

    def __init__(self, path: Path, reader: Reader) -> None:
        self.path = path
        self.notes: list[Note] = []
        self._reader = reader

    def probe(self) -> Probe:
        """Look at every topic's first messages."""
        probe = Probe()
        for connection in self._reader.connections:
            if not connection.msgcount:
                continue
            kind = _kind(connection)
            first = True
            for message in self._read([connection]):
                earliest = min(probe.first_log_time or message.log_time, message.log_time)
                probe.add(kind, message.log_time, message.data)
                probe.first_log_time = earliest
                if not first and probe.counts[kind] > len(probe.samples[kind]):
                    break
                first = False
        probe.counts = self._counts()
        return probe

    def _counts(self) -> dict[TopicType, int]:
        counts: dict[TopicType, int] = {}
        for connection in self._reader.connections:
            kind = _kind(connection)
            counts[kind] = counts.get(kind, 0) + connection.msgcount
        return {kind: count for kind, count in counts.items() if count}

    def messages(self, wanted: Callable[[str], bool]) -> Iterator[Message]:
        """Yield the messages of the wanted topics by log time."""
        chosen = [connection for connection in self._reader.connections if wanted(connection.topic)]
        return self._read(chosen) if chosen else iter(())

    def _read(self, connections: Sequence[Connection]) -> Iterator[Message]:
        kinds = {connection.id: _kind(connection) for connection in connections}
        stream = self._reader.messages(connections)
        count = 0
        while True:
            with decoding(self.path, f"what follows its message {count}"):
                item = next(stream, None)
            if item is None:
                return
            count += 1
            connection, log_time, data = item
            yield Message(kinds[connection.id], log_time, None, data)


def _kind(connection: Connection) -> TopicType:
    return TopicType(connection.topic, connection.msgtype, "ros1", "ros1msg", connection.msgdef.data.encode())
