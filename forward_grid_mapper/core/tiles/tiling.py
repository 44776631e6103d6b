"""Tiles of a grid, their readings, and which tiles may be searched in parallel.

A tile has three nested areas. Its *core* is its own part of the map; the cores cover the grid. Its *window* is the core
and a `margin` around it, so that each move of the search, such as closing a gap or shifting a wall, lies in some
window. Its *box* contains the cones of all readings that reach into the window.

All readings of the cells of the window are in the box, so gains of flips there are exact while the rest of the box is
fixed. Tiles of one *colour* have no reading in common, so they do not affect each other.
"""

from __future__ import annotations

import dataclasses
import math
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from ..common.constants import LONGEST_GAP, SHORT_WALL
from ..common.grid import Grid, cone_boxes
from ..common.parameters import Parameters
from ..common.readings import Readings
from ..sensor.cone_table import effective_sigma, grid_of, reach_of

AROUND_WINDOW = max(LONGEST_GAP, SHORT_WALL)
"""Metres around a window that its moves depend on, besides the readings: the other end of a gap, or the rest of a short
wall. The prior depends on `NEIGHBOURS_AWAY` more cells."""

NEIGHBOURS_AWAY = 3

LARGEST_EDGE = 1 << 40
"""Cells; no map is as large."""


