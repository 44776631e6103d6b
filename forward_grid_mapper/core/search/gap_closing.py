"""Bridges: walls that close the gap between two ends at once.

Each cell of a gap costs more than it gains, as long as the next one is missing, so single flips never close it. A
bridge is a straight run of free cells between two occupied ones through which no wall passes yet. It leaves each of
them away from the neighbours that it has; and no cell of it may have more against it than a nat, nor all together more
than a few. Doors have much against them: the readings that went through. Where a gap is so wide that a robot might
go, a few such readings are enough.
"""

from __future__ import annotations

import math
from typing import Any

import numpy as np
from numpy.typing import NDArray

from ..evidence.fixed_point import QUANTUM
from ..evidence.neighbourhood import DX, DY, NEIGHBOURS
from ..evidence.state import State
from ..evidence.updates import flip
from ..runtime.jit import allocating_kernel, kernel
from .flips import Least, gain_of
from .prior import Prior

MOST_AGAINST_CELL = 1.0
"""Nats."""

MOST_AGAINST_GAP = 4.0
"""Nats."""

MOST_AGAINST_PASSAGE = 1.5
"""Nats, over a gap that is wide enough to drive through."""

PASSAGE = 0.35
"""Metres of a gap from where on a robot might drive through."""

AWAY = -0.35
"""Largest cosine between the direction of a bridge and that of the neighbours that its end has."""


@kernel
def _leaves(pattern: int, dx: int, dy: int) -> bool:
    """Tell whether direction (dx, dy) leads away from the neighbours of a pattern."""
    x, y = 0.0, 0.0
    for k in range(NEIGHBOURS):
        if pattern >> k & 1:
            away = math.hypot(DX[k], DY[k])
            x += DX[k] / away
            y += DY[k] / away
    length = math.hypot(x, y)
    return bool(length < 0.1 or (x * dx + y * dy) <= AWAY * length * math.hypot(dx, dy))


@kernel
def _path(s: State, c: int, dx: int, dy: int, path: Any) -> bool:
    """Write the cells between c and the cell at (dx, dy) from it; tell whether a bridge may stand on them."""
    width = s.lattice.width
    n = max(abs(dx), abs(dy))
    against = 0.0
    for i in range(1, n):
        o = c + int(math.floor(dy * i / n + 0.5)) * width + int(math.floor(dx * i / n + 0.5))
        data = s.maps.evidence[o] * QUANTUM
        if s.maps.occupied[o] or not s.maps.seen[o] or data < -MOST_AGAINST_CELL:
            return False
        against -= data
        path[i - 1] = o
    passage = (n - 1) * s.lattice.resolution > PASSAGE
    return against <= (MOST_AGAINST_PASSAGE if passage else MOST_AGAINST_GAP)


@kernel
def _close(s: State, prior: Prior, least: Least, path: Any, n: int) -> float:
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


@allocating_kernel
def close_gaps(s: State, prior: Prior, least: Least, cells: NDArray[np.int64], longest: int) -> tuple[int, float]:
    """Build the bridges that gain, the shortest first; return the number of flips and the total gain.

    `cells` are the occupied ones to start from.
    """
    height, width = s.lattice.height, s.lattice.width
    occupied, pattern = s.maps.occupied, s.maps.pattern
    through = prior.shape[255]
    path = np.empty(longest, np.int64)
    flips, total = 0, 0.0
    for n in range(2, longest + 1):
        for c in cells:
            if s.stop[0]:
                return flips, total
            row, column = c // width, c % width
            if not occupied[c] or prior.shape[pattern[c]] >= through:
                continue
            for dy in range(n + 1):
                for dx in range(-n, n + 1, 1 if dy == n else 2 * n):
                    # each pair once
                    if (dy == 0 and dx < 0) or row + dy >= height or not 0 <= column + dx < width:
                        continue
                    o = c + dy * width + dx
                    if not occupied[o] or prior.shape[pattern[o]] >= through:
                        continue
                    if not _leaves(pattern[c], dx, dy) or not _leaves(pattern[o], -dx, -dy):
                        continue
                    if _path(s, c, dx, dy, path):
                        gain = _close(s, prior, least, path, n - 1)
                        if gain > 0.0:
                            flips += n - 1
                            total += gain
    return flips, total
