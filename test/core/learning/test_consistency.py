"""Warnings about poses and stamps that contradict the readings, with the cause; correct drives give none."""

from __future__ import annotations

import dataclasses
import math
import re
import sys
import time
import tracemalloc
from collections.abc import Callable, Iterator
from functools import lru_cache
from pathlib import Path
from typing import NamedTuple

import numpy as np
import pytest

from forward_grid_mapper.core.common.parameters import Parameters
from forward_grid_mapper.core.common.readings import Readings
from forward_grid_mapper.core.learning import consistency
from forward_grid_mapper.core.learning.consistency import consistency_warnings
from forward_grid_mapper.core.learning.trial_maps import MountedReadings
from forward_grid_mapper.core.mapping import Mapper
from forward_grid_mapper.core.messages.message_types import NANOSECONDS, OdometryMessage, Pose2, RangeMessage
from forward_grid_mapper.files.quality_warning import quality_warning
from forward_grid_mapper.simulation.drive import Recording, building_drive, corridor_drive, door_drive, drive
from forward_grid_mapper.simulation.sonar import NOISE_FREE, NOISY, SonarArray, front_array, sonar_ring
from forward_grid_mapper.simulation.world import rooms_world
from samples import associated

sys.path.insert(0, str(Path(__file__).resolve().parents[3] / 'benchmarks'))

from quality_worlds import OWN, ROUGHER, ring


class Messages(NamedTuple):
    """The messages of a robot, and the stated poses of its sensors."""

    extrinsics: dict[str, Pose2]
    odometry: list[OdometryMessage]
    ranges: list[RangeMessage]

    def mounted(self, change: Callable[[Pose2], Pose2]) -> Messages:
        return self._replace(extrinsics={frame: change(pose) for frame, pose in self.extrinsics.items()})

    def driven(self, change: Callable[[Pose2], Pose2]) -> Messages:
        return self._replace(odometry=[m._replace(pose=change(m.pose)) for m in self.odometry])

    def late(self, seconds: float) -> Messages:
        by = round(seconds * NANOSECONDS)
        return self._replace(ranges=[m._replace(stamp=m.stamp + by) for m in self.ranges])

    def wide(self, factor: float) -> Messages:
        return self._replace(ranges=[m._replace(field_of_view=factor * m.field_of_view) for m in self.ranges])

    def in_feet(self) -> Messages:
        def feet(m: RangeMessage) -> RangeMessage:
            return m._replace(range=3.281 * m.range, min_range=3.281 * m.min_range, max_range=3.281 * m.max_range)

        return self._replace(ranges=[feet(m) for m in self.ranges])


@lru_cache(maxsize=1)
def office() -> Messages:
    """A drive through the rooms of a building, with eight sonars in front."""
    made = building_drive(0, 1, NOISY, True, front_array())
    # ten poses a second are sufficient
    return Messages(dict(made.extrinsics), list(made.odometry[::5]), list(made.ranges))


def warnings_of(messages: Messages) -> list[str]:
    return consistency_warnings(associated(*messages).readings, messages.extrinsics)


def turned(degrees: float) -> Callable[[Pose2], Pose2]:
    return Pose2(0.0, 0.0, math.radians(degrees)).compose


