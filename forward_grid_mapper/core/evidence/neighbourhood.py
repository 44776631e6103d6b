"""The eight neighbours of a cell, and the pattern of the occupied ones: one bit for each.

Neighbour k lies k eighths of a turn counterclockwise from east (the x axis); row numbers increase with y. Bit k of the
pattern of a cell is set if its neighbour k is occupied.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from ..runtime.jit import inlined_kernel, kernel

NEIGHBOURS = 8

EAST, NORTH_EAST, NORTH, NORTH_WEST, WEST, SOUTH_WEST, SOUTH, SOUTH_EAST = range(NEIGHBOURS)

DX = (1, 1, 0, -1, -1, -1, 0, 1)
"""Columns from a cell to each neighbour."""

DY = (0, 1, 1, 1, 0, -1, -1, -1)
"""Rows from a cell to each neighbour."""

OPPOSITE_ENOUGH = 3
"""Least angle between two neighbours of a cell inside a curve, eighths of a turn: 135°, so that a curve on the lattice
may have any direction, but no corner."""


def occupied_of(pattern: int) -> list[int]:
    """Return the neighbours that are occupied in a pattern, in increasing order."""
    return [k for k in range(NEIGHBOURS) if pattern >> k & 1]


def continues(pattern: int) -> bool:
    """Return whether a curve continues through a cell: two of its neighbours are on opposite sides."""
    bits = occupied_of(pattern)
    return any(min((a - b) % NEIGHBOURS, (b - a) % NEIGHBOURS) >= OPPOSITE_ENOUGH for a in bits for b in bits)


@inlined_kernel
def offset(k: int, width: int) -> int:
    """Return the difference between the indices of neighbour k and the cell."""
    return DY[k] * width + DX[k]


@inlined_kernel
def neighbour(c: int, k: int, height: int, width: int) -> int:
    """Return neighbour k of cell c; -1 outside of the grid."""
    x, y = c % width + DX[k], c // width + DY[k]
    return y * width + x if 0 <= x < width and 0 <= y < height else -1


@kernel
def opposite(k: int) -> int:
    """Return the number of the opposite direction: that of a cell as a neighbour of its neighbour k."""
    return (k + 4) & 7


@inlined_kernel
def note_flip(pattern: NDArray[np.uint8], c: int, height: int, width: int) -> None:
    """Update the patterns of the neighbours of cell c after its flip."""
    for k in range(NEIGHBOURS):
        o = neighbour(c, k, height, width)
        if o >= 0:
            pattern[o] ^= 1 << opposite(k)


@kernel
def set_patterns(occupied: NDArray[np.uint8], shape: tuple[int, int], out: NDArray[np.uint8]) -> None:
    """Write the pattern of each cell to `out`, shape (cells,); allocates no memory."""
    out[:] = 0
    for c in range(len(occupied)):
        if occupied[c]:
            note_flip(out, c, shape[0], shape[1])


@kernel
def note_flips(pattern: NDArray[np.uint8], cells: NDArray[np.int64], shape: tuple[int, int]) -> None:
    """Update the patterns of the neighbours of cells after their flips."""
    for c in cells:
        note_flip(pattern, c, shape[0], shape[1])


def patterns(occupied: NDArray[np.uint8], shape: tuple[int, int]) -> NDArray[np.uint8]:
    """Return the pattern of each cell, shape (cells,)."""
    out = np.zeros(shape[0] * shape[1], np.uint8)
    set_patterns(occupied.ravel(), shape, out)
    return out
