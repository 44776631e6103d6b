"""Free space: the expected number of readings that passed each cell on the way to their cause, by direction.

A surface returns sound only within some angle of its normal. A reading that passed a cell does not tell of a surface
there that it would have met at a larger angle. The normal of a surface in an empty cell is unknown, and so is its
limit, since it may be rough or smooth (`usual_limits`). So passes are counted separately for `DIRECTIONS`. Let P_j be
the number of passes that the j-th of J surfaces, which are equally likely, would notice: those within its limit of its
normal. Such an unknown surface changes the likelihood of these passes by the factor

    (1 − p_hit)^n = 1/J Σ_j (1 − p_hit)^P_j

which is that of n readings that would detect a surface of any normal. If all readings have the same direction, n is
small, however many they are. Without a limit of the incidence angle, n is their number.
"""

from __future__ import annotations

import math
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from ..common.readings import Floats
from ..evidence.evidence import Evidence
from ..evidence.learned_normals import usual_limits
from ..evidence.state import State
from ..runtime.jit import allocating_kernel, inlined_kernel
from ..sensor.cone import rows_of, runs_of, strength
from ..sensor.cone_table import cone_of
from ..sensor.density import density, random_density

DIRECTIONS = 4
"""Directions, 45° apart: along the rows, the columns and both diagonals; opposite directions are the same. With eight,
the results are the same."""

EIGHTH = math.tan(math.pi / 8)
"""Tangent of the largest angle between a direction and the axis of the lattice that it is assigned to."""

PASS_UNIT = 2.0**-20
"""Unit of the integer sums of passes, in readings; integer sums do not depend on their order."""


@inlined_kernel
def direction_of(u: float, v: float) -> int:
    """Return which of the directions the vector (u, v) has; symmetric under the symmetries of the lattice."""
    if abs(v) < EIGHTH * abs(u):
        return 0
    if abs(u) < EIGHTH * abs(v):
        return 2
    return 1 if u * v > 0.0 else 3


def noticed_by(limit: float) -> Floats:
    """Return the fraction of each direction, 45° wide, that is within a limit, radians, of each normal.

    Shape (DIRECTIONS, DIRECTIONS); row j is for the normal along direction j.
    """
    wide = math.pi / DIRECTIONS
    off = np.abs(np.subtract.outer(np.arange(DIRECTIONS), np.arange(DIRECTIONS))) * wide
    out = np.zeros(off.shape)
    # directions are modulo a half turn
    for middle in (off, off - math.pi):
        low, high = np.maximum(middle - wide / 2, -limit), np.minimum(middle + wide / 2, limit)
        out += np.maximum(high - low, 0.0) / wide
    return out


@inlined_kernel
def _obstacles(s: State, t: int, occupied: Any, squares: Any, remaining: Any) -> tuple[int, int, float]:
    """List the occupied cells in the band of a cone, including those beyond the limit of the incidence angle.

    Writes their squared distances in increasing order, and into `remaining` (one longer) the part of T that remains in
    front of each and behind the last. Returns their number, the number of occupied cells in the free zone, and the
    smallest squared distance of these.
    """
    reading, reading_state = s.cones[t], s.reading_states[t]
    cone = cone_of(reading)
    n, blocking, near = 0, 0, np.inf
    for row in range(*rows_of(cone, s.lattice.height)):
        runs = runs_of(cone, row, s.lattice.width)
        v = row + 0.5 - cone.y
        for first, last in ((runs.first, runs.last), (runs.first2, runs.last2)):
            for column in range(first, last + 1):
                if not occupied[row * s.lattice.width + column]:
                    continue
                u = column + 0.5 - cone.x
                square = u * u + v * v
                if runs.inner <= column <= runs.outer:
                    blocking += 1
                    near = min(near, square)
                    continue
                k = n
                while k > 0 and squares[k - 1] > square:
                    squares[k] = squares[k - 1]
                    k -= 1
                squares[k] = square
                n += 1
    p = s.model.p_hit
    weight = s.model.mixture_weight * (1.0 - p) ** blocking
    for k in range(n):
        error = (reading.z - math.sqrt(squares[k])) / reading.sigma
        remaining[k] = weight * p * density(error, reading.sigma * s.lattice.resolution)
        weight *= 1.0 - p
    remaining[n] = weight * reading_state.max_range
    for k in range(n - 1, -1, -1):
        remaining[k] += remaining[k + 1]
    return n, blocking, near


