"""Measurements of `Range` messages (REP 117) at the limits of each field."""

from __future__ import annotations

import math

import pytest

from forward_grid_mapper.core.common.parameters import Parameters
from forward_grid_mapper.core.messages.message_types import RangeMessage
from forward_grid_mapper.core.messages.rep117 import (
    CHOSEN_BY_USER,
    LONGEST_NAME,
    NEAREST,
    REASONS,
    REASONS_OUTSIDE_MESSAGE,
    Measurement,
    measure,
    of_dead_sensors,
    rejection_warnings,
    sensor_rejections,
)

PLAIN = RangeMessage(7, 'sonar', 1.0, 0.1, 4.0, 0.3)


def measured(message: RangeMessage, **values: object) -> Measurement:
    made = measure(message, Parameters.from_flat(values).association)
    assert isinstance(made, Measurement), made
    return made


def rejected_as(message: RangeMessage, **values: object) -> str:
    made = measure(message, Parameters.from_flat(values).association)
    assert isinstance(made, str)
    return made


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


def test_measurement_of_a_plain_message() -> None:
    made = measured(PLAIN)
    assert (made.stamp, made.frame_id, made.z, made.z_max) == (7, 'sonar', 1.0, 4.0)
    assert (made.half_angle, made.sigma) == (0.15, 0.0)
    assert (made.number, made.arrival, made.newest) == (0, 0.0, None)


@pytest.mark.parametrize('variance', [0.0, -1.0, -0.5, math.inf, math.nan])
def test_variance_of_zero_or_without_meaning_is_ignored(variance: float) -> None:
    assert measured(PLAIN._replace(variance=variance)).sigma == 0.0


def test_variance_is_the_square_of_sigma() -> None:
    assert measured(PLAIN._replace(variance=0.25)).sigma == 0.5


def test_frame_id_of_255_characters_is_accepted_and_longer_is_not() -> None:
    assert LONGEST_NAME == 255
    assert measured(PLAIN._replace(frame_id='x' * 255)).frame_id == 'x' * 255
    assert rejected_as(PLAIN._replace(frame_id='x' * 256)) == 'long_frame_id'


def test_fixed_distance_ranger() -> None:
    """-inf is an object within max_range, 0 and below are invalid, and +inf is no echo."""
    fixed = PLAIN._replace(min_range=3.0, max_range=3.0)
    something = measured(fixed._replace(range=-math.inf, variance=0.01))
    assert (something.z, something.sigma) == (1.5, 0.25)
    assert 0 < something.z - 5 * something.sigma < something.z + 5 * something.sigma < 3.0
    assert rejected_as(fixed._replace(range=-0.5)) == 'below_min_range'
    assert rejected_as(fixed._replace(range=0.0)) == 'too_near'
    clear = measured(fixed._replace(range=math.inf))
    assert clear.z == clear.z_max == 3.0


@pytest.mark.parametrize('value', [math.nan, 0.0, -0.0, -1.0, NEAREST / 2])
def test_invalid_range_can_be_set_to_mean_no_echo(value: float) -> None:
    silent = PLAIN._replace(range=value)
    rejected_as(silent)
    assert measured(silent, invalid_range='no_echo').z == PLAIN.max_range
    assert rejected_as(silent, invalid_range='no_echo', over_range='discard') == 'over_range'


def test_range_that_is_too_near_never_means_no_echo() -> None:
    assert rejected_as(PLAIN._replace(range=-math.inf), invalid_range='no_echo') == 'too_near'
    assert rejected_as(PLAIN._replace(range=NEAREST), invalid_range='no_echo') == 'below_min_range'
    fixed = PLAIN._replace(min_range=3.0, max_range=3.0, range=-math.inf)
    assert measured(fixed, invalid_range='no_echo').z == 1.5


def test_smallest_and_largest_range_are_accepted() -> None:
    assert measured(PLAIN._replace(range=NEAREST, min_range=0.0)).z == NEAREST
    assert measured(PLAIN._replace(range=0.1)).z == 0.1
    assert measured(PLAIN._replace(range=4.0), over_range='no_echo').z == 4.0
    assert rejected_as(PLAIN._replace(range=4.0), over_range='discard') == 'over_range'
    assert measured(PLAIN._replace(range=3.999), over_range='discard').z == 3.999


@pytest.mark.parametrize(
    'changes',
    [
        {'max_range': math.inf},
        {'max_range': -1.0},
        {'max_range': 0.05},
        {'min_range': 0.0, 'max_range': NEAREST * 0.999},
        {'min_range': 1e-45, 'max_range': 1e-45},
        {'min_range': -0.001},
        {'min_range': -2.0, 'max_range': -1.0},
        {'min_range': math.inf, 'max_range': math.inf},
    ],
)
def test_senseless_limits_are_rejected(changes: dict[str, float]) -> None:
    assert rejected_as(PLAIN._replace(**changes)) == 'bad_limits'


def test_max_range_by_parameter_must_be_above_min_range() -> None:
    assert rejected_as(PLAIN._replace(min_range=2.0), max_range=2.0) == 'bad_limits'
    assert measured(PLAIN._replace(min_range=2.0, range=2.5), max_range=2.6).z_max == 2.6


def test_max_range_of_a_millimetre_is_accepted() -> None:
    assert measured(PLAIN._replace(min_range=0.0, max_range=NEAREST)).z_max == NEAREST


@pytest.mark.parametrize('angle', [math.pi, 0.0, -0.1])
def test_field_of_view_of_zero_or_180_degrees_is_rejected(angle: float) -> None:
    assert rejected_as(PLAIN._replace(field_of_view=angle)) == 'bad_field_of_view'
    assert measured(PLAIN._replace(field_of_view=math.nextafter(math.pi, 0))).half_angle < math.pi / 2


def test_measurements_are_ordered_by_stamp_and_then_by_arrival() -> None:
    first, second, later = measured(PLAIN), measured(PLAIN), measured(PLAIN._replace(stamp=8))
    second.number = 1
    assert first < second < later and not second < first and not first < measured(PLAIN)
