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


def patterns(occupied: NDArray[np.uint8], shape: tuple[int, int]) -> NDArray[np.uint8]:
    """Return the pattern of occupied neighbours of every cell, shape (cells,)."""
    wide = np.pad(occupied.reshape(shape), 1)
    out = np.zeros(shape, np.uint8)
    for k, (dx, dy) in enumerate(zip(DX, DY, strict=True)):
        out |= (wide[1 + dy : 1 + dy + shape[0], 1 + dx : 1 + dx + shape[1]] << k).astype(np.uint8)
    return out.ravel()
