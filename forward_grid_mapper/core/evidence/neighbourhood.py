"""The eight neighbours of a cell, and which of them are occupied: one bit of a pattern for each, counted from east."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from ..runtime.jit import kernel

EAST, NORTH_EAST, NORTH, NORTH_WEST, WEST, SOUTH_WEST, SOUTH, SOUTH_EAST = range(8)
"""Bits of a pattern; rows count upward."""


@kernel
def neighbour(c: int, k: int, width: int) -> int:
    """Return the neighbour of cell c that bit k of a pattern stands for; it must exist."""
    if k < 3:
        return c + (1 if k < 2 else 0) + (0 if k == 0 else width)
    if k < 6:
        return c + (-1) + (width if k == 3 else (0 if k == 4 else -width))
    return c - width + (0 if k == 6 else 1)


@kernel
def note_flip(pattern: NDArray[np.uint8], c: int, height: int, width: int) -> None:
    """Bring the patterns of the neighbours of cell c, which was flipped, up to date."""
    row, column = c // width, c % width
    for k in range(8):
        x = column + (1 if k in (0, 1, 7) else (-1 if k in (3, 4, 5) else 0))
        y = row + (1 if k in (1, 2, 3) else (-1 if k in (5, 6, 7) else 0))
        if 0 <= x < width and 0 <= y < height:
            pattern[y * width + x] ^= 1 << ((k + 4) & 7)


def patterns(occupied: NDArray[np.uint8], shape: tuple[int, int]) -> NDArray[np.uint8]:
    """Return the pattern of occupied neighbours of every cell, shape (cells,)."""
    wide = np.pad(occupied.reshape(shape), 1)
    out = np.zeros(shape, np.uint8)
    steps = ((0, 1), (1, 1), (1, 0), (1, -1), (0, -1), (-1, -1), (-1, 0), (-1, 1))
    for k, (dy, dx) in enumerate(steps):
        out |= (wide[1 + dy : 1 + dy + shape[0], 1 + dx : 1 + dx + shape[1]] << k).astype(np.uint8)
    return out.ravel()