SCENARIOS: dict[str, tuple[Callable[[Messages], Messages], str]] = {
    'left and right of the sensors swapped': (
        lambda m: m.mounted(lambda p: Pose2(p.x, -p.y, -p.yaw)),
        r'left and right of the sensors seem to be swapped; check the poses.*y to the left and yaw counter-clockwise',
    ),
    'yaw of the sensors clockwise': (
        lambda m: m.mounted(lambda p: Pose2(p.x, p.y, -p.yaw)),
        r'the yaw of the sensors seems to have the wrong sign; check the poses of the sensors',
    ),
    'sensors turned to the left': (
        lambda m: m.mounted(turned(90)),
        r'seem to be rotated by 90 degrees to the left',
    ),
    'sensors turned to the right': (
        lambda m: m.mounted(turned(-90)),
        r'sensors seem to be rotated by 90 degrees to the right',
    ),
    'sensors front to back': (
        lambda m: m.mounted(turned(180)),
        r'the sensors seem to be rotated by 180 degrees; check',
    ),
    'yaw of odometry clockwise': (
        lambda m: m.driven(lambda p: Pose2(p.x, p.y, -p.yaw)),
        r'y, or yaw, seems to have the wrong sign in odometry.*correct its driver',
    ),
    'y of odometry to the right': (
        lambda m: m.driven(lambda p: Pose2(p.x, -p.y, p.yaw)),
        r'y, or yaw, seems to have the wrong sign in odometry.*correct its driver',
    ),
    'x of odometry backwards': (
        lambda m: m.driven(lambda p: Pose2(-p.x, p.y, p.yaw)),
        r'(x|y, or yaw,) seems to have the wrong sign in odometry.*correct its driver',
    ),
    'x and y of odometry swapped': (
        lambda m: m.driven(lambda p: Pose2(p.y, p.x, p.yaw)),
        r'x and y seem to be swapped in odometry.*correct its driver',
    ),
    'odometry without orientation': (
        lambda m: m.driven(lambda p: Pose2(p.x, p.y, 0.0)),
        r'yaw of odometry never changes, although the robot turns.*leave out the orientation',
    ),
    'ranges half a second late': (
        lambda m: m.late(0.5),
        # at a constant speed, half a second is a quarter of a metre
        r'are 0\.[45]\d s \(±0\.0\d s\) too late.*does not tell which.*range_time_offset to -0\.[45]\d,.*at the time',
    ),
    'ranges a second late': (
        lambda m: m.late(1.0),
        r'readings are (0\.9\d|1\.0\d) s \(±0\.0\d s\) too late against those of odometry',
    ),
    'odometry half a second late': (
        lambda m: m.late(-0.5),
        r'readings are 0\.[45]\d s \(±0\.0\d s\) too early.*range_time_offset to 0\.[45]\d,',
    ),
    'odometry 0.8 s late': (
        lambda m: m.late(-0.8),
        r'readings are 0\.(7|8)\d s \(±0\.0\d s\) too early against those of',
    ),
    'odometry a second late': (
        lambda m: m.late(-1.0),
        r'are (0\.9\d|1\.0\d) s \(±0\.0\d s\) too early against those of',
    ),
    'ranges 0.15 s late': (
        lambda m: m.late(0.15),
        r'are 0\.1[3-7] s \(±0\.0[1-3] s\) too late.*range_time_offset to -0\.1[3-7],',
    ),
    'sensors turned by 12 degrees': (
        lambda m: m.mounted(turned(12)),
        r'sensors are rotated by 1[0-4] degrees \(±\d\.\d\) to the right of their stated poses; check the poses',
    ),
    'sensors turned by 12 degrees the other way': (
        lambda m: m.mounted(turned(-12)),
        r'sensors are rotated by 1[0-4] degrees \(±\d\.\d\) to the left of their stated poses; check the poses',
    ),
    'ranges a tenth too long': (
        lambda m: m._replace(ranges=[r._replace(range=1.1 * r.range) for r in m.ranges]),
        r'ranges are (9|10|11)% \(±\d\.\d\) too long for the distances of odometry; correct the speed of sound',
    ),
    'wheels stated a tenth too large': (
        lambda m: m.driven(lambda p: Pose2(1.1 * p.x, 1.1 * p.y, p.yaw)),
        r'ranges are (8|9|10)% \(±\d\.\d\) too short for the distances of odometry.*or the wheel radius',
    ),
    'sensors stated too far forward': (
        lambda m: m.mounted(lambda p: Pose2(p.x + 0.2, p.y, p.yaw)),
        r'the sensors are 0\.(1[6-9]|2[0-4]) m \(±0\.0\d m\) behind their stated poses',
    ),
    'sensors stated too far to the right': (
        lambda m: m.mounted(lambda p: Pose2(p.x, p.y - 0.2, p.yaw)),
        r'the sensors are 0\.(1[6-9]|2[0-4]) m \(±0\.0\d m\) to the left of their stated poses',
    ),
    'cones of 60 degrees for 15': (
        lambda m: m.wide(4.0),
        r'field of view is stated as 60 degrees.*fit about 15 degrees;.*set the parameter field_of_view',
    ),
    'cones of 87 degrees for 15': (lambda m: m.wide(1.5 / 0.26), r'is stated as 87 degrees.*fit about 14 degrees;'),
    'half of the field of view': (lambda m: m.wide(0.5), r'field of view is stated as 7 degrees.*fit about 15'),
    'odometry in feet': (
        lambda m: m.driven(lambda p: Pose2(3.281 * p.x, 3.281 * p.y, p.yaw)),
        r'the robot drives 1/3\.28 as far as odometry says.*in feet.*must be in metres',
    ),
    'ranges and limits in feet': (
        lambda m: m.in_feet(),
        r'the robot drives 3\.28 times as far as odometry says.*in feet.*must be in metres',
    ),
    'diameter of the wheels for their radius': (
        lambda m: m.driven(lambda p: Pose2(2 * p.x, 2 * p.y, p.yaw)),
        r'the robot drives 1/2 as far as odometry says.*is the wheel radius wrong',
    ),
}


