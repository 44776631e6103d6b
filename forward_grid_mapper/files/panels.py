"""Contents of pictures and figures: panels and tiles."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from ..core.common.grid import Grid
from ..core.common.readings import Readings

Box = tuple[float, float, float, float]
"""Left, right, bottom, top in metres."""


UNKNOWN_COLOUR, PATH = '#cfd9e4', '#0072b2'
DRIVES = (PATH, '#009e73', '#e69f00', '#7b3294', '#56b4e9', '#8c510a', '#666666', '#1b5e20')
"""Colours of the paths of several drives; the first is that of a single drive; the same as in chart.js."""


class FigureTile(NamedTuple):
    """One map of a table: `values` are probabilities, or cells 0 and 1, with NaN or -1 where unknown.

    The cones of `readings` are drawn over it, and the cells that are True in `marked` in the colour of dots. `path_xy`
    and `odometry_xy` are paths of a robot, float64 of shape (P, 2) in metres: a line, and a dashed one.
    """

    title: str
    grid: Grid
    values: NDArray[Any]
    readings: Readings | None = None
    marked: NDArray[np.bool_] | None = None
    path_xy: NDArray[np.float64] | None = None
    odometry_xy: NDArray[np.float64] | None = None


class Curve(NamedTuple):
    """A density in 1/m over ranges in metres, both float64 of shape (N,)."""

    x: NDArray[np.float64]
    y: NDArray[np.float64]


def coarse(values: NDArray[Any], step: int) -> NDArray[np.float32]:
    """Return a map in blocks of `step` cells, each with the largest of its values; NaN if all are NaN.

    So walls one cell thick are not lost between the pixels of a picture. The last row and column of blocks may be
    smaller: padded to whole blocks, a map would need memory for `step`², and the step is huge if a path jumps far away.
    """
    rows, columns = (np.arange(0, n, step) for n in values.shape)
    part = np.fmax.reduceat(np.asarray(values, np.float32), rows, axis=0)
    return np.asarray(np.fmax.reduceat(part, columns, axis=1))


class Panel(NamedTuple):
    """One map of the picture: `values` are probabilities with NaN where unknown, `extent` its box in metres."""

    title: str
    values: NDArray[np.float32]
    extent: Box


class Picture(NamedTuple):
    """Contents of a picture. `view` is the box shown; points are in metres, and are drawn on the panel `overlay`.

    `path_xy` of several drives, whose names are `drives`, is separated by rows of NaN. `odometry_xy` is the path of
    odometry, if it differs from `path_xy`.
    """

    title: str
    figures: str
    panels: list[Panel]
    view: Box
    overlay: int
    path_xy: NDArray[np.float64]
    unexplained_xy: NDArray[np.float64]
    odometry_xy: NDArray[np.float64] = np.zeros((0, 2))
    drives: tuple[str, ...] = ()


def paths_of(xy: NDArray[np.float64]) -> list[NDArray[np.float64]]:
    """Return the paths that are separated by rows of NaN, one for each drive; paths may be empty."""
    parts = np.split(xy, np.flatnonzero(~np.isfinite(xy).all(axis=1)))
    return [part[np.isfinite(part).all(axis=1)] for part in parts]


def joined_paths(paths: Sequence[NDArray[np.float64]]) -> NDArray[np.float64]:
    """Return paths of shape (P, 2) as one, separated by rows of NaN.

    `paths_of` is the inverse, except that it returns an empty path for none.
    """
    gap = np.full((1, 2), np.nan)
    parts = [part for path in paths for part in (gap, path)]
    return np.concatenate(parts[1:]) if parts else np.zeros((0, 2))
