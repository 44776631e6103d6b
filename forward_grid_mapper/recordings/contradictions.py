"""Reasons against one map of several drives: other frames, other sensors, or the same drive twice."""

from __future__ import annotations

import math
from collections import Counter
from collections.abc import Callable, Hashable, Iterator, Mapping, Sequence
from typing import NamedTuple, TypeVar

import numpy as np
from numpy.typing import NDArray

from ..core.common.errors import InputError
from ..core.common.readings import Readings
from ..core.common.words import counted
from ..core.messages.message_types import Pose2
from ..core.messages.thinning import mixed, name_hashes

SAME_DRIVE_SHARE = 0.5
"""Fraction of the echoes of a drive that another drive has as well, with the same sensor, stamp and range, from which
both are the same recording. It is 0 for two drives at different times, and small for simulated ones, whose stamps begin
at the same time."""

POSITION_TOLERANCE, ANGLE_TOLERANCE = 0.01, math.radians(1.0)
"""Smallest differences of the poses of a sensor, or of its limits, that cause a warning."""

MOST_NAMED = 6
"""Most drives or sensors that a warning names."""

T = TypeVar('T')


class Described(NamedTuple):
    """Data of a drive for comparison: its name for the user, frames, sensor poses by frame, and limits by sensor."""

    name: str
    map_frame: str
    base_frame: str
    extrinsics: Mapping[str, Pose2]
    limits: Mapping[str, tuple[float, float]]


class Shared(NamedTuple):
    """Two drives, by number, that share echoes: the number of shared echoes, and the number of each."""

    one: int
    other: int
    shared: int
    echoes: tuple[int, int]

    @property
    def same(self) -> bool:
        """Whether both have only shared echoes."""
        return self.shared == self.echoes[0] == self.echoes[1]


def check_frames(drives: Sequence[Described]) -> None:
    """Check that all drives are in the same map frame.

    Raises
    ------
    InputError
        Otherwise; names the drives of each frame.
    """
    frames: dict[str, list[str]] = {}
    for drive in drives:
        frames.setdefault(drive.map_frame.lstrip('/'), []).append(drive.name)
    if len(frames) == 1:
        return
    of = '; '.join(f'{frame or "no name"}: {listed(names)}' for frame, names in frames.items())
    few = min(frames.values(), key=len)
    raise InputError(
        f'these drives are not in the same map frame ({of}), so they cannot be mapped together. Localise all of them '
        f'in one map and record that odometry (--odom-topic selects it), or leave out {listed(few)}'
    )


def shared_echoes(drives: Sequence[Readings]) -> list[Shared]:
    """Return the pairs of drives of which one shares at least `SAME_DRIVE_SHARE` of its echoes with the other."""
    echoes = [echoes_of(readings) for readings in drives]
    count = [len(hashes) for hashes in echoes]
    every = np.concatenate(echoes) if echoes else np.zeros(0, np.uint64)
    owner = np.repeat(np.arange(len(drives)), count)
    order = np.argsort(every, kind='stable')
    every, owner = every[order], owner[order]
    pairs: Counter[tuple[int, int]] = Counter()
    again = np.flatnonzero(every[1:] == every[:-1]) + 1
    begin = again[~np.isin(again - 1, again)] - 1
    for first in begin.tolist():
        last = first + 1
        while last < len(every) and every[last] == every[first]:
            for earlier in range(first, last):
                pairs[int(owner[earlier]), int(owner[last])] += 1
            last += 1
    return [
        Shared(one, other, n, (count[one], count[other]))
        for (one, other), n in sorted(pairs.items())
        if n >= max(SAME_DRIVE_SHARE * min(count[one], count[other]), 1)
    ]


def _echo_hashes(readings: Readings) -> NDArray[np.uint64]:
    """Return a hash of sensor, stamp and range of every echo."""
    heard = readings.select(readings.echo)
    return mixed(name_hashes(heard)[heard.sensor] ^ heard.stamp.view(np.uint64), heard.z)


def limits_of(readings: Readings) -> dict[str, tuple[float, float]]:
    """Return the largest range, metres, and the field of view, radians, of each sensor that has readings."""
    found = {}
    for number, name in enumerate(readings.sensor_names):
        mine = readings.sensor == number
        if mine.any():
            found[name.lstrip('/')] = (
                float(np.median(readings.z_max[mine])),
                2 * float(np.median(readings.half_angle[mine])),
            )
    return found


def echoes_of(readings: Readings) -> NDArray[np.uint64]:
    """Return the hashes of sensor, stamp and range of all echoes, sorted and unique."""
    return np.unique(_echo_hashes(readings))


