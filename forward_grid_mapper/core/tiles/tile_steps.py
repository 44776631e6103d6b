"""Work on a single tile: functions of its readings and of the map around it, which any process may run.

Each takes a `TileInput` and returns arrays of the core of the tile, or of its window if the search may change that.
"""

from __future__ import annotations

from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from ..common.grid import Grid
from ..common.parameters import Parameters
from ..common.readings import Readings
from ..evidence.evidence import Evidence
from ..evidence.learned_normals import has_limit
from ..maps.dynamic import dynamic_echoes
from ..maps.final_maps import final_maps
from ..runtime.cancelling import NEVER
from ..runtime.memory import memory_for_pairs
from ..search.search import Progress, Search
from ..sensor.cone_table import cone_table
from ..sensor.forward_model import ForwardModel
from ..sensor.incidence import edges_of, with_own_angles
from ..sensor.surface_normals import SurfaceNormals, gather, known_normals, no_normals, normals_of
from .tiling import Tile


class TileInput(NamedTuple):
    """The input for the work on a tile.

    Attributes
    ----------
    tile : Tile
    box : Grid
        Contains the cones of all its readings, and its window.
    readings : Readings
        Those whose cones may reach into the window, in canonical order.
    own : bool, shape (N,)
        Mask of those whose sensors were in the core.
    traversed : bool, shape `box.shape`
    occupied : uint8, shape `box.shape`
        The map.
    normals : float32, shape (2, *box.shape)
        x and y of the surface normals (`SurfaceNormals`), 0 if unknown.
    ml : int8, shape `box.shape`
        The final map; only for `judge_readings`.
    """

    tile: Tile
    box: Grid
    readings: Readings
    own: NDArray[np.bool_]
    traversed: NDArray[np.bool_]
    occupied: NDArray[np.uint8]
    normals: NDArray[np.float32]
    ml: NDArray[np.int8]

    def core(self, values: NDArray[Any]) -> NDArray[Any]:
        """Return a copy of the core's part of an array of the box."""
        return np.array(values.reshape(self.box.shape)[self.box.window(self.tile.core)])


def normals_from(xy: NDArray[np.float32], parameters: Parameters) -> SurfaceNormals:
    """Return normals from x and y (`SurfaceNormals`), float32, shape (2, height, width), 0 if unknown."""
    if not has_limit(parameters.model):
        return no_normals()
    x, y = xy
    return known_normals(((x != 0) | (y != 0)).astype(np.uint8), x, y, parameters.model.max_incidence_angle)


class SearchedWindow(NamedTuple):
    """The map of a window after a search, and the part of the lattice that changed, or None."""

    occupied: NDArray[np.uint8]
    changed: Grid | None
    progress: Progress
    converged: bool


class FinishedCore(NamedTuple):
    """The final maps of a core, and sums over the own readings of the tile."""

    ml: NDArray[np.int8]
    uncertainty: NDArray[np.float32]
    searched: NDArray[np.int8]
    log_likelihood: float
    pairs: int
    nbytes: int
    unstored: int


class JudgedReadings(NamedTuple):
    """The evaluation of the own readings of a tile on the final map."""

    log_likelihood: NDArray[np.float64]
    unexplained: NDArray[np.bool_]
    dynamic: NDArray[np.float32]
    forward: ForwardModel


def estimate_normals(given: TileInput, parameters: Parameters) -> NDArray[np.float32]:
    """Return x and y of the surface normals of the core (`SurfaceNormals`), float32, shape (2, *core.shape)."""
    box = given.box
    if not has_limit(parameters.model):
        return np.zeros((2, *given.tile.core.shape), np.float32)
    sums = np.zeros((3, box.size), np.int64)
    cones = cone_table(given.readings, box, parameters.model)
    gather(cones, box.shape, (0, len(cones)), sums, NEVER)
    normals, edges = normals_of(sums, box, parameters.model.max_incidence_angle), edges_of(parameters.model)
    if edges is not None:
        whole, weights = (0, box.height, 0, box.width), np.ones(len(cones), np.int32)
        with_own_angles(normals, cones, weights, box, whole, edges)
    return np.stack([given.core(normals.x), given.core(normals.y)])


def _evidence(given: TileInput, parameters: Parameters) -> Evidence:
    threads = parameters.search.threads or 1
    memory = memory_for_pairs(parameters)
    normals = normals_from(given.normals, parameters)
    made = Evidence(given.box, parameters.model, memory, threads, start=given.occupied, normals=normals)
    if len(given.readings):
        made.extend(given.readings)
    return made


def _filled_part(mask: NDArray[np.bool_], window: Grid) -> Grid | None:
    """Return the smallest part of a window that contains all cells of a mask; None if there are none."""
    rows, columns = np.flatnonzero(mask.any(axis=1)).tolist(), np.flatnonzero(mask.any(axis=0)).tolist()
    if not rows:
        return None
    height, width = rows[-1] - rows[0] + 1, columns[-1] - columns[0] + 1
    return Grid(window.resolution, window.column + columns[0], window.row + rows[0], width, height)


def search_alone(given: TileInput, parameters: Parameters) -> SearchedWindow:
    """Search the whole box from the empty map, and return the part of the window.

    Cells outside of the window lack some of their readings; they only help to explain the readings of the window.
    """
    given = given._replace(occupied=np.zeros_like(given.occupied))
    evidence = _evidence(given, parameters)
    found = Search(evidence, parameters.search, given.traversed.ravel()).run()
    occupied = evidence.state.maps.occupied.reshape(given.box.shape)
    part = np.array(occupied[given.box.window(given.tile.window)])
    return SearchedWindow(part, _filled_part(part != 0, given.tile.window), found.progress, found.converged)


def search_with_neighbours(given: TileInput, parameters: Parameters) -> SearchedWindow:
    """Search the window, with the rest of the box fixed, until nothing gains."""
    evidence = _evidence(given, parameters)
    rows, columns = given.box.window(given.tile.window)
    window = rows.start, rows.stop, columns.start, columns.stop
    before = evidence.state.maps.occupied.copy()
    search = Search(evidence, parameters.search, given.traversed.ravel(), window, hold=True)
    found = search.improve()
    after = evidence.state.maps.occupied
    part = np.array(after.reshape(given.box.shape)[rows, columns])
    changed = (after != before).reshape(given.box.shape)[rows, columns]
    return SearchedWindow(part, _filled_part(changed, given.tile.window), found.progress, found.converged)


def finish_core(given: TileInput, parameters: Parameters) -> FinishedCore:
    """Return the final maps of the core from the map that the search found."""
    p = parameters
    evidence = _evidence(given, p)
    searched = evidence.observed()
    ml, uncertainty = final_maps(evidence, p.search, given.traversed)
    return FinishedCore(
        given.core(ml),
        given.core(uncertainty),
        given.core(searched),
        evidence.log_likelihood_of(given.own),
        evidence.pairs,
        evidence.nbytes,
        evidence.unstored,
    )


def judge_readings(given: TileInput, parameters: Parameters) -> JudgedReadings:
    """Evaluate the own readings of the tile on the final map."""
    own = given.readings.select(given.own)
    forward = ForwardModel(own, given.box, parameters.model, normals_from(given.normals, parameters))
    e = forward.expectations(given.ml)
    unexplained = e.random > 0.5
    return JudgedReadings(e.log_likelihood, unexplained, dynamic_echoes(forward, unexplained, given.ml), forward)
