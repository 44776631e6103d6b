"""The path that pictures show."""

from __future__ import annotations

import numpy as np

from forward_grid_mapper.core.messages.robot_path import MOST_POINTS, STEP, RobotPath


def test_a_long_path_has_fewer_points() -> None:
    path = RobotPath()
    for k in range(3 * MOST_POINTS):
        path.extend((0.06 * k, 0.0))
    assert len(path.points) <= MOST_POINTS
    assert path.points[-1][0] > 0.06 * 3 * MOST_POINTS - 1.0
    steps = np.diff(np.array(path.points)[:, 0])
    assert steps.max() < 2.5 * np.median(steps)


def test_points_are_a_step_apart_again_after_clearing() -> None:
    path = RobotPath()
    for k in range(MOST_POINTS + 1):
        path.extend((0.06 * k, 0.0))
    path.clear()
    for x in (0.0, 0.9 * STEP, 1.1 * STEP):
        path.extend((x, 0.0))
    assert path.points == [(0.0, 0.0), (1.1 * STEP, 0.0)]
