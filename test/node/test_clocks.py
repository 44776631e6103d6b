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
from forward_grid_mapper.node.clocks import JUMP_SPAN, JUMPS_OF_A_FAULT, LOG_AGAIN_AFTER, Arrivals
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
    for _ in range(JUMPS_OF_A_FAULT + 2):
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
        robot.arrival = 1000.0 + 0.1 * k
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
    drive(robot, 7, -2.0, 'sonar')
    (fault,) = faults(robot)
    assert fault.startswith('the stamps of sonar are 2.0 s ahead of those of odometry that arrives at the same time')


def test_rare_odometry_gives_no_warning_of_clocks(clock: Any) -> None:
    """The odometry of a reading is between two messages."""
    robot = taking()
    for k in range(200):
        if k % 20 == 0:
            robot.odometry(1000.0 + 0.1 * k)
        robot.range(1000.0 + 0.1 * k)
    assert faults(robot) == []
    late = taking()
    for k in range(200):
        late.arrival = 1000.0 + 0.1 * k
        if k % 20 == 0:
            late.odometry(1000.0 + 0.1 * k)
        late.range(1000.0 + 0.1 * k - 1.5)
    assert '1.5 s behind' in faults(late)[0]


def test_stamps_that_range_time_offset_corrects_give_no_warning(clock: Any) -> None:
    robot = Taking(range_time_offset=1.8)
    robot.intake.begin()
    drive(robot, 12, 1.8, 'sonar')
    assert faults(robot) == []
    drive(robot, 12, 0.0, 'other', first=12)
    assert '1.8 s ahead' in faults(robot)[0]


def test_late_and_early_sensors_give_separate_warnings(clock: Any) -> None:
    robot = taking()
    for k in range(70):
        robot.arrival = 1000.0 + 0.1 * k
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


@pytest.mark.parametrize('late', ['ranges', 'odometry'])
def test_node_that_takes_messages_late_gives_no_warning_of_clocks(clock: Any, late: str) -> None:
    """As with one topic for all sensors, or one for each: the messages of one kind wait for 20 s."""
    robot = taking()
    for k in range(600):
        if k >= 200 or late == 'ranges':
            at = 1000.0 + 0.1 * (k if late == 'ranges' else k - 200)
            robot.odometry(at)
        if k >= 200 or late == 'odometry':
            at = 1000.0 + 0.1 * (k if late == 'odometry' else k - 200)
            robot.range(at)
    assert faults(robot) == [] and robot.node.warned == []


@pytest.mark.parametrize('late', ['ranges', 'odometry'])
def test_wrong_clock_is_found_although_the_node_takes_messages_late(clock: Any, late: str) -> None:
    robot = taking()
    for k in range(600):
        for kind, shift in (('ranges', -2.5), ('odometry', 0.0)):
            n = k if kind != late else k - 200
            if n < 0:
                continue
            robot.arrival = 1000.0 + 0.1 * n
            (robot.range if kind == 'ranges' else robot.odometry)(robot.arrival + shift)
    (fault,) = faults(robot)
    assert fault.startswith('the stamps of sonar are 2.5 s behind')


def test_burst_after_an_outage_gives_no_warning_of_clocks(clock: Any) -> None:
    """The network delivers ten seconds of odometry, and then those of the sensors."""
    robot = taking()
    drive(robot, 10, 0.0, 'sonar')
    robot.arrival = 1020.0
    for k in range(100, 200):
        robot.odometry(1000.0 + 0.1 * k)
    robot.arrival = 1020.5
    for k in range(100, 200):
        robot.range(1000.0 + 0.1 * k)
    for first in range(20, 40):
        drive(robot, 1, 0.0, 'sonar', first=first)
        assert faults(robot) == []


@pytest.mark.parametrize('speed', [0.5, 1.0, 4.0, 20.0])
def test_speed_of_the_simulated_time_does_not_matter(clock: Any, speed: float) -> None:
    """The time of a warning is five seconds of the node, and a sensor may lag for less."""
    robot = taking()
    for k in range(300):
        robot.arrival = 1000.0 + 0.1 * k
        robot.odometry(1000.0 + 0.1 * speed * k)
        # right but for 4 s, in which its driver sends old readings
        robot.range(1000.0 + 0.1 * speed * (100 if 100 < k < 140 else k), 'sonar')
        robot.range(1000.0 + 0.1 * speed * k - 1.6, 'late')
        assert all('the stamps of late are 1.6 s' in fault for fault in faults(robot))
    assert faults(robot)


