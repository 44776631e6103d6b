"""Cells that a robot drove over: where its sensors were, and between, nothing stands."""

from __future__ import annotations

import math
from typing import Any

import numpy as np
from numpy.typing import NDArray

from .cones import Floats
from .grid import Grid
from .jit import kernel
from .readings import Readings

LONGEST_PAUSE = 500_000_000
"""Nanoseconds between two readings, beyond which nobody knows what the robot did."""

LONGEST_STEP = 0.8
"""Metres between the sensors of two readings: sensors of one robot are no farther apart, nor does it drive farther."""


@kernel
def _mark(x: Any, y: Any, joined: Any, out: Any) -> None:
    """Set the cells of each point (in cells), and those on the segment from it to the next where they are joined."""
    height, width = out.shape
    for i in range(len(x)):
        steps = 1
        if joined[i]:
            steps = 2 + int(4.0 * math.hypot(x[i + 1] - x[i], y[i + 1] - y[i]))
        for k in range(steps):
            u, v = x[i], y[i]
            if k:
                u += (x[i + 1] - x[i]) * k / (steps - 1)
                v += (y[i + 1] - y[i]) * k / (steps - 1)
            column, row = int(math.floor(u)), int(math.floor(v))
            if 0 <= row < height and 0 <= column < width:
                out[row, column] = 1


def mark_driven(x: Floats, y: Floats, stamp: NDArray[np.int64], grid: Grid, driven: NDArray[np.bool_]) -> None:
    """Set in `driven` the cells where sensors were, and those between where they were one after the other.

    Parameters
    ----------
    x, y : float64, shape (N,)
        Of the sensors, in the map frame, metres.
    stamp : int64, shape (N,)
        Nanoseconds.
    grid : Grid
    driven : bool, shape `grid.shape`
    """
    order = np.argsort(stamp, kind='stable')
    x, y, stamp = x[order], y[order], stamp[order]
    joined = np.zeros(len(order), np.bool_)
    joined[:-1] = (np.diff(stamp) <= LONGEST_PAUSE) & (np.hypot(np.diff(x), np.diff(y)) <= LONGEST_STEP)
    _mark(x / grid.resolution - grid.column, y / grid.resolution - grid.row, joined, driven.view(np.uint8))


def driven_cells(readings: Readings, grid: Grid) -> NDArray[np.bool_]:
    """Return which cells lie where sensors were, or between where they were one after the other, shape `grid.shape`."""
    out = np.zeros(grid.shape, np.bool_)
    mark_driven(readings.x, readings.y, readings.stamp, grid, out)
    return out
