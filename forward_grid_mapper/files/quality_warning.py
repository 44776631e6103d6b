"""Warnings to users: input that is wrong without an error, and readings that do not fit the map."""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from typing import Any

import numpy as np
from numpy.typing import NDArray

from ..core.common.parameters import Parameters
from ..core.common.readings import Floats, Readings, drives_of
from ..core.drive_changes import change_warnings
from ..core.drive_fit import fit_warnings
from ..core.learning.agreement import contradiction
from ..core.learning.consistency import consistency_warnings
from ..core.learning.input_warnings import input_warnings
from ..core.learning.range_warnings import STANDSTILL_STEP
from ..core.maps.map_set import MapSet
from ..core.messages.message_types import NANOSECONDS, Pose2
from ..core.trajectory.jumps import FASTEST

MANY_UNEXPLAINED = 0.5
"""Fraction of unexplained readings above which there is a warning."""

NOT_CONVERGED = 'the search ended at max_iterations before it converged; raise max_iterations'

LEAST_READINGS = 20
"""Fewest readings for a judgement."""

MOST_JUMPED = 0.1
"""Fraction of steps that are jumps, from which the poses have a wrong unit, or are not those of a robot."""

LEAST_JUMP = 0.1
"""Metres that poses of one source may jump without a motion."""

FEWEST_RETURNS = 4
"""Fewest steps to another place and back that are not regarded as outliers."""

FEW_RANDOM = 0.05
"""Random part of the echoes up to which the halves of a drive are not compared, which takes a second."""

LEAST_CONTRADICTION = 0.03
"""Least contradiction of the halves of a drive, nats an echo, for a warning; it is up to 0.025 in nearly all sound
drives, and from 0.04 on in most that are off by half a metre or more."""


def data_warnings(maps: MapSet, source: Mapping[str, Any]) -> list[str]:
    """Return all faults of the readings of a map, each with its remedy.

    Parameters
    ----------
    maps : MapSet
    source : mapping
        Of which `extrinsics` is used, the poses of the sensors that are fixed to the robot by `frame_id`, and for
        several drives `drives`, a list of such mappings with `bag`, the name of the drive.
    """
    names = [str(drive['bag']) for drive in source.get('drives') or ()]
    warnings = reading_warnings(maps.readings, source, maps.parameters)
    # a drive that does not fit contradicts the others everywhere
    warnings += fit_warnings(maps, names) or change_warnings(maps, names)
    return [*warnings, *filter(None, [quality_warning(maps, bool(warnings))])]


def reading_warnings(readings: Readings, source: Mapping[str, Any], parameters: Parameters) -> list[str]:
    """Return faults of readings that do not depend on their map; `source` is as in `data_warnings`."""
    drives = source.get('drives')
    if not drives:
        return list(_of_one(readings, source.get('extrinsics') or {}, parameters))
    warnings = []
    for mine in drives_of(readings):
        drive = drives[int(mine.drive[0])]
        warnings += [f'{drive["bag"]}: {text}' for text in _of_one(mine, drive.get('extrinsics') or {}, parameters)]
    return warnings


def _of_one(readings: Readings, extrinsics: Mapping[str, Pose2], parameters: Parameters) -> Iterator[str]:
    yield from without_echoes(readings)
    yield from input_warnings(readings)
    yield from consistency_warnings(readings, extrinsics, parameters)


def without_echoes(readings: Readings) -> Iterator[str]:
    """Yield a warning if no sensor measures echoes; if only some do not, their health shows it."""
    if len(readings) >= LEAST_READINGS and not readings.echo.any():
        yield (
            f'none of {len(readings)} readings has an echo: do the sensors work, is max_range that of their data '
            'sheet in metres, and does the driver publish ranges in metres? The maps show only free space'
        )


def quality_warning(maps: MapSet, warned: bool = False) -> str:
    """Return the reason why the maps should not be trusted; '' if there is none.

    `warned` is whether there are other warnings, which may name the cause.
    """
    count, unexplained = len(maps.readings), int(np.count_nonzero(maps.unexplained))
    if count < LEAST_READINGS or unexplained <= MANY_UNEXPLAINED * count:
        return ''
    cause = (
        'odometry has one pose for all of them: does its driver fill in the pose, and not only the velocity (twist)? '
        'Are its stamps set?'
        if _from_one_place(maps.readings)
        else 'are the poses of the sensors, odometry, the field of view and changed parameters right?'
    )
    return (
        f'{unexplained} of {count} readings are most likely random measurements: the map does not fit the readings; '
        f'{"if no other warning says why: " if warned else ""}{cause}'
    )


