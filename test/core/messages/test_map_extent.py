"""`MapExtent`: which readings the map may grow for."""

from __future__ import annotations

import math

import numpy as np
import pytest

from forward_grid_mapper.core.common.constants import arc_depths
from forward_grid_mapper.core.common.parameters import Parameters
from forward_grid_mapper.core.common.readings import Readings
from forward_grid_mapper.core.messages.map_extent import LARGEST_CONE, LARGEST_COORDINATE, MapExtent, reach_with_margin
from forward_grid_mapper.core.messages.message_types import Pose2, RangeMessage
from forward_grid_mapper.core.messages.rep117 import Measurement, measure
from forward_grid_mapper.core.sensor.density import CUT

PARAMETERS = Parameters.from_flat({'max_cells': 10_000, 'max_jump': 20.0})


def measured(z: float = 1.0, z_max: float = 4.0, angle: float = 0.3) -> Measurement:
    made = measure(RangeMessage(0, 'sonar', z, 0.1, z_max, angle), PARAMETERS.association)
    assert isinstance(made, Measurement)
    return made


def test_map_grows_up_to_its_limits() -> None:
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
def test_impossible_pose_is_rejected(pose: tuple[float, float, float]) -> None:
    assert MapExtent().admit(Pose2(*pose), measured(), PARAMETERS) == 'too_far_away'


def test_cone_of_millions_of_cells_is_rejected() -> None:
    wide = Parameters.from_flat({'max_cells': 10**9})
    assert MapExtent().admit(Pose2(0, 0, 0), measured(150.0, 200.0, 3.0), wide) == 'large_cone'


def test_restored_readings_extend_the_map() -> None:
    extent = MapExtent()
    readings = Readings.from_columns(x=[0.0, 25.0], y=0.0, yaw=0.0, z=[1.0, 1.0], z_max=4.0, half_angle=0.15)
    assert not any(mask.any() for mask in extent.restore(readings, PARAMETERS).values())
    assert extent.admit(Pose2(40, 0, 0), measured(), Parameters.from_flat({'max_jump': 20.0})) == ''
    assert extent.admit(Pose2(90, 0, 0), measured(), PARAMETERS) == 'far_from_map'


def test_only_restored_readings_outside_the_limits_are_rejected() -> None:
    """As if the resolution was changed, or the journal was forged."""
    x, z = np.zeros(50), np.ones(50)
    x[[3, 4]] = 1.9e7, -1.9e7
    z[[7, 8]] = 1e300, 5000.0
    readings = Readings.from_columns(x=x, y=0.0, yaw=0.0, z=z, z_max=1e308, half_angle=0.15)
    refused = {
        reason: np.flatnonzero(mask).tolist() for reason, mask in MapExtent().restore(readings, PARAMETERS).items()
    }
    assert refused == {'large_cone': [7, 8], 'too_far_away': [3, 4]}


def test_restoring_readings_equals_admitting_them() -> None:
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


def test_reach_depends_on_the_echo_and_not_on_the_largest_range() -> None:
    assert reach_with_margin(measured(1.0, 3e38), PARAMETERS) < 2.0
    assert reach_with_margin(measured(4.0, 4.0), PARAMETERS) == pytest.approx(4.0 + 0.1 + 0.2)


def test_reach_of_a_reading_with_margins() -> None:
    """Up to four standard deviations beyond the range, or to the end of the arc of the echo, and two cells more."""
    cell = PARAMETERS.grid.resolution
    sigma = PARAMETERS.model.sigma
    assert reach_with_margin(measured(1.0, 9.0), PARAMETERS) == pytest.approx(1.0 + CUT * sigma + 2 * cell)
    assert reach_with_margin(measured(4.0, 4.0), PARAMETERS) == pytest.approx(4.0 + arc_depths(cell)[1] + 2 * cell)
    stated = measure(RangeMessage(0, 'sonar', 1.0, 0.1, 9.0, 0.3, 0.25), PARAMETERS.association)
    assert isinstance(stated, Measurement)
    assert reach_with_margin(stated, PARAMETERS) == pytest.approx(1.0 + CUT * 0.5 + 2 * cell)
    # not less than half a cell
    coarse = Parameters.from_flat({'resolution': 1.0})
    assert reach_with_margin(measured(1.0, 90.0), coarse) == pytest.approx(1.0 + CUT * 0.5 + 2.0)


