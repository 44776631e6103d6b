"""Whether a map is to be believed: most readings should have a likelier cause in it than chance."""

from __future__ import annotations

import numpy as np

from ..core.maps import MapSet

TOO_MANY = 0.5
"""Share of unexplained readings from which on the map is doubted."""

ENOUGH = 20
"""Readings below which nothing can be said."""


def doubt(maps: MapSet) -> str:
    """Return why the maps should not be trusted; empty if nothing speaks against them."""
    count, unexplained = len(maps.readings), int(np.count_nonzero(maps.unexplained))
    if count < ENOUGH or unexplained <= TOO_MANY * count:
        return ''
    return (
        f'{unexplained} of {count} readings have chance as their likeliest cause: the map does not explain what was '
        f'measured; are the poses of the sensors, odometry and the field of view right?'
    )
