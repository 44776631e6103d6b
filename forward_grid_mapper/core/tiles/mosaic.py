"""The whole map in tiles: provides the input of each tile, and stores its results."""

from __future__ import annotations

from collections.abc import Callable, Iterable
from typing import TypeVar

import numpy as np
from numpy.typing import NDArray

from ..common.grid import UNKNOWN, Grid
from ..common.parameters import Parameters
from ..common.readings import Readings
from ..maps.traversed import traversed_cells
from ..sensor.surface_normals import SurfaceNormals
from .schedule import Schedule
from .tile_steps import FinishedCore, JudgedReadings, SearchedWindow, TileInput, normals_from
from .tiling import Tiling, boxes_of, widest_of

T = TypeVar('T')

Each = Callable[[Callable[[TileInput], T], Iterable[TileInput]], Iterable[T]]
"""Calls a function with each item, in any order or in parallel, and returns the results in the order of the items:
`map`, or that of an executor."""


FIRST_AROUND = 2.0
"""Metres around a core from which readings make its first map."""


class Mosaic:
    """The present map of all tiles, and the tiles that must be searched again.

    Attributes
    ----------
    readings : Readings
        In canonical order.
    grid : Grid
    tiling : Tiling
    schedule : Schedule
        Of the tiles that must be searched.
    traversed : bool, shape `grid.shape`
    occupied : uint8, shape `grid.shape`
    normals : float32, shape (2, *grid.shape)
    ml, searched : int8, shape `grid.shape`
    uncertainty, dynamic : float32, shape `grid.shape`
    log_likelihood : float64, shape (N,)
    unexplained : bool, shape (N,)
    """

    def __init__(self, readings: Readings, grid: Grid, parameters: Parameters, size: float) -> None:
        """Begin with an empty map in tiles of `size` metres."""
        self.readings, self.grid = readings, grid
        boxes = boxes_of(readings, parameters)
        self.tiling = Tiling(grid, size, widest_of(boxes))
        self._parameters = parameters
        self._readings_of, self._owner = self.tiling.readings_of(boxes), self.tiling.owners(readings)
        self.traversed = traversed_cells(readings, grid)
        self.occupied = np.zeros(grid.shape, np.uint8)
        self.normals = np.zeros((2, *grid.shape), np.float32)
        self.ml, self.searched = (np.full(grid.shape, UNKNOWN, np.int8) for _ in range(2))
        self.uncertainty = np.full(grid.shape, np.nan, np.float32)
        self.dynamic = np.zeros(grid.shape, np.float32)
        self.log_likelihood, self.unexplained = np.zeros(len(readings)), np.zeros(len(readings), np.bool_)
        self._first_readings = self.tiling.readings_of(boxes, FIRST_AROUND)
        self._boxes = [self._box(k, indices) for k, indices in enumerate(self._readings_of)]
        self.schedule = Schedule({k: self._boxes[k] for k in self.filled})

    @property
    def halo(self) -> float:
        """Mean number of tiles that evaluate a reading."""
        return sum(map(len, self._readings_of)) / len(self.readings)

    @property
    def filled(self) -> list[int]:
        """The tiles that have readings."""
        return [k for k, indices in enumerate(self._readings_of) if len(indices)]

    def _box(self, number: int, indices: NDArray[np.int64]) -> Grid:
        return self.tiling.box(number, self.readings.select(indices), self._parameters)

    def input_of(self, number: int) -> TileInput:
        """Return the input of a tile."""
        return self._input_of(number, self._readings_of[number], self._boxes[number])

    def first_input_of(self, number: int) -> TileInput:
        """Return the input of a tile for its first map, which is made without its neighbours."""
        indices = self._first_readings[number]
        return self._input_of(number, indices, self._box(number, indices))

    def _input_of(self, number: int, indices: NDArray[np.int64], box: Grid) -> TileInput:
        part = self.grid.window(box)
        return TileInput(
            self.tiling.tiles[number],
            box,
            self.readings.select(indices),
            self._owner[indices] == number,
            self.traversed[part],
            self.occupied[part].copy(),
            self.normals[(slice(None), *part)],
            self.ml[part],
        )

    def _core(self, number: int) -> tuple[slice, slice]:
        return self.grid.window(self.tiling.tiles[number].core)

    def all_normals(self) -> SurfaceNormals:
        """Return the normals of the whole map."""
        return normals_from(self.normals, self._parameters)

    def store_normals(self, number: int, normals: NDArray[np.float32]) -> None:
        """Store the normals of a core."""
        self.normals[(slice(None), *self._core(number))] = normals

    def store_first(self, number: int, found: SearchedWindow) -> None:
        """Store the core of a first map."""
        tile = self.tiling.tiles[number]
        self.occupied[self._core(number)] = found.occupied[tile.window.window(tile.core)]

    def store_window(self, number: int, found: SearchedWindow) -> None:
        """Store the map of a window; tiles whose boxes contain changes become stale."""
        self.occupied[self.grid.window(self.tiling.tiles[number].window)] = found.occupied
        self.schedule.searched(number, found.changed)

    def store_finished(self, number: int, found: FinishedCore) -> None:
        """Store the final maps of a core."""
        core = self._core(number)
        self.ml[core], self.uncertainty[core], self.searched[core] = found.ml, found.uncertainty, found.searched

    def store_judged(self, number: int, found: JudgedReadings) -> None:
        """Store the results for the own readings of a tile."""
        indices = self._readings_of[number]
        own = indices[self._owner[indices] == number]
        self.log_likelihood[own], self.unexplained[own] = found.log_likelihood, found.unexplained
        self.dynamic[self.grid.window(self._boxes[number])] += found.dynamic
