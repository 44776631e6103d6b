"""Warnings about clocks that jump, or that differ."""

from __future__ import annotations

from types import SimpleNamespace
from typing import Any

import pytest

pytest.importorskip('rclpy', reason='the intake takes messages of ROS')

from geometry_msgs.msg import Quaternion, Transform
from stand_ins import Taking

from forward_grid_mapper.core.messages.extrinsics import LATE
from forward_grid_mapper.node import clocks
from forward_grid_mapper.node.clocks import AGAIN, JUMP_SPAN
from forward_grid_mapper.node.frames import MapFrame, Transforms


@pytest.fixture
def clock(monkeypatch: pytest.MonkeyPatch) -> Any:
    """The clock of the node, set by the test."""
    made = SimpleNamespace(now=1000.0)
    monkeypatch.setattr(clocks.time, 'monotonic', lambda: made.now)
    return made


def taking() -> Taking:
    robot = Taking()
    robot.intake.begin()
    return robot


def test_two_odometry_sources_with_different_clocks_give_rare_warnings(clock: Any) -> None:
    robot = taking()
    for k in range(100):
        clock.now += 0.05
        robot.odometry(2000.0 + 0.1 * k)
        robot.odometry(1995.0 + 0.1 * k)
    (fault,) = faults(robot)
    assert 'do two nodes publish odometry, or is a clock set?' in fault
    assert len(robot.node.warned) == 1, 'in 5 s'
    clock.now += JUMP_SPAN
    robot.odometry(2020.0)
    robot.odometry(2005.0)
    assert len(robot.node.warned) == 2 and '(100 times so far)' in robot.node.warned[1]
    clock.now += JUMP_SPAN
    assert faults(robot) == []


def test_restarted_bag_is_no_fault(clock: Any) -> None:
    robot = taking()
    for _ in range(AGAIN + 2):
        clock.now += 0.6 * JUMP_SPAN
        for k in range(10):
            robot.odometry(100.0 + k)
    assert faults(robot) == []
    assert 'odometry of the drive, which refine_poses needs; the map is kept' in robot.node.warned[0]
    robot.associator.clear()
    robot.intake.forget()
    warned = len(robot.node.warned)
    clock.now += JUMP_SPAN
    robot.odometry(110.0)
    assert len(robot.node.warned) == warned, 'counts that a reset sets to 0 are no jumps'


def faults(robot: Taking) -> list[str]:
    """Faults about stamps; messages here have no sequence numbers, so lost ones are estimated."""
    return [fault for fault in robot.intake.faults() if 'stamps' in fault]


def drive(robot: Taking, seconds: int, late: float, *frames: str, first: int = 0) -> None:
    """Ten readings a second, with stamps that are late by `late` seconds."""
    for k in range(10 * first, 10 * (first + seconds)):
        robot.odometry(1000.0 + 0.1 * k)
        for frame in frames:
            robot.range(1000.0 + 0.1 * k - late, frame)


def test_sensor_with_a_late_clock_gives_a_warning(clock: Any) -> None:
    robot = taking()
    drive(robot, 20, 0.0, 'sonar')
    assert faults(robot) == []
    drive(robot, 4, 10.0, 'left', first=20)
    assert faults(robot) == [], 'that may be a queue'
    drive(robot, 2, 10.0, 'left', first=24)
    for _ in range(2):
        (fault,) = faults(robot)
        assert fault.startswith('the stamps of left are 10.0 s behind those of odometry')
    assert robot.node.warned == [fault]
    drive(robot, 6, 20.0, 'right', 'left', first=26)
    assert 'right (and 1 sensor more) are 20.0 s behind' in faults(robot)[0]
    # the left clock is correct again, or the sensor is silent
    drive(robot, 6, 0.0, 'left', first=32)
    assert 'the stamps of right are' in faults(robot)[0]
    drive(robot, 6, 0.0, 'left', first=38)
    assert faults(robot) == []


def test_sensor_with_a_clock_ahead_gives_a_warning(clock: Any) -> None:
    robot = taking()
    drive(robot, 6, -2.0, 'sonar')
    (fault,) = faults(robot)
    assert fault.startswith('the stamps of sonar are 2.0 s ahead of those of odometry: if a clock is wrong')
    # if odometry has more messages than a sensor, a node that is too slow gets those of odometry last
    assert 'play the bag more slowly' in fault
    rare = taking()
    for k in range(200):
        if k % 20 == 0:
            rare.odometry(1000.0 + 0.1 * k)
        rare.range(1000.0 + 0.1 * k)
    assert faults(rare) == []


def test_late_and_early_sensors_give_separate_warnings(clock: Any) -> None:
    robot = taking()
    for k in range(60):
        robot.odometry(1000.0 + 0.1 * k)
        for frame, late in (('old', 3.0), ('older', 4.0), ('young', -2.0)):
            robot.range(1000.0 + 0.1 * k - late, frame)
    behind, ahead = faults(robot)
    assert behind.startswith('the stamps of older (and 1 sensor more) are 4.0 s behind those of odometry')
    assert ahead.startswith('the stamps of young are 2.0 s ahead of those of odometry')
    assert robot.node.warned == [behind, ahead]


def test_odometry_that_waits_for_tf_gives_no_warning_of_clocks(clock: Any) -> None:
    class Late(Transforms):
        """TF that delivers transforms 1.5 s late."""

        now = 0.0

        def lookup(self, target: str, source: str, stamp: int) -> Any:
            return Transform(rotation=Quaternion(w=1.0)) if stamp <= (self.now - 1.5) * 1e9 else LATE

    transforms = Late()
    robot = Taking(map_frame=MapFrame('map', transforms, 2.0))
    robot.intake.begin()
    for k in range(200):
        transforms.now = 1000.0 + 0.1 * k
        robot.odometry(transforms.now)
        robot.range(transforms.now)
    assert len(robot.associator.buffer) > 100
    assert faults(robot) == []


def test_queue_of_messages_gives_no_warning_of_clocks(clock: Any) -> None:
    """Odometry is processed before the ranges that came with it."""
    robot = taking()
    for k in range(200):
        robot.odometry(1000.0 + 0.1 * k)
    for k in range(200):
        robot.range(1000.0 + 0.1 * k)
        robot.odometry(1020.0 + 0.05 * k)
    drive(robot, 10, 0.0, 'sonar', first=31)
    assert faults(robot) == []


def test_stamps_of_zero_give_no_warning_of_clocks(clock: Any) -> None:
    robot = taking()
    for k in range(100):
        robot.odometry(1000.0 + 0.1 * k)
        robot.range(0.0)
    assert faults(robot) == []
    assert robot.associator.rejected == {'zero_stamp': 100}


def test_jump_back_of_time_clears_the_warning(clock: Any) -> None:
    robot = taking()
    drive(robot, 6, 10.0, 'sonar', first=100)
    assert faults(robot)
    drive(robot, 2, 0.0, 'sonar')
    assert faults(robot) == []
