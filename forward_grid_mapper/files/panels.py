"""What is drawn: panels of a picture, and tiles of a figure."""

from __future__ import annotations

from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from ..core.common.grid import Grid

Box = tuple[float, float, float, float]
"""Left, right, bottom, top in metres."""


class Tile(NamedTuple):
    """One map of the table: `values` are probabilities, or cells 0 and 1, with NaN or -1 where unknown."""

    title: str
    grid: Grid
    values: NDArray[Any]


class Panel(NamedTuple):
    """One map of the picture: `values` are probabilities with NaN where unknown, `extent` its box in metres."""

    title: str
    values: NDArray[np.float32]
    extent: Box


class Picture(NamedTuple):
    """What is drawn. `view` is the box shown; points are in metres; `overlay` is the panel that bears them.

    `path_xy` is parted by rows of NaN where there are several drives. `odometry_xy` is the path that odometry gives,
    where it is another one than `path_xy`.
    """

    title: str
    figures: str
    panels: list[Panel]
    view: Box
    overlay: int
    path_xy: NDArray[np.float64]
    unexplained_xy: NDArray[np.float64]
    odometry_xy: NDArray[np.float64] = np.zeros((0, 2))

    @property
    def paths(self) -> list[NDArray[np.float64]]:
        """The path of each drive, none of them empty."""
        known = np.isfinite(self.path_xy).all(axis=1)
        parts = np.split(self.path_xy, np.flatnonzero(~known))
        parts = [part[np.isfinite(part).all(axis=1)] for part in parts]
        return [part for part in parts if len(part)]
