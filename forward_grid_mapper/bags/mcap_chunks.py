"""The messages of an MCAP file by its index, in the order of rosbags, in a third of the time.

rosbags reads the records of a chunk piece by piece. Here they are decoded in place. A chunk with a fault is left to
rosbags, so that its damage is handled and reported as usual.
"""

from __future__ import annotations

import struct
from collections.abc import Collection, Iterator
from typing import Any

from rosbags.rosbag2 import storage_mcap

from .source import RawMessage

_MESSAGE = 0x05
_HEAD = struct.Struct('<BQH4xQ8x')
"""Opcode and length of a record; channel and log time of a message; padding before its data."""


def indexed_messages(reader: Any, keys: Collection[int]) -> Iterator[RawMessage]:
    """Yield the messages of some channels by log time.

    Parameters
    ----------
    reader : rosbags.rosbag2.Reader
        Open, of a file with an index.
    keys : collection of int

    Raises
    ------
    Exception
        The error of rosbags for a damaged chunk, after all messages before the chunk.
    """
    storage = reader.storage
    connections = {c.id: c for c in storage.connections if c.id in keys}
    chunks = [c for c in storage.chunks if any(c.channel_count.get(key, 0) for key in connections)]
    chunks.sort(key=lambda chunk: chunk.message_start_time)
    held: list[tuple[int, int, int, bytes]] = []
    for chunk in chunks:
        # all messages before this chunk are known
        held.sort(key=lambda message: message[:2])
        begin = next((k for k, message in enumerate(held) if message[0] >= chunk.message_start_time), len(held))
        yield from ((key, time, data) for time, _, key, data in held[:begin])
        held = [*held[begin:], *_messages_of(chunk, connections, storage.bio)]
    held.sort(key=lambda message: message[:2])
    yield from ((key, time, data) for time, _, key, data in held)


def _messages_of(chunk: Any, connections: dict[int, Any], file: Any) -> list[tuple[int, int, int, bytes]]:
    """Return log time, number of the chunk, channel and data of the messages of a chunk, in their order in the file."""
    first, last, at = chunk.message_start_time, chunk.message_end_time, chunk.chunk_start_offset
    found = _walked(_unpacked(chunk, file), set(connections), first, last, at)
    if found is None:
        # the first item is a mark, not a message
        by_rosbags = list(storage_mcap.msgsrc(chunk, connections, first, last + 1, file))[1:]
        return [(m.timestamp, at, m.connection.id, bytes(m.data)) for m in by_rosbags]  # type: ignore[union-attr, arg-type]
    return found


def _unpacked(chunk: Any, file: Any) -> bytes:
    file.seek(chunk.chunk_start_offset + 9 + 24)
    (crc,) = struct.unpack('<I', file.read(4))
    file.seek(chunk.chunk_start_offset + 9 + 40 + len(chunk.compression))
    packed = file.read(chunk.compressed_size)
    return bytes(storage_mcap.decompress(packed, chunk.compression, chunk.uncompressed_size, crc))


def _walked(
    raw: bytes, keys: Collection[int], first: int, last: int, number: int
) -> list[tuple[int, int, int, bytes]] | None:
    """Return the messages among the records of a chunk; None if the records do not exactly fill it."""
    found = []
    at, end, head, unpack = 0, len(raw), _HEAD.size, _HEAD.unpack_from
    while at < end:
        if at + head > end:
            return None
        opcode, length, key, time = unpack(raw, at)
        after = at + 9 + length
        if after > end or (opcode == _MESSAGE and length < head - 9):
            return None
        if opcode == _MESSAGE and key in keys and first <= time <= last:
            found.append((time, number, key, raw[at + head : after]))
        at = after
    return found
