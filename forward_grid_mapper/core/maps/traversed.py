"""Cells that a robot drove over: where its sensors were, and between, nothing stands.

Lines between sensors across the robot fill its middle, also before it has moved.
"""

from __future__ import annotations

import math
from typing import Any

import numpy as np
from numpy.typing import NDArray

from ..common.grid import Grid
from ..common.readings import Readings
from ..runtime.jit import kernel
from ..sensor.cone_table import Floats

LONGEST_PAUSE = 500_000_000
"""Nanoseconds between two readings, beyond which nobody knows what the robot did."""

LONGEST_STEP = 0.8
"""Metres between the sensors of two readings: sensors of one robot are no farther apart, nor does it drive farther."""


STRIDES = (0, 1, 2, 4, 8, 16)
"""How many readings later the sensor is to which a line is drawn: itself, the next one, and others across the robot."""


@kernel
def _mark(x: Any, y: Any, stamp: Any, longest: float, out: Any) -> None:
    """Set the cells of each point, and those on the lines from it to the points `STRIDES` later that are near enough.

    `x`, `y` and `longest` are in cells, `stamp` is in order.
    """
    height, width = out.shape
    for i in range(len(x)):
        for stride in STRIDES:
            j = i + stride
            if j >= len(x):
                break
            length = math.hypot(x[j] - x[i], y[j] - y[i])
            if stamp[j] - stamp[i] > LONGEST_PAUSE or length > longest:
                continue
            steps = 1 + int(4.0 * length)
            for k in range(steps + 1):
                u = x[i] + (x[j] - x[i]) * k / steps
                v = y[i] + (y[j] - y[i]) * k / steps
                column, row = int(math.floor(u)), int(math.floor(v))
                if 0 <= row < height and 0 <= column < width:
                    out[row, column] = 1


def mark_traversed(x: Floats, y: Floats, stamp: NDArray[np.int64], grid: Grid, traversed: NDArray[np.bool_]) -> None:
    """Set in `traversed` the cells where sensors were, and those between where they were at about the same time.

    Parameters
    ----------
    x, y : float64, shape (N,)
        Of the sensors, in the map frame, metres.
    stamp : int64, shape (N,)
        Nanoseconds.
    grid : Grid
    traversed : bool, shape `grid.shape`
    """
    order = np.argsort(stamp, kind='stable')
    u, v = x[order] / grid.resolution - grid.column, y[order] / grid.resolution - grid.row
    _mark(u, v, stamp[order], LONGEST_STEP / grid.resolution, traversed.view(np.uint8))


def traversed_cells(readings: Readings, grid: Grid) -> NDArray[np.bool_]:
    """Return which cells lie where sensors were, or between where they were about then, shape `grid.shape`."""
    out = np.zeros(grid.shape, np.bool_)
    mark_traversed(readings.x, readings.y, readings.stamp, grid, out)
    return out
