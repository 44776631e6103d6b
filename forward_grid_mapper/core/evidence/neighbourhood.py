"""The eight neighbours of a cell, and which of them are occupied: one bit of a pattern for each.

Neighbour k lies k eighths of a turn counterclockwise from east; rows count upward. Bit k of a cell's pattern is set
where its neighbour k is occupied.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from ..runtime.jit import kernel

NEIGHBOURS = 8

EAST, NORTH_EAST, NORTH, NORTH_WEST, WEST, SOUTH_WEST, SOUTH, SOUTH_EAST = range(NEIGHBOURS)

DX = (1, 1, 0, -1, -1, -1, 0, 1)
"""Columns from a cell to each neighbour."""

DY = (0, 1, 1, 1, 0, -1, -1, -1)
"""Rows from a cell to each neighbour."""


@kernel
def offset(k: int, width: int) -> int:
    """Return what is to be added to the index of a cell for that of its neighbour k."""
    return DY[k] * width + DX[k]


@kernel
def neighbour(c: int, k: int, height: int, width: int) -> int:
    """Return neighbour k of cell c; -1 if it is off the grid."""
    x, y = c % width + DX[k], c // width + DY[k]
    return y * width + x if 0 <= x < width and 0 <= y < height else -1


@kernel
def opposite(k: int) -> int:
    """Return what number a cell has as a neighbour of its neighbour k."""
    return (k + 4) & 7


@kernel
def note_flip(pattern: NDArray[np.uint8], c: int, height: int, width: int) -> None:
    """Bring the patterns of the neighbours of cell c, which was flipped, up to date."""
    for k in range(NEIGHBOURS):
        o = neighbour(c, k, height, width)
        if o >= 0:
            pattern[o] ^= 1 << opposite(k)


@kernel
def set_patterns(occupied: NDArray[np.uint8], shape: tuple[int, int], out: NDArray[np.uint8]) -> None:
    """Write the pattern of occupied neighbours of every cell into `out`, shape (cells,); takes no memory."""
    out[:] = 0
    for c in range(len(occupied)):
        if occupied[c]:
            note_flip(out, c, shape[0], shape[1])


@kernel
def note_flips(pattern: NDArray[np.uint8], cells: NDArray[np.int64], shape: tuple[int, int]) -> None:
    """Bring the patterns of the neighbours of cells, which were flipped, up to date."""
    for c in cells:
        note_flip(pattern, c, shape[0], shape[1])


def patterns(occupied: NDArray[np.uint8], shape: tuple[int, int]) -> NDArray[np.uint8]:
    """Return the pattern of occupied neighbours of every cell, shape (cells,)."""
    out = np.zeros(shape[0] * shape[1], np.uint8)
    set_patterns(occupied.ravel(), shape, out)
    return out
