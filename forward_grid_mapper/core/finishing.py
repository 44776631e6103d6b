"""From the map that the search found to the one that is handed out: walls drawn out, and free told from unknown.

The search says of a cell that it is free where nothing makes it occupied. Whether anything went through it is another
question. Given the map, each reading tells how likely it passed a cell on its way to whatever explains it: for a cell
at distance d, with A the share of T from occupied cells up to d,

    p(passed) = (T − A) / (c + T)

and in the free zone T / (c + T), plus that of chance for an echo: something that the map lacks may have been there.
Chance counts (1 − p_hit) for each obstacle that it had to get by in the free zone. Here c holds p_lost · N(z; z_max, σ)
of every reading, so that an echo from nearly z_max frees little more than no echo. A reading counts by the strength of
its beam at the cell, since what stands at the edge of a cone is easily missed. A cell through which less than about
one reading passed is not known to be free.

Where a straight wall ends in the open, the cells ahead have nothing against them and are not known to be free, it goes
on for a few cells: a wall is more likely to leave the view than to end there.
"""

from __future__ import annotations

import math
from typing import Any

import numpy as np
from numpy.typing import NDArray

from .cone import row_runs, strength, within
from .cones import Floats, cone_of
from .evidence import Evidence
from .flips import State
from .jit import kernel
from .logs import QUANTUM

STRAIGHT_RUN = 4
"""Cells in a row that make a straight wall."""

MOST_AGAINST = 0.05
"""Nats that may speak against a cell by which a wall goes on."""

MOST_OBSTACLES = 4096
"""Occupied cells in one band that are told apart."""

UNIT = 2.0**-20
"""Unit of the sums of passed readings, which as whole numbers do not depend on their order."""


@kernel
def _obstacles(s: State, t: int, occupied: Any, squares: Any, left: Any) -> tuple[int, int, float]:
    """List the occupied cells in the band of a cone, all of it, near to far.

    Writes the squares of their distances, and into `left` (longer by one) what of T is left in front of each and
    behind the last. Returns how many there are, how many are in the free zone, and the least square of these.
    """
    reading, share = s.cones[t], s.shares[t]
    cone = cone_of(reading, s.lattice.nearest)
    n, blocking, near = 0, 0, np.inf
    for row in range(max(cone.bottom, 0), min(cone.top, s.lattice.height - 1) + 1):
        a, b, c, d = row_runs(cone, row, reading.reach, s.lattice.width, s.lattice.nearest)
        v = row + 0.5 - cone.y
        first, last = within(cone.x, v, reading.free, s.lattice.nearest)
        for begin, end in ((a, b), (c, d)):
            for column in range(begin, end + 1):
                if occupied[row * s.lattice.width + column]:
                    u = column + 0.5 - cone.x
                    if first <= column <= last:
                        blocking += 1
                        near = min(near, u * u + v * v)
                    elif n < len(squares):
                        k = n
                        while k > 0 and squares[k - 1] > u * u + v * v:
                            squares[k] = squares[k - 1]
                            k -= 1
                        squares[k] = u * u + v * v
                        n += 1
    p = s.model.p_hit
    weight = s.model.share * (1.0 - p) ** blocking
    peak = 1.0 / (math.sqrt(2.0 * math.pi) * reading.sigma * s.lattice.resolution)
    for k in range(n):
        error = (reading.z - math.sqrt(squares[k])) / reading.sigma
        left[k] = weight * p * peak * math.exp(-0.5 * error * error) if abs(error) <= s.lattice.cut else 0.0
        weight *= 1.0 - p
    left[n] = weight * share.no_echo
    for k in range(n - 1, -1, -1):
        left[k] += left[k + 1]
    return n, blocking, near


@kernel
def count_passed(s: State, begin: int, end: int, random: Floats, lost: Floats, occupied: Any, passed: Any) -> None:
    """Add to `passed` (int64, in units of UNIT) how likely the readings `begin` to `end` passed each of their cells.

    This looks at whole cones, what they graze included. `random` and `lost` are the densities p_rand / z_max and
    p_lost · N(z; z_max, σ) of all readings in 1/m.
    """
    squares, left = np.empty(MOST_OBSTACLES), np.empty(MOST_OBSTACLES + 1)
    for t in range(begin, end):
        if s.stop[0]:
            break
        reading, share = s.cones[t], s.shares[t]
        n, blocking, near = _obstacles(s, t, occupied, squares, left)
        scale = share.weight / ((random[t] + lost[t] + left[0]) * UNIT)
        chance = random[t] * scale if reading.z < reading.z_max else 0.0
        in_front = left[0] * scale + chance
        hidden = left[0] * scale + chance * (1.0 - s.model.p_hit) ** blocking
        cone = cone_of(reading, s.lattice.nearest)
        axis_x, axis_y, sine2 = reading.axis_x, reading.axis_y, reading.sine**2
        for row in range(max(cone.bottom, 0), min(cone.top, s.lattice.height - 1) + 1):
            a, b, c, d = row_runs(cone, row, reading.reach, s.lattice.width, s.lattice.nearest)
            v = row + 0.5 - cone.y
            first, last = within(cone.x, v, reading.free, s.lattice.nearest)
            line = passed[row * s.lattice.width : (row + 1) * s.lattice.width]
            for start, stop in ((a, b), (c, d)):
                for column in range(start, stop + 1):
                    u = column + 0.5 - cone.x
                    square = u * u + v * v
                    weight = strength(axis_x, axis_y, sine2, u, v)
                    if first <= column <= last:
                        line[column] += int(weight * (hidden if blocking and square > near else in_front))
                    else:
                        k = 0
                        while k < n and squares[k] <= square:
                            k += 1
                        line[column] += int(weight * left[k] * scale)


