"""The latest poses of the robot by odometry, and interpolation at any stamp."""

from __future__ import annotations

import math
from bisect import bisect_left
from collections.abc import Sequence
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from ..common.readings import Floats
from .message_batch import REASON
from .message_types import NANOSECONDS, Pose2
from .odometry_record import MOST_POSES as MOST_RECORDED
from .odometry_record import OdometryRecord

HISTORY = 600 * NANOSECONDS
"""Poses older than the newest one by more are dropped, nanoseconds: Range messages are late by less, even if a bag is
replayed faster than they can be processed."""

MOST_POSES = 100_000
"""Most poses, besides the record; 15 MB."""

FEWEST = 64
"""If there are fewer poses, none is dropped, so that trimming costs nothing."""

FASTEST = 100.0
"""Metres a second: if two poses are farther apart, the pose jumped, since no robot drives faster."""

APART = 60 * NANOSECONDS
"""Nanoseconds between stamps from which the poses between them are not looked at."""

STRIDE = 1.0
"""Metres that the pose may jump at once, like that of a localisation which corrects itself."""


def interpolate(before: Pose2, after: Pose2, fraction: float) -> Pose2:
    """Return the pose at `fraction` between two poses: linear in position, and in yaw by the shorter turn."""
    turn = math.remainder(after.yaw - before.yaw, 2 * math.pi)
    return Pose2(
        before.x + fraction * (after.x - before.x),
        before.y + fraction * (after.y - before.y),
        before.yaw + fraction * turn,
    )


class Poses(NamedTuple):
    """Poses at many stamps.

    Attributes
    ----------
    reason : str, shape (N,)
        Why there is none (`rep117.REASONS`); '' if there is one. The other columns are valid only then.
    x, y, yaw : float64, shape (N,)
    """

    reason: NDArray[np.str_]
    x: Floats
    y: Floats
    yaw: Floats


