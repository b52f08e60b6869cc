"""Which topic a channel of an MCAP file belongs to, and how far its description can be trusted."""

from __future__ import annotations

from collections.abc import Callable
from enum import IntEnum
from typing import Generic, NamedTuple, TypeVar

from flexid_cli.readers.decoders import TopicType
from flexid_cli.readers.mcap_records import (
    CHANNEL,
    Bytes,
    Channel,
    Schema,
    parse_channel,
    parse_schema,
)
from flexid_cli.readers.mcap_summary import Summary

_T = TypeVar("_T")


class Level(IntEnum):
    """Where a description comes from; the better one is used where a channel is described twice."""

    SUSPECT = 0
    UNCHECKED = 1
    CHECKED = 2
    SUMMARY = 3  # the summary's checksum holds


class Described(NamedTuple):
    """A channel's topic, whether it is wanted, and whether its description can be trusted."""

    kind: TopicType
    wanted: bool
    trusted: bool


class _Table(Generic[_T]):
    """Descriptions by number, the most trustworthy of each."""

    def __init__(self) -> None:
        self._known: dict[int, tuple[_T, Level]] = {}

    def add(self, number: int, content: _T, level: Level) -> None:
        known = self._known.get(number)
        if known is None or level >= known[1]:
            self._known[number] = (content, level)

    def get(self, number: int) -> tuple[_T, Level] | None:
        return self._known.get(number)

    def numbers(self) -> list[int]:
        return list(self._known)


class Topics:
    """The channels of one file.

    Parameters
    ----------
    summary : Summary
        The end of the file, which repeats the descriptions.
    wanted : callable
        Whether a topic is wanted.
    """

    def __init__(self, summary: Summary, wanted: Callable[[str], bool]) -> None:
        self._wanted = wanted
        self._schemas: _Table[Schema] = _Table()
        self._channels: _Table[Channel] = _Table()
        self._described: dict[int, Described | None] = {}
        level = Level.SUMMARY if summary.is_checked else Level.UNCHECKED
        for number, schema in summary.schemas.items():
            self._schemas.add(number, schema, level)
        for number, channel in summary.channels.items():
            self._channels.add(number, channel, level)

    def add(self, opcode: int, body: Bytes, level: Level) -> bool:
        """Take over a schema or channel record; returns whether it is whole."""
        try:
            if opcode == CHANNEL:
                number, channel = parse_channel(body)
                self._channels.add(number, channel, level)
            else:
                number, schema = parse_schema(body)
                self._schemas.add(number, schema, level)
        except ValueError:
            return False
        self._described.clear()
        return True

    def get(self, channel: int) -> Described | None:
        """Return the topic of a channel, or None where the file does not describe it."""
        if channel not in self._described:
            self._described[channel] = self._describe(channel)
        return self._described[channel]

    def wanted_channels(self) -> frozenset[int]:
        """Numbers of the channels described so far whose topics are wanted."""
        found = ((number, self.get(number)) for number in self._channels.numbers())
        return frozenset(number for number, described in found if described is None or described.wanted)

    def _describe(self, number: int) -> Described | None:
        known = self._channels.get(number)
        if known is None:
            return None
        channel, level = known
        schema = Schema("", "", b"")
        if channel.schema:
            found = self._schemas.get(channel.schema)
            if found is None:
                return None
            schema, level = found[0], min(level, found[1])
        kind = TopicType(channel.topic, schema.name, channel.encoding, schema.encoding, schema.data)
        return Described(kind, self._wanted(channel.topic), level > Level.SUSPECT)
