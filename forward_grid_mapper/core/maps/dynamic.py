"""Dynamic objects: echoes of people and other objects that moved away, in space that is free by other readings.

The maximum likelihood map explains such echoes as random measurements. They are counted in the free cells in which they
end: a person who stood for a while appears as a patch of counts, a stray echo as a thin arc of ones.
"""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import NDArray

from ..runtime.jit import allocating_kernel
from ..sensor.cone_table import Cones, walk_resized
from ..sensor.forward_model import ForwardModel


@allocating_kernel
def _count(cones: Cones, unexplained: Any, out: Any) -> None:
    """Add 1 to the cells within σ of the range of each unexplained echo."""
    flat = out.ravel()
    cells, distances = np.empty(1024, np.int32), np.empty(1024, np.float64)
    for t in range(len(cones)):
        reading = cones[t]
        if not unexplained[t] or reading.z >= reading.z_max:
            continue
        n, cells, distances = walk_resized(cones, t, out.shape, cells, distances)
        for k in range(n):
            if abs(distances[k] - reading.z) <= reading.sigma:
                flat[cells[k]] += 1.0


def dynamic_echoes(forward: ForwardModel, unexplained: NDArray[np.bool_], ml: NDArray[np.int8]) -> NDArray[np.float32]:
    """Return the number of unexplained echoes that end in each free cell of a map, shape `ml.shape`.

    Parameters
    ----------
    forward : ForwardModel
    unexplained : bool, shape (N,)
        Readings that are random measurements by the map.
    ml : int8, shape `forward.grid.shape`
        0 where free.
    """
    out = np.zeros(ml.shape, np.float32)
    _count(forward.cones, unexplained, out)
    out[ml != 0] = 0.0
    return out
