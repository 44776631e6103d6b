"""Local maps: the maximum likelihood map of the readings of some windows, as probabilities for scan matching.

The map is made by the same search as the final maps, with the prior for walls and the surface normals. A standard
occupancy grid is biased where cones overlap: poses matched with it are off by several centimetres.
"""

from __future__ import annotations

import math
from dataclasses import replace
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from ..common.grid import Grid
from ..common.parameter_groups import ModelParameters
from ..common.parameters import Parameters
from ..common.readings import Floats, Readings
from ..evidence.evidence import Evidence
from ..evidence.learned_normals import NO_INCIDENCE_LIMIT
from ..maps.traversed import traversed_cells
from ..runtime.cancelling import check
from ..runtime.memory import memory_for_pairs
from ..search.search import Search, SearchResult
from ..sensor.cone_table import grid_of
from ..sensor.density import hit_probability
from .sides import BEHIND, mean_bearings

OCCUPIED, FREE = 1 / (1 + math.exp(-3.0)), 1 / (1 + math.exp(4.0))
"""Probabilities of occupied and of free cells of a local map."""

UNKNOWN = 0.06
"""Probability of unknown cells: the usual fraction of occupied cells."""

RESOLUTION = 0.1
"""Metres; the cell size of local maps, independent of that of the final maps."""

MODEL = {'p_hit': 0.7, 'p_rand': 0.4, 'p_lost': 0.42, 'min_incidence_angle': NO_INCIDENCE_LIMIT}
"""The sensor model of matching, independent of that of the final maps. With it, the covariances of matches agree with
their errors. In the model of the final maps a single reading weighs less, since one reading must not make a wall. All
surfaces have the same limit of the incidence angle: learned limits discard readings, and trajectories are a little
worse."""


LONG = np.float32(1000.0)
"""Length of the mean bearing in place of a normal: so long that no ray is beyond the incidence angle."""

OF_LOCAL_MAPS = 1e9
"""Memory limit for the pairs of a local map, bytes; never reached."""


class LocalMap(NamedTuple):
    """A local map; cells outside of it are unknown.

    Attributes
    ----------
    column, row : float
        Lattice indices of the lower left cell.
    resolution : float
        Metres.
    shape : int, int
        Rows and columns.
    cells : float32, shape (rows * columns + 1, 4)
        Probability that a cell returns an echo if the sound reaches it; a vector v; and a number f. Rays along the unit
        vector r come from behind the surface if r · v < f (`sides`), and are beyond the incidence angle if (r · v)² is
        less than `cos2_limit`. v is the surface normal (`SurfaceNormals`), or NaN if there is nothing to compare with.
        The last row stands for all cells outside.
    cos2_limit : float
        As in `surface_normals.SurfaceNormals`.
    unknown : float
        The probability in `cells` of unknown cells.
    """

    column: float
    row: float
    resolution: float
    shape: tuple[int, int]
    cells: NDArray[np.float32]
    cos2_limit: float
    unknown: float


def cells_of(
    hit: NDArray[np.float32], x: NDArray[np.float32], y: NDArray[np.float32], bearing: NDArray[np.float32]
) -> NDArray[np.float32]:
    """Return `LocalMap.cells`.

    Parameters
    ----------
    hit, x, y : float32, shape (rows, columns)
        Probabilities, and normals with either sign; 0 if unknown.
    bearing : float32, shape (2, rows * columns)
        From `sides.mean_bearings`.
    """
    normal = np.stack([x.ravel(), y.ravel()])
    known, one_sided = normal.any(0), bearing.any(0)
    away = np.where((normal * bearing).sum(0) < 0.0, -normal, normal)
    vector = np.where(known, away, np.where(one_sided, LONG * bearing, np.float32(np.nan)))
    out = np.full((hit.size + 1, 4), np.nan, np.float32)
    out[:-1, 0], out[:-1, 1:3] = hit.ravel(), vector.T
    out[:-1, 3] = np.where(one_sided, np.where(known, 0.0, LONG * BEHIND), -np.inf)
    return out


def for_matching(parameters: Parameters) -> Parameters:
    """Return the parameters for scan matching: those of the final maps, with `RESOLUTION` and `MODEL`."""
    return parameters.varied({'resolution': RESOLUTION, **MODEL})


def at_poses(readings: Readings, poses: Floats) -> Readings:
    """Return the readings with their sensors at these poses, shape (N, 3)."""
    x, y, yaw = np.ascontiguousarray(poses.T)
    return replace(readings, x=x, y=y, yaw=yaw)


def local_map(readings: Readings, parameters: Parameters, stop: NDArray[np.uint8]) -> LocalMap:
    """Return the local map of readings; their poses are in the frame of the map.

    Raises
    ------
    Cancelled
        If `stop` was set.
    """
    grid, evidence, traversed, _ = _searched(readings, parameters, stop, OF_LOCAL_MAPS, 1)
    return soft_map(evidence, grid, traversed, parameters.model)


def explained(
    readings: Readings, parameters: Parameters, stop: NDArray[np.uint8], threads: int
) -> tuple[float, Floats]:
    """Return the objective J of the map that the search finds, and the log-likelihood of each reading in it.

    Both are in nats. The log-likelihoods, shape (N,), are tempered; with the prior of the map they add up to J.

    Raises
    ------
    Cancelled
        If `stop` was set.
    """
    _, evidence, _, found = _searched(readings, parameters, stop, memory_for_pairs(parameters), threads)
    each = parameters.model.likelihood_exponent * evidence.log_likelihoods
    return evidence.tempered_log_likelihood + found.log_prior, each


def _searched(
    readings: Readings, parameters: Parameters, stop: NDArray[np.uint8], memory: float, threads: int
) -> tuple[Grid, Evidence, NDArray[np.bool_], SearchResult]:
    """Return the grid of readings, their evidence, the traversed cells, and the result of the search."""
    grid = grid_of(readings, parameters.model, parameters.grid)
    evidence = Evidence(grid, parameters.model, memory, threads, stop)
    evidence.extend(readings)
    traversed = traversed_cells(readings, grid)
    return grid, evidence, traversed, Search(evidence, parameters.search, traversed.ravel()).run()


def soft_map(evidence: Evidence, grid: Grid, traversed: NDArray[np.bool_], model: ModelParameters) -> LocalMap:
    """Return the local map of a maximum likelihood map."""
    ml = evidence.observed()
    p_hit, normals = hit_probability(model, grid.resolution), evidence.state.normals
    shown = np.where(ml == 1, OCCUPIED, np.where((ml == 0) | traversed, FREE, UNKNOWN))
    hit = (shown * p_hit).astype(np.float32)
    x, y = (normals.x, normals.y) if len(normals.known) else np.zeros((2, hit.size), np.float32)
    cones = evidence.state.cones[: len(evidence)]
    bearing = mean_bearings(cones, grid.shape, ml.ravel() == 1, evidence.state.stop)
    check(evidence.state.stop)
    return LocalMap(
        float(grid.column),
        float(grid.row),
        grid.resolution,
        grid.shape,
        cells_of(hit, x, y, bearing),
        normals.cos2_limit,
        UNKNOWN * p_hit,
    )
