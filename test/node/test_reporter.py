"""Diagnostics about the input: causes in words, and no faults from before a reset."""

from __future__ import annotations

import time
from random import Random
from types import SimpleNamespace
from typing import Any

import pytest

pytest.importorskip('rclpy', reason='the tests of the node need rclpy')

from stand_ins import PlainNode, Taking

from forward_grid_mapper.core.common.grid import Grid
from forward_grid_mapper.core.messages.message_types import NANOSECONDS, Pose2
from forward_grid_mapper.node import diagnostics
from forward_grid_mapper.node.diagnostics import RECENT, Health
from forward_grid_mapper.node.frames import MapFrame, TfExtrinsics, Transforms
from forward_grid_mapper.node.reporter import Reporter
from forward_grid_mapper.node.sensor_silence import SILENT_INTERVALS
from forward_grid_mapper.node.verdict_log import CHECKS_BEFORE_LOG, CHECKS_UNTIL_END, VerdictLog

OK, WARN = b'\x00', b'\x01'


def judged(robot: Taking, health: Health) -> tuple[bytes, str]:
    """Level and message of the readings, after another second of the test."""
    if not robot.intake.listening:
        robot.intake.subscribe()
    found = health.statuses('mapper', robot.intake, robot.associator, None, 'none yet', Grid(0.1, 0, 0, 1, 1), {})[0]
    return found.level, found.message


def drive(robot: Taking, first: int, good: int, bad: int, frame: str = '') -> None:
    """Readings with and without a frame, each with odometry."""
    for k in range(first, first + good + bad):
        robot.odometry(100.0 + 0.05 * k)
        robot.range(100.0 + 0.05 * k, 'sonar' if k < first + good else frame)


def test_reason_is_that_of_the_last_second_also_after_a_reset(clock: Any) -> None:
    robot, health = Taking(), Health()
    robot.intake.begin()
    drive(robot, 0, 10, 90)
    assert 'most of them as empty_frame_id' in judged(robot, health)[1]
    drive(robot, 100, 40, 10, 'x' * 1000)
    drive(robot, 150, 0, 5)
    level, message = judged(robot, health)
    assert level == WARN and '15 of 55' in message and 'most of them as long_frame_id' in message
    clock.now += RECENT
    drive(robot, 155, 50, 0)
    assert judged(robot, health) == (OK, 'mapping')
    robot.associator.clear()
    robot.intake.forget()
    judged(robot, health)
    # fewer readings than before the reset
    drive(robot, 205, 10, 40)
    drive(robot, 255, 0, 15, 'x' * 1000)
    level, message = judged(robot, health)
    assert level == WARN and '55 of 65' in message and 'most of them as empty_frame_id' in message


def test_share_that_keeps_a_warning_begins_none_after_a_reset(clock: Any) -> None:
    """Between the share that begins a warning and that which ends it."""
    robot, health = Taking(), Health()
    robot.intake.begin()
    drive(robot, 0, 40, 60)
    assert judged(robot, health)[0] == WARN
    clock.now += 1.0
    drive(robot, 100, 920, 80)
    assert judged(robot, health)[0] == WARN, 'still many of ten seconds'
    robot.associator.clear()
    robot.intake.forget()
    clock.now += 1.0
    drive(robot, 1100, 46, 4)
    assert judged(robot, health) == (OK, 'mapping')


@pytest.mark.parametrize(('share', 'expected'), [(0.33, {WARN}), (0.12, {WARN}), (0.05, {OK})])
def test_constant_share_of_rejected_readings_has_a_constant_verdict(
    clock: Any, share: float, expected: set[bytes]
) -> None:
    """Of 20 readings a second by chance, as of a driver that sends 0 if there is no echo."""
    robot, health, random = Taking(), Health(), Random(1)
    robot.intake.begin()
    levels = []
    for second in range(200):
        clock.now += 1.0
        for k in range(20 * second, 20 * second + 20):
            robot.odometry(100.0 + 0.05 * k)
            # at first, so many that there is a warning for the other shares as well
            bad = random.random() < (0.5 if second < 5 and expected == {WARN} else share)
            robot.range(100.0 + 0.05 * k, '' if bad else 'sonar')
        level, text = judged(robot, health)
        levels.append(level)
    assert set(levels[5:]) == expected
    if expected == {WARN}:
        # it ends ten seconds after the last rejection at the latest
        for second in range(200, 211):
            clock.now += 1.0
            drive(robot, 20 * second, 20, 0)
            level, text = judged(robot, health)
        assert (level, text) == (OK, 'mapping')