@allocating_kernel
def add_passes(s: State, begin: int, end: int, random: Floats, lost: Floats, occupied: Any, passed: Any) -> None:
    """Add the probabilities that the readings `begin` to `end` passed the cells of their cones to `passed`.

    `passed` is int64, in units of PASS_UNIT, shape (DIRECTIONS, cells). All cells of a cone are included, also those
    beyond the limit of the incidence angle. `random` and `lost` are the densities of `random_density` and
    p_lost · N(z; z_max, σ) of all readings, 1/m.
    """
    # the band of a cone has no more cells than the largest cone
    squares, remaining = s.workspace.key, np.empty(len(s.workspace.key) + 1)
    for t in range(begin, end):
        if s.stop[0]:
            break
        reading, reading_state = s.cones[t], s.reading_states[t]
        n, blocking, near = _obstacles(s, t, occupied, squares, remaining)
        scale = reading_state.multiplicity / ((random[t] + lost[t] + remaining[0]) * PASS_UNIT)
        stray = random[t] * scale if reading.z < reading.z_max else 0.0
        in_front = remaining[0] * scale + stray
        hidden = remaining[0] * scale + stray * (1.0 - s.model.p_hit) ** blocking
        cone = cone_of(reading)
        axis_x, axis_y, sine2 = reading.axis_x, reading.axis_y, reading.sine**2
        for row in range(*rows_of(cone, s.lattice.height)):
            runs = runs_of(cone, row, s.lattice.width)
            v = row + 0.5 - cone.y
            start = row * s.lattice.width
            for first, last in ((runs.first, runs.last), (runs.first2, runs.last2)):
                for column in range(first, last + 1):
                    u = column + 0.5 - cone.x
                    square = u * u + v * v
                    weight = strength(axis_x, axis_y, sine2, u, v)
                    direction = direction_of(u, v)
                    if runs.inner <= column <= runs.outer:
                        passed[direction, start + column] += int(
                            weight * (hidden if blocking and square > near else in_front)
                        )
                    else:
                        k = 0
                        while k < n and squares[k] <= square:
                            k += 1
                        passed[direction, start + column] += int(weight * remaining[k] * scale)


@allocating_kernel
def count_passes(passed: Any, noticed: Any, p_hit: float, whole: Any, out: Any) -> None:
    """Write the number of readings that passed each cell, and the equivalent number n of the module docstring.

    Parameters
    ----------
    passed : int64, shape (DIRECTIONS, cells)
        From `add_passes`.
    noticed : float64, shape (J, DIRECTIONS)
        Rows of `noticed_by`, for all surfaces that are equally likely.
    p_hit : float
        Of the surface.
    whole, out : float64, shape (cells,)
        Output: both numbers.
    """
    each, miss = np.empty(len(noticed)), math.log(1.0 - p_hit)
    for c in range(len(out)):
        least, whole[c] = np.inf, 0.0
        for k in range(len(passed)):
            whole[c] += passed[k, c] * PASS_UNIT
        for j in range(len(noticed)):
            each[j] = 0.0
            for k in range(len(passed)):
                each[j] += noticed[j, k] * passed[k, c]
            each[j] *= PASS_UNIT
            least = min(least, each[j])
        if whole[c] == 0.0:
            # most cells of a map, and logarithms take most of the time
            out[c] = 0.0
            continue
        total = 0.0
        for j in range(len(noticed)):
            total += math.exp(miss * (each[j] - least))
        out[c] = least + math.log(total / len(noticed)) / miss


def passes_by_direction(evidence: Evidence, occupied: NDArray[np.uint8]) -> NDArray[np.int64]:
    """Return the expected number of passes by direction and cell, in units of PASS_UNIT, shape (DIRECTIONS, cells)."""
    model = evidence.model
    random = random_density(model, evidence.z_max)
    # also for echoes, so that one from nearly z_max frees little more than a reading without echo
    lost = model.p_lost * evidence.state.reading_states['max_range'][: len(evidence)]
    passed = np.zeros((DIRECTIONS, evidence.grid.size), np.int64)

    def work(s: State, begin: int, end: int, own: NDArray[np.int64]) -> None:
        add_passes(s, begin, end, random, lost, occupied, own)

    evidence.sum_over_readings(0, len(evidence), work, passed)
    return passed


class Passes(NamedTuple):
    """Expected number of readings that passed each cell, float64, shape (cells,).

    Attributes
    ----------
    all : float64
        All of them.
    noticing : float64
        The equivalent number n of readings that would detect a surface of any normal.
    """

    all: Floats
    noticing: Floats


def expected_passes(evidence: Evidence, occupied: NDArray[np.uint8]) -> Passes:
    """Return the expected passes of each cell of a map; `occupied` has the shape (cells,)."""
    model, passed = evidence.model, passes_by_direction(evidence, occupied)
    out = Passes(np.empty(evidence.grid.size), np.empty(evidence.grid.size))
    count_passes(passed, np.concatenate([noticed_by(limit) for limit in usual_limits(model)]), model.p_hit, *out)
    return out