def _from_one_place(readings: Readings) -> bool:
    """Return whether no sensor moves or turns; a small drive may change ranges too little for `input_warnings`."""
    # each reading is compared with the first of its sensor, since small steps may add up
    _, first, sensor = np.unique(readings.sensor, return_index=True, return_inverse=True)
    start = first[sensor]
    moved = np.hypot(readings.x - readings.x[start], readings.y - readings.y[start])
    turned = np.abs(np.remainder(readings.yaw - readings.yaw[start] + np.pi, 2 * np.pi) - np.pi)
    return bool(moved.max() <= STANDSTILL_STEP[0] and turned.max() <= STANDSTILL_STEP[1])


def contradiction_of_halves(maps: MapSet) -> float | None:
    """Return by how much the halves of a drive contradict each other, nats an echo; None if nearly all echoes fit."""
    echoes = int(np.count_nonzero(maps.readings.echo))
    if np.count_nonzero(maps.unexplained) <= FEW_RANDOM * echoes:
        return None
    return contradiction(maps.readings, maps.parameters)


def halves_warning(contradiction: float | None, remedy: str) -> str:
    """Return the warning about halves that contradict each other; '' if they do not.

    Parameters
    ----------
    contradiction : float or None
        As from `contradiction_of_halves`.
    remedy : str
        The option that refines the trajectory; '' if it was given and found none.
    """
    if contradiction is None or contradiction < LEAST_CONTRADICTION:
        return ''
    corrects = f'{remedy} corrects this' if remedy else 'no better trajectory was found'
    return (
        'the two halves of the drive contradict each other, so that walls may be bent or doubled: odometry drifts or '
        f'jumps ({corrects}), the robot was carried, many people or things moved, or another warning names the cause'
    )


def jumps_warning(steps: Floats, jumped: Sequence[int], remedy: str) -> str:
    """Return the warning about jumps of odometry in a map along it; '' without any.

    Parameters
    ----------
    steps : float64, shape (M,)
        Distances between poses, metres.
    jumped : sequence of int
        Which of them are jumps, in order.
    remedy : str
    """
    if not len(jumped):
        return ''
    first = jumped[0]
    often = 'once,' if len(jumped) == 1 else f'{len(jumped)} times, first'
    return (
        f'odometry jumps {often} by {steps[first]:.1f} m after {steps[:first].sum():.0f} m of driving: readings after '
        f'the jump are mapped in a wrong place; {remedy}'
    )


def alternation_warning(stamp: NDArray[np.int64], pose: Floats) -> str:
    """Return a warning if poses jump to another place and back, as when two sources publish alternately; or ''.

    Parameters
    ----------
    stamp : int64, shape (M,)
        Nanoseconds, increasing.
    pose : float64, shape (M, 3)
        x, y and yaw.
    """
    if len(stamp) < 3:
        return ''
    steps = np.hypot(*np.diff(pose[:, :2], axis=0).T)
    jumped = steps > LEAST_JUMP + FASTEST * np.diff(stamp) / NANOSECONDS
    back = np.hypot(*(pose[2:, :2] - pose[:-2, :2]).T)
    returned = jumped[:-1] & jumped[1:] & (back < np.minimum(steps[:-1], steps[1:]) / 2)
    both = np.append(returned, False) | np.append(False, returned)
    count = int(np.count_nonzero(both))
    if count < max(MOST_JUMPED * len(steps), FEWEST_RETURNS):
        return ''
    return (
        f'poses jump back and forth, by {np.median(steps[both]):.2f} m in {count} of {len(steps)} steps; do two nodes '
        'publish on this topic? Use the poses of only one of them, otherwise the map shows everything twice'
    )


def thinned(used: int, accepted: int) -> str:
    """Return a note if EM used only `used` of the readings because of `max_readings`; otherwise ''."""
    if used >= accepted:
        return ''
    return (
        f'EM used {used} of {accepted} readings (max_readings): the oldest were removed where a sensor measured often '
        'from one place in one direction'
    )
