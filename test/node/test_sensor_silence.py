"""Sensors that stop sending are named until they send again."""

from __future__ import annotations

from collections.abc import Callable
from types import SimpleNamespace
from typing import Any

import pytest

pytest.importorskip('rclpy', reason='the tests of the node need rclpy')

from inside import Inside

from forward_grid_mapper.core.messages.sensor_records import MOST_FRAMES
from forward_grid_mapper.node import sensor_silence
from forward_grid_mapper.node.sensor_silence import PAUSE, SILENT_INTERVALS, TIME_OUT, SensorSilence
from forward_grid_mapper.node.sensor_status import LEAST_PAUSES

OK, WARN = b'\x00', b'\x01'


class Clock:
    """A clock set by the test, seconds."""

    def __init__(self, monkeypatch: pytest.MonkeyPatch) -> None:
        self.now = 500.0
        monkeypatch.setattr(sensor_silence.time, 'monotonic', lambda: self.now)


@pytest.fixture
def clock(monkeypatch: pytest.MonkeyPatch) -> Clock:
    return Clock(monkeypatch)


def pass_by(clock: Clock, sensors: SensorSilence, seconds: float, **intervals: float) -> None:
    """Let time pass; each of these sensors sends once in its interval."""
    begin = clock.now
    times = sorted(
        (begin + k * interval, name)
        for name, interval in intervals.items()
        for k in range(1, round(seconds / interval) + 1)
    )
    for when, name in times:
        clock.now = when
        sensors.note(name)
    clock.now = begin + seconds


def test_sensor_that_stops_is_silent_until_it_sends_again(clock: Clock) -> None:
    sensors = SensorSilence()
    pass_by(clock, sensors, 10.0, left=0.1, right=0.1)
    assert sensors.silent() == {}
    pass_by(clock, sensors, TIME_OUT - 0.1, right=0.1)
    assert sensors.silent() == {}
    pass_by(clock, sensors, 4.1, right=0.1)
    assert sensors.silent() == {'left': pytest.approx(TIME_OUT + 4.0)}
    pass_by(clock, sensors, 0.1, left=0.1)
    assert sensors.silent() == {}
    # the gap is not used as the usual interval
    pass_by(clock, sensors, TIME_OUT + 0.5, right=0.1)
    assert set(sensors.silent()) == {'left'}


def test_pauses_are_counted_if_others_send_meanwhile(clock: Clock) -> None:
    sensors = SensorSilence()
    pass_by(clock, sensors, 10.0, left=0.1, right=0.1, slow=0.5)
    assert sensors.pauses == 0
    for k in range(3):
        pass_by(clock, sensors, PAUSE + 0.5 + k, right=0.1, slow=0.5)
        pass_by(clock, sensors, 5.0, left=0.1, right=0.1, slow=0.5)
        assert sensors.pauses == k + 1
    # too short, or none of the sensor alone
    pass_by(clock, sensors, PAUSE - 0.3, right=0.1, slow=0.5)
    pass_by(clock, sensors, 5.0, left=0.1, right=0.1, slow=0.5)
    for seconds in (2.0, 20.0):
        pass_by(clock, sensors, seconds)
        pass_by(clock, sensors, 5.0, left=0.1, right=0.1, slow=0.5)
    # the slow sensor may be late
    pass_by(clock, sensors, 2.0, left=0.1, right=0.1)
    pass_by(clock, sensors, 5.0, left=0.1, right=0.1, slow=0.5)
    assert sensors.pauses == 3
    sensors.clear()
    assert sensors.pauses == 0


def test_no_sensor_is_silent_if_all_have_stopped(clock: Clock) -> None:
    sensors = SensorSilence()
    pass_by(clock, sensors, 10.0, left=0.1, right=0.13, slow=2.0)
    pass_by(clock, sensors, 1000.0)
    assert sensors.silent() == {}
    # a sensor that was silent before stays silent
    pass_by(clock, sensors, 30.0, right=0.13, slow=2.0)
    pass_by(clock, sensors, 1000.0)
    assert set(sensors.silent()) == {'left'}


def test_pauses_of_all_do_not_change_the_usual_interval(clock: Clock) -> None:
    """Otherwise a sensor that sends once in a while would be silent after bags that were paused several times."""
    sensors = SensorSilence()
    pass_by(clock, sensors, 100.0, slow=5.0)
    for _ in range(30):
        pass_by(clock, sensors, 60.0)
        sensors.note('slow')
    assert sensors.patience == pytest.approx(SILENT_INTERVALS * 5.0)


def test_first_sensor_after_a_pause_of_all_does_not_make_the_others_silent(clock: Clock) -> None:
    """As when a bag is paused: the report may come between their messages."""
    sensors = SensorSilence()
    pass_by(clock, sensors, 10.0, left=0.1, right=0.1, broken=0.1)
    pass_by(clock, sensors, 10.0, left=0.1, right=0.1)
    for _ in range(3):
        assert set(sensors.silent()) == {'broken'}
        pass_by(clock, sensors, 60.0)
        sensors.note('right')
    pass_by(clock, sensors, TIME_OUT - 0.5, right=0.1)
    assert set(sensors.silent()) == {'broken'}
    pass_by(clock, sensors, 1.0, right=0.1)
    assert set(sensors.silent()) == {'broken', 'left'}