class Tile(NamedTuple):
    """One tile: its row and column among the tiles, its core and its window."""

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

    def __init__(self, grid: Grid, size: float, widest: float) -> None:
        """Divide a grid into tiles.

        Parameters
        ----------
        grid : Grid
            Of the whole map; it contains the cones of all readings.
        size : float
            Side of a tile, metres; at least a cell. Edges lie on the lattice, independent of the grid.
        widest : float
            `widest_of` the boxes of all readings, metres.
        """
        self.grid = grid
        self._edge = edge_of(size, grid.resolution)
        self._margin = margin(grid.resolution)
        self._around = math.ceil(AROUND_WINDOW / grid.resolution) + NEIGHBOURS_AWAY
        rows = range(grid.row // self._edge, (grid.row + grid.height - 1) // self._edge + 1)
        columns = range(grid.column // self._edge, (grid.column + grid.width - 1) // self._edge + 1)
        self._corner, self._across = (rows[0], columns[0]), len(columns)
        self._up = len(rows)
        self.tiles = tuple(self._tile(row, column) for row in rows for column in columns)
        # cells from a window to the end of its box
        self._beyond = max(math.ceil(widest / grid.resolution) + 2, self._around)
        self.colours = self._coloured(self._beyond)

    def _tile(self, row: int, column: int) -> Tile:
        resolution, edge, m = self.grid.resolution, self._edge, self._margin
        core = common_part(Grid(resolution, column * edge, row * edge, edge, edge), self.grid)
        wide = Grid(resolution, column * edge - m, row * edge - m, edge + 2 * m, edge + 2 * m)
        return Tile(row, column, core, common_part(wide, self.grid))

    def _coloured(self, apart: int) -> tuple[tuple[int, ...], ...]:
        """Return tiles by colour, so that windows of one colour are at least `apart` cells from each other."""
        stride = math.ceil((apart + 2 * self._margin) / self._edge) + 1
        colours: dict[tuple[int, int], list[int]] = {}
        for number, tile in enumerate(self.tiles):
            colours.setdefault((tile.row % stride, tile.column % stride), []).append(number)
        return tuple(tuple(colours[key]) for key in sorted(colours))

    def around(self, tile: Tile) -> Grid:
        """Return the window and the cells around it that its moves depend on, besides the readings."""
        n, w = self._around, tile.window
        wide = Grid(w.resolution, w.column - n, w.row - n, w.width + 2 * n, w.height + 2 * n)
        return common_part(wide, self.grid)

    def box(self, number: int, readings: Readings, parameters: Parameters) -> Grid:
        """Return the box of a tile with these readings."""
        around = self.around(self.tiles[number])
        if not len(readings):
            return around
        # no limit is needed, since no box is larger than the grid
        unlimited = dataclasses.replace(parameters.grid, max_cells=self.grid.size)
        return grid_of(readings, parameters.model, unlimited, within=around)

    def readings_of(self, boxes: NDArray[np.float64], around: float = 0.0) -> list[NDArray[np.int64]]:
        """Return the indices of the readings whose cones may touch the window of each tile, in their order.

        Parameters
        ----------
        boxes : float64, shape (4, N)
            From `boxes_of`.
        around : float
            Metres around the core that are used in place of the window, if this is more.
        """
        found = by_tile(boxes, self.grid.resolution, self._edge, around)
        none = np.zeros(0, np.int64)
        return [found.get((tile.row, tile.column), none) for tile in self.tiles]

    def touching(self, number: int, boxes: NDArray[np.float64], around: float = 0.0) -> NDArray[np.bool_]:
        """Return a mask of the `readings_of` a tile, shape (N,)."""
        first, last = _touched(boxes, self.grid.resolution, self._edge, around)
        place = np.array(self.tiles[number][:2])[:, None]
        return np.asarray(((first <= place) & (place <= last)).all(axis=0))

    def with_cores_in(self, part: Grid) -> list[int]:
        """Return the tiles whose cores overlap a part of the grid."""
        return self._within(part, 0)

    def with_windows_in(self, part: Grid) -> list[int]:
        """Return the tiles whose windows overlap a part of the grid."""
        return self._within(part, self._margin)

    def with_boxes_in(self, part: Grid) -> list[int]:
        """Return the tiles whose boxes may overlap a part of the grid."""
        return self._within(part, self._margin + self._beyond)

    def _within(self, part: Grid, m: int) -> list[int]:
        """Return the tiles whose cores are at most `m` cells away from a part of the grid."""
        rows = range((part.row - m) // self._edge, (part.row + part.height - 1 + m) // self._edge + 1)
        columns = range((part.column - m) // self._edge, (part.column + part.width - 1 + m) // self._edge + 1)
        places = ((row - self._corner[0], column - self._corner[1]) for row in rows for column in columns)
        return [r * self._across + c for r, c in places if 0 <= r < self._up and 0 <= c < self._across]

    def owners(self, readings: Readings) -> NDArray[np.int64]:
        """Return the tile that each reading belongs to, by the core that its sensor was in, shape (N,)."""
        rows, columns = self.grid.cells_of(readings.x, readings.y)
        row = (np.clip(rows, 0, self.grid.height - 1) + self.grid.row) // self._edge - self._corner[0]
        column = (np.clip(columns, 0, self.grid.width - 1) + self.grid.column) // self._edge - self._corner[1]
        owner: NDArray[np.int64] = row * self._across + column
        return owner


def edge_of(size: float, resolution: float) -> int:
    """Return the side of tiles of `size` metres, cells: at most `LARGEST_EDGE`, so that integers do not overflow."""
    return max(round(min(size / resolution, LARGEST_EDGE)), 1)


def _touched(
    boxes: NDArray[np.float64], resolution: float, edge: int, around: float
) -> tuple[NDArray[np.int64], NDArray[np.int64]]:
    """Return first and last row and column of the tiles whose windows cones may touch, each of shape (2, N)."""
    left, right, bottom, top = np.floor(boxes / resolution).astype(np.int64)
    cells = max(margin(resolution), round(around / resolution))
    return (np.stack([bottom, left]) - cells) // edge, (np.stack([top, right]) + cells) // edge


def by_tile(
    boxes: NDArray[np.float64], resolution: float, edge: int, around: float = 0.0
) -> dict[tuple[int, int], NDArray[np.int64]]:
    """Return `Tiling.readings_of` by row and column of the tiles.

    It needs no grid, since the edges of tiles lie on the lattice.
    """
    first, last = _touched(boxes, resolution, edge, around)
    spans = last - first + 1
    count = spans[0] * spans[1]
    reading = np.repeat(np.arange(len(count)), count)
    nth = np.arange(len(reading)) - np.repeat(np.cumsum(count) - count, count)
    row = first[0][reading] + nth // spans[1][reading]
    column = first[1][reading] + nth % spans[1][reading]
    order = np.lexsort((column, row))
    row, column = row[order], column[order]
    edges = np.flatnonzero((np.diff(row) != 0) | (np.diff(column) != 0)) + 1
    parts = np.split(reading[order], edges)
    begins = [0, *edges.tolist()] if len(reading) else []
    return {(int(row[k]), int(column[k])): part for k, part in zip(begins, parts, strict=False)}


def widest_of(boxes: NDArray[np.float64]) -> float:
    """Return the longest side of boxes, metres."""
    return float(max((boxes[1] - boxes[0]).max(), (boxes[3] - boxes[2]).max()))


def margin(resolution: float) -> int:
    """Return the cells of a window beyond its core: half the longest gap, so that each gap lies in some window."""
    return math.ceil(LONGEST_GAP / 2 / resolution) + 1


def boxes_of(readings: Readings, parameters: Parameters) -> NDArray[np.float64]:
    """Return the boxes (left, right, bottom, top) around the cells of cones, shape (4, N), metres."""
    model, cell = parameters.model, parameters.grid.resolution
    reach = reach_of(readings, effective_sigma(readings, model, cell)) + model.surface_offset * cell
    return cone_boxes(readings.x, readings.y, readings.yaw, readings.half_angle, reach)


def common_part(grid: Grid, whole: Grid) -> Grid:
    """Return the intersection of two grids; it may have no cells."""
    left, bottom = max(grid.column, whole.column), max(grid.row, whole.row)
    right = min(grid.column + grid.width, whole.column + whole.width)
    top = min(grid.row + grid.height, whole.row + whole.height)
    return Grid(grid.resolution, left, bottom, max(right - left, 0), max(top - bottom, 0))
