"""Free space: through which cells readings passed on their way to what explains them."""

from __future__ import annotations

import math
from typing import Any

import numpy as np
from numpy.typing import NDArray

from ..common.readings import Floats
from ..evidence.evidence import Evidence
from ..evidence.state import State
from ..runtime.jit import allocating_kernel, kernel
from ..sensor.cone import rows_of, runs_of, strength
from ..sensor.cone_table import cone_of
from ..sensor.density import density

UNIT = 2.0**-20
"""Readings in a unit of the sums of passed readings; sums of whole numbers do not depend on their order."""


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
    """Add to `passed` (int64, in units of UNIT) how likely the readings `begin` to `end` passed each of their cells.

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
            line = passed[row * s.lattice.width : (row + 1) * s.lattice.width]
            for first, last in ((runs.first, runs.last), (runs.first2, runs.last2)):
                for column in range(first, last + 1):
                    u = column + 0.5 - cone.x
                    square = u * u + v * v
                    weight = strength(axis_x, axis_y, sine2, u, v)
                    if runs.inner <= column <= runs.outer:
                        line[column] += int(weight * (hidden if blocking and square > near else in_front))
                    else:
                        k = 0
                        while k < n and squares[k] <= square:
                            k += 1
                        line[column] += int(weight * left[k] * scale)


def expected_passes(evidence: Evidence, occupied: NDArray[np.uint8]) -> Floats:
    """Return how many readings are expected to have passed each cell of a map, shape (cells,)."""
    model = evidence.model
    random = model.p_rand / evidence.z_max
    # of an echo from almost as far as z_max too, so that it frees little more than a reading without any
    lost = model.p_lost * evidence.state.reading_states['max_range'][: len(evidence)]
    passed = np.zeros(evidence.grid.size, np.int64)

    def work(s: State, begin: int, end: int, own: NDArray[np.int64]) -> None:
        add_passes(s, begin, end, random, lost, occupied, own)

    evidence.summed(0, len(evidence), work, passed)
    out: Floats = np.multiply(passed, UNIT, dtype=np.float64)
    return out
