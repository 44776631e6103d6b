"""What users are warned of: input that is wrong without an error, and readings that do not fit the map."""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from typing import Any

import numpy as np

from ..core.common.parameters import Parameters
from ..core.common.readings import Readings, drives_of
from ..core.drive_changes import change_warnings
from ..core.drive_fit import fit_warnings
from ..core.learning.consistency import consistency_warnings
from ..core.learning.input_warnings import input_warnings
from ..core.maps.map_set import MapSet
from ..core.messages.message_types import Pose2

TOO_MANY = 0.5
"""Fraction of unexplained readings above which a warning is due."""

NOT_CONVERGED = 'the search ended at max_iterations before it converged; raise max_iterations'

ENOUGH = 20
"""Readings below which nothing can be said."""


def data_warnings(maps: MapSet, source: Mapping[str, Any]) -> list[str]:
    """Return all that is wrong with the readings of a map, each with its remedy.

    Parameters
    ----------
    maps : MapSet
    source : mapping
        Of which `extrinsics` counts, the poses of the sensors that are fixed to the robot by `frame_id`, and of several
        drives `drives`, a list of such mappings with `bag`, the name of the drive.
    """
    names = [str(drive['bag']) for drive in source.get('drives') or ()]
    return [
        *reading_warnings(maps.readings, source, maps.parameters),
        # a drive that fits nowhere contradicts the others everywhere
        *(fit_warnings(maps, names) or change_warnings(maps, names)),
        *filter(None, [quality_warning(maps)]),
    ]


def reading_warnings(readings: Readings, source: Mapping[str, Any], parameters: Parameters) -> list[str]:
    """Return what is wrong with readings whatever their map; `source` is as in `data_warnings`."""
    drives = source.get('drives')
    if not drives:
        return list(_of_one(readings, source.get('extrinsics') or {}, parameters))
    told = []
    for mine in drives_of(readings):
        drive = drives[int(mine.drive[0])]
        told += [f'{drive["bag"]}: {text}' for text in _of_one(mine, drive.get('extrinsics') or {}, parameters)]
    return told


def _of_one(readings: Readings, extrinsics: Mapping[str, Pose2], parameters: Parameters) -> Iterator[str]:
    yield from deaf(readings)
    yield from input_warnings(readings)
    yield from consistency_warnings(readings, extrinsics, parameters)


def deaf(readings: Readings) -> Iterator[str]:
    """Yield a warning where no sensor hears anything; where only one does not, its health tells."""
    if len(readings) >= ENOUGH and not readings.echo.any():
        yield (
            f'none of {len(readings)} readings has an echo: do the sensors work, is max_range that of their data '
            'sheet in metres, and does the driver publish ranges in metres? The maps show only free space'
        )


def quality_warning(maps: MapSet) -> str:
    """Return why the maps should not be trusted; empty if nothing speaks against them."""
    count, unexplained = len(maps.readings), int(np.count_nonzero(maps.unexplained))
    if count < ENOUGH or unexplained <= TOO_MANY * count:
        return ''
    return (
        f'{unexplained} of {count} readings are most likely random measurements: the map does not fit the readings; '
        'are the poses of the sensors, odometry, the field of view and changed parameters right?'
    )


def thinned(used: int, accepted: int) -> str:
    """Return a note where `max_readings` let EM have only `used` of the readings; empty otherwise."""
    if used >= accepted:
        return ''
    return (
        f'EM used {used} of {accepted} readings (max_readings): the oldest were removed where a sensor measured often '
        'from one place in one direction'
    )
