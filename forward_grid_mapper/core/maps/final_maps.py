"""The final maps, made after the search in the same way by the offline tool, the node and tiles.

Echoes of people who walk by add up at a few cells: as independent readings, they outweigh those that passed there, and
the search keeps these cells. The uncertainty map knows that readings repeat each other, and that walls do not stand
alone in the open. So with the prior for walls, an obstacle is removed if each of its cells is likelier free than
occupied by that map.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from ..common.constants import EXTENSION, FREE_MARGIN
from ..common.grid import UNKNOWN
from ..common.parameter_groups import SearchParameters
from ..evidence.evidence import Evidence
from ..evidence.neighbourhood import DX, DY, NEIGHBOURS
from ..search.prior import has_walls
from .free_space import expected_passes
from .line_of_sight import mirror_images, not_passed
from .post_processing import grown, post_process
from .uncertainty import uncertainty_map

LEAST_PROBABILITY = 0.5
"""Least probability of one of the cells of an obstacle."""


class FinalMaps(NamedTuple):
    """The maximum likelihood map, int8, and the uncertainty map, float32, with values as in `MapSet`."""

    ml: NDArray[np.int8]
    uncertainty: NDArray[np.float32]


def final_maps(evidence: Evidence, search: SearchParameters, traversed: NDArray[np.bool_]) -> FinalMaps:
    """Return the final maps from the map that the search found, shape `grid.shape`.

    Parameters
    ----------
    evidence : Evidence
        After the search.
    search : SearchParameters
    traversed : bool, shape `grid.shape`
        Cells that the robot traversed, which are free even if in no cone.
    """
    walls = has_walls(search)
    passes = expected_passes(evidence, evidence.state.maps.occupied) if walls or search.least_passed > 0 else None
    extension = EXTENSION if walls else 0.0
    ml = post_process(evidence, extension, search.least_passed, search.least_noticed, traversed, passes)
    if not walls:
        return FinalMaps(ml, uncertainty_map(evidence.of_occupancy(), None, ml, traversed, search))
    images = mirror_images(evidence, ml == 1)
    if search.least_passed > 0:
        free = ml == 0
        passed = free & ~not_passed(evidence, free & ~traversed)
        ml[free & ~grown(passed, FREE_MARGIN, evidence)] = UNKNOWN
    ml[images] = UNKNOWN
    uncertainty = uncertainty_map(evidence.of_occupancy(), passes, ml, traversed, search)
    uncertainty[images] = np.nan
    unlikely = unlikely_obstacles(ml, uncertainty)
    ml[unlikely] = np.where(grown(ml == 0, FREE_MARGIN, evidence)[unlikely], 0, UNKNOWN)
    return FinalMaps(ml, uncertainty)


def unlikely_obstacles(ml: NDArray[np.int8], probability: NDArray[np.float32]) -> NDArray[np.bool_]:
    """Return the cells of obstacles that are likelier free than occupied in each cell, shape `ml.shape`.

    An obstacle is a set of occupied cells that touch, also at corners. Those at the border may be parts of larger ones.
    """
    occupied = ml == 1
    likely = occupied & (probability >= LEAST_PROBABILITY)
    for edge in (np.s_[:1], np.s_[-1:], np.s_[:, :1], np.s_[:, -1:]):
        likely[edge] = occupied[edge]
    # with a border, so that all cells have eight neighbours
    height, width = ml.shape[0] + 2, ml.shape[1] + 2
    remaining, front = (np.pad(cells, 1).ravel() for cells in (occupied & ~likely, likely))
    front = np.flatnonzero(front)
    around = np.array([DY[k] * width + DX[k] for k in range(NEIGHBOURS)])
    while len(front):
        near = (front[:, None] + around).ravel()
        front = np.unique(near[remaining[near]])
        remaining[front] = False
    return remaining.reshape(height, width)[1:-1, 1:-1]
