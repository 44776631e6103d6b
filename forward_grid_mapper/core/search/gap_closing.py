"""Moves of whole walls: gaps between two ends are closed at once, and short walls are removed at once.

Each cell of a gap costs more than it gains, as long as the next one is missing, so single flips never close it. A gap
is a straight run of free cells between two ends of walls. The run leads away from the neighbours of both ends. The
readings may speak against it, but only so much: `MOST_AGAINST_METRE` for each metre, and `MOST_AGAINST_GAP` in all.
Where a gap is so wide that a robot might go through, `MOST_AGAINST_PASSAGE` is the bound: the readings that went
through a door speak against a wall there.

Likewise, to free one cell of a short wall saves next to nothing, as long as the rest of it stands, since the rest has
two ends as well. A short wall is a set of up to `SHORT_WALL` of occupied cells that touch each other and no others.

Either move must raise the objective. All lengths are in metres, so that a finer lattice has the same gaps.
"""

from __future__ import annotations

import math
from typing import Any

import numpy as np
from numpy.typing import NDArray

from ..common.constants import (
    AWAY,
    MOST_AGAINST_GAP,
    MOST_AGAINST_METRE,
    MOST_AGAINST_PASSAGE,
    PASSAGE,
)
from ..evidence.neighbourhood import DX, DY, NEIGHBOURS
from ..evidence.state import State
from ..evidence.updates import flip
from ..runtime.jit import allocating_kernel, kernel
from .flips import Least, gain_of
from .prior import Prior


@kernel
def _leaves(pattern: int, dx: int, dy: int) -> bool:
    """Return whether direction (dx, dy) leads away from the neighbours of a pattern."""
    x, y = 0.0, 0.0
    for k in range(NEIGHBOURS):
        if pattern >> k & 1:
            away = math.hypot(DX[k], DY[k])
            x += DX[k] / away
            y += DY[k] / away
    length = math.hypot(x, y)
    return bool(length < 0.1 or (x * dx + y * dy) <= AWAY * length * math.hypot(dx, dy))


@kernel
def _is_end(s: State, prior: Prior, c: int) -> bool:
    """Return whether cell c is occupied and no wall goes through it."""
    return bool(s.maps.occupied[c] and prior.shape[s.maps.pattern[c]] < prior.shape[255])


@kernel
def _may_close(s: State, prior: Prior, c: int, dx: int, dy: int) -> bool:
    """Return whether end c and the cell at (dx, dy) from it are ends of walls that lead to each other."""
    pattern, width = s.maps.pattern, s.lattice.width
    row, column = c // width + dy, c % width + dx
    if not (0 <= row < s.lattice.height and 0 <= column < width):
        return False
    o = row * width + column
    return bool(_is_end(s, prior, o) and _leaves(pattern[c], dx, dy) and _leaves(pattern[o], -dx, -dy))


@kernel
def _path(s: State, c: int, dx: int, dy: int, up: bool, path: Any) -> bool:
    """Write the cells between c and the cell at (dx, dy) from it; return whether a wall may stand on them.

    Where the line passes midway between two cells, `up` takes the one of the larger row and column.
    """
    width = s.lattice.width
    n = max(abs(dx), abs(dy))
    against, most = 0.0, MOST_AGAINST_METRE * s.lattice.resolution
    for i in range(1, n):
        y, x = dy * i / n, dx * i / n
        if up:
            row, column = int(math.floor(y + 0.5)), int(math.floor(x + 0.5))
        else:
            row, column = int(math.ceil(y - 0.5)), int(math.ceil(x - 0.5))
        o = c + row * width + column
        data = s.maps.evidence[o] * s.model.nats
        if s.maps.occupied[o] or not s.maps.seen[o] or data < -most:
            return False
        against -= data
        path[i - 1] = o
    passage = (n - 1) * s.lattice.resolution > PASSAGE
    return against <= (MOST_AGAINST_PASSAGE if passage else MOST_AGAINST_GAP)


@kernel
def _midway(dx: int, dy: int) -> bool:
    """Return whether the line to (dx, dy) passes midway between two cells anywhere."""
    n = max(abs(dx), abs(dy))
    across = min(abs(dx), abs(dy))
    halves = 0
    for i in range(1, n):
        halves += 2 * across * i % (2 * n) == n
    return halves > 0


