"""Grids: rectangles of cells of one lattice.

All grids of one resolution are parts of the same lattice, whose cell (0, 0) has a corner at the origin of the map
frame. So grids that grow, shrink or are made from other readings have the same cells where they overlap.
"""

from __future__ import annotations

import math
import numbers
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray


@dataclass(frozen=True)
class Grid:
    """A rectangle of cells of the lattice.

    Attributes
    ----------
    resolution : float
        Edge length of a cell in metres.
    column, row : int
        Lattice indices of the lower left cell.
    width, height : int
        Number of cells along x and y, 0 or more.

    Raises
    ------
    ValueError
        If the resolution is not a finite number above 0, or another field not a whole number.
    """

    resolution: float
    column: int
    row: int
    width: int
    height: int

    def __post_init__(self) -> None:
        if not (isinstance(self.resolution, numbers.Real) and math.isfinite(self.resolution) and self.resolution > 0):
            raise ValueError(f'the resolution of a grid must be a finite number of metres above 0: {self.resolution!r}')
        for name in ('column', 'row', 'width', 'height'):
            value = getattr(self, name)
            if isinstance(value, bool) or not isinstance(value, numbers.Integral):
                raise ValueError(f'{name} of a grid must be a whole number: {value!r}')
        if self.width < 0 or self.height < 0:
            raise ValueError(f'a grid must have at least 0 cells: width {self.width}, height {self.height}')

    @property
    def origin(self) -> tuple[float, float]:
        """Corner of the lower left cell in the map frame, metres."""
        return self.column * self.resolution, self.row * self.resolution

    @property
    def shape(self) -> tuple[int, int]:
        """(height, width), the shape of a map's array; row 0 is the one with the smallest y."""
        return self.height, self.width

    @property
    def size(self) -> int:
        """Number of cells."""
        return self.width * self.height

    @property
    def extent(self) -> tuple[float, float, float, float]:
        """Left, right, bottom, top in metres."""
        x, y = self.origin
        return x, x + self.width * self.resolution, y, y + self.height * self.resolution

    def cells_of(self, x: NDArray[np.float64], y: NDArray[np.float64]) -> tuple[NDArray[np.int64], NDArray[np.int64]]:
        """Return (rows, columns) in this grid of points in metres; they may lie outside."""
        rows = np.floor(np.asarray(y) / self.resolution).astype(np.int64) - self.row
        columns = np.floor(np.asarray(x) / self.resolution).astype(np.int64) - self.column
        return rows, columns

    def centers(self) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
        """Return the x of each column and the y of each row in metres."""
        x = np.multiply(self.column + 0.5 + np.arange(self.width), self.resolution, dtype=np.float64)
        y = np.multiply(self.row + 0.5 + np.arange(self.height), self.resolution, dtype=np.float64)
        return x, y

    def union(self, other: Grid) -> Grid:
        """Return the smallest grid that contains both.

        Raises
        ------
        ValueError
            If they differ in resolution, and so are not parts of one lattice.
        """
        self._check_lattice(other)
        if not self.size or not other.size:
            return self if self.size else other
        column, row = min(self.column, other.column), min(self.row, other.row)
        right = max(self.column + self.width, other.column + other.width)
        top = max(self.row + self.height, other.row + other.height)
        return Grid(self.resolution, column, row, right - column, top - row)

    def window(self, inner: Grid) -> tuple[slice, slice]:
        """Return the slices (rows, columns) of this grid that are `inner`.

        Raises
        ------
        ValueError
            If `inner` is not inside, or differs in resolution.
        """
        self._check_lattice(inner)
        row, column = inner.row - self.row, inner.column - self.column
        if row < 0 or column < 0 or row + inner.height > self.height or column + inner.width > self.width:
            raise ValueError('the inner grid is not inside the outer one')
        return slice(row, row + inner.height), slice(column, column + inner.width)

    def _check_lattice(self, other: Grid) -> None:
        if self.resolution != other.resolution:
            raise ValueError(
                f'grids of {self.resolution} m and of {other.resolution} m a cell are not aligned; make both maps '
                'with the same resolution'
            )

    @classmethod
    def covering(cls, box: tuple[float, float, float, float], resolution: float) -> Grid:
        """Return the grid of all cells that the box (left, right, bottom, top in metres) touches."""
        left, right, bottom, top = (math.floor(v / resolution) for v in box)
        return cls(resolution, left, bottom, right - left + 1, top - bottom + 1)


def cone_boxes(
    x: NDArray[np.float64],
    y: NDArray[np.float64],
    yaw: NDArray[np.float64],
    half_angle: NDArray[np.float64],
    reach: NDArray[np.float64],
) -> NDArray[np.float64]:
    """Return the bounding boxes (left, right, bottom, top) of circular sectors, shape (4, N), metres.

    Parameters
    ----------
    x, y, yaw : float64, shape (N,)
        Apex in metres and direction of the axis in radians.
    half_angle, reach : float64, shape (N,)
        Radians and metres.
    """
    low, high = yaw - half_angle, yaw + half_angle
    cos = np.stack([np.cos(low), np.cos(high), np.zeros_like(yaw)])
    sin = np.stack([np.sin(low), np.sin(high), np.zeros_like(yaw)])
    box = np.stack([cos.min(0), cos.max(0), sin.min(0), sin.max(0)])
    quarter = math.pi / 2
    for k, (side, extreme) in enumerate(((1, 1.0), (3, 1.0), (0, -1.0), (2, -1.0))):
        inside = np.ceil((low - k * quarter) / (4 * quarter)) <= (high - k * quarter) / (4 * quarter)
        box[side] = np.where(inside, extreme, box[side])
    return np.stack([x, x, y, y]) + box * reach


UNKNOWN = -1

Window = tuple[int, int, int, int]
"""A rectangle of cells of a grid: first row, last one plus one, first column, last one plus one."""


def united(*windows: Window | None) -> Window | None:
    """Return the smallest window that contains all of `windows`; None is an empty one."""
    bounds = [window for window in windows if window]
    if not bounds:
        return None
    bottom, top, left, right = zip(*bounds, strict=True)
    return min(bottom), max(top), min(left), max(right)


def part_of(grid: Grid, values: NDArray[np.int8], wanted: Grid) -> NDArray[np.int8]:
    """Return a map on another grid of the same lattice; cells outside of `grid` are unknown.

    Parameters
    ----------
    grid : Grid
    values : int8, shape `grid.shape`
    wanted : Grid

    Raises
    ------
    ValueError
        If the grids differ in resolution.
    """
    whole = grid.union(wanted)
    out = np.full(whole.shape, UNKNOWN, np.int8)
    out[whole.window(grid)] = values
    return np.array(out[whole.window(wanted)])
