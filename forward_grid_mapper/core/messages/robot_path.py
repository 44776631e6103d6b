"""Where the robot drove, for pictures: a list of points that stays short however long the drive is."""

from __future__ import annotations

import math

STEP = 0.05
"""Metres between two points, as long as there are few of them: half the edge of a default cell."""

MOST_POINTS = 100_000
"""Points at the most; when there are more, every other one goes."""


class RobotPath:
    """Points (x, y) in metres, at least a step apart; the step doubles whenever there are too many."""

    def __init__(self) -> None:
        self.points: list[tuple[float, float]] = []
        self._step = STEP

    def clear(self) -> None:
        """Forget every point."""
        self.points.clear()
        self._step = STEP

    def extend(self, point: tuple[float, float]) -> None:
        """Add a point, if it lies far enough from the last one."""
        if self.points and math.dist(self.points[-1], point) <= self._step:
            return
        self.points.append(point)
        if len(self.points) > MOST_POINTS:
            del self.points[1::2]
            self._step *= 2