def test_delay_is_zero_without_times_of_the_middleware() -> None:
    robot, health = Taking(), Health()
    robot.intake.subscribe()

    def delay() -> str:
        found = health.statuses('mapper', robot.intake, robot.associator, None, '', Grid(0.1, 0, 0, 1, 1), {})[0]
        return next(pair.value for pair in found.values if pair.key == 'longest delay of a reading (ms)')

    health.taken(0)
    assert delay() == '0.0'
    health.taken(time.time_ns() - 2 * NANOSECONDS)
    assert 2000 <= float(delay()) < 10_000
    assert delay() == '0.0', 'that of the readings since the last report'


def test_constant_stamp_of_odometry_gives_a_warning(monkeypatch: pytest.MonkeyPatch) -> None:
    robot, now = Taking(), 50.0
    monkeypatch.setattr(diagnostics.time, 'monotonic', lambda: now)
    health = Health()
    robot.intake.begin()

    def second(k: int, stamp: float) -> tuple[bytes, str]:
        nonlocal now
        now += 1.0
        robot.odometry(stamp)
        robot.range(1000.0 + k)
        return judged(robot, health)

    verdicts = [second(k, 0.0) for k in range(5)]
    assert 'its stamp has been 0.000 s for 5 s' in verdicts[-1][1] and verdicts[-1][0] == WARN
    assert 'header.stamp' not in verdicts[1][1]
    assert all('header.stamp' not in second(k, 1000.0 + k)[1] for k in range(5, 12))
    # without waiting readings, as of a robot without sonars, it does not matter
    quiet, health = Taking(), Health()
    quiet.intake.begin()
    for _ in range(6):
        now += 1.0
        quiet.odometry(0.0)
        assert 'header.stamp' not in judged(quiet, health)[1]


def seconds(robot: Taking, clock: Any, health: Health, count: int, every: int, frame: str) -> list[tuple[bytes, str]]:
    """Verdicts of `count` seconds with readings of a sensor every few seconds; odometry comes all the time."""
    found = []
    for k in range(count):
        clock.now += 1.0
        stamp = robot.associator.odometry_stamp or 100 * 10**9
        robot.odometry(stamp / 1e9 + 1.0)
        if k % every == 0:
            robot.range(stamp / 1e9 + 1.0, frame)
        found.append(judged(robot, health))
    return found


def test_sensor_with_rare_readings_has_a_constant_verdict(clock: Any) -> None:
    robot, health = Taking(), Health()
    robot.intake.begin()
    verdicts = seconds(robot, clock, health, 20, 3, '')
    assert {level for level, _ in verdicts} == {WARN}
    assert 'readings were rejected in the last 10 s, most of them as empty_frame_id' in verdicts[-1][1]
    # good readings change the verdict within some seconds
    verdicts = seconds(robot, clock, health, 24, 3, 'sonar')
    assert verdicts[-1] == (OK, 'mapping')
    # a good sensor with a high rate does not hide the unknown frame
    robot.associator.rejected['unknown_extrinsics'] += 1
    robot.associator.unknown_frames.add('ghost')
    verdicts = seconds(robot, clock, health, 5, 1, 'sonar')
    assert {text for _, text in verdicts} == {'no pose on the robot for ghost'}
    # that sensor was switched off: its frame is still unknown, but no reading is lost any more
    verdicts = seconds(robot, clock, health, int(RECENT), 1, 'sonar')
    assert verdicts[-1] == (OK, 'mapping')


def test_sensor_with_readings_every_five_seconds_is_not_silent(clock: Any) -> None:
    robot, health = Taking(), Health()
    robot.intake.begin()
    seconds(robot, clock, health, 10, 5, 'sonar')
    verdicts = seconds(robot, clock, health, 20, 5, 'sonar')
    assert set(verdicts) == {(OK, 'mapping')}
    verdicts = seconds(robot, clock, health, int(5 * SILENT_INTERVALS) + 5, 1000, 'sonar')
    assert verdicts[-1][0] == WARN and verdicts[-1][1].startswith('no Range for ')


def test_status_without_accepted_readings_is_not_mapping(clock: Any) -> None:
    robot, health = Taking(), Health()
    robot.intake.begin()
    seconds(robot, clock, health, 5, 1, '')
    robot.intake.paused = True
    seconds(robot, clock, health, 12, 1, 'sonar')
    robot.intake.paused = False
    robot.odometry(200.0)
    assert 'were rejected' in judged(robot, health)[1]
    # messages come, and wait for odometry
    for _ in range(2):
        robot.range(300.0)
        level, text = judged(robot, health)
    assert level == WARN
    assert text.startswith('no reading has been accepted so far: 5 were rejected, most of them as empty_frame_id')


