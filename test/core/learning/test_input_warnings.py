"""Warnings about input that gives a wrong map without an error, with cause and remedy; correct drives give none."""

from __future__ import annotations

import itertools
import math
import re
from collections.abc import Callable
from dataclasses import replace
from functools import lru_cache
from pathlib import Path
from typing import NamedTuple

import numpy as np
import pytest

from forward_grid_mapper.core.common.parameters import Parameters
from forward_grid_mapper.core.common.readings import Readings
from forward_grid_mapper.core.learning.input_warnings import LONGEST_PERIOD, input_warnings
from forward_grid_mapper.core.messages.message_types import OdometryMessage, Pose2, RangeMessage
from forward_grid_mapper.simulation.drive import building_drive, corridor_drive, door_drive
from forward_grid_mapper.simulation.sonar import NOISE_FREE, NOISY, SonarArray, front_array, sonar_ring
from samples import associated


class Messages(NamedTuple):
    extrinsics: dict[str, Pose2]
    odometry: list[OdometryMessage]
    ranges: list[RangeMessage]

    def with_ranges(self, change: Callable[[RangeMessage], RangeMessage]) -> Messages:
        return self._replace(ranges=[change(m) for m in self.ranges])


@lru_cache(maxsize=1)
def drive() -> Messages:
    """A drive along a corridor and back with eight sonars."""
    recording = corridor_drive(0, 1, NOISY, True, front_array())
    return Messages(dict(recording.extrinsics), list(recording.odometry), list(recording.ranges))


def in_a_room(x: float, y: float, yaw: float) -> float:
    """The range in a room of 8 by 6 metres."""
    c, s = math.cos(yaw), math.sin(yaw)
    return min((math.copysign(4, c) - x) / (c or 1e-9), (math.copysign(3, s) - y) / (s or 1e-9))


@lru_cache(maxsize=1)
def circling() -> Messages:
    """A robot that drives in circles in a room of 8 by 6 metres, for a minute."""
    rng = np.random.default_rng(1)
    yaws = np.arange(8) * math.pi / 4
    extrinsics = {f'sonar_{n}': Pose2(0.0, 0.0, float(yaw)) for n, yaw in enumerate(yaws)}
    odometry, ranges = [], []
    for k in range(601):
        stamp, angle = k * 100_000_000, k / 60
        pose = Pose2(1.5 * math.cos(angle), 1.5 * math.sin(angle), angle + math.pi / 2)
        odometry.append(OdometryMessage(stamp, 'odom', 'base_link', pose))
        for frame, yaw in zip(extrinsics, yaws, strict=True):
            z = in_a_room(pose.x, pose.y, pose.yaw + yaw) + rng.normal(0, 0.02)
            ranges.append(RangeMessage(stamp, frame, math.inf if z > 5 else z, 0.1, 5.0, 0.26))
    return Messages(extrinsics, odometry, ranges)


def warnings_of(messages: Messages) -> list[str]:
    """The warnings about a drive, of the node and offline."""
    associator = associated(*messages)
    return [*associator.message_warnings(), *input_warnings(associator.readings)]


def stopped(frame: str) -> Messages:
    """The drive in circles, with a sensor that sends nothing in its second half."""
    half = circling().ranges[-1].stamp // 2
    return circling()._replace(ranges=[m for m in circling().ranges if m.frame_id != frame or m.stamp < half])


def scaled(range_by: float, limits_by: float) -> Messages:
    return drive().with_ranges(
        lambda m: m._replace(
            range=m.range * range_by, min_range=m.min_range * limits_by, max_range=m.max_range * limits_by
        )
    )


def of_one(given: Messages, by: float) -> Messages:
    """A drive in which the driver of one sensor sends ranges in another unit."""
    frame = sorted(given.extrinsics)[2]
    return given.with_ranges(lambda m: m._replace(range=m.range * by) if m.frame_id == frame else m)