def test_sensor_that_sends_rarely_has_a_longer_limit(clock: Clock) -> None:
    sensors = SensorSilence()
    pass_by(clock, sensors, 100.0, fast=0.1, slow=5.0)
    assert sensors.silent() == {}
    pass_by(clock, sensors, SILENT_INTERVALS * 5.0 - 0.1, fast=0.1)
    assert sensors.silent() == {}
    pass_by(clock, sensors, 0.3, fast=0.1)
    assert set(sensors.silent()) == {'slow'}
    sensors.clear()
    assert sensors.silent() == {} and 'slow' not in sensors


def test_interval_of_sensors_that_all_send_rarely_is_learned(clock: Clock) -> None:
    """Their first intervals are no pauses, and one that stops is silent."""
    sensors = SensorSilence()
    for k in range(20):
        clock.now = 500.0 + 5.0 * k
        sensors.note('left')
        clock.now += 0.1
        if k < 10:
            sensors.note('right')
        assert ('right' in sensors.silent()) == (k >= 15)
        assert 'left' not in sensors.silent()
    assert sensors.patience == pytest.approx(5 * SILENT_INTERVALS, rel=0.1)


def test_unprintable_names_and_too_many_are_ignored(clock: Clock) -> None:
    sensors = SensorSilence()
    for name in ('', 'a\nb', 'x' * 256, *(f'made up {k}' for k in range(2 * MOST_FRAMES))):
        sensors.note(name)
    assert '' not in sensors and 'a\nb' not in sensors and 'x' * 256 not in sensors
    for _ in range(4):
        clock.now += TIME_OUT - 0.5
        sensors.note('made up 0')
    assert len(sensors.silent()) == MOST_FRAMES - 1


def test_diagnostics_name_the_silent_sensor(inside: Callable[..., Inside], monkeypatch: pytest.MonkeyPatch) -> None:
    robot = inside(**{'sensors.other.pose': [0.1, 0.0, 1.0]}).start()
    clock = Clock(monkeypatch)
    lines: list[str] = []
    log = SimpleNamespace(info=lines.append, warning=lines.append, error=lines.append)
    monkeypatch.setattr(robot.node, 'get_logger', lambda: log)

    def drive(first: int, *frames: str) -> None:
        for k in range(first, first + 50):
            clock.now += 0.1
            robot.odometry(100.0 + 0.05 * k, 0.001 * k)
            for frame in frames:
                robot.range(100.0 + 0.05 * k, frame=frame)
        robot.until(lambda: not robot.node.intake.busy)

    drive(0, 'sonar', 'other', 'of nobody')
    sensors = robot.status('sensors')
    assert (sensors['level'], sensors['message']) == (OK, 'judged after EM')
    drive(50, 'sonar')
    sensors = robot.status('sensors')
    assert sensors['level'] == WARN
    # a frame without a pose is reported elsewhere
    assert sensors['message'] == 'other: no more messages'
    assert sensors['other'] == 'SILENT for 5 s; 50 readings, 0% max range'
    drive(100, 'sonar', 'other')
    assert robot.status('sensors')['level'] == OK
    drive(150, 'other')
    assert 'sonar: no more messages' in robot.status('sensors')['message']
    robot.call(robot.node.reset)
    drive(200, 'other')
    assert robot.status('sensors')['level'] == OK
    assert [line for line in lines if 'these sensors' in line] == [
        'these sensors have stopped sending: other',
        'these sensors send again: other',
        'these sensors have stopped sending: sonar',
    ]


@pytest.mark.parametrize('inf', [False, True])
def test_driver_that_sends_nothing_without_echo_is_named(
    inside: Callable[..., Inside], monkeypatch: pytest.MonkeyPatch, inf: bool
) -> None:
    """Pauses are no silence then, unless they last; if some readings are without an echo, a sensor is broken."""
    robot = inside(**{'sensors.other.pose': [0.1, 0.0, 1.0]}).start()
    clock = Clock(monkeypatch)
    lines: list[str] = []
    log = SimpleNamespace(info=lines.append, warning=lines.append, error=lines.append)
    monkeypatch.setattr(robot.node, 'get_logger', lambda: log)
    sent = 0

    def drive(seconds: float, *frames: str) -> dict[str, Any]:
        nonlocal sent
        for _ in range(round(10 * seconds)):
            sent, clock.now = sent + 1, clock.now + 0.1
            robot.odometry(100.0 + 0.05 * sent, 0.001 * sent)
            for frame in frames:
                robot.range(100.0 + 0.05 * sent, 6.0 if inf and sent % 20 == 0 else 2.0, frame=frame)
        robot.until(lambda: not robot.node.intake.busy)
        return robot.status('sensors')

    for _ in range(LEAST_PAUSES):
        drive(2.0, 'sonar', 'other')
        drive(2.0, 'sonar')
    status = drive(2.0, 'sonar', 'other')
    assert ('does the driver send nothing if there is no echo?' in status['message']) != inf
    assert (status['level'] == WARN) != inf
    drive(4.0, 'sonar')
    drive(2.0, 'sonar', 'other')
    ends = ['these sensors have stopped sending: other', 'these sensors send again: other']
    if inf:
        assert lines == ends
        return
    (fault,) = lines
    assert '+inf' in fault
    assert 'other: no more messages' in drive(70.0, 'sonar')['message']
    drive(2.0, 'sonar', 'other')
    assert lines == [fault, *ends]