def test_status_with_waiting_readings_is_not_mapping(clock: Any) -> None:
    robot, health = Taking(), Health()
    robot.intake.begin()
    robot.odometry(100.0)
    robot.range(100.5)
    assert judged(robot, health) == (OK, 'no reading has been accepted so far: they wait for their poses')
    robot.odometry(101.0)
    assert judged(robot, health) == (OK, 'mapping')


def test_more_readings_rejected_than_received_in_a_second(clock: Any) -> None:
    """They were received before, and waited."""
    robot, health = Taking(), Health()
    robot.intake.begin()
    robot.odometry(100.0)
    for k in range(20):
        robot.range(101.0 + 0.01 * k)
    judged(robot, health)
    for k in range(12):
        robot.range(102.0 + 0.01 * k)
    robot.odometry(104.0)
    clock.now += 1.0
    assert '32 of 32 readings were rejected in the last second' in judged(robot, health)[1]


def test_readings_rejected_in_a_pause_are_no_fault_afterwards(clock: Any) -> None:
    robot, health = Taking(), Health()
    robot.intake.begin()
    seconds(robot, clock, health, 5, 1, 'sonar')
    robot.intake.paused = True
    assert {text for _, text in seconds(robot, clock, health, 5, 1, 'sonar')} == {'paused'}
    robot.intake.paused = False
    assert seconds(robot, clock, health, 3, 1, 'sonar') == [(OK, 'mapping')] * 3


def test_missing_ranges_and_odometry_are_both_reported(clock: Any) -> None:
    robot, health = Taking(), Health()
    robot.intake.subscribe()
    robot.intake.begin()

    def verdict() -> tuple[bytes, str]:
        made = health.statuses(
            'mapper',
            robot.intake,
            robot.associator,
            None,
            'none yet',
            Grid(0.1, 0, 0, 1, 1),
            {},
            absent=lambda kind: f': no node publishes {kind}',
        )[0]
        return made.level, made.message

    assert verdict() == (OK, 'no reading has been accepted so far: none has been received')
    clock.now += 4.0
    expected = 'no odometry for 4 s: no node publishes Odometry; no Range for 4 s: no node publishes Range'
    assert verdict() == (WARN, expected)


def test_stamps_of_zero_give_a_warning_if_readings_are_accepted(clock: Any) -> None:
    robot, health = Taking(), Health()
    robot.intake.begin()
    for _ in range(6):
        clock.now += 1.0
        robot.odometry(0.0)
        robot.range(0.0)
        level, text = judged(robot, health)
    assert len(robot.associator.buffer) and level == WARN
    assert 'its stamp has been 0.000 s for 6 s' in text and 'header.stamp' in text


def test_inactive_node_does_not_report_missing_messages(clock: Any) -> None:
    robot, health = Taking(), Health()
    robot.intake.begin()

    def verdict() -> tuple[bytes, str]:
        made = health.statuses('mapper', robot.intake, robot.associator, None, '', Grid(0.1, 0, 0, 1, 1), {})[0]
        return made.level, made.message

    for _ in range(600):
        clock.now += 1.0
        assert verdict() == (OK, 'inactive: nothing is received')
    robot.intake.subscribe()
    for _ in range(3):
        clock.now += 1.0
        assert verdict() == (OK, 'no reading has been accepted so far: none has been received')
    clock.now += 1.0
    assert verdict()[1].startswith('no odometry for 4 s')


def test_waiting_odometry_is_not_reported_as_missing(clock: Any) -> None:
    # for the journal of an earlier run, or for a localiser
    transforms = Transforms()
    early, lost = Taking(), Taking(map_frame=MapFrame('map', transforms, 2.0))
    lost.intake.begin()
    for robot in (early, lost):
        robot.intake.subscribe()
        health = Health()
        for _ in range(20):
            clock.now += 1.0
            robot.odometry(clock.now)
            robot.range(clock.now)
            level, text = judged(robot, health)
            assert 'odometry' not in text or 'from map (map_frame)' in text, text
    assert (level, early.intake.waiting) == (OK, 20)


def test_run_em_names_the_missing_transform(inside: Any) -> None:
    robot = inside().start()
    robot.node._map_frame = robot.node.intake._map_frame = MapFrame('map', Transforms(), 2.0)
    for k in range(10):
        robot.odometry(100.0 + 0.1 * k)
        robot.range(100.0 + 0.1 * k)
    success, message = robot.call(robot.node.em.run_em)
    assert not success
    assert 'TF has no transform from map (map_frame) to odom: 10 odometry messages wait for it' in message


