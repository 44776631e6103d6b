"""Simulated drives: the recorded messages, and their consistency."""

from __future__ import annotations

import math

import numpy as np
import pytest

from forward_grid_mapper.simulation.drive import (
    START,
    building_drive,
    corridor_drive,
    door_drive,
    drive,
    drive_sweeps,
    passing_drive,
)
from forward_grid_mapper.simulation.rays import blocked
from forward_grid_mapper.simulation.sonar import NOISE_FREE, NOISY, front_array
from forward_grid_mapper.simulation.world import door_world, rooms_world

TOUR = np.array([[1.5, 1.5], [3.0, 3.45], [9.0, 3.45], [9.0, 2.0], [10.5, 6.5]])


@pytest.fixture(scope='module')
def tour():
    return drive(rooms_world(), TOUR, 0.3, front_array(), NOISY, seed=2)


def test_sweeps_are_evenly_spaced(tour):
    length = np.hypot(*np.diff(TOUR, axis=0).T).sum()
    assert len(tour.robot) == 1 + math.floor(length / 0.3)
    assert len(tour.ranges) == len(tour.readings) == 8 * len(tour.robot)
    steps = np.hypot(*np.diff(tour.robot[:, :2], axis=0).T)
    assert steps.max() == pytest.approx(0.3)


def test_messages_and_readings_agree(tour):
    readings = tour.readings
    assert [m.stamp for m in tour.ranges] == readings.stamp.tolist()
    assert [m.frame_id for m in tour.ranges] == [readings.sensor_names[k] for k in readings.sensor]
    ranges = np.array([m.range for m in tour.ranges])
    assert np.array_equal(np.minimum(ranges, 5.0), readings.z)
    assert np.all(np.isinf(ranges[~readings.echo]))
    assert not readings.echo.all()
    assert {m.max_range for m in tour.ranges} == {5.0}
    assert 2 * readings.half_angle[0] == pytest.approx(tour.ranges[0].field_of_view)


def test_interpolated_odometry_places_each_reading_exactly(tour):
    stamps = np.array([m.stamp for m in tour.odometry])
    assert stamps[0] == START < tour.ranges[0].stamp
    assert stamps[-1] > tour.ranges[-1].stamp
    assert 0 < np.diff(stamps).min() and np.diff(stamps).max() <= 20_000_000
    assert {(m.frame_id, m.child_frame_id) for m in tour.odometry} == {('odom', 'base_link')}
    # without the messages that coincide with a sweep, as if odometry and sonars had independent clocks
    other = ~np.isin(stamps, tour.readings.stamp)
    poses = np.array([m.pose for m in tour.odometry])[other]
    seconds, at = (stamps[other] - START) / 1e9, (tour.readings.stamp[::8] - START) / 1e9
    robot = np.stack([np.interp(at, seconds, column) for column in poses.T], axis=1)
    assert robot[1:] == pytest.approx(tour.robot[1:], abs=1e-6)  # the first one is a corner itself
    for pose, start in zip(tour.robot, range(0, len(tour.readings), 8), strict=True):
        for k, (_, extrinsic) in enumerate(tour.extrinsics):
            c, s = math.cos(pose[2]), math.sin(pose[2])
            assert tour.readings.x[start + k] == pytest.approx(pose[0] + c * extrinsic.x - s * extrinsic.y)
            assert tour.readings.y[start + k] == pytest.approx(pose[1] + s * extrinsic.x + c * extrinsic.y)
            assert tour.readings.yaw[start + k] == pytest.approx(pose[2] + extrinsic.yaw)


def test_motion_never_passes_through_walls():
    for recording in (door_drive(), corridor_drive(passes=2), building_drive(laps=2)):
        poses = np.array([message.pose[:2] for message in recording.odometry])
        moved = np.r_[True, np.any(np.diff(poses, axis=0) != 0.0, axis=1)]
        assert not blocked(poses[moved], recording.world.segments)
    with pytest.raises(ValueError, match='through a wall'):
        drive(door_world(), np.array([[3.0, 3.75], [3.0, 6.0]]), 0.3)


