"""Measurements of `Range` messages (REP 117) at the limits of each field."""

from __future__ import annotations

import math

import pytest

from forward_grid_mapper.core.common.parameters import Parameters
from forward_grid_mapper.core.messages.message_types import RangeMessage
from forward_grid_mapper.core.messages.rep117 import (
    LONGEST_NAME,
    NEAREST,
    Measurement,
    measure,
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
