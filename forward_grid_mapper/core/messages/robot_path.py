"""The path of the robot, for pictures: a list of points of bounded length."""

from __future__ import annotations

import math

STEP = 0.05
"""Smallest distance between two points, metres, while there are few: half a default cell."""

MOST_POINTS = 100_000
"""Most points; if there are more, every second one is dropped."""


class RobotPath:
    """Points (x, y) in metres, at least a step apart; the step doubles whenever there are too many."""

    def __init__(self) -> None:
        self.points: list[tuple[float, float]] = []
        self._step = STEP

    def clear(self) -> None:
        """Remove all points."""
        self.points.clear()
        self._step = STEP

    def extend(self, point: tuple[float, float]) -> None:
        """Add a point, if it is far enough from the last one."""
        if self.points and math.dist(self.points[-1], point) <= self._step:
            return
        self.points.append(point)
        if len(self.points) > MOST_POINTS:
            del self.points[1::2]
            self._step *= 2
