"""Bounds on what a bag may unpack to, so that a small crafted file takes neither all memory nor all day.

Every decompression of a bag, rosbags' own included, goes through `unpack`.
"""

from __future__ import annotations

import bz2
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from contextvars import ContextVar
from functools import partial
from typing import Any

from backports import zstd
from lz4.frame import LZ4FrameDecompressor
from rosbags.rosbag1 import reader as rosbag1_reader
from rosbags.rosbag2 import storage_mcap

from .source import Damage

LARGEST_CHUNK = 128 << 20
"""Bytes that one chunk may unpack to. Recorders close a chunk at 1 to 4 MB, or after one message that is larger."""

LARGEST_MESSAGE = 16 << 20
"""Bytes that one message of a bag with compressed messages may unpack to; a Range has 60, an Odometry 720."""

FREE = 256 << 20
"""Bytes that a file may unpack to, however small it is."""

RATIO = 100
"""Times its own size that a file may unpack to beyond `FREE`. Ranges and odometry shrink to a tenth or so."""

LARGEST_METADATA = 16 << 20
"""Bytes of a metadata.yaml; one of a bag with ten thousand files has 3 MB."""

_DECOMPRESSORS: dict[str, Callable[[], Any]] = {
    'bz2': bz2.BZ2Decompressor,
    'lz4': LZ4FrameDecompressor,
    'zstd': zstd.ZstdDecompressor,
}


def most_unpacked(size: int) -> int:
    """Return how many bytes a file of `size` bytes may unpack to."""
    return FREE + RATIO * size


def megabytes(size: int) -> str:
    """Return a number of bytes for people."""
    return f'{size / 1e6:,.0f} MB'


def unpack(compression: str, data: bytes, most: int) -> bytes:
    """Decompress frame after frame; data that are cut off give their beginning.

    Parameters
    ----------
    compression : {'', 'none', 'bz2', 'lz4', 'zstd'}
    data : bytes
    most : int
        Bytes of the result at the most; not much more memory is taken before the error.

    Raises
    ------
    Damage
        If the compression is another one, or the result would be larger.
    Exception
        Of the kinds of the libraries, if the data are damaged.
    """
    if compression in ('', 'none'):
        return data
    if compression not in _DECOMPRESSORS:
        raise Damage(f'a chunk states the compression {compression!r}')
    parts: list[bytes] = []
    left = most
    while data:
        decompressor = _DECOMPRESSORS[compression]()
        part = decompressor.decompress(data, left + 1)
        while True:
            left -= len(part)
            if left < 0:
                raise Damage(f'it unpacks to more than {megabytes(most)}')
            parts.append(part)
            if decompressor.eof or decompressor.needs_input:
                break
            part = decompressor.decompress(b'', left + 1)
        data = decompressor.unused_data or b'' if decompressor.eof else b''
    return b''.join(parts)


class Budget:
    """What the chunks of one file may unpack to together; a reader may unpack a chunk more than once.

    Parameters
    ----------
    size : int
        Bytes of the file.
    """

    def __init__(self, size: int) -> None:
        self._most = self._left = most_unpacked(size)

    def unpack(self, compression: str, data: bytes, stated: int = LARGEST_CHUNK) -> bytes:
        """Decompress a chunk that states its size, or has the largest admitted one.

        Raises
        ------
        Damage
            If it unpacks to more than it states, or all of them to more than is admitted.
        """
        if stated > LARGEST_CHUNK:
            raise Damage(f'a chunk states {megabytes(stated)}, more than the {megabytes(LARGEST_CHUNK)} admitted')
        # what was refused already takes no more time
        self.spend(0)
        raw = unpack(compression, data, stated)
        self.spend(len(raw))
        return raw

    def spend(self, size: int) -> None:
        """Count what a chunk unpacked to.

        Raises
        ------
        Damage
            If all of them unpack to more than is admitted.
        """
        self._left -= size
        if self._left < 0:
            raise Damage(f'its chunks unpack to more than {megabytes(self._most)}')

    def metered(self, decompress: Callable[[bytes], bytes]) -> Callable[[bytes], bytes]:
        """Return a function that decompresses, and counts the result."""

        def counted(data: bytes) -> bytes:
            self.spend(0)
            raw = decompress(data)
            self.spend(len(raw))
            return raw

        return counted


_opening: ContextVar[Budget | None] = ContextVar('_opening', default=None)


@contextmanager
def bounded(size: int) -> Iterator[None]:
    """Let rosbags unpack in the block only what a file of `size` bytes may: some files it unpacks as it opens them."""
    token = _opening.set(Budget(size))
    try:
        yield
    finally:
        _opening.reset(token)


def _unpack_for_rosbags(compression: str, data: bytes, stated: int) -> bytes:
    budget = _opening.get()
    if budget is not None:
        return budget.unpack(compression, data, min(stated, LARGEST_CHUNK))
    return unpack(compression, data, min(stated, LARGEST_CHUNK))


def _bound_rosbags() -> None:
    """Put bounded decompressors into rosbags' tables: its own trust the size that the compressed data state."""
    for name in ('lz4', 'zstd'):
        storage_mcap.DECOMPRESSORS[name] = partial(_unpack_for_rosbags, name)
    for name in ('lz4', 'bz2'):
        rosbag1_reader.decompressors[name] = partial(_unpack_for_rosbags, name, stated=LARGEST_CHUNK)


_bound_rosbags()