def test_fault_that_begins_again_is_logged_again(clock: Any) -> None:
    robot = taking()

    def logged(seconds: int, late: float) -> int:
        """Number of warnings in the log in these seconds."""
        nonlocal first
        before = len(robot.node.warned)
        for _ in range(seconds):
            drive(robot, 1, late, 'sonar', first=first)
            first, clock.now = first + 1, clock.now + 1.0
            faults(robot)
        return len(robot.node.warned) - before

    first = 0
    assert logged(20, 3.0) == 1
    assert logged(20, 0.0) == 0
    # too soon, and then it is due
    assert logged(10, 3.0) == 0
    assert logged(round(LOG_AGAIN_AFTER), 3.0) == 1
    assert logged(20, 0.0) == 0
    # a fault of the other kind is new
    assert logged(20, -3.0) == 1
    robot.intake.forget()
    assert logged(20, -3.0) == 1, 'after a reset, nothing has been logged'


def test_wrong_stamps_are_in_the_notes_until_a_reset(clock: Any) -> None:
    robot = taking()
    assert robot.intake.clock_notes() == []
    drive(robot, 21, 2.5, 'left', 'right')
    drive(robot, 20, 0.0, 'left', 'right', first=21)
    assert faults(robot) == []
    (note,) = robot.intake.clock_notes()
    assert note.startswith(
        'the stamps of left (and 1 sensor more) are 2.5 s behind those of odometry that arrived at the same time, for '
        '20 s so far'
    )
    robot.intake.forget()
    assert robot.intake.clock_notes() == []


def test_sensor_with_a_clock_ahead_is_in_the_notes(clock: Any) -> None:
    """The largest lead of all windows counts, also if the last ones are smaller."""
    robot = taking()
    drive(robot, 12, -4.0, 'sonar')
    drive(robot, 12, -2.0, 'sonar', first=12)
    drive(robot, 12, 0.0, 'sonar', first=24)
    assert faults(robot) == []
    (note,) = robot.intake.clock_notes()
    assert note.startswith('the stamps of sonar are 4.0 s ahead of those of odometry that arrived at the same time')


def test_arrivals_without_times_of_the_middleware(monkeypatch: pytest.MonkeyPatch) -> None:
    """The node is late by up to 3 s, and the clock of the sender by 10 s."""
    now, found = 2000.0, Arrivals()
    monkeypatch.setattr(clocks.time, 'time_ns', lambda: round(now * 1e9))

    def arrival(sent: float) -> float:
        return found.of('sonar', {'source_timestamp': round((sent - 10.0) * 1e9), 'received_timestamp': 0}) / 1e9

    assert arrival(1999.9) == pytest.approx(2000.0)
    for k in range(1, 250):
        now = 2000.0 + 0.1 * k + 3.0 * (k % 30) / 30
        assert arrival(1999.9 + 0.1 * k) == pytest.approx(2000.0 + 0.1 * k)
    # the clock of the sender is set back: the delays of before count for a minute at most
    for k in range(250, 1000):
        now = 2000.0 + 0.1 * k
        last = arrival(1995.0 + 0.1 * k)
    assert last == pytest.approx(now)
    assert found.of('sonar', {'received_timestamp': 5, 'source_timestamp': 3}) == 5
    assert found.of('sonar', {'source_timestamp': 0}) == round(now * 1e9)


def test_delay_of_the_node_when_delays_are_found_anew_is_no_later_arrival(monkeypatch: pytest.MonkeyPatch) -> None:
    """The first message of the next half minute may wait for the node, as in a pause of its executor."""
    now, found = 2000.0, Arrivals()
    monkeypatch.setattr(clocks.time, 'time_ns', lambda: round(now * 1e9))

    def arrival(sent: float) -> float:
        return found.of('sonar', {'source_timestamp': round(sent * 1e9), 'received_timestamp': 0}) / 1e9

    for k in range(300):
        now = 2000.0 + 0.1 * k
        assert arrival(now - 0.1) == pytest.approx(now)
    for k in range(20):
        now = 2033.0 + 0.01 * k
        assert arrival(2029.9 + 0.1 * k) == pytest.approx(2030.0 + 0.1 * k)


def test_stamps_of_zero_give_no_warning_of_clocks(clock: Any) -> None:
    robot = taking()
    for k in range(100):
        robot.odometry(1000.0 + 0.1 * k)
        robot.range(0.0)
    assert faults(robot) == []
    assert robot.associator.rejected == {'zero_stamp': 100}


def test_jump_back_of_time_clears_the_warning(clock: Any) -> None:
    robot = taking()
    drive(robot, 7, 10.0, 'sonar', first=100)
    assert faults(robot)
    drive(robot, 2, 0.0, 'sonar')
    assert faults(robot) == []
