"""What users are warned of: readings that do not fit the map, and readings that it was not made from."""

from __future__ import annotations

import numpy as np

from ..core.maps.map_set import MapSet

TOO_MANY = 0.5
"""Fraction of unexplained readings above which a warning is due."""

ENOUGH = 20
"""Readings below which nothing can be said."""


def quality_warning(maps: MapSet) -> str:
    """Return why the maps should not be trusted; empty if nothing speaks against them."""
    count, unexplained = len(maps.readings), int(np.count_nonzero(maps.unexplained))
    if count < ENOUGH or unexplained <= TOO_MANY * count:
        return ''
    return (
        f'{unexplained} of {count} readings are most likely random measurements: the map does not fit what was '
        f'measured; are the poses of the sensors, odometry and the field of view right?'
    )


def thinned(used: int, accepted: int) -> str:
    """Return a note where `max_readings` let EM have only `used` of the readings; empty otherwise."""
    if used >= accepted:
        return ''
    return (
        f'EM maps from {used} of {accepted} readings (max_readings): where a sensor looked often from one place in one '
        f'direction, the oldest went'
    )
