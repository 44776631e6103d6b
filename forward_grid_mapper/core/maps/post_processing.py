"""From the map that the search found to the one that is handed out: walls are extended, and unknown cells marked.

The search says of a cell that it is free where nothing makes it occupied. Whether anything went through it is another
question. Given the map, each reading says how likely it passed a cell on its way to its cause. For a cell at distance
d, with A the part of T from occupied cells up to d,

    p(passed) = (T − A) / (c + T)

In the free zone it is T / (c + T). For an echo the probability of a random measurement is added, since something that
the map lacks may have been there; it counts (1 − p_hit) for each obstacle that it had to pass in the free zone. Here c
holds p_lost · N(z; z_max, σ) of every reading, so that an echo from nearly z_max frees little more than no echo. A
reading counts by the strength of its beam at the cell, since what stands at the edge of a cone is easily missed. A cell
through which less than about one reading passed is not known to be free.

Nor is it if all that passed it would have passed a surface there as well, at a slant (`free_space`): it is free where
readings passed that any surface would have noticed, and within `LED_ON` of there as far as readings passed at all. So
what is seen at a slant alone through a hole in a wall is not free, while a door is that was looked through once.

Passing is a count of readings, not of nats, so the likelihood exponent has no part in it. It depends on p_rand and
p_lost: of readings without echo, (1 − p_rand − p_lost) / (1 − p_rand) count where nothing stood in the way.

Straight walls go on where they leave the view (`wall_extension`).
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from ..common.constants import FREE_MARGIN, LED_ON
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
    """Return cells and what lies within a length of them, metres."""
    for _ in range(_cells(length, evidence)):
        cells = _grown(cells)
    return cells


def led_on(known: NDArray[np.bool_], passed: NDArray[np.bool_], steps: int) -> NDArray[np.bool_]:
    """Return the cells known to be free, and so many steps on through cells that readings passed."""
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
    """Return the maximum likelihood map that is handed out, shape `grid.shape`: 1 occupied, 0 free, -1 not observed.

    Parameters
    ----------
    evidence : Evidence
        After the search.
    extension : float
        Metres by which walls go on at most where they leave the view.
    least_passed : float
        Readings that must have passed a cell, or one within `FREE_MARGIN`, for it to be free; 0 takes all cells that
        were seen.
    least_noticed : float
        Readings that any surface would have noticed of which as much must be said about the cell, or about one that
        leads there within `LED_ON`; 0 asks for no such.
    traversed : bool, shape `grid.shape`
        Cells that are known to be free, though no reading may see them.
    passes : Passes, optional
        `expected_passes`, where they are known already.
    """
    ml = evidence.observed()
    # no cone holds the middle of the robot
    ml[traversed & (ml < 0)] = 0
    barred = known = traversed & (ml == 0)
    if least_passed > 0:
        passes = passes or expected_passes(evidence, evidence.state.maps.occupied)
        passed = known | ((passes.all >= least_passed).reshape(ml.shape) & (ml == 0))
        noticed = (passes.noticing >= least_noticed).reshape(ml.shape)
        # walls are not drawn out over what may be free
        barred, known = passed, led_on(known | (passed & noticed), passed, _cells(LED_ON, evidence))
    if steps := round(extension / evidence.grid.resolution):
        ahead = np.zeros(ml.shape, np.uint8)
        extend(evidence.state, steps, barred.astype(np.uint8).ravel(), ahead.ravel())
        ml[ahead == 1] = 1
    if least_passed > 0:
        ml[(ml == 0) & ~grown(known, FREE_MARGIN, evidence)] = -1
    return ml
