"""What a recorded drive gives, wherever it was recorded: readings in the map frame, and an account of all messages."""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from ..core.common.parameters import Parameters
from ..core.maps.log_odds_map import LogOddsMap
from ..core.maps.map_set import MapSet
from ..core.messages.message_batch import MessageBatch
from ..core.messages.message_types import NANOSECONDS, Pose2
from ..core.messages.pose_association import PoseAssociator
from ..core.messages.robot_path import RobotPath
from ..core.trajectory.jumps import FASTEST, too_far
from ..files.quality_warning import thinned

MOST_JUMPED = 0.1
"""Part of the steps that are jumps, from which on poses are in another unit, or none of a robot."""

LEAST_JUMP = 0.1
"""Metres that poses of one source may be off without any motion."""

FEWEST_RETURNS = 4
"""Steps to and fro below which they may be outliers."""


@dataclass(frozen=True)
class Part:
    """Which part of a drive to map: seconds after its first message, and seconds from there on."""

    start: float = 0.0
    duration: float = math.inf

    @property
    def whole(self) -> bool:
        """Whether that is all of the drive."""
        return self.start <= 0 and math.isinf(self.duration)

    def __str__(self) -> str:
        end = '' if math.isinf(self.duration) else f' --duration {self.duration:g}'
        return f'--start {self.start:g}{end}'

    def bounds(self, first: int) -> tuple[float, float]:
        """Return the stamps, nanoseconds, that it lies between, the last one excluded; `first` is the drive's."""
        begin = first + _nanoseconds(self.start)
        return begin, begin + _nanoseconds(self.duration)


def _nanoseconds(seconds: float) -> float:
    """Return seconds as a whole number, since a stamp as a float is off by up to 128 and may be after the message."""
    found = seconds * NANOSECONDS
    return round(found) if math.isfinite(found) else found


WHOLE = Part()


class Spans:
    """Takes the messages of a part of a drive, and tells which stamps there are.

    Parameters
    ----------
    part : Part
        The drive begins with the first message that has a stamp.
    margin : float
        Nanoseconds before and after the part whose odometry is taken as well.

    Attributes
    ----------
    ranges, odometry, left_out : list of int
        The first and the last stamp of what is taken, and of what is not; empty where there is nothing.
    """

    def __init__(self, part: Part, margin: float) -> None:
        self._part, self._margin = part, margin
        self._bounds: tuple[float, float] | None = None
        self.ranges: list[int] = []
        self.odometry: list[int] = []
        self.left_out: list[int] = []

    def taken(self, batch: MessageBatch) -> MessageBatch:
        """Return the messages that are of the part."""
        ranges, odometry = batch.ranges.stamp, batch.odometry.stamp
        if self._part.whole:
            _widen(self.ranges, ranges)
            _widen(self.odometry, odometry)
            return batch
        if self._bounds is None and (first := _first_stamp(batch)) is not None:
            self._bounds = self._part.bounds(first)
        begin, end = self._bounds or self._part.bounds(0)
        # as whole numbers, which floats of this size are not all
        now = np.array([begin <= stamp < end for stamp in ranges.tolist()], np.bool_)
        near = [begin - self._margin <= stamp < end + self._margin for stamp in odometry.tolist()]
        moved = np.array(near, np.bool_)
        _widen(self.ranges, ranges[now])
        _widen(self.odometry, odometry[moved])
        left_out = np.concatenate([ranges[~now], odometry[~moved]])
        _widen(self.left_out, left_out[left_out != 0] if left_out.any() else left_out)
        return batch.select(now, moved)


def _first_stamp(batch: MessageBatch) -> int | None:
    """Return the stamp of the first message that has one; a driver may not have filled in that of the very first."""
    found = []
    for kind in batch:
        stamped = np.flatnonzero(kind.stamp)
        if len(stamped):
            found.append((int(kind.place[stamped[0]]), int(kind.stamp[stamped[0]])))
    return min(found)[1] if found else None


def _widen(span: list[int], stamps: NDArray[np.int64]) -> None:
    if len(stamps):
        both = [*span, int(stamps.min()), int(stamps.max())]
        span[:] = min(both), max(both)