@pytest.mark.parametrize('n', [0, 1, 3, 16])
def test_door_is_seen_by_n_sweeps(n):
    recording = door_drive(n)
    door = recording.world.doors[0]
    beside = np.abs(recording.robot[:, 0] - door.x)
    assert (beside <= 0.1 + 1e-9).sum() == n
    assert not np.any((beside > 0.1 + 1e-9) & (beside < 1.0))
    assert np.diff(recording.readings.stamp[::24]).min(initial=10**9) > 0
    # the sonars that look straight through the door reach the back wall of the room
    readings = recording.readings
    square = (np.abs(readings.x - door.x) < 0.11) & (np.abs(np.sin(readings.yaw) - 1.0) < 1e-6)
    assert square.sum() == n
    assert readings.z[square] == pytest.approx(8.45 - readings.y[square], rel=2e-5)
    # hardly any other readings do
    into = readings.y + readings.z * np.sin(readings.yaw) > door.y + 0.5
    assert (into & readings.echo & ~square).sum() <= 2 + n


def test_corridor_drive_has_twelve_thousand_readings_and_a_person():
    recording, alone = corridor_drive(seed=1), corridor_drive(seed=1, noise=NOISE_FREE, person=False)
    assert len(recording.readings) == len(alone.readings) == 12_000
    assert recording.extrinsics == alone.extrinsics
    behind = recording.readings.z[12::24]
    assert np.median(behind) == pytest.approx(0.5, abs=0.05)
    assert np.median(alone.readings.z[12::24]) > 3.0


def test_corridor_passes_alternate_in_direction():
    recording = corridor_drive(passes=2)
    assert len(recording.readings) == 24_000
    assert recording.robot[:500, :2] == pytest.approx(recording.robot[:499:-1, :2], abs=1e-6)
    assert np.cos(recording.robot[500:, 2]) == pytest.approx(-1.0)


def test_building_has_16_wide_sonars_and_laps_that_differ():
    recording = building_drive(seed=3, laps=2, noise=NOISE_FREE)
    readings = recording.readings
    assert len(readings) == 56_000
    assert len(recording.extrinsics) == 16
    assert 2 * readings.half_angle == pytest.approx(math.radians(30.0))
    first, second = recording.robot[:1750], recording.robot[1750:]
    apart = np.hypot(*(first[:, None, :2] - second[None, ::7, :2]).T).min(axis=1)
    assert 0.0 < np.median(apart) < apart.max() < 0.3


def test_recording_depends_only_on_the_seed():
    first, again, other = corridor_drive(7), corridor_drive(7), corridor_drive(8)
    assert first.ranges == again.ranges
    assert first.odometry == again.odometry
    assert first.ranges != other.ranges


def test_equal_waypoints_are_rejected():
    with pytest.raises(ValueError, match='waypoints'):
        drive_sweeps(door_world(), np.array([[3.0, 3.75], [3.0, 3.75]]), np.zeros(1))


def test_person_passes_the_robot_in_the_world_with_four_doors() -> None:
    recording = passing_drive(noise=NOISE_FREE)
    assert recording.world.grid.shape == (120, 114)
    sides = [door.y > recording.robot[0, 1] for door in recording.world.doors]
    assert sorted(sides) == [False, False, True, True]
    empty = drive_sweeps(
        recording.world, recording.robot[[0, -1], :2], np.arange(len(recording.robot)) * 0.1, noise=NOISE_FREE
    )
    met = recording.readings.z < empty.readings.z - 1e-9
    assert met.any(), 'nobody was met'
    ends = recording.readings.y + recording.readings.z * np.sin(recording.readings.yaw)
    assert ((ends > 4.8) & (ends < 7.1))[met].all(), 'the person walks in the corridor'
