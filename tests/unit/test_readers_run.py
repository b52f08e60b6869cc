"""The run over the files of a log: what is kept, marked, counted and refused."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from flexid_cli.errors import InputError
from flexid_cli.readers.base import DEFAULT_OPTIONS, Note, RawLog, ReadOptions, Window
from flexid_cli.readers.batch import Batch
from flexid_cli.readers.container import Container, MessageReader, Probe
from flexid_cli.readers.decoders import TopicType
from flexid_cli.readers.gather import Growing
from flexid_cli.readers.layout import LayoutDecoder
from flexid_cli.readers.loss import Loss
from flexid_cli.readers.messages import leaves_of, needs_integers
from flexid_cli.readers.payloads import Payloads, agreement, patterns

KIND = TopicType("/q", "x/msg/Q", "cdr", "ros2msg", b"float64 q\nint64 n\n")
STEP_NS = 1_000_000


def payload(q: float, n: int = 0) -> bytes:
    return b"\0\1\0\0" + np.float64(q).tobytes() + np.int64(n).tobytes()


def batch(first: int, payloads: Sequence[bytes], **more: Any) -> Batch:
    lengths = np.array([len(data) for data in payloads], dtype=np.int64)
    times = (np.arange(len(payloads)) + first) * STEP_NS
    content = np.frombuffer(b"".join(payloads), dtype=np.uint8)
    made = Batch(KIND, content, np.cumsum(lengths) - lengths, lengths, times, None, checked=True)
    return replace(made, **more)


class File:
    """A container with batches that were made up."""

    def __init__(self, path: Path, batches: Sequence[Batch]) -> None:
        self.path = path
        self.notes: list[Note] = []
        self.loss = Loss()
        self._batches = batches

    def probe(self) -> Probe:
        probe = Probe()
        for one in self._batches:
            for row, time in enumerate(one.log_time.tolist()):
                probe.add(one.kind, time, one.payload(row))
        return probe

    def batches(self, wanted: Callable[[str], bool], window: Window) -> Iterator[Batch]:
        self.loss = Loss()
        for one in self._batches:
            if wanted(one.kind.topic):
                yield one


class Reader(MessageReader):
    name = "made up"

    def __init__(self, files: Sequence[File]) -> None:
        self._files = files

    @contextmanager
    def open_files(
        self, paths: Sequence[Path], options: ReadOptions = DEFAULT_OPTIONS
    ) -> Iterator[tuple[list[Container], list[Note]]]:
        yield list(self._files), []


def read(*files: Sequence[Batch], **options: Any) -> RawLog:
    made = [File(Path(f"/logs/{number}"), batches) for number, batches in enumerate(files)]
    return Reader(made).read([file.path for file in made], ["/q.q"], ReadOptions(**options))


def ramp(first: int, last: int) -> list[bytes]:
    return [payload(k / 8) for k in range(first, last)]


def test_files_in_the_order_of_their_log_times() -> None:
    log = read([batch(100, ramp(100, 150))], [batch(0, ramp(0, 100))])
    assert log.channels["/q.q"].values.tolist() == [k / 8 for k in range(150)]
    assert log.channels["/q.q"].stamps["log_time"].tolist() == [k * STEP_NS for k in range(150)]
    assert [one.path.name for one in log.damage] == ["0", "1"]
    assert [one.trusted for one in log.damage] == [50, 100]
    assert all(one.is_harmless for one in log.damage)


def test_a_message_that_cannot_be_decoded_is_lost_and_counted() -> None:
    payloads = ramp(0, 100)
    payloads[40] = payloads[40][:9]
    log = read([batch(0, payloads)])
    assert log.channels["/q.q"].values.tolist() == [k / 8 for k in range(100) if k != 40]
    (damage,) = log.damage
    assert (damage.trusted, damage.lost) == (99, 1)
    assert f"from {40 * STEP_NS} ns on" in damage.reasons[0]
    with pytest.raises(InputError, match="1 message of topic '/q'"):
        read([batch(0, payloads)], strict=True)


def test_suspect_batches_are_left_out_or_marked() -> None:
    batches = [
        batch(0, ramp(0, 50)),
        batch(50, [*ramp(50, 59), b"\0"], trusted=False),
        batch(60, ramp(60, 99)),
    ]
    log = read(batches)
    assert log.channels["/q.q"].values.tolist() == [k / 8 for k in range(99) if not 50 <= k < 60]
    assert log.channels["/q.q"].suspect is None
    assert (log.damage[0].trusted, log.damage[0].suspect, log.damage[0].lost) == (89, 10, 0)
    kept = read(batches, keep_suspect=True).channels["/q.q"]
    assert kept.values.tolist() == [k / 8 for k in range(99) if k != 59]
    assert kept.suspect is not None
    assert np.flatnonzero(kept.suspect).tolist() == list(range(50, 59))


def test_jumps_that_no_checksum_covers_are_suspect() -> None:
    rng = np.random.default_rng(2)
    smooth = np.sin(np.arange(5000) / 200) + 1e-3 * rng.normal(size=5000)
    smooth[1234] = 1e5
    payloads = [payload(q) for q in smooth]
    assert read([batch(0, payloads)]).channels["/q.q"].values.size == 5000
    log = read([batch(0, payloads[:1000])], [batch(1000, payloads[1000:], checked=False)])
    values = log.channels["/q.q"].values
    assert np.array_equal(values, np.delete(smooth, 1234))
    assert log.channels["/q.q"].stamps["log_time"].size == values.size
    assert [(one.trusted, one.suspect) for one in log.damage] == [(1000, 0), (3999, 1)]
    assert "jump farther" in log.damage[1].reasons[0]
    kept = read([batch(0, payloads, checked=False)], keep_suspect=True).channels["/q.q"]
    assert kept.suspect is not None
    assert np.flatnonzero(kept.suspect).tolist() == [1234]


def test_a_time_window() -> None:
    batches = [batch(0, ramp(0, 50)), batch(50, ramp(50, 100))]
    log = read(batches, start_s=0.01, end_s=0.06)
    assert log.channels["/q.q"].values.tolist() == [k / 8 for k in range(10, 60)]
    assert log.damage[0].trusted == 50
    with pytest.raises(InputError, match="no messages in the time window"):
        read(batches, start_s=5.0)


def test_messages_packed_one_by_one() -> None:
    import zstandard

    packed = [zstandard.ZstdCompressor().compress(data) for data in ramp(0, 30)]
    packed[7] = packed[7][:-3]
    log = read([batch(0, packed)])
    assert log.channels["/q.q"].values.tolist() == [k / 8 for k in range(30) if k != 7]
    assert log.damage[0].lost == 1


def test_integers_that_outgrow_float64_are_kept_from_the_first_on() -> None:
    leaf = next(leaf for leaf in leaves_of("/q", {"n": 1}))
    numbers = [[1, 2, 3], [2**60, 2**60 + 1], [7]]
    batches = [batch(0, [payload(0.0, n) for n in some]) for some in numbers]
    files = [File(Path("/logs/0"), batches)]
    channel = Reader(files).read([files[0].path], ["/q.n"]).channels["/q.n"]
    assert channel.exact is not None
    assert channel.exact.tolist() == [n for some in numbers for n in some]
    assert LayoutDecoder(KIND, [leaf]).decode(batches[0]).exact == {}
    assert not needs_integers(np.array([2**53, -(2**53), 2**60]))
    assert needs_integers(np.array([2**53 + 1]))
    assert needs_integers(np.array([2**63 - 1]))


def test_growing_arrays() -> None:
    growing: Growing[np.int64] = Growing(np.int64, expected=3)
    for first in range(0, 5000, 7):
        growing.extend(np.arange(first, first + 7))
    assert growing.view().tolist() == list(range(5005))
    assert growing.finish().tolist() == list(range(5005))


@pytest.mark.parametrize("stride", [40, None])
def test_patterns_find_every_bit_that_matters(stride: int | None) -> None:
    """Each flipped bit is noticed exactly where it matters, for evenly and unevenly placed payloads."""
    rng = np.random.default_rng(5)
    reference = rng.integers(0, 256, 37).astype(np.uint8)
    matters = [(0, 2, 255), (4, 9, 128), (12, 15, 255), (15, 21, 0), (21, 36, 255)]
    mask = np.zeros(37, dtype=np.uint8)
    for first, end, bits in matters:
        mask[first:end] = bits
    starts = np.arange(300) * 40 if stride else np.cumsum(rng.integers(37, 50, 300))
    buffer = np.zeros(int(starts[-1]) + 37, dtype=np.uint8)
    for start in starts:
        buffer[start : start + 37] = reference
    shape = patterns(reference.tobytes(), matters)
    assert agreement(shape, Payloads(buffer, starts)) is None
    for row, (place, bit) in enumerate((place, bit) for place in range(37) for bit in range(8)):
        buffer[starts[row] + place] ^= 1 << bit
    found = agreement(shape, Payloads(buffer, starts))
    expected = [not mask[row // 8] & 1 << row % 8 if row < 296 else True for row in range(300)]
    assert found is not None
    assert found.tolist() == expected
