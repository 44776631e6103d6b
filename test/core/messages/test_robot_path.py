"""The path of the robot that pictures show."""

from __future__ import annotations

import numpy as np

from forward_grid_mapper.core.messages.robot_path import MOST_POINTS, STEP, RobotPath


def test_points_of_a_long_path_are_bounded_and_even() -> None:
    path = RobotPath()
    for k in range(3 * MOST_POINTS):
        path.extend((0.06 * k, 0.0))
    assert len(path.points) <= MOST_POINTS
    assert path.points[-1][0] > 0.06 * 3 * MOST_POINTS - 1.0
    steps = np.diff(np.array(path.points)[:, 0])
    assert steps.max() < 2.5 * np.median(steps)


def test_points_are_one_step_apart_after_clearing() -> None:
    path = RobotPath()
    for k in range(MOST_POINTS + 1):
        path.extend((0.06 * k, 0.0))
    path.clear()
    for x in (0.0, 0.9 * STEP, 1.1 * STEP):
        path.extend((x, 0.0))
    assert path.points == [(0.0, 0.0), (1.1 * STEP, 0.0)]


def test_every_second_point_is_removed_above_the_limit() -> None:
    path = RobotPath()
    for k in range(MOST_POINTS):
        path.extend((1.0 * k, 2.0))
    assert len(path.points) == MOST_POINTS
    path.extend((1.0 * MOST_POINTS, 2.0))
    assert path.points == [(1.0 * k, 2.0) for k in range(0, MOST_POINTS + 1, 2)]
    last = 1.0 * MOST_POINTS
    for x in (last + 1.9 * STEP, last + 2.1 * STEP):
        path.extend((x, 2.0))
    assert path.points[-2:] == [(last, 2.0), (last + 2.1 * STEP, 2.0)], 'the step is twice as long'


def test_points_nearer_than_a_step_are_skipped() -> None:
    path = RobotPath()
    for point in ((0.0, 0.0), (STEP, 0.0), (0.8 * STEP, 0.8 * STEP), (0.8 * STEP, 0.1 * STEP), (0.8 * STEP, -STEP)):
        path.extend(point)
    assert path.points == [(0.0, 0.0), (0.8 * STEP, 0.8 * STEP), (0.8 * STEP, -STEP)]
    assert STEP == 0.05