class LogOddsMapOfAll:
    """The live map of all readings of a drive, where `max_readings` lets EM have only some.

    It costs nothing where no reading goes, since EM's result has the same live map then.
    """

    def __init__(self, associator: PoseAssociator, parameters: Parameters) -> None:
        self._associator, self._live = associator, LogOddsMap(parameters)
        self._count = 0
        associator.buffer.before_thinning.append(self._look)

    def _look(self) -> None:
        self._live.add(self._associator.buffer.snapshot(self._count))
        self._count = len(self._associator.buffer)

    def on(self, maps: MapSet) -> MapSet:
        """Return the maps with the live map of all readings."""
        if len(maps.readings) == len(self._associator.buffer):
            return maps
        live = self.complete()
        return maps.with_live(live.grid, live.probability())

    def complete(self) -> LogOddsMap:
        """Return the map of all readings."""
        self._look()
        return self._live


@dataclass(frozen=True)
class Drive:
    """What a bag or a journal holds for mapping.

    Attributes
    ----------
    associator : PoseAssociator
        With all readings in the map frame.
    source : dict
        What was read and rejected, for the report.
    live : LogOddsMapOfAll
    mounts : mapping of str to Pose2, optional
        Where no odometry was recorded, the poses of sensors on the robot that were given, by frame.
    """

    associator: PoseAssociator
    source: dict[str, Any]
    live: LogOddsMapOfAll
    mounts: Mapping[str, Pose2] | None = None

    @property
    def path_xy(self) -> NDArray[np.float64]:
        """Where the robot drove, shape (P, 2), metres."""
        return path_of(self.associator)


def path_of(associator: PoseAssociator) -> NDArray[np.float64]:
    """Return where the robot drove, shape (P, 2), metres: in order of stamps, where odometry came in another one."""
    points, record = associator.path, associator.record
    # a clock that jumped back has the record begin anew
    if record.late and not associator.time_jumps:
        path = RobotPath()
        for x, y in record.snapshot()[1][:, :2].tolist():
            path.extend((x, y))
        points = path.points
    return np.array(points, np.float64).reshape(-1, 2)


def length_of(associator: PoseAssociator) -> float:
    """Return the metres that the robot drove; where odometry jumps faster than a robot drives it did not."""
    whole = np.hypot(*np.diff(path_of(associator), axis=0).T).sum()
    steps, jumped = _steps(associator)
    return max(float(whole - steps[jumped].sum()), 0.0)


def jumps_note(associator: PoseAssociator) -> list[str]:
    """Return a note where odometry jumps, for those who map it as it is; not where it seems to do nothing else."""
    steps, jumped = _steps(associator)
    count = int(np.count_nonzero(jumped))
    if not 0 < count < MOST_JUMPED * len(steps):
        return []
    first = int(np.flatnonzero(jumped)[0])
    often = 'once,' if count == 1 else f'{count} times, first'
    return [
        f'odometry jumps {often} by {steps[first]:.1f} m after {steps[:first].sum():.0f} m of driving: readings after '
        'the jump are mapped in a wrong place; --refine-poses corrects this from the readings, or map only a part '
        'with --start and --duration'
    ]


def to_and_fro_note(associator: PoseAssociator) -> list[str]:
    """Return a warning where poses jump to another place and at once back, as those of two sources do in turn."""
    stamp, pose = associator.record.snapshot()
    if len(stamp) < 3:
        return []
    steps = np.hypot(*np.diff(pose[:, :2], axis=0).T)
    jumped = steps > LEAST_JUMP + FASTEST * np.diff(stamp) / NANOSECONDS
    back = np.hypot(*(pose[2:, :2] - pose[:-2, :2]).T)
    returned = jumped[:-1] & jumped[1:] & (back < np.minimum(steps[:-1], steps[1:]) / 2)
    both = np.append(returned, False) | np.append(False, returned)
    count = int(np.count_nonzero(both))
    if count < max(MOST_JUMPED * len(steps), FEWEST_RETURNS):
        return []
    return [
        f'poses jump back and forth, by {np.median(steps[both]):.2f} m in {count} of {len(steps)} steps; do two nodes '
        'publish on this topic? Record the poses of only one of them, otherwise the map shows everything twice'
    ]


def _steps(associator: PoseAssociator) -> tuple[NDArray[np.float64], NDArray[np.bool_]]:
    """Return the metres between poses of odometry, and which of these steps no robot drives."""
    stamp, pose = associator.record.snapshot()
    steps: NDArray[np.float64] = np.hypot(*np.diff(pose[:, :2], axis=0).T)
    return steps, too_far(steps, np.diff(stamp) / NANOSECONDS)


def thinning_note(associator: PoseAssociator) -> list[str]:
    """Return a note where `max_readings` lets EM have only some of the readings."""
    count = len(associator.buffer)
    return list(filter(None, [thinned(min(count, associator.parameters.max_readings or count), count)]))