def without_silence(limit: float) -> Messages:
    """The drive in circles with a shorter max_range, and a driver that sends nothing if there is no echo."""
    given = circling().with_ranges(lambda m: m._replace(max_range=limit))
    return given._replace(ranges=[m for m in given.ranges if m.range < limit])


def twice() -> Messages:
    return drive()._replace(ranges=[m for m in drive().ranges for _ in range(2)])


def one_frame(apart: int, given: Messages | None = None) -> Messages:
    """The drive with all sensors in one frame, and `apart` nanoseconds between two sensors in a sweep."""
    given = given or drive()
    frames = list(given.extrinsics)
    return given._replace(
        extrinsics={'sonar': given.extrinsics[frames[0]]},
        ranges=[m._replace(frame_id='sonar', stamp=m.stamp + apart * frames.index(m.frame_id)) for m in given.ranges],
    )


def standing(part: float) -> Messages:
    """Odometry that stands still after a part of the drive."""
    odometry = circling().odometry
    stop = odometry[int(part * (len(odometry) - 1))]
    return circling()._replace(odometry=[m if m.stamp < stop.stamp else m._replace(pose=stop.pose) for m in odometry])


def moved_by(factor: float) -> Messages:
    """Odometry in other units than metres."""
    odometry = [m._replace(pose=m.pose._replace(x=m.pose.x * factor, y=m.pose.y * factor)) for m in circling().odometry]
    return circling()._replace(odometry=odometry)


def stuck(frame: int, value: float) -> Messages:
    name = list(circling().extrinsics)[frame]
    return circling().with_ranges(lambda m: m._replace(range=value) if m.frame_id == name else m)


def astray(seconds: float) -> Messages:
    """Odometry that is 300 m away for some seconds, after a gap in which a robot could have driven this distance."""
    begin = drive().odometry[0].stamp + 40_000_000_000
    back = begin + round(seconds * 1e9)
    odometry = [
        m._replace(pose=m.pose._replace(x=m.pose.x + 300, y=m.pose.y + 200)) if begin <= m.stamp < back else m
        for m in drive().odometry
        if not (begin - 5e9 < m.stamp < begin or back <= m.stamp < back + 5e9)
    ]
    return drive()._replace(odometry=odometry)


def far_echo() -> Messages:
    """Correct ranges in a room, from a sensor with a stated limit of 90 m, and one echo near it."""
    one = circling().ranges[2000]
    near = circling().with_ranges(lambda m: m._replace(range=min(m.range, 4.5 + m.stamp % 700_000_000 / 2e9)))
    return near.with_ranges(
        lambda m: m._replace(
            max_range=90.0, range=80.0 if m.stamp == one.stamp and m.frame_id == one.frame_id else m.range
        )
    )


def own_no_echo_value(value: float) -> Messages:
    """A driver that sends a constant range below max_range if there is no echo."""
    return drive().with_ranges(lambda m: m._replace(range=min(m.range, value)))


def own_no_echo_value_of(frames: tuple[str, ...], value: float) -> Messages:
    """The same, if only the drivers of some sensors do so, and the others send +inf."""

    def changed(m: RangeMessage) -> RangeMessage:
        if m.frame_id in frames:
            return m._replace(range=min(m.range, value))
        return m._replace(range=math.inf if m.range >= m.max_range - 0.3 else m.range)

    return circling().with_ranges(changed)


def with_random_echoes(given: Messages, beyond: float) -> Messages:
    """Half a percent of the readings, and some more, are random echoes from beyond."""
    count = itertools.count()
    return given.with_ranges(lambda m: m._replace(range=beyond) if next(count) % 140 == 0 else m)


def stamped(change: Callable[[int], int]) -> Messages:
    """Wrong stamps of a driver, for both ranges and odometry."""
    ranges = [m._replace(stamp=change(m.stamp)) for m in circling().ranges]
    return circling()._replace(ranges=ranges, odometry=[m._replace(stamp=change(m.stamp)) for m in circling().odometry])


