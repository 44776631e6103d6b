"""Common ground of the scanners that read a damaged file from front to back, without its index."""

from __future__ import annotations

import bz2
from collections import Counter
from collections.abc import Collection, Iterator
from pathlib import Path

from rosbags.rosbag2.storage_mcap import DECOMPRESSORS

from .source import Channel, RawMessage

_LARGEST_CHUNK = 1 << 30


class Damage(Exception):
    """A record cannot be understood; the text says why."""


def inflate(compression: str, data: bytes, size: int) -> bytes:
    """Decompress a chunk. One that was cut off gives its beginning, except with zstd and lz4, where it is lost."""
    if compression in ('', 'none'):
        return data
    if compression == 'bz2':
        # A flipped bit in the declared size must not make us ask for all the memory there is.
        return bz2.BZ2Decompressor().decompress(data, max_length=min(size, _LARGEST_CHUNK))
    if compression in DECOMPRESSORS and size <= _LARGEST_CHUNK:
        return bytes(DECOMPRESSORS[compression](data, size))
    raise Damage(f'a chunk states the compression {compression!r} and {size} bytes')


class Scan:
    """Reads a file from front to back; a subclass knows the format.

    The first pass, on construction, finds the channels and counts their messages. Files without an index are not in
    the order of time, so `messages` keeps what it is asked for in memory and sorts it.
    """

    def __init__(self, path: Path) -> None:
        self._path = path
        self._found: dict[int, Channel] = {}
        self.damage: str | None = None
        counts = Counter(key for key, _, _ in self._walk())
        self.channels = [c._replace(total=counts[c.key]) for c in self._found.values()]

    def messages(self, keys: Collection[int]) -> Iterator[RawMessage]:
        """Yield the messages of these channels by log time."""
        yield from sorted((raw for raw in self._walk() if raw[0] in keys), key=lambda raw: raw[1])

    def close(self) -> None:
        """Nothing is held open between passes."""

    def _walk(self) -> Iterator[RawMessage]:
        """Yield every message that can be read, in the file's order; note channels and damage."""
        raise NotImplementedError

    def _note(self, damage: str) -> None:
        self.damage = self.damage or damage