class PoseHistory:
    """Poses by stamp, in nanoseconds, at most one for each stamp.

    Attributes
    ----------
    record : OdometryRecord
        Of all of them, including dropped ones.
    """

    def __init__(self, patient: bool = False) -> None:
        """Begin without poses; for files (`patient`), the record has no bound."""
        self.record = OdometryRecord(0 if patient else MOST_RECORDED)
        self._stamps: list[int] = []
        self._poses: list[Pose2] = []

    def __len__(self) -> int:
        return len(self._stamps)

    @property
    def newest(self) -> int | None:
        """The latest stamp; None if there is none."""
        return self._stamps[-1] if self._stamps else None

    @property
    def before(self) -> int | None:
        """The stamp before the latest; None if there is none."""
        return self._stamps[-2] if len(self._stamps) > 1 else None

    def clear(self) -> None:
        """Remove all poses, also from the record."""
        self.record.clear()
        self._stamps.clear()
        self._poses.clear()

    def add(self, stamp: int, pose: Pose2) -> None:
        """Add a pose, in any order of stamps; it replaces one of the same stamp."""
        self.record.add(stamp, pose)
        stamps, poses = self._stamps, self._poses
        if not stamps or stamp > stamps[-1]:
            stamps.append(stamp)
            poses.append(pose)
            return
        at = bisect_left(stamps, stamp)
        if stamps[at] == stamp:
            poses[at] = pose
        else:
            stamps.insert(at, stamp)
            poses.insert(at, pose)

    def drop_newest(self) -> None:
        """Remove the pose of the latest stamp, also from the record."""
        self.record.drop(self._stamps.pop())
        self._poses.pop()

    def extend(self, stamps: Sequence[int], poses: Sequence[Pose2]) -> None:
        """Add many poses, whose stamps increase and are later than all before."""
        self.record.extend(stamps, poses)
        self._stamps += stamps
        self._poses += poses

    def trim(self) -> None:
        """Remove poses older than `HISTORY`, and the older half if there are more than `MOST_POSES`.

        At least half of the poses are removed at once, so that the mean cost of a message is constant. The second
        newest stamp is used, since the newest may be wrong and far ahead.
        """
        stamps = self._stamps
        old = bisect_left(stamps, stamps[-2:][0] - HISTORY) if len(stamps) < MOST_POSES else MOST_POSES // 2
        if old > FEWEST and old >= len(stamps) // 2:
            del stamps[: old - 1], self._poses[: old - 1]

    def forget_before(self, stamp: int) -> None:
        """Remove poses before a stamp, except the last two; the record keeps them."""
        count = min(bisect_left(self._stamps, stamp), max(len(self._stamps) - 2, 0))
        del self._stamps[:count], self._poses[:count]

    def at(self, stamp: int, max_gap: float) -> Pose2 | str:
        """Return the pose at a stamp, or the reason why there is none (`rep117.REASONS`).

        A pose with exactly this stamp bridges no gap, but it must not have jumped from both poses before: the pose
        after it, which would tell an outlier from a correction, is not known yet while the robot drives.

        Parameters
        ----------
        stamp : int
            Nanoseconds, not after `newest`.
        max_gap : float
            Longest time between two poses for interpolation, seconds.
        """
        stamps, poses = self._stamps, self._poses
        after = bisect_left(stamps, stamp)
        exact = stamps[after] == stamp
        if exact:
            before = range(max(after - 2, 0), after)
            jumped = len(before) > 0 and all(self._jumped(k, after) for k in before)
            return 'pose_jump' if jumped else poses[after]
        if after == 0:
            return 'before_odometry' if stamp else 'zero_stamp'
        gap = stamps[after] - stamps[after - 1]
        if gap > max_gap * NANOSECONDS:
            return 'pose_gap'
        if self._jumped(after - 1, after):
            return 'pose_jump'
        return interpolate(poses[after - 1], poses[after], (stamp - stamps[after - 1]) / gap)

    def at_all(self, stamp: NDArray[np.int64], max_gap: float) -> Poses:
        """Apply `at` to many stamps, shape (N,)."""
        # a driver whose stamps are zero, or late by an hour, must not make each call look at all poses until now
        order = np.argsort(stamp, kind='stable')
        found = Poses(np.zeros(len(stamp), REASON), *np.zeros((3, len(stamp))))
        for which in np.split(order, np.flatnonzero(np.diff(stamp[order]) > APART) + 1):
            if len(which):
                for column, values in zip(found, self._at_near(stamp[which], max_gap), strict=True):
                    column[which] = values
        return found

    def _at_near(self, stamp: NDArray[np.int64], max_gap: float) -> Poses:
        """Apply `at` to stamps that are near each other; there must be one."""
        # of the poses before the first stamp, only the last two are needed
        begin = max(bisect_left(self._stamps, int(stamp.min())) - 2, 0)
        end = bisect_left(self._stamps, int(stamp.max())) + 1
        stamps, poses = np.array(self._stamps[begin:end], np.int64), np.array(self._poses[begin:end]).reshape(-1, 3)
        after = np.searchsorted(stamps, stamp)
        exact = stamps[after] == stamp
        reason = np.full(len(stamp), '', REASON)
        count = range(begin, begin + len(stamps))
        one = np.array([k > 0 and self._jumped(k - 1, k) for k in count], np.bool_)[after]
        which, of = np.unique(after[exact], return_inverse=True)
        two = [k + begin < 2 or self._jumped(k + begin - 2, k + begin) for k in which.tolist()]
        reason[exact] = np.where(one[exact] & np.array(two, np.bool_)[of], 'pose_jump', '')
        between = ~exact & (after + begin > 0)
        reason[~exact & ~between] = np.where(stamp[~exact & ~between] == 0, 'zero_stamp', 'before_odometry')
        last, before = after[between], after[between] - 1
        gap = stamps[last] - stamps[before]
        found = np.where(one[between], 'pose_jump', '')
        found[gap > max_gap * NANOSECONDS] = 'pose_gap'
        reason[between] = found
        turns = np.array([math.remainder(turn, 2 * math.pi) for turn in np.diff(poses[:, 2]).tolist()])
        part = (stamp[between] - stamps[before]) / gap
        at = poses[after]
        at[between, :2] = poses[before, :2] + part[:, None] * (poses[last, :2] - poses[before, :2])
        at[between, 2] = poses[before, 2] + part * turns[before]
        return Poses(reason, *at.T)

    def _jumped(self, before: int, after: int) -> bool:
        """Return whether no robot is fast enough to drive from one pose to another."""
        seconds = (self._stamps[after] - self._stamps[before]) / NANOSECONDS
        return math.dist(self._poses[before][:2], self._poses[after][:2]) > STRIDE + FASTEST * seconds