FEW = (
    'left and right of the sensors swapped',
    'odometry in feet',
    'ranges 0.15 s late',
    'half of the field of view',
)
"""One scenario of each kind, tried first."""


@pytest.mark.parametrize(
    'name', [*FEW, *(pytest.param(name, marks=pytest.mark.slow) for name in sorted({*SCENARIOS} - {*FEW}))]
)
def test_wrong_poses_give_one_warning_with_the_cause(name: str) -> None:
    change, expected = SCENARIOS[name]
    warnings = warnings_of(change(office()))
    assert len(warnings) == 1, 'one cause, one warning'
    assert re.search(expected, warnings[0]), warnings


@pytest.mark.parametrize(
    ('quantity', 'plus', 'minus'),
    [
        (consistency.TIME, 'are 0.10 s (±0.01 s) too early', 'are 0.10 s (±0.01 s) too late'),
        (consistency.YAW, 'by 6 degrees (±0.6) to the left of', 'by 6 degrees (±0.6) to the right of'),
        (consistency.FORWARD, 'are 0.10 m (±0.01 m) forward of', 'are 0.10 m (±0.01 m) behind'),
        (consistency.SCALE, 'ranges are 10% (±1.0) too long', 'ranges are 10% (±1.0) too short'),
        (consistency.LEFT, 'are 0.10 m (±0.01 m) to the left of', 'are 0.10 m (±0.01 m) to the right of'),
    ],
)
def test_sign_of_an_offset_is_that_of_its_words(quantity: consistency.Quantity, plus: str, minus: str) -> None:
    assert plus in consistency._words(quantity, 0.1, 0.01)
    assert minus in consistency._words(quantity, -0.1, 0.01)


def test_remedy_includes_the_offset_that_is_set() -> None:
    late = office().late(0.15)
    readings = associated(*late).readings
    (warning,) = consistency_warnings(readings, late.extrinsics, Parameters.from_flat({'range_time_offset': -0.1}))
    assert re.search(r'0\.1[3-7] s .* too late.*range_time_offset to -0\.2[3-7],', warning), warning


