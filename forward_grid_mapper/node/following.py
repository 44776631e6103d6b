"""Following in the background: online SLAM that continues the trajectory of a run."""

from __future__ import annotations

import math
from collections.abc import Callable
from typing import Any

import numpy as np
from numpy.typing import NDArray

from ..core.common.errors import Cancelled
from ..core.common.readings import Readings
from ..core.common.words import counted
from ..core.messages.message_types import Pose2
from ..core.trajectory.correction import Correction
from ..core.trajectory.following import Follower
from ..core.trajectory.windows import STILL, Odometry
from .background import Inbox, Worker


class Following:
    """Runs a `Follower` in a thread. The executor owns it; its methods return at once.

    Attributes
    ----------
    follower : Follower or None
        None if no trajectory is followed; the thread changes it.
    """

    def __init__(self, log: Any, inbox: Inbox, changed: Callable[[Correction], object]) -> None:
        """Prepare; the executor calls `changed` with each new correction."""
        self.follower: Follower | None = None
        self.worker = Worker('following', log.error)
        self._log, self._inbox, self._changed = log, inbox, changed
        self._seen: Pose2 | None
        self._busy, self._ended, self._seen = False, False, None

    @property
    def obstacle(self) -> str:
        """The reason why following ended, in words; '' while it continues, or if it never began."""
        return self.follower.obstacle if self.follower else ''

    def begin(self, follower: Follower | None) -> None:
        """Replace the follower; None to end."""
        self.cancel()
        self.follower, self._busy, self._ended, self._seen = follower, False, False, None
        self._say()

    def offer(
        self, at: Pose2, drive: Callable[[], tuple[Readings, tuple[NDArray[np.int64], NDArray[np.float64]]]]
    ) -> None:
        """Follow the drive so far, unless the thread is busy or the robot has not moved; called often.

        Parameters
        ----------
        at : Pose2
            The newest pose of odometry.
        drive : callable
            Called if it is followed; returns all readings that are held, as odometry placed them, and odometry: stamps,
            int64, shape (M,), and poses, float64, shape (M, 3).
        """
        follower = self.follower
        if follower is None or self._busy or follower.obstacle or not self._moved(at):
            return
        readings, odometry = drive()
        self._busy, self._seen = True, at

        def work() -> None:
            try:
                follower.follow(readings, Odometry(*odometry))
            except Cancelled:
                return
            self._inbox.put(lambda: self._take(follower))

        def failed(why: str) -> None:
            follower.obstacle = why
            self._inbox.put(lambda: self._take(follower))

        self.worker.put(work, failed)

    def end(self, why: str) -> None:
        """End following until the next `begin`, for a reason in words; the result of the current work is dropped."""
        follower = self.follower
        if follower is not None and not follower.obstacle:
            follower.cancel()
            follower.obstacle, self._ended = why, True
            self._say()

    def cancel(self) -> None:
        """Cancel the current work; its result is dropped."""
        if self.follower is not None:
            self.follower.cancel()
            self.follower = None

    def close(self, seconds: float) -> None:
        """Cancel, and wait at most this many seconds for the end of the thread."""
        self.cancel()
        self.worker.close(seconds)

    def values(self) -> dict[str, str]:
        """Return values for diagnostics."""
        follower = self.follower
        if follower is None:
            return {}
        said = f'{counted(follower.windows, "window")}, {counted(follower.places, "place")} recognised'
        if follower.kept:
            said += '; the last correction is kept, since it predicts the readings better'
        return {'followed since the latest run': f'{said}; ended: {follower.obstacle}' if follower.obstacle else said}

    def _moved(self, at: Pose2) -> bool:
        """Return whether the robot has moved; odometry of a robot that stands may still be noisy."""
        seen = self._seen
        turn = 0.0 if seen is None else math.remainder(at.yaw - seen.yaw, math.tau)
        return seen is None or math.dist(at[:2], seen[:2]) >= STILL or abs(turn) >= STILL

    def _take(self, follower: Follower) -> None:
        if follower is self.follower and not self._ended:
            self._busy = False
            self._changed(follower.correction)
            self._say()

    def _say(self) -> None:
        if self.obstacle:
            self._log.warning(f'map to odom is no longer followed until the next run_em: {self.obstacle}')
