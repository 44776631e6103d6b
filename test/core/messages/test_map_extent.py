"""Whether a map may grow to hold one more reading."""

from __future__ import annotations

import math

import numpy as np
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
    readings = Readings.from_columns(x=[0.0, 25.0], y=0.0, yaw=0.0, z=[1.0, 1.0], z_max=4.0, half_angle=0.15)
    assert not any(mask.any() for mask in extent.restore(readings, PARAMETERS).values())
    assert extent.admit(Pose2(40, 0, 0), measured(), Parameters.from_flat({'max_jump': 20.0})) == ''
    assert extent.admit(Pose2(90, 0, 0), measured(), PARAMETERS) == 'far_from_map'


def test_restored_readings_that_the_map_cannot_hold_are_refused_alone() -> None:
    """As where the resolution was changed, or somebody made the journal up."""
    x, z = np.zeros(50), np.ones(50)
    x[[3, 4]] = 1.9e7, -1.9e7
    z[[7, 8]] = 1e300, 5000.0
    readings = Readings.from_columns(x=x, y=0.0, yaw=0.0, z=z, z_max=1e308, half_angle=0.15)
    refused = {
        reason: np.flatnonzero(mask).tolist() for reason, mask in MapExtent().restore(readings, PARAMETERS).items()
    }
    assert refused == {'large_cone': [7, 8], 'too_far_away': [3, 4]}


def test_restored_readings_are_those_that_were_admitted() -> None:
    rng = np.random.default_rng(1)
    few = Parameters.from_flat({'max_cells': 10_000, 'max_jump': 1e7})
    columns = {'x': rng.normal(scale=6, size=300), 'y': rng.normal(scale=6, size=300), 'z': rng.uniform(0.5, 4, 300)}
    one, all_at_once = MapExtent(), MapExtent()
    admitted = [
        one.admit(Pose2(x, y, 0), measured(z), few) == ''
        for x, y, z in zip(*(columns[name].tolist() for name in ('x', 'y', 'z')), strict=True)
    ]
    readings = Readings.from_columns(**columns, yaw=0.0, z_max=4.0, half_angle=0.15)
    masks = all_at_once.restore(readings, few)
    assert masks['too_far_away'].tolist() == [not fits for fits in admitted]
    assert 0 < sum(admitted) < 300
    assert all_at_once._box == pytest.approx(one._box)


def test_reach_is_that_of_the_echo_and_not_of_the_sensor() -> None:
    assert reach_of(measured(1.0, 3e38), PARAMETERS) < 2.0
    assert reach_of(measured(4.0, 4.0), PARAMETERS) == pytest.approx(4.0 + max(0.05, 0.05) + 0.2)
