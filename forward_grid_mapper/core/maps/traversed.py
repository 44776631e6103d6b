"""Cells that a robot traversed: where its sensors were, and between, nothing stands.

Lines between sensors across the robot fill its middle, also before it has moved.
"""

from __future__ import annotations

import math
from typing import Any

import numpy as np
from numpy.typing import NDArray

from ..common.grid import Grid
from ..common.readings import Readings, drives_of
from ..runtime.jit import kernel
from ..sensor.cone_table import Floats

LONGEST_PAUSE = 500_000_000
"""Nanoseconds between two readings, beyond which nobody knows what the robot did."""

LONGEST_STEP = 0.8
"""Metres between the places of two readings that a line joins: a robot at 1.6 m/s drives so far in `LONGEST_PAUSE`. A
longer way is a jump of the odometry, unless it is from one sensor to another of a large robot."""

LARGEST_ROBOT = 5.0
"""Metres between two sensors of one robot, at most: those in the bumpers of a car. It bounds the lines that are drawn
whatever the readings say of the size of the robot."""

LEAST_MEETINGS = 3
"""Times that two sensors must have been read one shortly after the other for their distance to be known: the median of
three is right though the robot jumped once meanwhile."""

MEANWHILE = 0.1
"""Metres that a robot drives between readings of two of its sensors (at 1 m/s in 0.1 s), by which the distance of the
sensors may seem shorter than it is."""

STRIDES = (0, 1, 2, 4, 8, 16)
"""How many readings later the sensor is to which a line is drawn: itself, the next one, and others across the robot."""


@kernel
def _mark(x: Any, y: Any, stamp: Any, longest: float, corner: Any, out: Any) -> None:
    """Set the cells of each point, and those on the lines from it to the points `STRIDES` later that are near enough.

    `x`, `y` and `longest` are in cells of the lattice, `stamp` is in order, and `corner` is the row and the column of
    the lattice with which `out` begins: so what is marked does not depend on it.
    """
    height, width = out.shape
    bottom, left = corner
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
                column, row = int(math.floor(u)) - left, int(math.floor(v)) - bottom
                if 0 <= row < height and 0 <= column < width:
                    out[row, column] = 1


def longest_step(readings: Readings) -> float:
    """Return how many metres may lie between the places of two readings that a line joins.

    `LONGEST_STEP`, or the distance of the two sensors of the robot that are the farthest apart, where this is more: the
    largest of the medians, over pairs of sensors, of how far apart they were when one was read shortly after the other.
    """
    count = len(readings.sensor_names) or int(readings.sensor.max(initial=0)) + 1
    order = np.argsort(readings.stamp, kind='stable')
    x, y, stamp, sensor = readings.x[order], readings.y[order], readings.stamp[order], readings.sensor[order]
    pairs: list[NDArray[np.int64]] = []
    apart: list[Floats] = []
    for stride in STRIDES[1:]:
        one, other = sensor[:-stride].astype(np.int64), sensor[stride:].astype(np.int64)
        distance = np.hypot(x[stride:] - x[:-stride], y[stride:] - y[:-stride])
        near = (one != other) & (stamp[stride:] - stamp[:-stride] <= LONGEST_PAUSE) & (distance <= LARGEST_ROBOT)
        pairs.append((np.minimum(one, other) * count + np.maximum(one, other))[near])
        apart.append(distance[near])
    if max(float(each.max(initial=0.0)) for each in apart) + MEANWHILE <= LONGEST_STEP:
        # so is every median; of most robots it is so
        return LONGEST_STEP
    pair, distance = np.concatenate(pairs), np.concatenate(apart)
    by_pair = np.lexsort((distance, pair))
    _, first, times = np.unique(pair[by_pair], return_index=True, return_counts=True)
    known = times >= LEAST_MEETINGS
    medians = distance[by_pair][(first + (times - 1) // 2)[known]]
    return max(LONGEST_STEP, float(medians.max(initial=0.0)) + MEANWHILE)


def mark_traversed(
    x: Floats,
    y: Floats,
    stamp: NDArray[np.int64],
    grid: Grid,
    traversed: NDArray[np.bool_],
    longest: float = LONGEST_STEP,
) -> None:
    """Set in `traversed` the cells where sensors were, and those between where they were at about the same time.

    Parameters
    ----------
    x, y : float64, shape (N,)
        Of the sensors, in the map frame, metres.
    stamp : int64, shape (N,)
        Nanoseconds.
    grid : Grid
    traversed : bool, shape `grid.shape`
    longest : float
        That of `longest_step`, metres.
    """
    order = np.argsort(stamp, kind='stable')
    u, v = x[order] / grid.resolution, y[order] / grid.resolution
    corner = int(grid.row), int(grid.column)
    _mark(u, v, stamp[order], longest / grid.resolution, corner, traversed.view(np.uint8))


def traversed_cells(readings: Readings, grid: Grid) -> NDArray[np.bool_]:
    """Return which cells lie where sensors were, or between where they were about then, shape `grid.shape`."""
    out = np.zeros(grid.shape, np.bool_)
    # no line leads from one robot to another, nor from one day to the next
    for drive in drives_of(readings):
        mark_traversed(drive.x, drive.y, drive.stamp, grid, out, longest_step(drive))
    return out