def largest(count: int, **values: float) -> Parameters:
    return Parameters.from_flat({'max_cells': count, 'max_jump': 1e7, **values})


@pytest.mark.parametrize('across', [True, False])
def test_map_of_exactly_max_cells_is_accepted_and_one_more_is_not(across: bool) -> None:
    """Two readings 90 m apart: their box may have one more cell in a row, since it may begin within a cell."""
    reach = reach_with_margin(measured(), PARAMETERS)
    cell = PARAMETERS.grid.resolution
    pose = Pose2(90.0, 0, 0) if across else Pose2(0, 90.0, 0)
    cells = ((90.0 + 2 * reach) / cell + 1) * (2 * reach / cell + 1)
    assert cells > 10_000
    for count, expected in ((math.ceil(cells) + 1, ''), (math.floor(cells) - 1, 'too_far_away')):
        extent = MapExtent()
        assert extent.admit(Pose2(0, 0, 0), measured(), largest(count)) == ''
        assert extent.admit(pose, measured(), largest(count)) == expected
        restored = Readings.from_columns(
            x=[0.0, pose.x], y=[0.0, pose.y], yaw=0.0, z=[1.0, 1.0], z_max=4.0, half_angle=0.15
        )
        assert MapExtent().restore(restored, largest(count))['too_far_away'].tolist() == [False, bool(expected)]


@pytest.mark.parametrize('restored', [True, False])
@pytest.mark.parametrize(('x', 'y'), [(1, 0), (-1, 0), (0, 1), (0, -1)])
def test_reading_farther_than_max_jump_from_the_map_is_rejected(x: int, y: int, restored: bool) -> None:
    """Measured from the edge of the map, not from its middle, on each side."""
    parameters = Parameters.from_flat({'max_jump': 20.0})
    reach = reach_with_margin(measured(), parameters)
    for distance, expected in ((reach + 19.9, ''), (reach + 20.1, 'far_from_map')):
        extent = MapExtent()
        if restored:
            one = Readings.from_columns(x=[50.0], y=[70.0], yaw=0.0, z=[1.0], z_max=4.0, half_angle=0.15)
            assert not any(mask.any() for mask in extent.restore(one, parameters).values())
        else:
            assert extent.admit(Pose2(50.0, 70.0, 0), measured(), parameters) == ''
        assert extent.admit(Pose2(50.0 + x * distance, 70.0 + y * distance, 0), measured(), parameters) == expected


def test_cone_at_the_limit_of_cells_is_accepted_and_above_is_not() -> None:
    wide = largest(10**9)
    for z, expected in ((138.0, ''), (142.0, 'large_cone')):
        # 2e6 = 1.0 rad · (141.4 m / 0.1 m)²
        one = measured(z - 0.6, 1000.0, 2.0)
        assert MapExtent().admit(Pose2(0, 0, 0), one, wide) == expected
        restored = Readings.from_columns(x=0.0, y=0.0, yaw=0.0, z=[z - 0.6], z_max=1000.0, half_angle=1.0)
        assert MapExtent().restore(restored, wide)['large_cone'].tolist() == [bool(expected)]
    assert LARGEST_COORDINATE == 2e7 and LARGEST_CONE == 2_000_000


def test_restored_readings_have_their_own_sigma_or_that_of_the_model() -> None:
    """With a σ of 1 m, the map of two readings 9 m apart is too large; with that of the model it is not."""
    few = largest(10_000)
    for sigma, refused in ((0.0, False), (0.1, False), (1.0, True)):
        restored = Readings.from_columns(
            x=[0.0, 5.0], y=[0.0, 5.0], yaw=0.0, z=[1.0, 1.0], z_max=9.0, half_angle=0.15, sigma=sigma
        )
        assert MapExtent().restore(restored, few)['too_far_away'].any() == refused
