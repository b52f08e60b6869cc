"""What all writers share: the table that is written, its messages, and how a file comes into being."""

from __future__ import annotations

import re
import shutil
from collections.abc import Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import dataclass, field
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

from flexid_cli.errors import OutputError

if TYPE_CHECKING:
    from rosbags.typesys.store import Typestore

JOINT_STATE = "sensor_msgs/msg/JointState"
FLOAT64 = "std_msgs/msg/Float64"
QUANTITIES = ("position", "velocity", "effort")
_JOINT_CHANNEL = re.compile(rf"(?P<topic>.*)/(?P<joint>[^/]+)/(?P<quantity>{'|'.join(QUANTITIES)})")
_NANO = 1_000_000_000


@dataclass(frozen=True)
class LogTable:
    """Channels that share their stamps.

    Attributes
    ----------
    stamps_ns : ndarray of int64, shape (n,)
        Nanoseconds.
    channels : mapping of str to ndarray of float64, shape (n,)
        Values by signal path (``/joint_states/motor/position``) or column name; NaN where there is none.
    units : mapping of str to str
        Units of the channels, where they are declared; only CSV has a place for them.
    """

    stamps_ns: NDArray[np.int64]
    channels: Mapping[str, NDArray[np.float64]]
    units: Mapping[str, str] = field(default_factory=dict)

    def __post_init__(self) -> None:
        if self.stamps_ns.dtype != np.int64 or self.stamps_ns.ndim != 1:
            raise OutputError("the stamps of a log must be int64 nanoseconds in one dimension")
        if not self.channels:
            raise OutputError("a log without channels cannot be written")
        for source, values in self.channels.items():
            if values.shape != self.stamps_ns.shape:
                raise OutputError(
                    f"channel {source!r} has the shape {values.shape}, its stamps {self.stamps_ns.shape}"
                )


@dataclass(frozen=True)
class Topic:
    """One topic and the content of its messages.

    Attributes
    ----------
    name, msgtype : str
        The topic and its message type.
    joints : tuple of str
        Names of a JointState; empty for a Float64.
    arrays : mapping of str to ndarray, shape (n, joints)
        Values by field: ``position``, ``velocity``, ``effort`` (shape (n, 0) where no joint has it) or
        ``data``.
    """

    name: str
    msgtype: str
    joints: tuple[str, ...]
    arrays: Mapping[str, NDArray[np.float64]]


def topics_of(table: LogTable, default: str) -> list[Topic]:
    """Group the channels of a table into topics.

    Channels ``/topic/joint/position`` (or velocity, effort) become one JointState a topic, in which NaN
    stands where a joint lacks a quantity that another joint has. Every other channel becomes a Float64 on a
    topic of its own, below ``default`` unless its name begins with a slash.
    """
    grouped: dict[str, dict[tuple[str, str], NDArray[np.float64]]] = {}
    topics: list[Topic] = []
    for source, values in table.channels.items():
        match = _JOINT_CHANNEL.fullmatch(source)
        if match and match["topic"].startswith("/") and len(match["topic"]) > 1:
            grouped.setdefault(match["topic"], {})[match["joint"], match["quantity"]] = values
        else:
            name = source if source.startswith("/") else f"{default.rstrip('/')}/{source}"
            topics.append(Topic(name, FLOAT64, (), {"data": values[:, np.newaxis]}))
    return [_joint_state(name, channels, table.stamps_ns.size) for name, channels in grouped.items()] + topics


def _joint_state(name: str, channels: Mapping[tuple[str, str], NDArray[np.float64]], count: int) -> Topic:
    joints = tuple(dict.fromkeys(joint for joint, _ in channels))
    present = {quantity for _, quantity in channels}
    absent = np.full(count, np.nan)
    arrays = {
        quantity: np.column_stack([channels.get((joint, quantity), absent) for joint in joints])
        if quantity in present
        else np.empty((count, 0))
        for quantity in QUANTITIES
    }
    return Topic(name, JOINT_STATE, joints, arrays)


def ros_store(ros: int) -> Typestore:
    """Return the message types of ROS 1 or ROS 2."""
    from rosbags.typesys import Stores, get_typestore

    return get_typestore(Stores.ROS1_NOETIC if ros == 1 else Stores.ROS2_JAZZY)


def ros_message(store: Typestore, topic: Topic, row: int, stamp_ns: int) -> Any:
    """Build the message of one row; its header has the stamp and, in ROS 1, the row's number."""
    types: Mapping[str, Any] = store.types
    values = {name: np.ascontiguousarray(array[row]) for name, array in topic.arrays.items()}
    if topic.msgtype == FLOAT64:
        return types[FLOAT64](data=float(values["data"][0]))
    seconds, nanoseconds = divmod(stamp_ns, _NANO)
    stamp = types["builtin_interfaces/msg/Time"](sec=seconds, nanosec=nanoseconds)
    header_type = types["std_msgs/msg/Header"]
    counted = {"seq": row} if "seq" in header_type.__dataclass_fields__ else {}
    header = header_type(**counted, stamp=stamp, frame_id="")
    return types[JOINT_STATE](header=header, name=list(topic.joints), **values)


def check_stamps(stamps_ns: NDArray[np.int64], *, largest_s: int, kind: str) -> None:
    """Raise OutputError where a stamp does not fit a clock that counts from 0 to ``largest_s`` seconds."""
    if stamps_ns.size and (stamps_ns.min() < 0 or stamps_ns.max() > largest_s * _NANO):
        raise OutputError(
            f"{kind} holds times from 0 to {largest_s} s, the log's go from {stamps_ns.min()} to "
            f"{stamps_ns.max()} ns",
            "shift the stamps, or write CSV",
        )


@contextmanager
def finished_later(path: Path, *, overwrite: bool) -> Iterator[Path]:
    """Give a path to write to, and put the result in the place of ``path`` when all went well.

    The given path has the final name in a hidden folder beside it, so that what a container says of its own
    name holds, and a failure leaves nothing behind.

    Raises
    ------
    OutputError
        ``path`` exists and is not to be overwritten, or the folder cannot be written to.
    """
    if path.exists() and not overwrite:
        raise OutputError(f"{path} exists already", "choose another name, or allow it to be overwritten")
    try:
        with TemporaryDirectory(prefix=f".{path.name}-", dir=path.parent) as folder:
            draft = Path(folder) / path.name
            yield draft
            _replace(draft, path)
    except OSError as error:
        raise OutputError(f"cannot write {path}: {(error.strerror or str(error)).lower()}") from error


def _replace(draft: Path, path: Path) -> None:
    if path.is_dir() and not path.is_symlink():
        old = draft.parent / "old"
        path.rename(old)
        draft.rename(path)
        shutil.rmtree(old)
    elif draft.is_dir() and path.exists():
        path.unlink()
        draft.rename(path)
    else:
        draft.replace(path)


def one_of(value: str, choices: Sequence[str], what: str) -> str:
    """Return ``value``; raise OutputError where it is none of ``choices``."""
    if value not in choices:
        raise OutputError(f"{what} {value!r} is not known", "choose one of " + ", ".join(choices))
    return value
