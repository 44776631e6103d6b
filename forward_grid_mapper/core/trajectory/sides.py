"""The side from which each surface of a local map was seen.

A wall or a shelf has two faces, and from one aisle only one of them is seen. The map says nothing about the other one.
Otherwise readings from the next aisle would be matched with the wrong face, and the trajectory would be moved by the
depth of the shelf.
"""

from __future__ import annotations

import math
from typing import Any

import numpy as np
from numpy.typing import NDArray

from ..runtime.jit import kernel
from ..sensor.cone import rows_of, runs_of
from ..sensor.cone_table import Cones, cone_of

ONE_SIDE = 0.5
"""A surface was seen from one side if the mean resultant length of the bearings of its echoes is larger. Bearings from
both sides cancel: it is not larger if a quarter of the echoes or more come from the other side."""

BEHIND = math.cos(math.radians(120.0))
"""Where the normal is unknown, rays come from behind such a surface if the cosine of their angle to the mean bearing is
smaller: this may be 45° off the normal, and rays may meet the surface at 75°."""

FARTHEST = 4.0
"""Echoes whose range differs from the distance of a cell by more σ do not come from it."""


@kernel
def add_bearings(cones: Cones, shape: tuple[int, int], occupied: Any, sums: Any, stop: Any) -> None:
    """Add the bearings of echoes as unit vectors, and their weights, to `sums`, float64, shape (3, cells).

    Only cells that are `occupied`, bool, shape (cells,), are added to. The weight is exp(−(d − z)² / 2σ²).
    """
    height, width = shape
    for t in range(len(cones)):
        if stop[0]:
            break
        reading = cones[t]
        if reading.z >= reading.z_max:
            continue
        cone = cone_of(reading)
        for row in range(*rows_of(cone, height)):
            v = row + 0.5 - cone.y
            runs = runs_of(cone, row, width)
            for first, last in ((runs.first, runs.last), (runs.first2, runs.last2)):
                for column in range(first, last + 1):
                    cell = row * width + column
                    u = column + 0.5 - cone.x
                    d = math.sqrt(u * u + v * v)
                    error = (d - reading.z) / reading.sigma
                    if occupied[cell] and d > 0.0 and abs(error) <= FARTHEST:
                        weight = math.exp(-0.5 * error * error)
                        sums[0, cell] += weight * u / d
                        sums[1, cell] += weight * v / d
                        sums[2, cell] += weight


def mean_bearings(
    cones: Cones, shape: tuple[int, int], occupied: NDArray[np.bool_], stop: NDArray[np.uint8]
) -> NDArray[np.float32]:
    """Return the mean bearing of the echoes of each occupied cell as a unit vector, float32, shape (2, cells).

    It is 0 where a surface was seen from both sides (`ONE_SIDE`), and in the other cells.

    Parameters
    ----------
    cones : records of `CONE`, shape (N,)
    shape : int, int
        Rows and columns.
    occupied : bool, shape (cells,)
    stop : uint8, shape (1,)
        Set to 1 from any thread to cancel.
    """
    sums = np.zeros((3, occupied.size))
    add_bearings(cones, shape, occupied, sums, stop)
    length = np.hypot(sums[0], sums[1])
    one_side = length > ONE_SIDE * sums[2]
    return np.where(one_side, sums[:2] / np.where(one_side, length, 1.0), 0.0).astype(np.float32)