def in_a_room(turns: Callable[[float], float]) -> Messages:
    """A robot in a room of 8 by 6 metres that alternately turns by 0.5 rad/s and drives; `turns` changes its yaw.

    Eight sensors measure one after the other, 80 times a second; odometry has 20 messages a second.
    """
    rng = np.random.default_rng(4)
    extrinsics = {f'sonar_{n}': Pose2(0.0, 0.0, n * math.pi / 4) for n in range(8)}
    pose, odometry, ranges = Pose2(0.0, 0.0, 0.0), [], []
    for k in range(3201):
        stamp = k * NANOSECONDS // 80
        if k % 4 == 0:
            odometry.append(OdometryMessage(stamp, 'odom', 'base_link', pose._replace(yaw=turns(pose.yaw))))
        yaw = pose.yaw + k % 8 * math.pi / 4
        c, s = math.cos(yaw), math.sin(yaw)
        z = min((math.copysign(4, c) - pose.x) / (c or 1e-9), (math.copysign(3, s) - pose.y) / (s or 1e-9))
        ranges.append(RangeMessage(stamp, f'sonar_{k % 8}', z + rng.normal(0, 0.02), 0.1, 8.0, 0.26))
        pose = pose.compose(Pose2(0.0, 0.0, 0.5 / 80) if k // 250 % 2 else Pose2(0.004, 0.0, 0.0))
    return Messages(extrinsics, odometry, ranges)


def test_yaw_in_degrees_gives_a_warning() -> None:
    assert warnings_of(in_a_room(lambda yaw: yaw)) == []
    (warning,) = warnings_of(in_a_room(lambda yaw: math.remainder(math.degrees(yaw), math.tau)))
    assert re.search(r'the yaw of the robot turns at \d\d rad/s: is it in degrees\?.*half the yaw in radians', warning)


def test_jumps_and_noise_of_the_yaw_give_no_warning_of_degrees() -> None:
    rng = np.random.default_rng(0)
    assert warnings_of(in_a_room(lambda yaw: yaw + rng.normal(0, 0.01))) == []
    assert warnings_of(in_a_room(lambda yaw: yaw + 2.0 * (rng.random() < 0.01))) == []


def drives() -> Iterator[tuple[str, Callable[[], Recording]]]:
    """All simulated worlds, with both arrays."""
    for sonars in (front_array, sonar_ring):
        for seen in (1, 3, 16):
            yield f'door {seen} {sonars.__name__}', lambda n=seen, s=sonars: door_drive(n, NOISY, 0, s())
        yield f'corridor {sonars.__name__}', lambda s=sonars: corridor_drive(0, 1, NOISY, True, s())
        yield f'building {sonars.__name__}', lambda s=sonars: building_drive(0, 1, NOISY, True, s())
    wide = sonar_ring(field_of_view=math.radians(30.0))
    yield 'corridor 30°', lambda: corridor_drive(1, sonars=wide)
    yield 'door noise-free', lambda: door_drive(3, NOISE_FREE, 0)
    for name, (make, way) in OWN.items():
        for degrees, spacing, noise, person in ((15, 0.08, NOISY, False), (30, 0.15, ROUGHER, True)):
            yield (
                f'{name} {degrees}°',
                lambda w=make, p=way, d=degrees, s=spacing, n=noise, o=person: drive(
                    w(), np.array(p), s, ring(d), n, 11, person=o
                ),
            )


DRIVES = dict(drives())


@pytest.mark.slow
@pytest.mark.parametrize('name', sorted(DRIVES))
def test_simulated_worlds_give_no_warning(name: str) -> None:
    recording = DRIVES[name]()
    assert consistency_warnings(recording.readings, dict(recording.extrinsics)) == []


@pytest.mark.slow
@pytest.mark.parametrize('odometry', ['/odom', '/odom_corrected'])
@pytest.mark.parametrize('name', ['office_a', 'office_b', 'building_a', 'building_b', 'building_c'])
def test_real_recordings_give_no_warning(shared: Path, name: str, odometry: str) -> None:
    from forward_grid_mapper.recordings.read_drive import read_drive

    bag = shared / 'data' / name / 'bag'
    if not bag.exists():
        pytest.skip(f'{bag} is not there')
    found = read_drive(bag, Parameters(), {}, None, odometry)
    assert len(found.source['extrinsics']) >= 8
    assert consistency_warnings(found.associator.readings, found.source['extrinsics']) == []


@pytest.mark.slow
@pytest.mark.parametrize(
    ('change', 'expected'),
    [
        (lambda drive: drive.shifted(0.25), r'stamps of the readings are 0\.2\d s \(±0\.0\d s\) too late'),
        (lambda drive: drive.rotated(math.radians(6)), r'rotated by [567] degrees \(±\d\.\d\) to the right'),
        (lambda drive: drive.moved(forward=0.12), r'are 0\.1\d m \(±0\.0\d m\) behind their'),
        (lambda drive: drive.moved(left=-0.12), r'are 0\.1\d m \(±0\.0\d m\) to the left of'),
    ],
)
def test_offsets_are_measured_on_a_recording(
    shared: Path, change: Callable[[MountedReadings], Readings], expected: str
) -> None:
    from forward_grid_mapper.recordings.read_drive import read_drive

    found = read_drive(shared / 'data' / 'building_c' / 'bag', Parameters(), {}, None, '/odom_corrected')
    extrinsics = found.source['extrinsics']
    drive = MountedReadings.of(found.associator.readings, extrinsics)
    # the readings are placed by wrong poses of the sensors
    (warning,) = consistency_warnings(change(drive), extrinsics)
    assert re.search(expected, warning), warning


def swapped_sides(readings: Readings, extrinsics: dict[str, Pose2]) -> list[str]:
    """The warnings about readings that are placed with left and right of the sensors swapped."""
    drive = MountedReadings.of(readings, extrinsics)
    forward, left, turn = drive.extrinsics
    wrong = {name: Pose2(pose.x, -pose.y, -pose.yaw) for name, pose in extrinsics.items()}
    return consistency_warnings(drive.placed(extrinsics=np.stack([forward, -left, -turn])), wrong)


def test_swapped_sides_are_found_if_a_short_part_tells_little() -> None:
    """Three sensors, of whose readings most have no echo."""
    three = SonarArray((0.0, math.pi / 2, -math.pi / 2), 0.1, math.radians(25.0), 4.0, 0.1)
    made = building_drive(0, 1, NOISY, True, three)
    silent = np.random.default_rng(0).random(len(made.readings)) < 0.6
    readings = dataclasses.replace(made.readings, z=np.where(silent, made.readings.z_max, made.readings.z))
    extrinsics = dict(made.extrinsics)
    assert consistency_warnings(readings, extrinsics) == []
    (warning,) = swapped_sides(readings, extrinsics)
    assert 'left and right of the sensors seem to be swapped' in warning


@pytest.mark.slow
@pytest.mark.parametrize('name', ['office_a', 'office_b'])
def test_swapped_sides_are_found_on_a_recording(shared: Path, name: str) -> None:
    from forward_grid_mapper.recordings.read_drive import read_drive

    bag = shared / 'data' / name / 'bag'
    if not bag.exists():
        pytest.skip(f'{bag} is not there')
    found = read_drive(bag, Parameters(), {}, None, '/odom_corrected')
    (warning,) = swapped_sides(found.associator.readings, found.source['extrinsics'])
    assert 'left and right of the sensors seem to be swapped' in warning


@pytest.mark.slow
def test_wide_cones_are_named_on_a_recording_with_drift(shared: Path) -> None:
    from forward_grid_mapper.recordings.read_drive import read_drive

    found = read_drive(shared / 'data' / 'building_b' / 'bag', Parameters(), {}, None, '/odom')
    readings = found.associator.readings
    wide = dataclasses.replace(readings, half_angle=np.full(len(readings), 0.75))
    (warning,) = consistency_warnings(wide, found.source['extrinsics'])
    assert re.search(r'the field of view is stated as 86 degrees, but the readings fit about (21|43) degrees', warning)


def test_few_readings_or_unknown_sensors_give_no_warning() -> None:
    recording = building_drive(0, 1, NOISY, True, front_array())
    backwards = {frame: turned(180)(pose) for frame, pose in recording.extrinsics}
    r, count = recording.readings, len(recording.readings)
    wrong = {name: pose for name, pose in backwards.items() if name == r.sensor_names[0]}
    assert consistency_warnings(r.select(slice(0, 250)), backwards) == []
    assert consistency_warnings(r, {}) == []
    assert consistency_warnings(r.select(r.sensor != 0), wrong) == []
    assert consistency_warnings(Readings.from_columns(x=[], y=[], yaw=[], z=[], z_max=[], half_angle=[]), {}) == []
    assert count > 1000


def test_robot_at_standstill_gives_no_warning() -> None:
    rng = np.random.default_rng(0)
    frames = list(office().extrinsics)
    pose = office().odometry[0].pose
    odometry = [OdometryMessage(k * NANOSECONDS // 10, 'odom', 'base_link', pose) for k in range(101)]
    ranges = [
        RangeMessage(k * NANOSECONDS // 10, frame, 2.0 + 0.2 * n + rng.normal(0, 0.02), 0.1, 5.0, 0.26)
        for k in range(100)
        for n, frame in enumerate(frames)
    ]
    assert warnings_of(Messages(office().extrinsics, odometry, ranges)) == []


@pytest.mark.slow
def test_processor_time_is_independent_of_length_and_range() -> None:
    """Each limit is a multiple of the usual processor time."""
    recording = building_drive(0, 1, NOISY, True, front_array())
    r, extrinsics = recording.readings, dict(recording.extrinsics)

    def cost(readings: Readings) -> float:
        begin = time.process_time()
        consistency_warnings(readings, extrinsics)
        return time.process_time() - begin

    cost(r)
    usual = cost(r)
    far = dataclasses.replace(r, z=10 * r.z, z_max=10 * r.z_max)
    again = np.tile(np.arange(len(r)), 20)
    often = dataclasses.replace(
        r.select(again), stamp=r.stamp[again] + np.repeat(np.arange(20), len(r)) * np.ptp(r.stamp)
    )
    assert cost(far) < 4 * usual
    assert cost(often) < 4 * usual


def test_random_ranges_of_all_sensors_give_a_quality_warning() -> None:
    """If the ranges of all sensors are random, no sensor differs from the others."""
    recording = building_drive(0, 1, NOISY, True, front_array())
    r = recording.readings
    random = dataclasses.replace(r, z=np.random.default_rng(0).uniform(0.2, 1.0, len(r)) * r.z_max)
    maps = Mapper(Parameters()).run(random)
    assert re.search(r'of \d+ readings are most likely random.*poses of the sensors, odometry', quality_warning(maps))
    assert not quality_warning(Mapper(Parameters()).run(r))


@pytest.mark.parametrize('yaw', [0.0, 57.3])
def test_constant_yaw_of_a_straight_drive_is_not_called_a_turn(yaw: float) -> None:
    """Odometry without an orientation, and one in degrees: 57.3° are 1 rad."""
    made = drive(rooms_world(), np.array([[1.5, 3.45], [10.5, 3.45]]), 0.05, front_array(), NOISY, seed=2)
    straight = Messages(dict(made.extrinsics), list(made.odometry), list(made.ranges)).driven(Pose2(0, 0, 1.0).compose)
    assert not warnings_of(straight)
    (warning,) = warnings_of(straight.driven(lambda p: Pose2(p.x, p.y, yaw)))
    assert f'always {yaw:.2f} rad, but the robot drives in the direction 1.0' in warning, warning
    assert 'leave out the orientation, or is the yaw in degrees' in warning


def test_directions_of_travel_of_odometry_that_jumps_need_little_memory() -> None:
    k = np.arange(20_000)
    readings = Readings.from_columns(
        ('a',), x=50.0 * (k % 2), y=0.001 * k, yaw=0.0, z=np.ones(len(k)), z_max=3.0, half_angle=0.1, stamp=k
    )
    made = MountedReadings.of(readings, {'a': Pose2(0.0, 0.0, 0.0)})
    tracemalloc.start()
    at, directions = made.travel()
    most = tracemalloc.get_traced_memory()[1]
    tracemalloc.stop()
    assert len(at) == len(directions) == len(k) - 2
    assert most < 2000 * len(k) / 10
