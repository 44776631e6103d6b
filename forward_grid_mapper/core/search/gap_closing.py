"""Moves of whole walls: closing gaps between two ends, and removing short walls, each in one step.

Each single cell of a gap costs more than it gains while the next one is free, so single flips never close it. A gap is
a straight run of free cells between two ends of walls, and leads away from the neighbours of both ends. The evidence of
readings against it may be at most `MOST_AGAINST_METRE` for each metre, and `MOST_AGAINST_GAP` in total. If the gap is
so wide that a robot could drive through, the total is `MOST_AGAINST_PASSAGE`, since readings that passed a door are
evidence against a wall there.

Likewise, freeing one cell of a short wall gains almost nothing, since the rest has two ends as well. A short wall is a
connected set of occupied cells of at most `SHORT_WALL`.

Both moves must increase the objective. All lengths are in metres, so that gaps do not depend on the cell size.
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
from ..common.readings import Floats
from ..evidence.cell_flip import flip
from ..evidence.neighbourhood import DX, DY, NEIGHBOURS
from ..evidence.state import State
from ..runtime.jit import kernel
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
    """Write the cells between c and the cell at (dx, dy) from it; return whether a wall is possible there.

    If the line passes midway between two cells, `up` takes the one of the larger row and column.
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
def _is_gap(s: State, prior: Prior, gap: Any, path: Any) -> bool:
    """Return whether a gap of `_list_gaps` may be closed, and write its cells to `path`."""
    c, dx, dy = gap[0], gap[1], gap[2]
    return bool(_is_end(s, prior, c) and _may_close(s, prior, c, dx, dy) and _path(s, c, dx, dy, gap[3] == 1, path))


@kernel
def _list_gaps(s: State, prior: Prior, cells: NDArray[np.int64], n: int, gaps: Any, paths: Any) -> int:
    """List the gaps of length n that may be closed; return their number, also if it is more than fits into `gaps`.

    Parameters
    ----------
    gaps : int64, shape (most, 4)
        The cell at one end, the offset (dx, dy) of the other one, and 1 for `up` of `_path`.
    paths : int64, shape (most + 1, n - 1)
        The cells between. The last row is a workspace.
    """
    m, most = 0, len(gaps)
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
                    if _path(s, c, dx, dy, up == 1, paths[min(m, most)]):
                        if m < most:
                            gaps[m, 0], gaps[m, 1], gaps[m, 2], gaps[m, 3] = c, dx, dy, up
                        m += 1
    return m


@kernel
def _flip_sets(s: State, prior: Prior, least: Least, cells: Any, starts: Any, keep: bool, gains: Any) -> None:
    """Flip sets of cells at once, one set after the other.

    Parameters
    ----------
    cells : int64
        The cells of all sets.
    starts : int64, shape (sets + 1,)
        Index at which each set begins, and at which the last one ends.
    keep : bool
        Whether sets that gain enough stay flipped; others are flipped back.
    gains : float64, shape (sets,)
        Output: the gain of each set, 0 if that is not enough.
    """
    for k in range(len(starts) - 1):
        begin, end = starts[k], starts[k + 1]
        gain, needed = 0.0, 10.0 * least[0]
        if not s.stop[0]:
            for i in range(begin, end):
                gain += gain_of(s, prior, cells[i])
                needed += least[1] * s.maps.seen[cells[i]]
                flip(s, cells[i])
            enough = gain > needed
            if not (enough and keep):
                for i in range(begin, end):
                    flip(s, cells[i])
            gain = gain if enough else 0.0
        gains[k] = gain


@kernel
def _close(s: State, prior: Prior, least: Least, gaps: Any, paths: Any, starts: Any, gains: Any) -> None:
    """Close gaps of one length one after the other, if they are still gaps and still gain.

    Parameters
    ----------
    gaps, paths
        From `_list_gaps`, in the order in which they are closed.
    starts : int64, shape (2,)
        0, and the number of cells of a gap.
    gains : float64, shape (gaps,)
        Output, as in `_flip_sets`.
    """
    # not a literal, of which numba makes a type of its own, so that callees are compiled once
    keep: Any = np.bool_(True)
    for k in range(len(gaps)):
        gains[k] = 0.0
        if _is_gap(s, prior, gaps[k], paths[k]):
            _flip_sets(s, prior, least, paths[k], starts, keep, gains[k : k + 1])


