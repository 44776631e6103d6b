"""Post-processing of the map that the search found: walls are extended, and cells that no reading passed are unknown.

For the search, a cell is free if nothing makes it occupied, whether or not any sound went through it. Given the map,
each reading has a probability that it passed a cell on its way to its cause. For a cell at distance d, with A the part
of T from occupied cells up to d,

    p(passed) = (T − A) / (c + T)

In the free zone it is T / (c + T). For an echo, the probability of a random measurement is added, since an object that
is not on the map may have been there, times (1 − p_hit) for each obstacle in the free zone that the sound had to pass.
Here c includes p_lost · N(z; z_max, σ) of every reading, so that an echo from nearly z_max frees little more than no
echo. Each reading is weighted by the strength of its beam at the cell, since objects at the edge of a cone are easily
missed. A cell that less than about one reading passed is not known to be free.

Neither is a cell that readings passed only at a slant at which a surface there would have returned no echo
(`free_space`). It is free if readings passed that would have detected any surface, and within `FREE_GROWTH` of such
cells if readings passed at all. So what is seen only at a slant through a hole in a wall is not free, but a door
through which a sensor looked once is.

Passes are numbers of readings, not nats, so the likelihood exponent does not matter. They depend on p_rand and p_lost:
a reading without echo counts as (1 − p_rand − p_lost) / (1 − p_rand) if no obstacle was in the way.

Straight walls are extended where they leave the field of view (`wall_extension`).
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from ..common.constants import FREE_GROWTH, FREE_MARGIN
from ..evidence.evidence import Evidence
from .free_space import Passes, expected_passes
from .wall_extension import extend


def _grown(cells: NDArray[np.bool_]) -> NDArray[np.bool_]:
    wide = np.pad(cells, 1)
    rows = wide[:-2] | wide[1:-1] | wide[2:]
    out: NDArray[np.bool_] = rows[:, :-2] | rows[:, 1:-1] | rows[:, 2:]
    return out


def _cells(length: float, evidence: Evidence) -> int:
    return max(round(length / evidence.grid.resolution), 1)


def grown(cells: NDArray[np.bool_], length: float, evidence: Evidence) -> NDArray[np.bool_]:
    """Return cells dilated by a length, metres."""
    for _ in range(_cells(length, evidence)):
        cells = _grown(cells)
    return cells


def grown_through(known: NDArray[np.bool_], passed: NDArray[np.bool_], steps: int) -> NDArray[np.bool_]:
    """Return the cells known to be free, grown by this many steps through cells that readings passed."""
    for _ in range(steps):
        known = known | (_grown(known) & passed)
    return known


def post_process(
    evidence: Evidence,
    extension: float,
    least_passed: float,
    least_noticed: float,
    traversed: NDArray[np.bool_],
    passes: Passes | None = None,
) -> NDArray[np.int8]:
    """Return the final maximum likelihood map, shape `grid.shape`: 1 occupied, 0 free, -1 not observed.

    Parameters
    ----------
    evidence : Evidence
        After the search.
    extension : float
        Largest extension of walls where they leave the field of view, metres.
    least_passed : float
        Fewest readings that passed a free cell, or one within `FREE_MARGIN`; with 0, all observed cells may be free.
    least_noticed : float
        Fewest readings among them that would have detected any surface (`Passes.noticing`), at the cell or at one
        from which free space grows to it within `FREE_GROWTH`; with 0, none are needed.
    traversed : bool, shape `grid.shape`
        Cells that the robot traversed, which are free even if in no cone.
    passes : Passes, optional
        `expected_passes`, if already computed.
    """
    ml = evidence.observed()
    # the middle of the robot is in no cone
    ml[traversed & (ml < 0)] = 0
    barred = known = traversed & (ml == 0)
    if least_passed > 0:
        passes = passes or expected_passes(evidence, evidence.state.maps.occupied)
        passed = known | ((passes.all >= least_passed).reshape(ml.shape) & (ml == 0))
        noticed = (passes.noticing >= least_noticed).reshape(ml.shape)
        # walls are not extended over cells that may be free
        barred, known = passed, grown_through(known | (passed & noticed), passed, _cells(FREE_GROWTH, evidence))
    if steps := round(extension / evidence.grid.resolution):
        ahead = np.zeros(ml.shape, np.uint8)
        extend(evidence.state, steps, barred.astype(np.uint8).ravel(), ahead.ravel())
        ml[ahead == 1] = 1
    if least_passed > 0:
        ml[(ml == 0) & ~grown(known, FREE_MARGIN, evidence)] = -1
    return ml
