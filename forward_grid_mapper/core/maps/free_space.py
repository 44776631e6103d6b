"""Free space: through which cells readings passed on their way to what explains them, and in which directions.

A surface returns sound within `max_incidence_angle` of its normal alone. A reading that passed a cell says nothing of a
surface there that it would have met at more of a slant, and which way a surface in an empty cell would face is not
known. So passes are summed apart for `DIRECTIONS` of looking. Be P_j the number of those within that angle of the j-th
of as many normals, each as likely as the others. Then a surface of unknown normal makes what passed less likely by

    (1 − p_hit)^n = 1/J Σ_j (1 − p_hit)^P_j

and as much so as n readings that any surface would have noticed. Readings that all look the same way, however many,
make n less than one; without a limit of the incidence n is their number.
"""

from __future__ import annotations

import math
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from ..common.readings import Floats
from ..evidence.evidence import Evidence
from ..evidence.state import State
from ..runtime.jit import allocating_kernel, kernel
from ..sensor.cone import rows_of, runs_of, strength
from ..sensor.cone_table import cone_of
from ..sensor.density import density

DIRECTIONS = 4
"""Directions of looking, apart by 45°: along the rows, the columns and both diagonals, either way. Of eight, figures
are the same."""

EIGHTH = math.tan(math.pi / 8)
"""Of the angle up to which a direction is that of the nearer axis of the lattice."""

UNIT = 2.0**-20
"""Readings in a unit of the sums of passed readings; sums of whole numbers do not depend on their order."""


@kernel
def direction_of(u: float, v: float) -> int:
    """Return which of the directions of looking (u, v) is in; mirrored and turned ones are so on the lattice."""
    if abs(v) < EIGHTH * abs(u):
        return 0
    if abs(u) < EIGHTH * abs(v):
        return 2
    return 1 if u * v > 0.0 else 3


def noticed_by(max_incidence_angle: float) -> Floats:
    """Return the part of each direction of looking that is within an angle of each of as many normals.

    Shape (DIRECTIONS, DIRECTIONS); row j is of the normal along direction j. Angles are in radians.
    """
    wide = math.pi / DIRECTIONS
    off = np.abs(np.subtract.outer(np.arange(DIRECTIONS), np.arange(DIRECTIONS))) * wide
    out = np.zeros(off.shape)
    # either way round
    for middle in (off, off - math.pi):
        low, high = (
            np.maximum(middle - wide / 2, -max_incidence_angle),
            np.minimum(middle + wide / 2, max_incidence_angle),
        )
        out += np.maximum(high - low, 0.0) / wide
    return out


@kernel
def _obstacles(s: State, t: int, occupied: Any, squares: Any, left: Any) -> tuple[int, int, float]:
    """List the occupied cells in the band of a cone, also those at which the reading exceeds the incidence angle.

    Writes the squares of their distances, near to far, and into `left` (longer by one) what of T is left in front of
    each and behind the last. Returns how many there are, how many are in the free zone, and the least square of these.
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
        left[k] = weight * p * density(error, reading.sigma * s.lattice.resolution)
        weight *= 1.0 - p
    left[n] = weight * reading_state.max_range
    for k in range(n - 1, -1, -1):
        left[k] += left[k + 1]
    return n, blocking, near


@allocating_kernel
def add_passes(s: State, begin: int, end: int, random: Floats, lost: Floats, occupied: Any, passed: Any) -> None:
    """Add to `passed` how likely the readings `begin` to `end` passed each of their cells in which direction.

    It is int64, in units of UNIT, shape (DIRECTIONS, cells).

    All cells of a cone count, also those at which the reading exceeds the incidence angle. `random` and `lost` are the
    densities p_rand / z_max and p_lost · N(z; z_max, σ) of all readings in 1/m.
    """
    # no band has more cells than the largest cone
    squares, left = s.workspace.key, np.empty(len(s.workspace.key) + 1)
    for t in range(begin, end):
        if s.stop[0]:
            break
        reading, reading_state = s.cones[t], s.reading_states[t]
        n, blocking, near = _obstacles(s, t, occupied, squares, left)
        scale = reading_state.multiplicity / ((random[t] + lost[t] + left[0]) * UNIT)
        stray = random[t] * scale if reading.z < reading.z_max else 0.0
        in_front = left[0] * scale + stray
        hidden = left[0] * scale + stray * (1.0 - s.model.p_hit) ** blocking
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
                    way = direction_of(u, v)
                    if runs.inner <= column <= runs.outer:
                        passed[way, start + column] += int(
                            weight * (hidden if blocking and square > near else in_front)
                        )
                    else:
                        k = 0
                        while k < n and squares[k] <= square:
                            k += 1
                        passed[way, start + column] += int(weight * left[k] * scale)


@allocating_kernel
def count(passed: Any, noticed: Any, p_hit: float, whole: Any, out: Any) -> None:
    """Write how many readings passed each cell, and how many that any surface would have noticed say as much.

    Parameters
    ----------
    passed : int64, shape (DIRECTIONS, cells)
        As of `add_passes`.
    noticed : float64, shape (DIRECTIONS, DIRECTIONS)
        As of `noticed_by`.
    p_hit : float
        Of the surface.
    whole, out : float64, shape (cells,)
        Both.
    """
    each, miss = np.empty(len(noticed)), math.log(1.0 - p_hit)
    for c in range(len(out)):
        least, whole[c] = np.inf, 0.0
        for j in range(len(noticed)):
            whole[c] += passed[j, c] * UNIT
            each[j] = 0.0
            for k in range(len(noticed)):
                each[j] += noticed[j, k] * passed[k, c]
            each[j] *= UNIT
            least = min(least, each[j])
        total = 0.0
        for j in range(len(noticed)):
            total += math.exp(miss * (each[j] - least))
        out[c] = least + math.log(total / len(noticed)) / miss


def passes_by_direction(evidence: Evidence, occupied: NDArray[np.uint8]) -> NDArray[np.int64]:
    """Return how many readings are expected to have passed each cell of a map in which direction, in units of UNIT.

    Shape (DIRECTIONS, cells).
    """
    model = evidence.model
    random = model.p_rand / evidence.z_max
    # of an echo from almost as far as z_max too, so that it frees little more than a reading without any
    lost = model.p_lost * evidence.state.reading_states['max_range'][: len(evidence)]
    passed = np.zeros((DIRECTIONS, evidence.grid.size), np.int64)

    def work(s: State, begin: int, end: int, own: NDArray[np.int64]) -> None:
        add_passes(s, begin, end, random, lost, occupied, own)

    evidence.summed(0, len(evidence), work, passed)
    return passed


class Passes(NamedTuple):
    """How many readings are expected to have passed each cell, float64, shape (cells,).

    Attributes
    ----------
    all : float64
        Whatever they would have noticed there.
    noticing : float64
        As many that any surface would have noticed say as much, as above.
    """

    all: Floats
    noticing: Floats


def expected_passes(evidence: Evidence, occupied: NDArray[np.uint8]) -> Passes:
    """Return how many readings passed each cell of a map, which is uint8, shape (cells,)."""
    model, passed = evidence.model, passes_by_direction(evidence, occupied)
    out = Passes(np.empty(evidence.grid.size), np.empty(evidence.grid.size))
    count(passed, noticed_by(model.max_incidence_angle), model.p_hit, *out)
    return out
