"""What users are warned of: input that is wrong without an error, and readings that do not fit the map."""

from __future__ import annotations

from collections.abc import Mapping

import numpy as np

from ..core.learning.consistency import consistency_warnings
from ..core.learning.input_warnings import input_warnings
from ..core.maps.map_set import MapSet
from ..core.messages.message_types import Pose2

TOO_MANY = 0.5
"""Fraction of unexplained readings above which a warning is due."""

ENOUGH = 20
"""Readings below which nothing can be said."""


def data_warnings(maps: MapSet, extrinsics: Mapping[str, Pose2]) -> list[str]:
    """Return all that is wrong with the readings of a map, each with its remedy.

    Parameters
    ----------
    maps : MapSet
    extrinsics : mapping
        Poses of the sensors that are fixed to the robot, by `frame_id`.
    """
    return [
        *input_warnings(maps.readings),
        *consistency_warnings(maps.readings, extrinsics, maps.parameters),
        *filter(None, [quality_warning(maps)]),
    ]


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
