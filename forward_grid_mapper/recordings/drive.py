"""A recorded drive, from a bag or a journal: readings in the map frame, and counts of all messages."""

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
from ..core.trajectory.jumps import too_far
from ..files.quality_warning import MOST_JUMPED, alternation_warning, jumps_warning, thinned


@dataclass(frozen=True)
class Part:
    """The part of a drive to map: its start in seconds after the first message, and its duration in seconds."""

    start: float = 0.0
    duration: float = math.inf

    @property
    def whole(self) -> bool:
        """Whether it is the whole drive."""
        return self.start <= 0 and math.isinf(self.duration)

    def __str__(self) -> str:
        end = '' if math.isinf(self.duration) else f' --duration {self.duration:g}'
        return f'--start {self.start:g}{end}'

    def bounds(self, first: int) -> tuple[float, float]:
        """Return the stamps of its start and end, nanoseconds, the end excluded; `first` is the first of the drive."""
        begin = first + _nanoseconds(self.start)
        return begin, begin + _nanoseconds(self.duration)


def _nanoseconds(seconds: float) -> float:
    """Return whole nanoseconds, or what is not finite: floats are too coarse for stamps."""
    found = seconds * NANOSECONDS
    return round(found) if math.isfinite(found) else found


WHOLE = Part()


class Spans:
    """Selects the messages of a part of a drive, and records their stamps.

    Parameters
    ----------
    part : Part
        The drive begins with the first message that has a stamp.
    margin : float
        Nanoseconds before and after the part for which odometry is selected as well.

    Attributes
    ----------
    ranges, odometry, left_out : list of int
        The first and the last stamp of selected messages, and of the others; empty if there are none.
    stamped : bool
        Whether any Range message has a stamp other than 0.
    """

    def __init__(self, part: Part, margin: float) -> None:
        self._part, self._margin = part, margin
        self._bounds: tuple[float, float] | None = None
        self.ranges: list[int] = []
        self.odometry: list[int] = []
        self.left_out: list[int] = []
        self.stamped = False

    def select(self, batch: MessageBatch) -> MessageBatch:
        """Return the messages of the part."""
        ranges, odometry = batch.ranges.stamp, batch.odometry.stamp
        self.stamped |= bool(ranges.any())
        if self._part.whole:
            _widen(self.ranges, ranges)
            _widen(self.odometry, odometry)
            return batch
        if self._bounds is None and (first := _first_stamp(batch)) is not None:
            self._bounds = self._part.bounds(first)
        begin, end = self._bounds or self._part.bounds(0)
        # as integers, since floats of this size do not represent all of them
        now = np.array([begin <= stamp < end for stamp in ranges.tolist()], np.bool_)
        near = [begin - self._margin <= stamp < end + self._margin for stamp in odometry.tolist()]
        moved = np.array(near, np.bool_)
        _widen(self.ranges, ranges[now])
        _widen(self.odometry, odometry[moved])
        left_out = np.concatenate([ranges[~now], odometry[~moved]])
        _widen(self.left_out, left_out[left_out != 0] if left_out.any() else left_out)
        return batch.select(now, moved)


def _first_stamp(batch: MessageBatch) -> int | None:
    """Return the stamp of the first message that has one; the first messages of some drivers have none."""
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


class FullLiveMap:
    """The live map of all readings of a drive, if `max_readings` restricts EM to some of them.

    Without removed readings it needs no work, since the result of EM has the same live map.
    """

    def __init__(self, associator: PoseAssociator, parameters: Parameters) -> None:
        self._associator, self._live = associator, LogOddsMap(parameters)
        self._count = 0
        associator.buffer.before_thinning.append(self._add_new)

    def _add_new(self) -> None:
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
        self._add_new()
        return self._live


@dataclass(frozen=True)
class Drive:
    """Data of a bag or a journal for mapping.

    Attributes
    ----------
    associator : PoseAssociator
        With all readings in the map frame.
    source : dict
        Data for the report.
    live : FullLiveMap
    mounts : mapping of str to Pose2, optional
        If there is no recorded odometry, the poses of sensors on the robot, by frame: given ones, or of the journal.
    """

    associator: PoseAssociator
    source: dict[str, Any]
    live: FullLiveMap
    mounts: Mapping[str, Pose2] | None = None

    @property
    def path_xy(self) -> NDArray[np.float64]:
        """Path of the robot, shape (P, 2), metres."""
        return path_of(self.associator)


def path_of(associator: PoseAssociator) -> NDArray[np.float64]:
    """Return the path of the robot, shape (P, 2), metres, in order of stamps even if odometry came in another one."""
    points, record = associator.path, associator.record
    # the record begins again after the clock jumped back
    if record.late and not associator.time_jumps:
        return _path_through(record.snapshot()[1])
    return np.array(points, np.float64).reshape(-1, 2)


def _path_through(poses: NDArray[np.float64]) -> NDArray[np.float64]:
    """Return the path through poses, shape (M, 3), as the associator keeps it while they arrive."""
    path = RobotPath()
    for x, y in poses[:, :2].tolist():
        path.extend((x, y))
    return np.array(path.points, np.float64).reshape(-1, 2)


def length_of(associator: PoseAssociator) -> float:
    """Return the distance driven by the robot, metres, without jumps of odometry."""
    steps, jumped = _steps(associator)
    return _length(path_of(associator), steps[jumped])


def length_between(associator: PoseAssociator, first: int, last: int) -> float:
    """Return the distance driven between two stamps, nanoseconds, as `length_of` does for the whole drive."""
    stamp, pose = associator.record.snapshot()
    inside = (stamp >= first) & (stamp <= last)
    steps, jumped = _steps(associator)
    return _length(_path_through(pose[inside]), steps[jumped & inside[:-1] & inside[1:]])


def _length(path: NDArray[np.float64], jumps: NDArray[np.float64]) -> float:
    """Return the length of a path, shape (P, 2), without the steps that are jumps; metres."""
    return max(float(np.hypot(*np.diff(path, axis=0).T).sum() - jumps.sum()), 0.0)


def jumps_note(associator: PoseAssociator) -> list[str]:
    """Return a note if odometry jumps, for users who map without refinement; not if it seems to consist of jumps."""
    steps, jumped = _steps(associator)
    at = np.flatnonzero(jumped).tolist()
    if len(at) >= MOST_JUMPED * len(steps):
        return []
    remedy = '--refine-poses corrects this from the readings, or map only a part with --start and --duration'
    return list(filter(None, [jumps_warning(steps, at, remedy)]))


def alternation_note(associator: PoseAssociator) -> list[str]:
    """Return a warning if poses jump to another place and back, as when two sources publish alternately."""
    return list(filter(None, [alternation_warning(*associator.record.snapshot())]))


def _steps(associator: PoseAssociator) -> tuple[NDArray[np.float64], NDArray[np.bool_]]:
    """Return the distances between poses of odometry, metres, and a mask of the jumps, faster than a robot drives."""
    stamp, pose = associator.record.snapshot()
    steps: NDArray[np.float64] = np.hypot(*np.diff(pose[:, :2], axis=0).T)
    return steps, too_far(steps, np.diff(stamp) / NANOSECONDS)


def thinning_note(associator: PoseAssociator) -> list[str]:
    """Return a note if `max_readings` restricts EM to some of the readings."""
    count = len(associator.buffer)
    return list(filter(None, [thinned(min(count, associator.parameters.max_readings or count), count)]))