def _gain_of_sets(
    s: State, prior: Prior, least: Least, cells: NDArray[np.int64], starts: NDArray[np.int64], keep: bool
) -> Floats:
    gains = np.zeros(len(starts) - 1)
    _flip_sets(s, prior, least, cells, starts, keep, gains)
    return gains


def _gaps(s: State, prior: Prior, cells: NDArray[np.int64], n: int) -> tuple[NDArray[np.int64], NDArray[np.int64]]:
    """Return all gaps of length n and their cells, as in `_list_gaps`."""
    most = 1024
    while True:
        gaps, paths = np.empty((most, 4), np.int64), np.empty((most + 1, n - 1), np.int64)
        m = _list_gaps(s, prior, cells, n, gaps, paths)
        if m <= most:
            return gaps[:m], paths[:m]
        most = m


def close_gaps(s: State, prior: Prior, least: Least, cells: NDArray[np.int64], longest: int) -> tuple[int, float]:
    """Close the gaps that gain, the shortest first, and among those of one length the largest gain first.

    So the result does not depend on the order of cells, which differs in a mirrored map. Returns the number of flips
    and the total gain.

    Parameters
    ----------
    cells : int64, shape (N,)
        The occupied ones to start from.
    longest : int
        Cells from one end of a gap to the other.
    """
    flips, total = 0, 0.0
    for n in range(2, longest + 1):
        gaps, paths = _gaps(s, prior, cells, n)
        if not len(gaps) and n > 2:
            # the first length continues even without gaps, so that each search calls, and compiles, all kernels
            continue
        gains = _gain_of_sets(s, prior, least, paths.ravel(), np.arange(len(gaps) + 1) * (n - 1), False)
        order = np.argsort(-gains, kind='stable')[: int((gains > 0.0).sum())]
        gains = np.empty(len(order))
        _close(s, prior, least, gaps[order], paths[order], np.array([0, n - 1]), gains)
        flips += (n - 1) * int((gains > 0.0).sum())
        total += float(gains.sum())
    return flips, total


@kernel
def _connected(s: State, reached: Any, wall: Any) -> int:
    """List all occupied cells that are 8-connected to the first one of `wall`; return their number.

    They are set in `reached` (uint8, shape (cells,)).
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


@kernel
def _list_short_walls(s: State, cells: NDArray[np.int64], longest: int, reached: Any, walls: Any, starts: Any) -> int:
    """List the cells of all walls of 2 to `longest` cells; return the number of walls.

    Parameters
    ----------
    reached : uint8, shape (cells of the map,)
        Workspace; all 0.
    walls : int64
        Output: the cells; as long as the number of occupied cells.
    starts : int64
        Output, one longer: index at which each wall begins, and at which the last one ends.
    """
    n, end = 0, 0
    starts[0] = 0
    for c in cells:
        if s.stop[0]:
            break
        if reached[c] or not s.maps.occupied[c]:
            continue
        walls[end] = c
        size = _connected(s, reached, walls[end:])
        if 1 < size <= longest:
            n, end = n + 1, end + size
            starts[n] = end
    return n


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
    occupied = int(np.count_nonzero(s.maps.occupied))
    walls, starts = np.empty(occupied, np.int64), np.empty(occupied + 1, np.int64)
    n = _list_short_walls(s, cells, longest, np.zeros(len(s.maps.occupied), np.uint8), walls, starts)
    gains = _gain_of_sets(s, prior, least, walls, starts[: n + 1], True)
    return int(np.diff(starts[: n + 1])[gains > 0.0].sum()), float(gains.sum())
