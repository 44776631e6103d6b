"""Local maps: the maximum likelihood map of some windows' readings, as probabilities that a scan is matched with.

The map is that of the core's search, with its prior of walls and its surface normals. A standard occupancy grid would
not do: it is biased where cones overlap, and a scan matched with it comes out several centimetres off.
"""

from __future__ import annotations

import math
from dataclasses import replace
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from ..common.grid import Grid
from ..common.parameters import ModelParameters, Parameters
from ..common.readings import Readings
from ..evidence.evidence import Evidence
from ..evidence.learned_normals import NO_INCIDENCE_LIMIT
from ..maps.traversed import traversed_cells
from ..runtime.memory import memory_for_pairs
from ..search.search import Search, SearchResult
from ..sensor.cone_table import grid_of
from ..sensor.density import hit_probability
from .poses import Floats

OCCUPIED, FREE = 1 / (1 + math.exp(-3.0)), 1 / (1 + math.exp(4.0))
"""Probabilities of cells that a local map shows as occupied, and as free."""

UNKNOWN = 0.06
"""Probability of cells that it does not know: the usual fraction of occupied cells."""

RESOLUTION = 0.1
"""Metres; matches are made on cells of one size, whatever size the maps are to have."""

MODEL = {'p_hit': 0.7, 'p_rand': 0.4, 'p_lost': 0.42, 'min_incidence_angle': NO_INCIDENCE_LIMIT}
"""The sensor model of matches, whatever that of the maps is. With it the errors that matches state are the real ones;
that of the maps lets a reading say less, since a wall must not hang on one. All surfaces have one incidence angle: with
angles of their own, which take away what readings say, trajectories are a little worse."""


OF_LOCAL_MAPS = 1e9
"""Bytes that pairs of a local map may take: more than they do."""


class LocalMap(NamedTuple):
    """Probabilities of a local map; what lies outside is unknown.

    Attributes
    ----------
    column, row : float
        Lattice indices of the lower left cell.
    resolution : float
        Metres.
    shape : int, int
        Rows and columns.
    cells : float32, shape (rows * columns + 1, 3)
        Probability that a cell returns the echo of a reading that reaches it, and the unit vector along the normal of
        its surface, as of `SurfaceNormals`, NaN where it is not known. The last row is for what lies outside.
    cos2_limit : float
        As in `surface_normals.SurfaceNormals`.
    unknown : float
        `hit` of unknown cells.
    """

    column: float
    row: float
    resolution: float
    shape: tuple[int, int]
    cells: NDArray[np.float32]
    cos2_limit: float
    unknown: float


def cells_of(hit: NDArray[np.float32], x: NDArray[np.float32], y: NDArray[np.float32]) -> NDArray[np.float32]:
    """Return the `cells` of a local map, given the normals of the surfaces: 0 where they are not known."""
    out = np.full((hit.size + 1, 3), np.nan, np.float32)
    out[:-1, 0] = hit.ravel()
    known = (x.ravel() != 0) | (y.ravel() != 0)
    out[:-1, 1], out[:-1, 2] = (np.where(known, each.ravel(), np.float32(np.nan)) for each in (x, y))
    return out


def for_matching(parameters: Parameters) -> Parameters:
    """Return the parameters that scans are matched with: those of the maps but for `RESOLUTION` and `MODEL`."""
    return parameters.varied({'resolution': RESOLUTION, **MODEL})


def at_poses(readings: Readings, poses: Floats) -> Readings:
    """Return the readings with sensors at other poses, shape (N, 3)."""
    x, y, yaw = np.ascontiguousarray(poses.T)
    return replace(readings, x=x, y=y, yaw=yaw)


def local_map(readings: Readings, parameters: Parameters, stop: NDArray[np.uint8]) -> LocalMap:
    """Return the map of readings that are placed in its frame.

    Raises
    ------
    Cancelled
        If `stop` was set.
    """
    grid, evidence, traversed, _ = _searched(readings, parameters, stop, OF_LOCAL_MAPS)
    return soft_map(evidence, grid, traversed, parameters.model)


def explained(readings: Readings, parameters: Parameters, stop: NDArray[np.uint8]) -> tuple[float, Floats]:
    """Return J of readings, what the search maximises, at the map that it finds, and what each reading has of it.

    J is in nats; what readings have, shape (N,), is in nats, too, and is all of J but the prior of the map.

    Raises
    ------
    Cancelled
        If `stop` was set.
    """
    _, evidence, _, found = _searched(readings, parameters, stop, memory_for_pairs(parameters))
    each = parameters.model.likelihood_exponent * evidence.log_likelihoods
    return evidence.tempered_log_likelihood + found.log_prior, each


def _searched(
    readings: Readings, parameters: Parameters, stop: NDArray[np.uint8], memory: float
) -> tuple[Grid, Evidence, NDArray[np.bool_], SearchResult]:
    """Return the grid of readings, what they say there, the cells that sensors were moved over, and the search."""
    grid = grid_of(readings, parameters.model, parameters.grid)
    evidence = Evidence(grid, parameters.model, memory, 1, stop)
    evidence.extend(readings)
    traversed = traversed_cells(readings, grid)
    return grid, evidence, traversed, Search(evidence, parameters.search, traversed.ravel()).run()


def soft_map(evidence: Evidence, grid: Grid, traversed: NDArray[np.bool_], model: ModelParameters) -> LocalMap:
    """Return the probabilities of a map that was searched."""
    ml = evidence.observed()
    p_hit, normals = hit_probability(model, grid.resolution), evidence.state.normals
    shown = np.where(ml == 1, OCCUPIED, np.where((ml == 0) | traversed, FREE, UNKNOWN))
    hit = (shown * p_hit).astype(np.float32)
    x, y = (normals.x, normals.y) if len(normals.known) else np.zeros((2, hit.size), np.float32)
    return LocalMap(
        float(grid.column),
        float(grid.row),
        grid.resolution,
        grid.shape,
        cells_of(hit, x, y),
        normals.cos2_limit,
        UNKNOWN * p_hit,
    )