def test_end_of_faults_is_logged_only_if_readings_are_mapped(inside: Any) -> None:
    robot = inside().start()
    node, log = robot.node, PlainNode()
    node.reporter._verdicts = VerdictLog(log)

    def looks(count: int) -> None:
        for _ in range(count):
            robot.status('readings')

    for k in range(20):
        robot.odometry(100.0 + 0.1 * k)
        robot.range(100.0 + 0.1 * k, frame='')
    looks(CHECKS_BEFORE_LOG)
    (fault,) = log.warned
    assert 'empty_frame_id' in fault
    robot.call(node.pause, SimpleNamespace(data=True))
    looks(CHECKS_BEFORE_LOG)
    robot.call(node.pause, SimpleNamespace(data=False))
    robot.call(node.reset)
    looks(CHECKS_BEFORE_LOG)
    assert log.warned == [fault]
    robot.drive(40, 20)
    looks(CHECKS_UNTIL_END - 1)
    assert log.warned == [fault]
    looks(1)
    assert log.warned == [fault, 'readings are mapped without faults again']


@pytest.mark.parametrize('kind', ['of the clock', 'of the robot'])
def test_end_of_faults_is_not_logged_after_a_jump(inside: Any, kind: str) -> None:
    robot = inside(refine_poses=True).start()
    node, log = robot.node, PlainNode()
    node.reporter._verdicts = VerdictLog(log)
    robot.drive(0, 20)
    for k in range(20, 40):
        robot.odometry(100.0 + 0.05 * k, 0.02)
        robot.range(100.0 + 0.05 * k, frame='')
    for _ in range(CHECKS_BEFORE_LOG):
        robot.status('readings')
    assert len(log.warned) == 1
    if kind == 'of the clock':
        robot.drive(0, 500)
    else:
        # so that the last pose is known
        robot.spin(0.5)
        for k in range(40, 500):
            robot.odometry(100.0 + 0.05 * k, 5.0)
            robot.range(100.0 + 0.05 * k)
        robot.until(lambda: robot.status('trajectory')['level'] == WARN, 20.0)
    assert len(log.warned) == 1
    for _ in range(CHECKS_UNTIL_END + 5):
        status = robot.status('readings')
    assert status['message'] == 'mapping'
    assert len(log.warned) == 1


def reporter_of(robot: Taking) -> Any:
    made = Reporter.__new__(Reporter)
    made._node, made._associator, made._no_name = robot.node, robot.associator, False
    made._intake = robot.intake
    return made


def test_odometry_without_a_frame_gives_a_warning() -> None:
    robot = Taking()
    robot.intake.begin()
    reporter = reporter_of(robot)
    assert reporter._no_frame_id() == [], 'nothing came yet'
    robot.odometry(100.0, frame='')
    for _ in range(2):
        (text,) = reporter._no_frame_id()
        assert 'odometry has no frame_id in its header' in text
    assert robot.node.warned == [text]
    named = Taking()
    named.intake.begin()
    named.odometry(100.0)
    assert reporter_of(named)._no_frame_id() == [] and named.node.warned == []


def test_message_without_a_base_frame_suggests_no_transform() -> None:
    for child, advice in (('base_link', 'publish the transform from base_link'), ('', 'child_frame_id')):
        robot = Taking()
        robot.intake.begin()
        robot.odometry(100.0)
        reporter = reporter_of(robot)
        reporter._reported, reporter._without_pose, reporter._far = set(), set(), False
        reporter._extrinsics = TfExtrinsics({}, Transforms())
        robot.associator.base_frame = child
        robot.associator.unknown_frames.add('sonar')
        reporter._name_frames()
        (text,) = robot.node.warned
        assert 'set sensors.sonar.pose: [x, y, yaw], or ' in text and advice in text
        assert text.endswith('its readings are rejected')


def test_unused_poses_are_suggested_for_a_frame_without_pose() -> None:
    robot = Taking()
    robot.intake.begin()
    drive(robot, 0, 3, 0)
    reporter = reporter_of(robot)
    reporter._reported, reporter._without_pose, reporter._far = set(), set(), False
    # a frame with waiting readings
    robot.range(200.0, '/waits')
    poses = {name: Pose2(0.1, 0.0, 0.0) for name in ('sonar', 'us_left', 'us_right', 'waits')}
    reporter._extrinsics = TfExtrinsics(poses, Transforms())
    robot.associator.unknown_frames.update(('left', 'right'))
    reporter._name_frames()
    text, other = robot.node.warned
    assert other.endswith('its readings are rejected')
    assert text.endswith('; there are poses for us_left, us_right: is it one of these?')
