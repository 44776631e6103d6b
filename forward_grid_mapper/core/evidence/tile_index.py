"""Spatial index: lists of the readings that may observe the cells of each square tile.

The list of a tile is a linked list of chunks that grows at its head, so readings can be added at any time. It needs
about four bytes for fifteen pairs. Which of its readings observe a certain cell must be tested for each of them.
"""

from __future__ import annotations

from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from ..runtime.jit import inlined_kernel

SHIFT = 3
"""A tile is 2³ cells wide and high."""

CHUNK = 15


class Tiles(NamedTuple):
    """Lists of readings.

    Attributes
    ----------
    across : int
        Tiles in a row of them.
    head, fill, latest : int32, shape (tiles,)
        The first chunk of each list or -1, the number of ids in that chunk, and the reading inserted last.
    chunks : int32, shape (capacity, CHUNK + 1)
        Ids, and the next chunk or -1.
    used : int64, shape (1,)
        Chunks in use.
    """

    across: int
    head: NDArray[np.int32]
    fill: NDArray[np.int32]
    latest: NDArray[np.int32]
    chunks: NDArray[np.int32]
    used: NDArray[np.int64]


def no_tiles(height: int, width: int) -> Tiles:
    """Return empty lists for a grid of height x width cells."""
    across, up = ((n + (1 << SHIFT) - 1) >> SHIFT for n in (width, height))
    head, fill, latest = (np.full(across * up, value, np.int32) for value in (-1, 0, -1))
    return Tiles(across, head, fill, latest, np.empty((0, CHUNK + 1), np.int32), np.zeros(1, np.int64))


def more_chunks(tiles: Tiles) -> Tiles:
    """Return the same lists with more free chunks."""
    kept = len(tiles.chunks)
    chunks = np.empty((kept + max(kept // 2, len(tiles.head) + 1024), CHUNK + 1), np.int32)
    chunks[:kept] = tiles.chunks
    return tiles._replace(chunks=chunks)


@inlined_kernel
def insert(tiles: Tiles, row: int, first: int, last: int, t: Any) -> None:
    """Insert reading t for the cells `first` to `last` of a row; there must be a free chunk for each tile."""
    line = (row >> SHIFT) * tiles.across
    for tile in range(line + (first >> SHIFT), line + (last >> SHIFT) + 1):
        if tiles.latest[tile] == t:
            continue
        tiles.latest[tile] = t
        head = tiles.head[tile]
        if head < 0 or tiles.fill[tile] == CHUNK:
            chunk = tiles.used[0]
            tiles.used[0] += 1
            tiles.chunks[chunk, CHUNK] = head
            tiles.head[tile] = chunk
            tiles.fill[tile] = 0
            head = tiles.head[tile]
        tiles.chunks[head, tiles.fill[tile]] = t
        tiles.fill[tile] += 1