SECOND = 1_000_000_000

SCENARIOS: dict[str, tuple[Callable[[], Messages], str]] = {
    'every message twice': (twice, r'copies of others.*recorded twice.*Leave one'),
    'stamps of 0': (lambda: stamped(lambda stamp: 0), r'all stamps are equal.*set header\.stamp'),
    'stamps without nanoseconds': (
        lambda: stamped(lambda stamp: stamp - stamp % SECOND),
        r'all stamps are whole seconds, although a sensor has 10 readings at each.*nanosec in nanoseconds',
    ),
    'milliseconds in place of nanoseconds': (
        lambda: stamped(lambda stamp: stamp - stamp % SECOND + stamp % SECOND // 1_000_000),
        r'all stamps are whole seconds',
    ),
    'one frame, one stamp a sweep': (
        lambda: one_frame(0),
        r'frame sonar alternate.*the same frame_id.*Set a different one for each',
    ),
    'one frame, one after the other': (lambda: one_frame(8_000_000), r'frame sonar alternate.*the same frame_id'),
    'one frame, one after the other, while it turns': (
        lambda: one_frame(8_000_000, circling()),
        r'frame sonar alternate.*the same frame_id',
    ),
    'odometry never moves': (lambda: standing(0.0), r'odometry does not change.*while the ranges.*encoders'),
    'odometry stops in the middle': (lambda: standing(0.5), r'odometry does not change for \d+ s'),
    'poses in centimetres': (lambda: moved_by(100), r'poses move at \d+ m/s: are they in millimetres or centimetres'),
    'a sensor at 1.2 m': (lambda: stuck(2, 1.2345), r'gives the same range.*Repair it'),
    'a sensor at 0.2 m': (lambda: stuck(5, 0.2), r'sensor \S+ \(0\.200 m\) gives the same range'),
    'a sensor stops halfway': (
        lambda: stopped('sonar_3'),
        r'in the last 30 s of a drive .* no readings of sonar_3, but',
    ),
    'field of view of 1 degree': (
        lambda: drive().with_ranges(lambda m: m._replace(field_of_view=math.radians(1))),
        r'field of view is 1 degrees.*set the parameter field_of_view',
    ),
    'field of view of 120 degrees': (
        lambda: drive().with_ranges(lambda m: m._replace(field_of_view=math.radians(120))),
        r'field of view is 120 degrees.*a default of a simulator\?',
    ),
    'max_range four times too large': (
        lambda: drive().with_ranges(
            lambda m: m._replace(max_range=4 * m.max_range, range=math.inf if m.range >= m.max_range else m.range)
        ),
        r'no echo is from beyond.*does the sensor reach that far.*set the parameter max_range',
    ),
    'no echo is 3 m, max_range 5 m': (
        lambda: own_no_echo_value(3.0),
        r'of the echoes are at 3\.000 m.*if there is no echo.*set the parameter max_range to 2\.9,',
    ),
    'no echo is 4.4 m in some drivers': (
        lambda: own_no_echo_value_of(('sonar_1', 'sonar_3'), 4.4),
        r'^sonar_1, sonar_3: the longest range is 4\.400 m again and again.*unlike those of other sensors.*send \+inf',
    ),
    'no echo is 3 m, with random echoes': (
        lambda: with_random_echoes(own_no_echo_value(3.0), 4.0),
        r'of the echoes are at 3\.000 m.*no reading is without an echo',
    ),
    'no echo is a float below max_range': (lambda: own_no_echo_value(4.9999995), r'of the echoes are at 5\.000 m'),
    'no echo is min_range': (
        lambda: drive().with_ranges(lambda m: m._replace(range=m.min_range if m.range >= m.max_range else m.range)),
        r'of the echoes are at 0\.100 m.*if there is no echo\? Let it send \+inf',
    ),
    'variance in square millimetres': (
        lambda: drive().with_ranges(lambda m: m._replace(variance=9.0)),
        r'state a variance of 9 m², as if ranges scattered by 3 m.*square metres',
    ),
    'no limit stated': (
        lambda: drive().with_ranges(
            lambda m: m._replace(max_range=3.4e38, range=math.inf if m.range >= m.max_range else m.range)
        ),
        r'does the driver state no limit.*set the parameter max_range',
    ),
    'odometry far away for a moment': (
        lambda: astray(0.3),
        r'readings make the map 3\d\d x 2\d\d m instead of .* far from all others.*max_jump',
    ),
    'one echo far away': (far_echo, r'1 of 4808 readings make the map .* range of 80.0 m.*set the parameter max_range'),
    'ranges in centimetres': (lambda: scaled(100, 1), r'are the ranges in centimetres and the limits in metres'),
    'ranges in centimetres, of near walls': (
        lambda: scaled(52, 1),
        r'times as large, and so are treated as no echo: are the ranges in centimetres',
    ),
    'ranges in millimetres': (lambda: scaled(1000, 1), r'are the ranges in millimetres and the limits in metres'),
    'ranges in feet': (lambda: scaled(3.281, 1), r'are the ranges in feet and the limits in metres'),
    'ranges in inches': (lambda: scaled(39.37, 1), r'are the ranges in inches and the limits in metres'),
    'ranges of one sensor in centimetres': (
        lambda: of_one(circling(), 100),
        r'^sensor sonar_2: \d+ of \d+ examined ranges .* are the ranges in centimetres and the limits in metres',
    ),
    'readings without an echo are left out': (
        lambda: without_silence(3.0),
        'sensors sonar_5, sonar_6, sonar_7 send nothing for up to .* readings without an echo',
    ),
    'min_range in centimetres': (
        lambda: drive().with_ranges(lambda m: m._replace(min_range=2.0)),
        r'below min_range \(2 m\).*are the limits in centimetres',
    ),
    'limits in centimetres': (
        lambda: scaled(1, 100),
        r'max_range is 500 m, and no range.*is it in centimetres',
    ),
    'limits in millimetres': (lambda: scaled(1, 1000), r'max_range is 5000 m, and no range.*is it in centimetres'),
    'all in centimetres': (lambda: scaled(100, 100), r'are ranges and limits in centimetres or millimetres'),
    'all in millimetres': (lambda: scaled(1000, 1000), r'are ranges and limits in centimetres or millimetres'),
}


@pytest.mark.parametrize('name', sorted(SCENARIOS))
def test_wrong_input_gives_one_warning_with_the_cause(name: str) -> None:
    make, expected = SCENARIOS[name]
    warnings = warnings_of(make())
    assert any(re.search(expected, warning) for warning in warnings), warnings
    assert len(warnings) == 1, f'one cause, one warning: {warnings}'


@pytest.mark.parametrize(('limit', 'given', 'warned'), [(500.0, 5.0, 1), (0.5, 5.0, 1), (5.0, 1.5, 0)])
def test_max_range_as_a_parameter_replaces_wrong_limits(limit: float, given: float, warned: int) -> None:
    """The warning asks for it; and a smaller one than that of the messages, to map only what is near, is no fault."""
    wrong = drive().with_ranges(lambda m: m._replace(max_range=limit))
    assert len(associated(*wrong).message_warnings()) == warned
    assert associated(*wrong, max_range=given).message_warnings() == []


def test_ranges_are_compared_with_max_range_as_a_parameter() -> None:
    centimetres = drive().with_ranges(lambda m: m._replace(range=100 * m.range, max_range=500.0))
    (warning,) = associated(*centimetres, max_range=5.0).message_warnings()
    assert 'are the ranges in centimetres and the limits in metres' in warning


def test_unit_of_a_sensor_that_seldom_has_an_echo_is_found() -> None:
    rng = np.random.default_rng(0)
    frame = sorted(circling().extrinsics)[2]
    quiet = circling().with_ranges(lambda m: m._replace(range=m.range if rng.random() < 0.2 else math.inf))
    assert associated(*quiet).message_warnings() == []
    (warning,) = associated(*of_one(quiet, 100)).message_warnings()
    assert re.search(f'sensor {frame}: .* are the ranges in centimetres', warning), warning


def test_limits_in_the_wrong_order_are_no_question_of_units() -> None:
    """The readings are rejected as bad_limits, which is said elsewhere."""
    swapped = drive().with_ranges(lambda m: m._replace(min_range=m.max_range, max_range=m.min_range))
    associator = associated(*swapped)
    assert set(associator.rejected) == {'bad_limits'} and associator.message_warnings() == []


@pytest.mark.slow
@pytest.mark.parametrize('noise', [NOISY, NOISE_FREE])
@pytest.mark.parametrize('sonars', [front_array, sonar_ring])
def test_simulated_worlds_give_no_warning(noise: object, sonars: Callable[[], SonarArray]) -> None:
    for seed in range(3):
        for recording in (
            *(door_drive(seen, noise, seed, sonars()) for seen in (1, 3, 16)),
            corridor_drive(seed, 1 + seed % 2, noise, noise is NOISY, sonars()),
            *([building_drive(seed, 1, noise, noise is NOISY, sonars())] if not seed else []),
        ):
            # ten poses a second
            assert warnings_of(Messages(dict(recording.extrinsics), recording.odometry[::5], recording.ranges)) == []


@pytest.mark.parametrize('given', [circling, drive])
@pytest.mark.parametrize('back', [21.0, 29.0])
@pytest.mark.parametrize('apart', [0.0, 0.037])
def test_two_places_at_one_time_give_no_warning(given: Callable[[], Messages], back: float, apart: float) -> None:
    """The clock jumped back in the middle of the drive, and the robot drove on."""
    readings = associated(*given()).readings
    stamp, half = readings.stamp.copy(), len(readings) // 2
    stamp[half:] -= round((back + apart) * SECOND)
    assert input_warnings(replace(readings, stamp=stamp)) == []


def test_few_readings_may_have_a_period_at_random() -> None:
    def alternating(count: int) -> bool:
        k = np.arange(count)
        ranges = Readings.from_columns(
            ('sonar',),
            x=0.05 * k,
            y=0.0,
            yaw=0.0,
            z=1.0 + k % 3,
            z_max=5.0,
            half_angle=0.13,
            stamp=k * 10**8 + 7 * 10**6,
        )
        return any('alternate like' in text for text in input_warnings(ranges))

    assert not alternating(100)
    assert alternating(101)


def test_an_echo_that_comes_and_goes_has_no_period() -> None:
    """Half of the time the sensor passes a wall that it hears at random, so that a quarter of the ranges change."""
    count = 1000
    for seed in range(20):
        heard = np.random.default_rng(seed).random(count) < 0.5
        z = np.where(heard & (np.arange(count) < 0.52 * count), 2.0, 5.0)
        x, stamp = 0.05 * np.arange(count), np.arange(count) * 10**8 + 7 * 10**6
        ranges = Readings.from_columns(('sonar',), x=x, y=0.0, yaw=0.0, z=z, z_max=5.0, half_angle=0.13, stamp=stamp)
        assert not any('alternate like' in text for text in input_warnings(ranges)), seed


@pytest.mark.parametrize(('sensors', 'warns'), [(6, True), (LONGEST_PERIOD, True), (LONGEST_PERIOD + 1, False)])
def test_rings_of_up_to_32_sensors_with_one_frame_are_detected(sensors: int, warns: bool) -> None:
    k, wide = np.arange(20 * sensors), np.random.default_rng(2).permutation(sensors)
    z = 1.0 + 8.0 * wide[k % sensors] / sensors
    ranges = Readings.from_columns(
        ('sonar',), x=0.01 * k, y=0.0, yaw=0.0, z=z, z_max=10.0, half_angle=0.13, stamp=k * 10**8 + 7 * 10**6
    )
    assert any('alternate like' in text for text in input_warnings(ranges)) == warns


@pytest.mark.parametrize('odometry', ['/odom', '/odom_corrected'])
@pytest.mark.parametrize('name', ['office_a', 'office_b', 'building_a', 'building_b', 'building_c'])
def test_real_recordings_give_no_warning(shared: Path, name: str, odometry: str) -> None:
    from forward_grid_mapper.recordings.read_drive import read_drive

    bag = shared / 'data' / name / 'bag'
    if not bag.exists():
        pytest.skip(f'{bag} is not there')
    found = read_drive(bag, Parameters(), {}, None, odometry)
    assert found.associator.message_warnings() == []
    assert input_warnings(found.associator.readings) == []


def test_largest_ranges_from_one_place_give_no_warning() -> None:
    """Six of eight sensors see walls at 1 m, two look along a corridor."""
    rng = np.random.default_rng(0)
    frames, pose = list(drive().extrinsics), drive().odometry[0].pose
    odometry = [OdometryMessage(k * 100_000_000, 'odom', 'base_link', pose) for k in range(301)]
    ranges = [
        RangeMessage(k * 100_000_000, frame, math.inf if n < 2 else 1.0 + rng.normal(0, 0.02), 0.1, 5.0, 0.26)
        for k in range(300)
        for n, frame in enumerate(frames)
    ]
    assert warnings_of(Messages(drive().extrinsics, odometry, ranges)) == []


def test_robot_at_standstill_with_people_gives_no_warning() -> None:
    """Two of eight sensors see a person approach; the others have constant ranges."""
    rng = np.random.default_rng(0)
    frames = list(drive().extrinsics)
    pose = drive().odometry[0].pose
    odometry = [OdometryMessage(k * 100_000_000, 'odom', 'base_link', pose) for k in range(601)]
    ranges = [
        RangeMessage(
            k * 100_000_000,
            frame,
            2.0 + rng.normal(0, 0.02) - (0.03 * (k % 50) if n < 2 else 0.0),
            0.1,
            5.0,
            0.26,
        )
        for k in range(600)
        for n, frame in enumerate(frames)
    ]
    assert warnings_of(Messages(drive().extrinsics, odometry, ranges)) == []


def test_sensor_that_paused_before_may_pause_at_the_end() -> None:
    def kept(message: RangeMessage) -> bool:
        return message.frame_id != 'sonar_3' or not (5 < message.stamp / 1e9 < 20 or message.stamp / 1e9 > 45)

    assert warnings_of(circling()._replace(ranges=[m for m in circling().ranges if kept(m)])) == []


def test_robot_that_drives_in_circles_gives_no_warning() -> None:
    assert warnings_of(circling()) == []


@pytest.mark.parametrize('swings', [False, True])
@pytest.mark.parametrize('steps', [5, 10, 16, 25, 32])
def test_repeated_ranges_of_a_turning_sensor_give_no_warning(steps: int, swings: bool) -> None:
    """On a robot that turns on the spot all the time, or on a servo that turns to the left and to the right."""
    rng, odometry, ranges = np.random.default_rng(2), [], []
    for k in range(600):
        part = k % steps / steps
        yaw = 2.0 * abs(2 * part - 1) if swings else math.remainder(math.tau * part, math.tau)
        odometry.append(OdometryMessage(k * 100_000_000, 'odom', 'base_link', Pose2(2.5, 1.5, yaw)))
        z = in_a_room(2.5, 1.5, yaw) + rng.normal(0, 0.02)
        ranges.append(RangeMessage(k * 100_000_000, 'sonar', z, 0.1, 8.0, 0.26))
    assert warnings_of(Messages({'sonar': Pose2(0.0, 0.0, 0.0)}, odometry, ranges)) == []


def test_few_readings_give_no_warning() -> None:
    few = drive()._replace(ranges=twice().ranges[:28])
    assert warnings_of(few) == []


def test_value_above_max_range_for_no_echo_gives_no_warning() -> None:
    for value in (5.11, 6.5535, 65.535, 99.0):
        assert (
            warnings_of(drive().with_ranges(lambda m, v=value: m._replace(range=v) if m.range >= m.max_range else m))
            == []
        )


def test_fixed_distance_rangers_give_no_warning() -> None:
    """REP 117: -inf is an echo below max_range, which is mapped at half of it."""

    def fixed(m: RangeMessage) -> RangeMessage:
        return m._replace(range=-math.inf if m.range < 1.5 else math.inf, min_range=1.5, max_range=1.5)

    assert warnings_of(drive().with_ranges(fixed)) == []


def test_sensor_that_sees_the_robot_gives_no_warning_of_no_echo() -> None:
    """The sensor returns min_range in all directions, which has its own verdict."""
    frame = next(iter(circling().extrinsics))
    near = circling().with_ranges(lambda m: m._replace(range=0.1 if m.frame_id == frame and m.stamp % 7 else m.range))
    assert not [text for text in warnings_of(near) if 'if there is no echo' in text]


@pytest.mark.parametrize(('sensors', 'part'), [(8, 0.4), (8, 1.0), (4, 1.0), (2, 1.0)])
def test_covered_sensor_gives_no_warning_of_units(sensors: int, part: float) -> None:
    """It sees the dirt on it, nearer than min_range."""
    rng, (frame, *others) = np.random.default_rng(0), list(circling().extrinsics)
    covered = circling().with_ranges(
        lambda m: m._replace(range=0.04) if m.frame_id == frame and rng.random() < part else m
    )
    covered = covered._replace(ranges=[m for m in covered.ranges if m.frame_id in (frame, *others[: sensors - 1])])
    if sensors == 2:
        covered = covered.with_ranges(lambda m: m if m.frame_id == frame else m._replace(range=math.inf))
    assert not [text for text in warnings_of(covered) if 'must state metres' in text]


def test_plausible_variance_gives_no_warning() -> None:
    assert warnings_of(drive().with_ranges(lambda m: m._replace(variance=0.04))) == []


def test_wall_at_a_constant_distance_gives_no_warning_of_no_echo() -> None:
    """A robot at standstill for long, with ranges in centimetres, and one that drives to and fro along a wall."""
    rounded = circling().with_ranges(lambda m: m._replace(range=round(min(m.range, 4.5), 2), max_range=4.5))
    last = rounded.odometry[-1]
    poses = [last._replace(stamp=last.stamp + k * 100_000_000) for k in range(1, 3000)]
    farthest = [m._replace(range=4.4) for m in rounded.ranges[-len(rounded.extrinsics) :]]
    ranges = [m._replace(stamp=pose.stamp) for pose in poses for m in farthest]
    assert not [
        text for text in warnings_of(Messages(rounded.extrinsics, poses, ranges)) if 'if there is no echo' in text
    ]

    at_the_side = {'left': Pose2(0.0, 0.0, math.pi / 2)}
    beside = [Pose2(min(k, 200 - k) * 0.1, 0.0, 0.0) for k in range(200)]
    poses = [OdometryMessage(k * 500_000_000, 'odom', 'base_link', pose) for k, pose in enumerate(beside)]
    ranges = [
        RangeMessage(k * 250_000_000, 'left', round(1.5 + 0.01 * math.sin(k), 2), 0.1, 4.0, 0.26) for k in range(400)
    ]
    assert not [text for text in warnings_of(Messages(at_the_side, poses, ranges)) if 'if there is no echo' in text]


def test_readings_at_whole_seconds_give_no_warning() -> None:
    seldom = circling()._replace(ranges=[m for m in circling().ranges if m.stamp % SECOND == 0])
    assert warnings_of(seldom) == []
