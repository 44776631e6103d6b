"""Agreement of the two halves of a drive: with odometry that drifts, they contradict each other."""

from __future__ import annotations

import numpy as np

from ..common.parameters import Parameters
from ..common.readings import Readings
from .trial_maps import coarse_parameters, randomly_thinned, trial_map

MOST, ENOUGH = 8000, 1000
"""Most readings that are used; with fewer than the second, nothing can be said."""


def contradiction(readings: Readings, parameters: Parameters) -> float:
    """Return by how much better maps of the two halves of a drive explain their echoes than one map, nats an echo.

    A map of its own fits each half a little better anyway, and much better if the halves do not agree. If no place is
    seen in both halves, nothing is contradicted. Readings without an echo do not count: smooth walls and small things
    are heard from one side and not from the other, and with exact poses most of the difference comes from this.
    """
    readings = randomly_thinned(readings.select(np.argsort(readings.stamp, kind='stable')), MOST)
    echoes, middle = int(np.count_nonzero(readings.echo)), len(readings) // 2
    if len(readings) < ENOUGH or not echoes:
        return 0.0
    p = coarse_parameters(parameters, readings)
    parts = (readings.select(slice(middle)), readings.select(slice(middle, None)))
    return (sum(trial_map(part, p).echoes for part in parts) - trial_map(readings, p).echoes) / echoes
