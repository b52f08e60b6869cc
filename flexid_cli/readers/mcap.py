"""MCAP logs: chunked or not, zstd, lz4 or plain, with or without index and summary, whole or damaged."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from pathlib import Path

from flexid_cli.readers.base import DEFAULT_OPTIONS, Note, Progress, ReadOptions, Window
from flexid_cli.readers.batch import Batch
from flexid_cli.readers.byte_source import ByteSource
from flexid_cli.readers.container import Container, MessageReader, Probe
from flexid_cli.readers.loss import Loss
from flexid_cli.readers.mcap_pass import McapPass
from flexid_cli.readers.mcap_probe import probe
from flexid_cli.readers.mcap_records import MAGIC
from flexid_cli.readers.mcap_summary import Summary, read_summary

_LEAST_MAGIC = 6  # bytes of the magic that a damaged file must still have


class McapReader(MessageReader):
    """Reader of MCAP files (https://mcap.dev/spec); every checksum that a file has is verified."""

    name = "mcap"
    suffixes: tuple[str, ...] = (".mcap",)

    def sniff(self, path: Path, head: bytes) -> bool:  # noqa: ARG002 - the protocol asks for it
        """Whether ``path`` begins with the MCAP magic, of which two bytes may be damaged."""
        return sum(map(int.__eq__, head[: len(MAGIC)], MAGIC)) >= _LEAST_MAGIC

    @contextmanager
    def open_files(
        self, paths: Sequence[Path], options: ReadOptions = DEFAULT_OPTIONS
    ) -> Iterator[tuple[list[Container], list[Note]]]:
        """Open all files of one run."""
        progress = Progress(options, sum(_size(path) for path in paths))
        yield [McapFile(path, options=options, progress=progress) for path in paths], []


def _size(path: Path) -> int:
    try:
        return path.stat().st_size
    except OSError:
        return 0  # opening it tells why


class McapFile:
    """One MCAP file, read from its beginning to its end; the index only shortens the way.

    Parameters
    ----------
    path : Path
        The file.
    shown : Path, optional
        The file that messages name, where ``path`` is an unpacked copy of it.
    options : ReadOptions
        Of them, the number of threads.
    progress : Progress, optional
        Is told what has been read.

    Attributes
    ----------
    loss : Loss
        Damage met in the last call of `probe` or `batches`.
    """

    def __init__(
        self,
        path: Path,
        shown: Path | None = None,
        options: ReadOptions = DEFAULT_OPTIONS,
        progress: Progress | None = None,
    ) -> None:
        self.path = shown or path
        self.notes: list[Note] = []
        self.loss = Loss()
        self._file = path
        self._options = options
        self._progress = progress
        self._summary: tuple[int, Summary] | None = None

    def probe(self) -> Probe:
        """Count the messages and take the first ones of every topic, with as little reading as it needs."""
        self.loss = Loss()
        with ByteSource(self._file, self.path) as source:
            return probe(source, self.loss, self._read_summary(source))

    def batches(self, wanted: Callable[[str], bool], window: Window) -> Iterator[Batch]:
        """Yield the messages of the wanted topics, chunk by chunk; see `Container`."""
        self.loss = Loss()
        with ByteSource(self._file, self.path) as source:
            summary = self._read_summary(source)
            reading = McapPass(
                source, self.loss, wanted, window, self._options.threads, self._progress, summary
            )
            yield from reading.batches()

    def _read_summary(self, source: ByteSource) -> Summary:
        """Return the end of the file, which is read again where the file has grown."""
        if self._summary is None or self._summary[0] != source.size:
            self._summary = source.size, read_summary(source)
        return self._summary[1]
