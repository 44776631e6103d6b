"""Warnings about rejected readings: which reasons and sensors are named."""

from __future__ import annotations

from forward_grid_mapper.core.messages.rejections import (
    CHOSEN_BY_USER,
    of_dead_sensors,
    rejection_warnings,
    sensor_rejections,
)
from forward_grid_mapper.core.messages.rep117 import REASONS, REASONS_OUTSIDE_MESSAGE


def test_warning_names_reasons_that_rejected_many_readings() -> None:
    rejected = {'below_min_range': 21, 'nan_range': 20, 'unknown_extrinsics': 50}
    (warning,) = rejection_warnings(rejected, 100, 'ranges', known={'unknown_extrinsics'})
    assert warning.startswith('21 of 100 ranges were rejected as below_min_range') and 'send +inf' in warning


def test_warning_names_a_sensor_with_nearly_all_readings_rejected() -> None:
    fine = {f'sonar_{k}': (100, 20) for k in range(20)}
    by_frame = {'left': {'too_near': 95, 'nan_range': 3}, 'sonar_3': {'too_near': 50}, 'right': {'nan_range': 29}}
    (warning,) = sensor_rejections(by_frame, {**fine, 'left': (2, 0)})
    assert warning.startswith('nearly all readings of left were rejected as too_near: is the sensor dead')
    assert sensor_rejections(by_frame, {**fine, 'left': (20, 0)}) == []
    assert sensor_rejections(by_frame, fine, known={'too_near'}) == []
    # no warning for a frame without name, which has its own reason, nor for a reason that rejected many of all readings
    assert sensor_rejections({'': {'empty_frame_id': 50}}, fine) == []
    assert sensor_rejections({'left': {'bad_limits': 600}}, fine) == []
    # no warning for a sensor without echoes, if these are discarded on purpose
    assert sensor_rejections({'left': {'over_range': 95}}, fine) == []
    # a fault of all sensors has other warnings
    assert sensor_rejections({'left': {'too_near': 95}}, {'left': (2, 0)}) == []
    assert sensor_rejections({'left': {'too_near': 95}}, {}) == []
    without_stamps = {'zero_stamp': 900}
    assert sensor_rejections({'left': {'too_near': 95}, 'right': without_stamps}, {'left': (2, 0)}) == []
    assert len(sensor_rejections({'left': {'too_near': 95}, 'right': without_stamps}, {'rear': (2, 0)})) == 1


def test_dead_sensor_is_named_also_if_it_is_one_of_few() -> None:
    """Its readings are a quarter of all, but not what the driver sends for 'no echo'."""
    fine = {f'sonar_{k}': (100, 20) for k in range(3)}
    by_frame = {'left': {'too_near': 98}, 'sonar_1': {'too_near': 2}}
    accepted = {**fine, 'left': (2, 0)}
    dead = of_dead_sensors(by_frame, accepted)
    assert dead == {'too_near': 98}
    assert rejection_warnings({'too_near': 100}, 402, dead=dead) == []
    (warning,) = sensor_rejections(by_frame, accepted)
    assert warning.startswith('nearly all readings of left were rejected as too_near: is the sensor dead')
    # a sensor that has nothing within range is not dead: others get the same value for 'no echo' now and then
    with_others = {**by_frame, 'sonar_1': {'too_near': 15}}
    assert of_dead_sensors(with_others, accepted) == {}
    (common,) = rejection_warnings({'too_near': 113}, 415, dead=of_dead_sensors(with_others, accepted))
    assert common.startswith('113 of 415 readings were rejected as too_near')
    assert sensor_rejections(with_others, accepted) == []
    assert of_dead_sensors({frame: {'nan_range': 99} for frame in ('a', 'b')}, {'c': (100, 0)}) == {}
    # no value for 'no echo'
    assert of_dead_sensors({'left': {'bad_limits': 98}}, accepted) == {}


def test_a_pause_is_no_fault_and_hides_none() -> None:
    assert rejection_warnings({'paused': 900}, 1000) == []
    (warning,) = rejection_warnings({'paused': 900, 'nan_range': 30}, 1000)
    assert warning.startswith('30 of 100 readings were rejected as nan_range')
    fine = {f'sonar_{k}': (100, 20) for k in range(20)}
    pause = {frame: {'paused': 300} for frame in (*fine, 'unused')}
    assert sensor_rejections(pause, fine) == []
    (warning,) = sensor_rejections({**pause, 'left': {'paused': 300, 'too_near': 95}}, {**fine, 'left': (2, 0)})
    assert warning.startswith('nearly all readings of left were rejected as too_near')
    assert sensor_rejections({'paused before it was repaired': {'paused': 50}}, {}) == []


def test_warning_of_no_echo_that_is_rejected() -> None:
    by_frame = {f'sonar_{k}': {'nan_range': 10} for k in range(3)}
    accepted = {f'sonar_{k}': (90, 0) for k in range(4)}
    (warning,) = sensor_rejections(by_frame, accepted)
    assert warning.startswith('30 of 390 readings were rejected as nan_range, and no other reading is without an echo')
    assert 'set the parameter invalid_range to no_echo' in warning
    # sensors without any reading do not count
    assert sensor_rejections(by_frame, {**accepted, **{f'idle_{k}': (0, 0) for k in range(9)}}) == [warning]
    # not if the driver sends max_range or inf for it, if it is reported elsewhere, or if few sensors are concerned
    assert sensor_rejections(by_frame, {**accepted, 'sonar_3': (90, 9)}) == []
    assert sensor_rejections(by_frame, accepted, known={'nan_range'}) == []
    assert sensor_rejections({frame: {'nan_range': 40} for frame in accepted}, accepted) == []
    assert sensor_rejections({'sonar_0': {'too_near': 30}, 'sonar_1': {'too_near': 30}}, accepted) == []
    # an object may be too near to a robot that begins to drive
    assert sensor_rejections({frame: {'too_near': 7} for frame in accepted}, accepted) == []
    # the pose is missing, or the user does not want these readings
    assert sensor_rejections({frame: {'pose_gap': 10} for frame in accepted}, accepted) == []


def test_nan_of_a_few_sensors_stands_for_no_echo() -> None:
    """In a small room, most sensors always have an echo."""
    accepted = {f'sonar_{k}': (300, 0) for k in range(8)}
    of_two = {'sonar_0': {'nan_range': 20}, 'sonar_1': {'nan_range': 20}}
    (warning,) = sensor_rejections(of_two, accepted)
    assert warning.startswith('40 of 2440 readings were rejected as nan_range')
    # a single sensor may be broken, and an object may be too near to two sensors
    assert sensor_rejections({'sonar_0': {'nan_range': 40}}, accepted) == []
    assert sensor_rejections({frame: {'too_near': 20} for frame in of_two}, accepted) == []
    # but not if other readings have no echo
    assert sensor_rejections(of_two, {**accepted, 'sonar_7': (300, 90)}) == []


def test_reasons_of_poses_are_known_reasons() -> None:
    assert REASONS_OUTSIDE_MESSAGE | CHOSEN_BY_USER < set(REASONS)


def test_warning_names_eight_sensors_at_most() -> None:
    by_frame = {f'sonar_{k:02d}': {'bad_limits': 30} for k in reversed(range(12))}
    (warning,) = sensor_rejections(by_frame, {'left': (3000, 0)})
    assert 'sonar_07 and 4 more were rejected as bad_limits' in warning and 'sonar_08' not in warning
