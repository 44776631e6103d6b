"""Cells that the robot traversed: where its sensors were, and between them, is no obstacle.

Lines between sensors across the robot cover its middle, even before it has moved.
"""

from __future__ import annotations

import math
from typing import Any

import numpy as np
from numpy.typing import NDArray

from ..common.grid import Grid
from ..common.readings import Floats, Readings, drives_of
from ..runtime.jit import kernel

LONGEST_PAUSE = 500_000_000
"""Longest time between two readings that a line joins, nanoseconds; after a longer one the path is unknown."""

LONGEST_STEP = 0.8
"""Longest line between the sensors of two readings, metres: a robot at 1.6 m/s drives so far in `LONGEST_PAUSE`. More
is a jump of the odometry, unless the sensors are far apart on a large robot."""

LARGEST_ROBOT = 5.0
"""Largest distance between two sensors of one robot, metres: those in the bumpers of a car. It limits the lines even if
the readings suggest a larger robot."""

LEAST_MEETINGS = 3
"""Fewest times that two sensors were read shortly after each other for their distance to be known: the median of three
is right even if odometry jumped once in between."""

MEANWHILE = 0.1
"""Metres that a robot drives between readings of two sensors (at 1 m/s in 0.1 s); their distance may appear shorter by
this."""

STRIDES = (0, 1, 2, 4, 8, 16)
"""A line is drawn from the sensor of each reading to that of the reading this many later: itself, the next one, and
others across the robot."""


@kernel
def _mark(x: Any, y: Any, stamp: Any, longest: float, corner: Any, out: Any) -> None:
    """Set the cells of each point, and those on the lines from it to the points `STRIDES` later that are near enough.

    `x`, `y` and `longest` are in cells of the lattice, and `stamp` increases. `corner` is the row and the column of the
    lattice at which `out` begins, so that the result does not depend on the grid.
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
    """Return the longest line between the sensors of two readings, metres.

    It is `LONGEST_STEP`, or the distance of the two sensors that are farthest apart on the robot, if that is more: for
    each pair of sensors, the median distance when one was read shortly after the other, and the largest of these.
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
        # then no median can be larger; this is so for most robots
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
    """Set in `traversed` the cells where sensors were, and those between sensors at about the same time.

    Parameters
    ----------
    x, y : float64, shape (N,)
        Positions of the sensors in the map frame, metres.
    stamp : int64, shape (N,)
        Nanoseconds.
    grid : Grid
    traversed : bool, shape `grid.shape`
    longest : float
        From `longest_step`, metres.
    """
    order = np.argsort(stamp, kind='stable')
    u, v = x[order] / grid.resolution, y[order] / grid.resolution
    corner = int(grid.row), int(grid.column)
    _mark(u, v, stamp[order], longest / grid.resolution, corner, traversed.view(np.uint8))


def traversed_cells(readings: Readings, grid: Grid) -> NDArray[np.bool_]:
    """Return which cells sensors were in, or between sensors at about the same time, shape `grid.shape`."""
    out = np.zeros(grid.shape, np.bool_)
    # drive by drive: no line may join different robots or days
    for drive in drives_of(readings):
        mark_traversed(drive.x, drive.y, drive.stamp, grid, out, longest_step(drive))
    return out
