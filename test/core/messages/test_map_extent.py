"""Whether a map may grow to hold one more reading."""

from __future__ import annotations

import math

import pytest

from forward_grid_mapper.core.common.parameters import Parameters
from forward_grid_mapper.core.common.readings import Readings
from forward_grid_mapper.core.messages.map_extent import MapExtent, reach_of
from forward_grid_mapper.core.messages.message_types import Pose2, RangeMessage
from forward_grid_mapper.core.messages.rep117 import Measurement, measure

PARAMETERS = Parameters.from_flat({'max_cells': 10_000, 'max_jump': 20.0})


def measured(z: float = 1.0, z_max: float = 4.0, angle: float = 0.3) -> Measurement:
    made = measure(RangeMessage(0, 'sonar', z, 0.1, z_max, angle), PARAMETERS.association)
    assert isinstance(made, Measurement)
    return made


def test_it_grows_up_to_its_bounds() -> None:
    extent = MapExtent()
    assert extent.admit(Pose2(0, 0, 0), measured(), PARAMETERS) == ''
    assert extent.admit(Pose2(5, 5, 0), measured(), PARAMETERS) == ''
    assert extent.admit(Pose2(30, 0, 0), measured(), PARAMETERS) == 'far_from_map'
    assert extent.admit(Pose2(15, 15, 0), measured(), PARAMETERS) == 'too_far_away', 'more than 10 000 cells'
    assert extent.admit(Pose2(5, 5, 0), measured(), PARAMETERS) == '', 'a refused reading changes nothing'
    extent.clear()
    assert extent.admit(Pose2(30, 0, 0), measured(), PARAMETERS) == ''


@pytest.mark.parametrize(
    'pose', [Pose2(math.nan, 0, 0), Pose2(0, math.inf, 0), Pose2(0, 0, math.nan), Pose2(3e7, 0, 0)]
)
def test_an_impossible_pose_is_refused(pose: tuple[float, float, float]) -> None:
    assert MapExtent().admit(Pose2(*pose), measured(), PARAMETERS) == 'too_far_away'


def test_a_cone_of_millions_of_cells_is_refused() -> None:
    wide = Parameters.from_flat({'max_cells': 10**9})
    assert MapExtent().admit(Pose2(0, 0, 0), measured(150.0, 200.0, 3.0), wide) == 'large_cone'


def test_restored_readings_count() -> None:
    extent = MapExtent()
    extent.restore(Readings.from_columns(x=[0.0, 40.0], y=0.0, yaw=0.0, z=[1.0, 1.0], z_max=4.0, half_angle=0.15))
    assert extent.admit(Pose2(55, 0, 0), measured(), Parameters.from_flat({'max_jump': 20.0})) == ''
    assert extent.admit(Pose2(90, 0, 0), measured(), PARAMETERS) == 'far_from_map'


def test_reach_is_that_of_the_echo_and_not_of_the_sensor() -> None:
    assert reach_of(measured(1.0, 3e38), PARAMETERS) < 2.0
    assert reach_of(measured(4.0, 4.0), PARAMETERS) == pytest.approx(4.0 + max(0.05, 0.05) + 0.2)
