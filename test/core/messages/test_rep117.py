"""What a Range message says at the very limits of what is admitted."""

from __future__ import annotations

import math

import pytest

from forward_grid_mapper.core.common.parameters import Parameters
from forward_grid_mapper.core.messages.message_types import RangeMessage
from forward_grid_mapper.core.messages.rep117 import (
    CHOSEN,
    LONGEST_NAME,
    NEAREST,
    OF_POSES,
    REASONS,
    Measurement,
    measure,
    rejection_warnings,
    sensor_rejections,
)

PLAIN = RangeMessage(7, 'sonar', 1.0, 0.1, 4.0, 0.3)


def said(message: RangeMessage, **values: object) -> Measurement:
    made = measure(message, Parameters.from_flat(values).association)
    assert isinstance(made, Measurement), made
    return made


def refused(message: RangeMessage, **values: object) -> str:
    made = measure(message, Parameters.from_flat(values).association)
    assert isinstance(made, str)
    return made


def test_reasons_that_took_many_readings_are_worth_a_warning() -> None:
    rejected = {'below_min_range': 21, 'nan_range': 20, 'unknown_extrinsics': 50}
    (told,) = rejection_warnings(rejected, 100, 'ranges', known={'unknown_extrinsics'})
    assert told.startswith('21 of 100 ranges were rejected as below_min_range') and 'send +inf' in told


def test_a_sensor_that_loses_nearly_all_readings_is_named_however_few_they_are() -> None:
    fine = {f'sonar_{k}': (100, 20) for k in range(20)}
    by_frame = {'left': {'too_near': 95, 'nan_range': 3}, 'sonar_3': {'too_near': 50}, 'right': {'nan_range': 29}}
    (told,) = sensor_rejections(by_frame, {**fine, 'left': (2, 0)})
    assert told.startswith('nearly all readings of left were rejected as too_near: ') and 'sensor is dead' in told
    assert sensor_rejections(by_frame, {**fine, 'left': (20, 0)}) == []
    assert sensor_rejections(by_frame, fine, known={'too_near'}) == []
    # a frame without a name is told of by its reason, and so is what costs many of all readings
    assert sensor_rejections({'': {'empty_frame_id': 50}}, fine) == []
    assert sensor_rejections({'left': {'too_near': 600}}, fine) == []
    # nor is a sensor dead that hears nothing, where that is to be discarded
    assert sensor_rejections({'left': {'over_range': 95}, 'right': {'paused': 50}}, fine) == []
    # what is wrong with all sensors is told by other warnings
    assert sensor_rejections({'left': {'too_near': 95}}, {'left': (2, 0)}) == []
    assert sensor_rejections({'left': {'too_near': 95}}, {}) == []
    without_stamps = {'zero_stamp': 900}
    assert sensor_rejections({'left': {'too_near': 95}, 'right': without_stamps}, {'left': (2, 0)}) == []
    assert len(sensor_rejections({'left': {'too_near': 95}, 'right': without_stamps}, {'rear': (2, 0)})) == 1


def test_reasons_of_poses_are_reasons() -> None:
    assert OF_POSES | CHOSEN < set(REASONS)


def test_many_such_sensors_are_not_all_named() -> None:
    by_frame = {f'sonar_{k:02d}': {'bad_limits': 30} for k in reversed(range(12))}
    (told,) = sensor_rejections(by_frame, {'left': (3000, 0)})
    assert 'sonar_07 and 4 more were rejected as bad_limits' in told and 'sonar_08' not in told


def test_what_a_plain_message_says() -> None:
    made = said(PLAIN)
    assert (made.stamp, made.frame_id, made.z, made.z_max) == (7, 'sonar', 1.0, 4.0)
    assert (made.half_angle, made.sigma) == (0.15, 0.0)
    assert (made.number, made.arrival, made.newest) == (0, 0.0, None)


@pytest.mark.parametrize('variance', [0.0, -1.0, -0.5, math.inf, math.nan])
def test_a_variance_that_states_nothing(variance: float) -> None:
    assert said(PLAIN._replace(variance=variance)).sigma == 0.0


def test_a_variance_is_the_square_of_sigma() -> None:
    assert said(PLAIN._replace(variance=0.25)).sigma == 0.5


def test_names_up_to_255_characters() -> None:
    assert LONGEST_NAME == 255
    assert said(PLAIN._replace(frame_id='x' * 255)).frame_id == 'x' * 255
    assert refused(PLAIN._replace(frame_id='x' * 256)) == 'long_frame_id'


def test_a_fixed_distance_ranger() -> None:
    """-inf is something within max_range, 0 and below is nothing that it says, and +inf is no echo."""
    fixed = PLAIN._replace(min_range=3.0, max_range=3.0)
    something = said(fixed._replace(range=-math.inf, variance=0.01))
    assert (something.z, something.sigma) == (1.5, 0.25)
    assert refused(fixed._replace(range=-0.5)) == 'below_min_range'
    assert refused(fixed._replace(range=0.0)) == 'too_near'
    assert said(fixed._replace(range=math.inf)).z == 3.0


@pytest.mark.parametrize('value', [math.nan, 0.0, -0.0, -1.0, NEAREST / 2])
def test_invalid_ranges_may_mean_no_echo(value: float) -> None:
    silent = PLAIN._replace(range=value)
    refused(silent)
    assert said(silent, invalid_range='no_echo').z == PLAIN.max_range
    assert refused(silent, invalid_range='no_echo', over_range='discard') == 'over_range'


def test_what_is_too_near_is_never_no_echo() -> None:
    assert refused(PLAIN._replace(range=-math.inf), invalid_range='no_echo') == 'too_near'
    assert refused(PLAIN._replace(range=NEAREST), invalid_range='no_echo') == 'below_min_range'
    fixed = PLAIN._replace(min_range=3.0, max_range=3.0, range=-math.inf)
    assert said(fixed, invalid_range='no_echo').z == 1.5


def test_the_least_and_the_largest_range() -> None:
    assert said(PLAIN._replace(range=NEAREST, min_range=0.0)).z == NEAREST
    assert said(PLAIN._replace(range=0.1)).z == 0.1
    assert said(PLAIN._replace(range=4.0), over_range='no_echo').z == 4.0
    assert refused(PLAIN._replace(range=4.0), over_range='discard') == 'over_range'
    assert said(PLAIN._replace(range=3.999), over_range='discard').z == 3.999


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
def test_limits_that_make_no_sense(changes: dict[str, float]) -> None:
    assert refused(PLAIN._replace(**changes)) == 'bad_limits'


def test_a_largest_range_given_by_parameter_at_the_least_one() -> None:
    assert refused(PLAIN._replace(min_range=2.0), max_range=2.0) == 'bad_limits'
    assert said(PLAIN._replace(min_range=2.0, range=2.5), max_range=2.6).z_max == 2.6


def test_a_largest_range_of_a_millimetre_is_one() -> None:
    assert said(PLAIN._replace(min_range=0.0, max_range=NEAREST)).z_max == NEAREST


@pytest.mark.parametrize('angle', [math.pi, 0.0, -0.1])
def test_cones_of_no_angle_or_half_of_the_plane(angle: float) -> None:
    assert refused(PLAIN._replace(field_of_view=angle)) == 'bad_field_of_view'
    assert said(PLAIN._replace(field_of_view=math.nextafter(math.pi, 0))).half_angle < math.pi / 2


def test_the_order_is_that_of_stamps_and_then_of_arrival() -> None:
    first, second, later = said(PLAIN), said(PLAIN), said(PLAIN._replace(stamp=8))
    second.number = 1
    assert first < second < later and not second < first and not first < said(PLAIN)
