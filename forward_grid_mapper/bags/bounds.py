"""Bounds on decompression, so that a small crafted bag uses neither all memory nor all time.

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
"""Largest decompressed size of a chunk. Recorders close a chunk at 1 to 4 MB, or after one message that is larger."""

LARGEST_MESSAGE = 16 << 20
"""Largest decompressed size of a message in a bag with compressed messages; a Range has 60, an Odometry 720."""

ALWAYS_ALLOWED = 256 << 20
"""Decompressed size that is allowed for a file of any size."""

LARGEST_RATIO = 100
"""Largest ratio of decompressed to compressed size beyond `ALWAYS_ALLOWED`. For ranges and odometry it is about 10."""

LARGEST_METADATA = 16 << 20
"""Largest metadata.yaml, bytes; that of a bag with ten thousand files has 3 MB."""

_DECOMPRESSORS: dict[str, Callable[[], Any]] = {
    'bz2': bz2.BZ2Decompressor,
    'lz4': LZ4FrameDecompressor,
    'zstd': zstd.ZstdDecompressor,
}


def most_unpacked(size: int) -> int:
    """Return the largest decompressed size that is allowed for a file of `size` bytes."""
    return ALWAYS_ALLOWED + LARGEST_RATIO * size


def megabytes(size: int) -> str:
    """Return a number of bytes in words."""
    return f'{size / 1e6:,.0f} MB'


def unpack(compression: str, data: bytes, most: int) -> bytes:
    """Decompress all frames; truncated data give their beginning.

    Parameters
    ----------
    compression : {'', 'none', 'bz2', 'lz4', 'zstd'}
    data : bytes
    most : int
        Largest size of the result, bytes; not much more memory is used before the error.

    Raises
    ------
    Damage
        If the compression is unknown, or the result would be larger.
    Exception
        Of the library, if the data are damaged.
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
    """Bounds the decompressed size of all chunks of a file; a chunk that is read again counts again.

    Parameters
    ----------
    size : int
        Bytes of the file.
    """

    def __init__(self, size: int) -> None:
        self._most = self._left = most_unpacked(size)

    def unpack(self, compression: str, data: bytes, stated: int = LARGEST_CHUNK) -> bytes:
        """Decompress a chunk with a stated size, or at most the largest allowed one.

        Raises
        ------
        Damage
            If its size is larger than stated, or the total is larger than allowed.
        """
        if stated > LARGEST_CHUNK:
            raise Damage(f'a chunk states {megabytes(stated)}, more than the {megabytes(LARGEST_CHUNK)} admitted')
        # once the budget is spent, no more time is spent either
        self.spend(0)
        raw = unpack(compression, data, stated)
        self.spend(len(raw))
        return raw

    def spend(self, size: int) -> None:
        """Count the decompressed size of a chunk.

        Raises
        ------
        Damage
            If the total is larger than allowed.
        """
        self._left -= size
        if self._left < 0:
            raise Damage(f'its chunks unpack to more than {megabytes(self._most)}')

    def metered(self, decompress: Callable[[bytes], bytes]) -> Callable[[bytes], bytes]:
        """Return a decompression function that counts its results."""

        def counted(data: bytes) -> bytes:
            self.spend(0)
            raw = decompress(data)
            self.spend(len(raw))
            return raw

        return counted


_opening: ContextVar[Budget | None] = ContextVar('_opening', default=None)


@contextmanager
def bounded(size: int) -> Iterator[None]:
    """Bound decompression by rosbags in the block for a file of `size` bytes: it decompresses some as it opens them."""
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
    """Put bounded decompressors into rosbags' tables: its own ones trust the size stated in the data."""
    for name in ('lz4', 'zstd'):
        storage_mcap.DECOMPRESSORS[name] = partial(_unpack_for_rosbags, name)
    for name in ('lz4', 'bz2'):
        rosbag1_reader.decompressors[name] = partial(_unpack_for_rosbags, name, stated=LARGEST_CHUNK)


_bound_rosbags()