def passed_readings(evidence: Evidence, occupied: NDArray[np.uint8]) -> Floats:
    """Return how many readings are expected to have passed each cell of a map, shape (cells,)."""
    model = evidence.model
    random = model.p_rand / evidence.z_max
    # of an echo from almost as far as z_max too, so that it frees little more than a reading without any
    lost = model.p_lost * evidence.state.shares['no_echo'][: len(evidence)]
    sums: list[NDArray[np.int64]] = []

    def work(s: State, begin: int, end: int) -> None:
        sums.append(np.zeros(evidence.grid.size, np.int64))
        count_passed(s, begin, end, random, lost, occupied, sums[-1])

    evidence.each(0, len(evidence), work)
    total: Floats = np.sum(sums, axis=0) * UNIT
    return total


@kernel
def _ahead(c: int, k: int, height: int, width: int, n: int) -> int:
    """Return the cell that is n steps from c in direction k (in eighths of a turn), or -1 off the grid."""
    o = c
    for _ in range(n):
        x, y = o % width, o // width
        dx = 1 if k in (0, 1, 7) else (-1 if k in (3, 4, 5) else 0)
        dy = 1 if k in (1, 2, 3) else (-1 if k in (5, 6, 7) else 0)
        if not (0 <= x + dx < width and 0 <= y + dy < height):
            return -1
        o = (y + dy) * width + x + dx
    return o


@kernel
def extend(s: State, steps: int, barred: Any, out: Any) -> None:
    """Set in `out` (uint8) the cells by which straight walls go on at their ends, up to what is `barred` (uint8)."""
    height, width = s.lattice.height, s.lattice.width
    occupied, evidence, seen = s.maps.occupied, s.maps.evidence, s.maps.seen
    for c in range(len(occupied)):
        if not occupied[c]:
            continue
        for k in range(8):
            straight = True
            for n in range(1, STRAIGHT_RUN):
                o = _ahead(c, (k + 4) & 7, height, width, n)
                straight = straight and o >= 0 and occupied[o] == 1
            # a true end has no neighbour ahead, nor abreast of what is ahead
            for turn in (k, (k + 1) & 7, (k + 7) & 7):
                o = _ahead(c, turn, height, width, 1)
                straight = straight and (o < 0 or occupied[o] == 0)
            if straight:
                for n in range(1, steps + 1):
                    o = _ahead(c, k, height, width, n)
                    if o < 0 or occupied[o] or not seen[o] or barred[o] or evidence[o] * QUANTUM < -MOST_AGAINST:
                        break
                    out[o] = 1


def _grown(cells: NDArray[np.bool_]) -> NDArray[np.bool_]:
    wide = np.pad(cells, 1)
    rows = wide[:-2] | wide[1:-1] | wide[2:]
    out: NDArray[np.bool_] = rows[:, :-2] | rows[:, 1:-1] | rows[:, 2:]
    return out


def finish(evidence: Evidence, steps: int, least_passed: float, driven: NDArray[np.bool_]) -> NDArray[np.int8]:
    """Return the ML map that is handed out, shape `grid.shape`: 1 occupied, 0 free, -1 not observed.

    Parameters
    ----------
    evidence : Evidence
        After the search.
    steps : int
        Cells by which to draw walls out.
    least_passed : float
        Readings that must have passed a cell, or one beside it, for it to be free; 0 takes all cells that were seen.
    driven : bool, shape `grid.shape`
        Cells that are known to be free, though no reading may see them.
    """
    ml = evidence.observed()
    # no cone holds the middle of the robot
    ml[driven & (ml < 0)] = 0
    known = driven & (ml == 0)
    if least_passed > 0:
        passed = passed_readings(evidence, evidence.state.maps.occupied).reshape(ml.shape)
        known |= (passed >= least_passed) & (ml == 0)
    if steps:
        ahead = np.zeros(ml.shape, np.uint8)
        extend(evidence.state, steps, known.astype(np.uint8).ravel(), ahead.ravel())
        ml[ahead == 1] = 1
    if least_passed > 0:
        ml[(ml == 0) & ~_grown(known)] = -1
    return ml
