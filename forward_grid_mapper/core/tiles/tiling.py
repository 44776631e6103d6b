"""Tiles of a grid, the readings that each of them takes, and which tiles may be searched at once.

A tile has three nested windows. Its *core* is its own part of the map; the cores cover the grid. Its *window* is the
core and `MARGIN` around it: whatever move the search makes, a gap closed or a wall shifted, lies in some window. Its
*box* holds the cones of all readings that touch the window, its halo.

All that the readings say of a cell of the window is in the box: so what a flip there gains is exact, as long as the
rest of the box is held. Tiles of one *colour* have no reading in common, so they do not see each other change.
"""

from __future__ import annotations

import math
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from ..common.constants import LONGEST_GAP, SHORT_WALL
from ..common.grid import Grid, cone_boxes
from ..common.parameters import Parameters
from ..common.readings import Readings
from ..sensor.cone_table import effective_sigma, reach_of

ROUND = max(LONGEST_GAP, SHORT_WALL)
"""Metres around a window that its moves look at, whatever the readings reach: the other end of a gap, the rest of a
short wall. The prior looks `NEIGHBOURS_AWAY` cells farther."""

NEIGHBOURS_AWAY = 3


class Tile(NamedTuple):
    """One tile: its place among the tiles, its core and its window."""

    row: int
    column: int
    core: Grid
    window: Grid


class Tiling:
    """The tiles of a grid, and the readings of each.

    Attributes
    ----------
    grid : Grid
    tiles : tuple of Tile
        By row and column.
    colours : tuple of tuple of int
        The numbers of the tiles of each colour.
    """

    def __init__(self, grid: Grid, readings: Readings, parameters: Parameters, size: float) -> None:
        """Cut a grid into tiles.

        Parameters
        ----------
        grid : Grid
            Of the whole map; holds the cones of all readings.
        readings : Readings
        parameters : Parameters
        size : float
            Edge of a tile, metres; a cell at the least. Edges lie on the lattice, wherever the grid begins.
        """
        self.grid = grid
        self._edge = max(round(size / grid.resolution), 1)
        self._margin = margin(grid.resolution)
        self._around = math.ceil(ROUND / grid.resolution) + NEIGHBOURS_AWAY
        rows = range(grid.row // self._edge, (grid.row + grid.height - 1) // self._edge + 1)
        columns = range(grid.column // self._edge, (grid.column + grid.width - 1) // self._edge + 1)
        self._corner, self._across = (rows[0], columns[0]), len(columns)
        self._up = len(rows)
        self.tiles = tuple(self._tile(row, column) for row in rows for column in columns)
        self._boxes = boxes = boxes_of(readings, parameters)
        widest = float(max((boxes[1] - boxes[0]).max(), (boxes[3] - boxes[2]).max())) / grid.resolution
        self.colours = self._coloured(max(math.ceil(widest) + 2, self._around))

    def _tile(self, row: int, column: int) -> Tile:
        resolution, edge, m = self.grid.resolution, self._edge, self._margin
        core = _clipped(Grid(resolution, column * edge, row * edge, edge, edge), self.grid)
        wide = Grid(resolution, column * edge - m, row * edge - m, edge + 2 * m, edge + 2 * m)
        return Tile(row, column, core, _clipped(wide, self.grid))

    def _touched(self, around: int) -> tuple[NDArray[np.int64], NDArray[np.int64]]:
        """Return the first and the last row and column of tiles that cones touch, with cells around; shape (2, N)."""
        left, right, bottom, top = np.floor(self._boxes / self.grid.resolution).astype(np.int64)
        corner = np.array(self._corner)[:, None]
        first = (np.stack([bottom, left]) - around) // self._edge - corner
        last = (np.stack([top, right]) + around) // self._edge - corner
        most = np.array([self._up - 1, self._across - 1])[:, None]
        return np.clip(first, 0, most), np.clip(last, 0, most)

    def _coloured(self, apart: int) -> tuple[tuple[int, ...], ...]:
        """Return tiles by colour, so that windows of one colour are at least `apart` cells from each other."""
        stride = math.ceil((apart + 2 * self._margin) / self._edge) + 1
        colours: dict[tuple[int, int], list[int]] = {}
        for number, tile in enumerate(self.tiles):
            colours.setdefault((tile.row % stride, tile.column % stride), []).append(number)
        return tuple(tuple(colours[key]) for key in sorted(colours))

    def around(self, tile: Tile) -> Grid:
        """Return the window and the cells around it that its search looks at, whatever the readings reach."""
        n, w = self._around, tile.window
        wide = Grid(w.resolution, w.column - n, w.row - n, w.width + 2 * n, w.height + 2 * n)
        return _clipped(wide, self.grid)

    def readings_of(self, around: float = 0.0) -> list[NDArray[np.int64]]:
        """Return the indices of the readings whose cones may touch the window of each tile, in their order.

        With `around`, metres, also those that touch what is so near to the core, where that is more.
        """
        first, last = self._touched(max(self._margin, round(around / self.grid.resolution)))
        spans = last - first + 1
        count = spans[0] * spans[1]
        reading = np.repeat(np.arange(len(count)), count)
        nth = np.arange(len(reading)) - np.repeat(np.cumsum(count) - count, count)
        row = first[0][reading] + nth // spans[1][reading]
        column = first[1][reading] + nth % spans[1][reading]
        tile = row * self._across + column
        order = np.argsort(tile, kind='stable')
        edges = np.searchsorted(tile[order], np.arange(len(self.tiles) + 1))
        return [reading[order[edges[k] : edges[k + 1]]] for k in range(len(self.tiles))]

    def owners(self, readings: Readings) -> NDArray[np.int64]:
        """Return the tile in whose core each sensor was, shape (N,): so each reading is of one tile."""
        rows, columns = self.grid.cells_of(readings.x, readings.y)
        row = (np.clip(rows, 0, self.grid.height - 1) + self.grid.row) // self._edge - self._corner[0]
        column = (np.clip(columns, 0, self.grid.width - 1) + self.grid.column) // self._edge - self._corner[1]
        owner: NDArray[np.int64] = row * self._across + column
        return owner


def margin(resolution: float) -> int:
    """Return how many cells a window reaches beyond its core: half the longest gap, so that one window holds each."""
    return math.ceil(LONGEST_GAP / 2 / resolution) + 1


def boxes_of(readings: Readings, parameters: Parameters) -> NDArray[np.float64]:
    """Return the boxes (left, right, bottom, top) around the cells of cones, shape (4, N), metres."""
    model, cell = parameters.model, parameters.grid.resolution
    reach = reach_of(readings, effective_sigma(readings, model, cell)) + model.surface_offset * cell
    return cone_boxes(readings.x, readings.y, readings.yaw, readings.half_angle, reach)


def _clipped(grid: Grid, whole: Grid) -> Grid:
    """Return the part of a grid that lies in another one."""
    left, bottom = max(grid.column, whole.column), max(grid.row, whole.row)
    right = min(grid.column + grid.width, whole.column + whole.width)
    top = min(grid.row + grid.height, whole.row + whole.height)
    return Grid(grid.resolution, left, bottom, max(right - left, 0), max(top - bottom, 0))
