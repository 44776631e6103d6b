"""What was taken out of the map: echoes of people and other things that moved on, where other readings went through.

An echo that the map puts down to chance has left no mark in it. Where such echoes end in space that is free, they are
counted cell by cell: a person who stood about shows as a patch of counts, a stray echo as a thin arc of ones.
"""

from __future__ import annotations

import math
from typing import Any

import numpy as np
from numpy.typing import NDArray

from ..common.grid import Grid
from ..common.parameters import ModelParameters
from ..common.readings import Readings
from ..runtime.jit import kernel
from ..sensor.cone import row_runs
from ..sensor.cone_table import Cones, cone_of, cone_table


@kernel
def _count(cones: Cones, unexplained: Any, nearest: bool, out: Any) -> None:
    """Add 1 to the cells that are at most σ from the range of each unexplained echo."""
    height, width = out.shape
    for t in range(len(cones)):
        reading = cones[t]
        if not unexplained[t] or reading.z >= reading.z_max:
            continue
        cone = cone_of(reading, nearest)
        for row in range(max(cone.bottom, 0), min(cone.top, height - 1) + 1):
            v = row + 0.5 - cone.y
            a, b, c, d = row_runs(cone, row, reading.reach, width, nearest)
            for first, last in ((a, b), (c, d)):
                for column in range(first, last + 1):
                    if abs(math.hypot(column + 0.5 - cone.x, v) - reading.z) <= reading.sigma:
                        out[row, column] += 1.0


def dynamic_echoes(
    readings: Readings, unexplained: NDArray[np.bool_], grid: Grid, ml: NDArray[np.int8], model: ModelParameters
) -> NDArray[np.float32]:
    """Return how many echoes that the map does not evaluate end in each of its free cells, shape `grid.shape`.

    Parameters
    ----------
    readings : Readings
    unexplained : bool, shape (N,)
        Readings that the map puts down to chance.
    grid : Grid
    ml : int8, shape `grid.shape`
        0 where free.
    model : ModelParameters
    """
    out = np.zeros(grid.shape, np.float32)
    _count(cone_table(readings, grid, model), unexplained, model.cell_distance == 'nearest', out)
    out[ml != 0] = 0.0
    return out