def contradictions(drives: Sequence[Described]) -> list[str]:
    """Return a warning for each difference between drives of the same robot (the same base frame)."""
    warnings: list[str] = []
    robots: dict[str, list[Described]] = {}
    for drive in drives:
        robots.setdefault(drive.base_frame.lstrip('/'), []).append(drive)
    for group in robots.values():
        warnings += _poses(group)
        warnings += _limits(group)
        warnings += _missing(group)
    return warnings


def _poses(drives: Sequence[Described]) -> Iterator[str]:
    def key(pose: Pose2) -> Hashable:
        turn = math.remainder(pose.yaw, 2 * math.pi)
        return round(pose.x / POSITION_TOLERANCE), round(pose.y / POSITION_TOLERANCE), round(turn / ANGLE_TOLERANCE)

    poses = [{frame.lstrip('/'): pose for frame, pose in drive.extrinsics.items()} for drive in drives]
    for names, frames, usual, value in _differing(drives, poses, key, _same_pose):
        yield (
            f'{_is_where(frames[0], value)} in {listed(names)}, and {_at(usual)} in the other drives of this '
            f'robot{_and_more(frames)}: if this is a mistake, set --sensor {frames[0]}=x,y,yaw; if the sensor was '
            'moved between the drives, ignore this; if these are different robots, give their base frames different '
            'names'
        )


def _limits(drives: Sequence[Described]) -> Iterator[str]:
    def key(value: tuple[float, float]) -> Hashable:
        return round(value[0] / POSITION_TOLERANCE), round(value[1] / ANGLE_TOLERANCE)

    def same(one: tuple[float, float], other: tuple[float, float]) -> bool:
        return abs(one[0] - other[0]) <= POSITION_TOLERANCE and abs(one[1] - other[1]) <= ANGLE_TOLERANCE

    for names, frames, usual, value in _differing(drives, [drive.limits for drive in drives], key, same):
        yield (
            f'{frames[0]} has a range of {value[0]:.2f} m and a field of view of {math.degrees(value[1]):.0f} degrees '
            f'in {listed(names)}, and {usual[0]:.2f} m and {math.degrees(usual[1]):.0f} degrees in the other drives '
            f'of this robot{_and_more(frames)}: is it another sensor? If a driver states wrong values, set the '
            'parameters max_range or field_of_view'
        )


def _missing(drives: Sequence[Described]) -> Iterator[str]:
    have = [set(drive.limits) for drive in drives]
    usual = Counter(frame for frames in have for frame in frames)
    expected = {frame for frame, count in usual.items() if 2 * count > len(drives)}
    for drive, frames in zip(drives, have, strict=True):
        if lost := sorted(expected - frames):
            yield (
                f'{drive.name} has no reading of {listed(lost)}, as most drives of this robot have: was it switched '
                f'off, or its topic not recorded or not chosen (--range-topics)?'
            )


def _differing(
    drives: Sequence[Described],
    values: Sequence[Mapping[str, T]],
    key: Callable[[T], Hashable],
    same: Callable[[T, T], bool],
) -> Iterator[tuple[list[str], list[str], T, T]]:
    """Yield drives with unusual values, the sensors concerned, a usual value and an unusual one."""
    found: dict[tuple[str, ...], list[tuple[str, T, T]]] = {}
    for frame in sorted({frame for value in values for frame in value}):
        mine = [(drive.name, value[frame]) for drive, value in zip(drives, values, strict=True) if frame in value]
        counts = Counter(key(value) for _, value in mine)
        # the first, if several are equally frequent
        most = max(counts.values())
        usual = next(value for _, value in mine if counts[key(value)] == most)
        others = [(name, value) for name, value in mine if not same(value, usual)]
        if others:
            found.setdefault(tuple(name for name, _ in others), []).append((frame, usual, others[0][1]))
    for names, rows in found.items():
        yield list(names), [frame for frame, _, _ in rows], rows[0][1], rows[0][2]


def _same_pose(one: Pose2, other: Pose2) -> bool:
    away = math.hypot(one.x - other.x, one.y - other.y)
    return away <= POSITION_TOLERANCE and abs(math.remainder(one.yaw - other.yaw, 2 * math.pi)) <= ANGLE_TOLERANCE


def _at(pose: Pose2) -> str:
    return f'at x = {pose.x:.2f} m, y = {pose.y:.2f} m, yaw = {math.degrees(pose.yaw):.0f} degrees'


def _is_where(frame: str, pose: Pose2) -> str:
    return f'{frame} is mounted on the robot {_at(pose)}'


def _and_more(frames: Sequence[str]) -> str:
    return f' (and so on for {counted(len(frames) - 1, "more sensor")})' if len(frames) > 1 else ''


def listed(names: Sequence[str]) -> str:
    """Return a list of names in words, at most `MOST_NAMED` of them."""
    more = f' and {len(names) - MOST_NAMED} more' if len(names) > MOST_NAMED else ''
    return ', '.join(names[:MOST_NAMED]) + more
