"""What is to be said of a map with its results: whether it explains the readings, and whether it knows them all."""

from __future__ import annotations

import numpy as np

from ..core.maps.map_set import MapSet

TOO_MANY = 0.5
"""Share of unexplained readings from which on the map is doubted."""

ENOUGH = 20
"""Readings below which nothing can be said."""


def quality_warning(maps: MapSet) -> str:
    """Return why the maps should not be trusted; empty if nothing speaks against them."""
    count, unexplained = len(maps.readings), int(np.count_nonzero(maps.unexplained))
    if count < ENOUGH or unexplained <= TOO_MANY * count:
        return ''
    return (
        f'{unexplained} of {count} readings have chance as their likeliest cause: the map does not explain what was '
        f'measured; are the poses of the sensors, odometry and the field of view right?'
    )


def thinned(used: int, accepted: int) -> str:
    """Return what is to be told where `max_readings` let EM have only `used` of the readings; empty otherwise."""
    if used >= accepted:
        return ''
    return (
        f'EM maps from {used} of {accepted} readings (max_readings): where a sensor looked often from one place in one '
        f'direction, the oldest went'
    )
