"""The robot's poses over time, as odometry gives them, and the pose at any stamp in between."""

from __future__ import annotations

import math
from bisect import bisect_left

from .message_types import NANOSECONDS, Pose2
from .odometry_record import MOST_POSES as MOST_RECORDED
from .odometry_record import OdometryRecord

HISTORY = 600 * NANOSECONDS
"""Nanoseconds before the newest pose from which on poses are forgotten: Range messages are late by less, even where a
bag is replayed faster than they can be taken."""

MOST_POSES = 100_000
"""Poses that are kept at the most, beside the record; 15 MB."""

FEWEST = 64
"""Poses below which none is forgotten, so that trimming costs nothing where there are few."""

FASTEST = 100.0
"""Metres a second between two poses, beyond which the pose jumped: no robot drives faster."""

STRIDE = 1.0
"""Metres that the pose may jump in no time, as a localisation does that corrects itself."""


def interpolate(before: Pose2, after: Pose2, fraction: float) -> Pose2:
    """Return the pose at `fraction` of the way: position linear, yaw by the shortest way."""
    turn = math.remainder(after.yaw - before.yaw, 2 * math.pi)
    return Pose2(
        before.x + fraction * (after.x - before.x),
        before.y + fraction * (after.y - before.y),
        before.yaw + fraction * turn,
    )


class PoseHistory:
    """Poses by stamp, in nanoseconds, at most one for each stamp.

    Attributes
    ----------
    record : OdometryRecord
        Of all of them, those that were forgotten too.
    """

    def __init__(self, patient: bool = False) -> None:
        """Begin without poses; the record has no bound where there is no hurry and the drive has an end (`patient`)."""
        self.record = OdometryRecord(0 if patient else MOST_RECORDED)
        self._stamps: list[int] = []
        self._poses: list[Pose2] = []

    def __len__(self) -> int:
        return len(self._stamps)

    @property
    def newest(self) -> int | None:
        """The latest stamp; None while there is none."""
        return self._stamps[-1] if self._stamps else None

    def clear(self) -> None:
        """Forget every pose, those of the record too."""
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

    def trim(self) -> None:
        """Forget poses older than `HISTORY`, and the older half of more than `MOST_POSES`.

        They go by halves, so that the cost of a message is constant.
        """
        stamps = self._stamps
        old = bisect_left(stamps, stamps[-1] - HISTORY) if len(stamps) < MOST_POSES else MOST_POSES // 2
        if old > FEWEST and old >= len(stamps) // 2:
            del stamps[: old - 1], self._poses[: old - 1]

    def at(self, stamp: int, max_gap: float) -> Pose2 | str:
        """Return the pose at a stamp, or the reason why there is none (`rep117.REASONS`).

        A pose of the very stamp bridges no gap, but it must not have jumped from the two before: the one after it,
        which would tell a wild pose from a correction, is not known yet while a robot drives.

        Parameters
        ----------
        stamp : int
            Nanoseconds, not after `newest`.
        max_gap : float
            Seconds between two poses that may be bridged.
        """
        stamps, poses = self._stamps, self._poses
        after = bisect_left(stamps, stamp)
        exact = stamps[after] == stamp
        if exact:
            before = range(max(after - 2, 0), after)
            jumped = len(before) > 0 and all(self._jumped(k, after) for k in before)
            return 'pose_jump' if jumped else poses[after]
        if after == 0:
            return 'before_odometry'
        gap = stamps[after] - stamps[after - 1]
        if gap > max_gap * NANOSECONDS:
            return 'pose_gap'
        if self._jumped(after - 1, after):
            return 'pose_jump'
        return interpolate(poses[after - 1], poses[after], (stamp - stamps[after - 1]) / gap)

    def _jumped(self, before: int, after: int) -> bool:
        """Return whether no robot drives from one pose to another so fast."""
        seconds = (self._stamps[after] - self._stamps[before]) / NANOSECONDS
        return math.dist(self._poses[before][:2], self._poses[after][:2]) > STRIDE + FASTEST * seconds
