"""Sources of raw messages: a storage file read by rosbags, or by a scanner where that fails."""

from __future__ import annotations

from collections import Counter
from collections.abc import Callable, Collection, Iterable, Iterator
from contextlib import ExitStack
from functools import partial
from typing import Any, NamedTuple, Protocol

from ..core.common.words import counted

RawMessage = tuple[int, int, bytes]
"""Channel key, log time in nanoseconds, serialized message."""


class Damage(Exception):
    """A record cannot be understood; the text is the reason."""


class Channel(NamedTuple):
    """Messages of one topic and type in one file. `encoding` is 'cdr' or 'ros1'."""

    key: int
    topic: str
    msgtype: str
    encoding: str
    definition_format: str
    definition: str
    total: int


class Source(Protocol):
    """One storage file that is open for reading.

    Attributes
    ----------
    channels : list of Channel
    damage : str or None
        The reason why not everything could be read, as far as known.
    span : (int, int) or None
        Log times of the first and the last message, nanoseconds; None if unknown, or if there is no message.
    """

    channels: list[Channel]
    damage: str | None
    span: tuple[int, int] | None

    def messages(self, keys: Collection[int]) -> Iterator[RawMessage]:
        """Yield the messages of these channels by log time."""

    def close(self) -> None:
        """Release the file."""


def close_all(sources: Iterable[Source]) -> None:
    """Close sources, also the others if one cannot be closed: some have a temporary folder with gigabytes."""
    with ExitStack() as closing:
        for source in sources:
            closing.callback(source.close)


def one_line(error: BaseException) -> str:
    """Return the message of an exception, on one line and short enough to quote."""
    text = ' '.join(str(error).split()).rstrip('.')
    if isinstance(error, KeyError):
        text = f'a record lacks {text}'
    return (text[:160] + ' …' if len(text) > 160 else text) or type(error).__name__


def full_type_name(msgtype: str) -> str:
    """Return 'package/msg/Name', also for ROS 1's 'package/Name'."""
    parts = msgtype.split('/')
    return f'{parts[0]}/msg/{parts[1]}' if len(parts) == 2 else msgtype


class RosbagsSource:
    """An MCAP file or a ROS 1 bag that rosbags reads by its index.

    Parameters
    ----------
    reader : rosbags.rosbag1.Reader or rosbags.rosbag2.Reader
        Already open; this object closes it.
    encoding : str
        'cdr' or 'ros1'.
    scan : callable
        Opens a scanner of the same file, which continues where rosbags stops at damage.
    messages : callable, optional
        Yields the messages of a reader and some of its channels in the order of rosbags, but faster.
    """

    def __init__(
        self,
        reader: Any,
        encoding: str,
        scan: Callable[[], Source] | None,
        messages: Callable[[Any, Collection[int]], Iterator[RawMessage]] | None = None,
    ) -> None:
        self._reader = reader
        self._by_index = partial(messages, reader) if messages else self._by_rosbags
        self._scan = scan
        self._connections = {c.id: c for c in reader.connections}
        self.damage: str | None = None
        # rosbags gives the time after the last message
        self.span = (reader.start_time, reader.end_time - 1) if reader.start_time < reader.end_time else None
        self.channels = [
            Channel(
                c.id,
                c.topic,
                full_type_name(c.msgtype),
                encoding,
                c.msgdef.format.name.lower(),
                c.msgdef.data,
                c.msgcount,
            )
            for c in reader.connections
        ]

    def messages(self, keys: Collection[int]) -> Iterator[RawMessage]:
        """Yield the messages of these channels by log time."""
        connections = [c for key, c in self._connections.items() if key in keys]
        if not connections:
            return
        # yielded messages with the latest time, since several may have the same
        last, seen = -1, 0
        at_last: list[tuple[int, bytes]] = []
        try:
            for message in self._by_index(keys):
                if message[1] != last:
                    at_last = []
                    last = message[1]
                seen += 1
                at_last.append(message[::2])
                yield message
        except Exception as error:  # rosbags does not catch struct, zstd, sqlite and assertion errors
            self.damage = one_line(error)
        expected = sum(c.msgcount for c in connections)
        if self.damage is None and seen < expected:
            self.damage = f'the index promises {counted(expected, "message")}, only {seen} were found'
        if self.damage is not None and self._scan is not None:
            yield from self._rest(keys, last, Counter(at_last))

    def _by_rosbags(self, keys: Collection[int]) -> Iterator[RawMessage]:
        connections = [c for key, c in self._connections.items() if key in keys]
        for connection, time, data in self._reader.messages(connections):
            yield connection.id, time, bytes(data)

    def _rest(self, keys: Collection[int], last: int, given: Counter[tuple[int, bytes]]) -> Iterator[RawMessage]:
        """Yield the messages that a scanner finds from the time `last` on, except those that are `given`."""
        assert self._scan is not None
        try:
            scan = self._scan()
        except Exception:  # the damage is known already; the scanner could not read past it
            return
        try:
            for key, time, data in scan.messages(keys):
                if time == last and given[key, data]:
                    given[key, data] -= 1
                elif time >= last:
                    yield key, time, data
        finally:
            scan.close()

    def close(self) -> None:
        """Release the file."""
        self._reader.close()