@kernel
def _flip_all(s: State, prior: Prior, least: Least, path: Any, n: int) -> float:
    """Flip the first n cells of `path`; flip them back, and return 0, if that does not gain enough."""
    gain, needed = 0.0, 10.0 * least[0]
    for i in range(n):
        gain += gain_of(s, prior, path[i])
        needed += least[1] * s.maps.seen[path[i]]
        flip(s, path[i])
    if gain > needed:
        return gain
    for i in range(n):
        flip(s, path[i])
    return 0.0


@kernel
def _list_gaps(
    s: State, prior: Prior, least: Least, cells: NDArray[np.int64], n: int, path: Any, gaps: Any, gains: Any
) -> int:
    """List the gaps of length n that gain if closed, and what they gain; return their number, at most that of `gaps`.

    A row of `gaps` has the cell at one end, the way to the other one, and 1 where cells midway are taken `up`.
    """
    m = 0
    for c in cells:
        if s.stop[0]:
            break
        if not _is_end(s, prior, c):
            continue
        # each pair once
        for dy in range(n + 1):
            for dx in range(-n, n + 1, 1 if dy == n else 2 * n):
                if (dy == 0 and dx < 0) or not _may_close(s, prior, c, dx, dy):
                    continue
                for up in range(0 if _midway(dx, dy) else 1, 2):
                    if m == len(gaps) or not _path(s, c, dx, dy, up == 1, path):
                        continue
                    gain = _flip_all(s, prior, least, path, n - 1)
                    if gain > 0.0:
                        for i in range(n - 1):
                            flip(s, path[i])
                        gaps[m, 0], gaps[m, 1], gaps[m, 2], gaps[m, 3] = c, dx, dy, up
                        gains[m] = gain
                        m += 1
    return m


@allocating_kernel
def close_gaps(s: State, prior: Prior, least: Least, cells: NDArray[np.int64], longest: int) -> tuple[int, float]:
    """Close the gaps that gain, the shortest first, and of one length the one first that gains most.

    So what is closed does not depend on the order of cells, which differs in a mirrored map. Returns the number of
    flips and the total gain.

    Parameters
    ----------
    cells : int64, shape (N,)
        The occupied ones to start from.
    longest : int
        Cells from one end of a gap to the other.
    """
    path = np.empty(longest, np.int64)
    gaps, gains = np.empty((2 * len(cells) + 64, 4), np.int64), np.empty(2 * len(cells) + 64)
    flips, total = 0, 0.0
    for n in range(2, longest + 1):
        m = _list_gaps(s, prior, least, cells, n, path, gaps, gains)
        for k in np.argsort(-gains[:m], kind='mergesort'):
            c, dx, dy, up = gaps[k, 0], gaps[k, 1], gaps[k, 2], gaps[k, 3]
            if _is_end(s, prior, c) and _may_close(s, prior, c, dx, dy) and _path(s, c, dx, dy, up == 1, path):
                gain = _flip_all(s, prior, least, path, n - 1)
                if gain > 0.0:
                    flips += n - 1
                    total += gain
    return flips, total


@kernel
def _connected(s: State, reached: Any, wall: Any) -> int:
    """List all occupied cells that are connected to the first one of `wall`, by any neighbours; return their number.

    Sets them in `reached` (uint8, shape (cells,)).
    """
    height, width = s.lattice.height, s.lattice.width
    reached[wall[0]] = 1
    n, i = 1, 0
    while i < n:
        row, column = wall[i] // width, wall[i] % width
        i += 1
        for y in range(max(row - 1, 0), min(row + 2, height)):
            for x in range(max(column - 1, 0), min(column + 2, width)):
                o = y * width + x
                if s.maps.occupied[o] and not reached[o]:
                    reached[o] = 1
                    wall[n] = o
                    n += 1
    return n


@allocating_kernel
def remove_short_walls(
    s: State, prior: Prior, least: Least, cells: NDArray[np.int64], longest: int
) -> tuple[int, float]:
    """Free the short walls whose removal gains; return the number of flips and the total gain.

    Walls of a single cell are left to single flips.

    Parameters
    ----------
    cells : int64, shape (N,)
        The occupied ones to start from.
    longest : int
        Cells of a wall that counts as short.
    """
    reached = np.zeros(len(s.maps.occupied), np.uint8)
    wall = np.empty(int(s.maps.occupied.sum()), np.int64)
    flips, total = 0, 0.0
    for c in cells:
        if s.stop[0]:
            break
        if reached[c] or not s.maps.occupied[c]:
            continue
        wall[0] = c
        n = _connected(s, reached, wall)
        if 1 < n <= longest:
            gain = _flip_all(s, prior, least, wall, n)
            if gain > 0.0:
                flips += n
                total += gain
    return flips, total
