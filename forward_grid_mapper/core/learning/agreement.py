"""Agreement of the two halves of a drive: with odometry that drifts, they contradict each other."""

from __future__ import annotations

import numpy as np

from ..common.parameters import Parameters
from ..common.readings import Readings
from .trial_maps import coarse_parameters, randomly_thinned, trial_map

MOST, ENOUGH = 8000, 1000
"""Most readings that are used; with fewer than the second, nothing can be said."""


def contradiction(readings: Readings, parameters: Parameters) -> float:
    """Return by how much better maps of the two halves of a drive explain their readings than one map, nats an echo.

    A map of its own fits each half a little better anyway, and much better if the halves do not agree. If no place is
    seen in both halves, nothing is contradicted.
    """
    readings = randomly_thinned(readings.select(np.argsort(readings.stamp, kind='stable')), MOST)
    echoes, middle = int(np.count_nonzero(readings.echo)), len(readings) // 2
    if len(readings) < ENOUGH or not echoes:
        return 0.0
    p = coarse_parameters(parameters, readings)
    parts = (readings.select(slice(middle)), readings.select(slice(middle, None)))
    apart = sum(float(trial_map(part, p).blocks.sum()) for part in parts)
    return (apart - float(trial_map(readings, p).blocks.sum())) / echoes
