"""The distance driven by odometry, and its jumps."""

from __future__ import annotations

import math
from typing import NamedTuple

import numpy as np

from ..core.messages.message_types import Pose2
from ..core.messages.odometry_record import OdometryRecord
from ..core.trajectory.jumps import MOST_JUMPS, jumps, may_jump
from ..core.trajectory.windows import STILL, Odometry
from ..files.quality_warning import alternation_warning, jumps_warning

RECENT = 60_000_000_000
"""Nanoseconds of odometry before the last pose, from which the usual distance between poses follows."""


class Jump(NamedTuple):
    """A jump of odometry: the stamp after it, nanoseconds; its size, and the distance driven before it, metres."""

    stamp: int
    far: float
    driven: float

    def __str__(self) -> str:
        return (
            f'odometry jumped by {self.far:.1f} m: the pose of the robot on the map is unknown until run_em has found '
            'it, and new readings are mapped with wrong poses; if the robot was carried away (kidnapped), call reset'
        )


def jump_warnings(odometry: Odometry) -> list[str]:
    """Return a warning if odometry jumps, for maps along it; if it seems to consist of jumps, only if to and fro."""
    if alternation := alternation_warning(odometry.stamp, odometry.pose):
        return [alternation]
    at = jumps(odometry)
    if len(at) > MOST_JUMPS:
        return []
    steps = np.hypot(*np.diff(odometry.pose[:, :2], axis=0).T)
    remedy = 'set refine_poses, which corrects this from the readings, or call reset after a jump'
    return list(filter(None, [jumps_warning(steps, (at - 1).tolist(), remedy)]))


class Distance:
    """The distance driven in a drive, up to the last pose added.

    Attributes
    ----------
    driven : float
        Metres, without jumps, and without noise of odometry while the robot stands.
    jump : Jump or None
        The last jump, until it is explained.
    """

    def __init__(self, record: OdometryRecord) -> None:
        """Begin a drive; `record` has all poses of odometry, of which only some are added."""
        self._record = record
        self.driven = 0.0
        self.forget()

    def forget(self) -> None:
        """Forget the last pose and jumps, as after a jump of the clock; the distance driven remains."""
        self._newest: tuple[int, Pose2] | None = None
        self._counted: Pose2 | None = None
        self.jump: Jump | None = None

    def explain(self, stamp: int) -> None:
        """Forget a jump up to a stamp, nanoseconds, since a run has used the odometry after it."""
        if self.jump is not None and self.jump.stamp <= stamp:
            self.jump = None

    def add(self, stamp: int, pose: Pose2) -> Jump | None:
        """Add the distance to the newest pose of odometry; return a new jump before it, if any.

        Many poses may have come since the last one that was added.
        """
        before, self._newest = self._newest or (stamp, pose), (stamp, pose)
        if may_jump(Odometry(*self._record.since(before[0]))) and (jump := self._jump_after(before[0])):
            known, self.jump, self._counted = self.jump is not None, jump, pose
            return None if known else jump
        # odometry of a robot that stands may be noisy: it would drive 100 m in an hour at a dock
        self._counted = self._counted or before[1]
        far = math.dist(self._counted[:2], pose[:2])
        if far >= STILL:
            self.driven, self._counted = self.driven + far, pose
        return None

    def _jump_after(self, before: int) -> Jump | None:
        """Return the last jump after a stamp, and add the distance driven since then; None if there is no jump."""
        recent = Odometry(*self._record.since(before - RECENT))
        first, at = int(np.searchsorted(recent.stamp, before)), jumps(recent)
        at = at[at > first]
        if not len(at):
            return None
        steps = np.hypot(*np.diff(recent.pose[:, :2], axis=0).T)
        far, last = float(steps[at[-1] - 1]), int(at[-1])
        steps[:first], steps[at - 1] = 0.0, 0.0
        begin, self.driven = self.driven + float(steps[:last].sum()), self.driven + float(steps.sum())
        return Jump(int(recent.stamp[last]), far, begin)
