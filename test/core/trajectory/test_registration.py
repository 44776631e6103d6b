"""Registration of a drive with the map of another: it is found after a shift, and kept if readings do not decide."""

from __future__ import annotations

import math
from dataclasses import replace

import numpy as np
import pytest

from forward_grid_mapper.core.common.errors import Cancelled
from forward_grid_mapper.core.common.parameters import Parameters
from forward_grid_mapper.core.common.readings import Readings
from forward_grid_mapper.core.trajectory import registration
from forward_grid_mapper.core.trajectory.likelihood import LANES, Scan
from forward_grid_mapper.core.trajectory.local_map import LocalMap
from forward_grid_mapper.core.trajectory.poses import compose, relative
from forward_grid_mapper.core.trajectory.registration import (
    SILENT,
    OnMap,
    Registration,
    moved_to,
    readings_moved,
    register,
)
from forward_grid_mapper.simulation.drive import Recording, drive
from forward_grid_mapper.simulation.sonar import NOISY, front_array
from forward_grid_mapper.simulation.world import building_tour, building_world


@pytest.fixture(scope='module')
def two() -> tuple[Recording, Recording]:
    """Two exact drives along the same path."""
    tour = building_tour()[:6]
    one, other = (drive(building_world(), tour, 0.15, front_array(), NOISY, seed=seed) for seed in (3, 4))
    return one, other


def placed(readings: Readings, begin: np.ndarray, others: Readings) -> Registration:
    return register(readings, begin, others, Parameters(), np.zeros(1, np.uint8))


@pytest.mark.parametrize('off', [(0.1, -0.05, 6.0), (-0.2, 0.1, -8.0), (0.0, 0.0, 2.0)])
def test_shifted_drive_is_moved_back(two: tuple[Recording, Recording], off: tuple[float, float, float]) -> None:
    one, other = two
    true = other.robot[0]
    begin = compose(true, np.array([off[0], off[1], math.radians(off[2])]))
    found = placed(readings_moved(other.readings, true, begin), begin, one.readings)
    assert found.gain.sigmas > 2.3
    x, y, yaw = relative(true, found.begin)
    assert math.hypot(x, y) < 0.08
    assert abs(math.degrees(yaw)) < 0.7


def test_drive_that_fits_is_not_moved(two: tuple[Recording, Recording]) -> None:
    one, other = two
    found = placed(other.readings, other.robot[0], one.readings)
    assert np.hypot(*(found.begin - other.robot[0])[:2]) < 0.05


def test_drive_without_overlap_is_not_moved(two: tuple[Recording, Recording]) -> None:
    one, other = two
    far = replace(other.readings, x=other.readings.x + 100.0)
    begin = other.robot[0] + np.array([100.0, 0.0, 0.0])
    found = placed(far, begin, one.readings)
    assert found.begin is begin
    assert found.gain.sigmas < 2.3


def test_gains_of_blocks_are_means_and_unknown_space_counts_zero(two: tuple[Recording, Recording]) -> None:
    one, other = two
    around = OnMap(other.readings, other.robot[0], one.readings, Parameters(), np.zeros(1, np.uint8))
    for begin in (other.robot[0], compose(other.robot[0], np.array([0.3, -0.2, 0.2]))):
        each = around.of_each(begin, len(other.readings))
        blocks = np.array_split(each, 7)
        assert around.predicted(begin, 7) == pytest.approx(np.array([block.mean() for block in blocks]))
        assert around.of_each(begin, 50) == pytest.approx(each[:50])
    far = other.robot[0] + np.array([100.0, 0.0, 0.0])
    assert np.abs(around.of_each(far, 200)).max() < SILENT
    assert around.search(far, np.array([0.25, 0.25, 0.2]), 7) is far, 'nothing can be told there'
    wide = compose(other.robot[0], np.array([0.4, -0.3, math.radians(18.0)]))
    x, y, yaw = relative(other.robot[0], around.search(wide, np.array([0.25, 0.25, math.radians(10.0)]), 20))
    assert math.hypot(x, y) < 0.1 and abs(math.degrees(yaw)) < 1.0


def test_result_does_not_depend_on_the_order_of_readings(two: tuple[Recording, Recording]) -> None:
    one, other = two
    begin = compose(other.robot[0], np.array([0.0, 0.0, 0.1]))
    turned = readings_moved(other.readings, other.robot[0], begin)
    shuffled = turned.select(np.random.default_rng(1).permutation(len(turned)))
    # for equal stamps the order of sensors differs, so a few other readings are evaluated
    a, b = (placed(each, begin, one.readings).begin for each in (turned, shuffled))
    assert a == pytest.approx(b, abs=0.03)


def test_registration_can_be_cancelled(two: tuple[Recording, Recording]) -> None:
    one, other = two
    with pytest.raises(Cancelled):
        register(other.readings, other.robot[0], one.readings, Parameters(), np.ones(1, np.uint8))


def test_search_ends_soon_after_it_was_cancelled(
    two: tuple[Recording, Recording], monkeypatch: pytest.MonkeyPatch
) -> None:
    one, other = two
    stop, poses = np.zeros(1, np.uint8), []
    around = OnMap(other.readings, other.robot[0], one.readings, Parameters(), stop)
    values = registration.scores

    def cancelled(scan: Scan, there: LocalMap, at: np.ndarray, stride: int = 1) -> np.ndarray:
        poses.append(len(at))
        stop[0] = len(poses) == 3
        return values(scan, there, at, stride)

    monkeypatch.setattr(registration, 'scores', cancelled)
    with pytest.raises(Cancelled):
        around.search(other.robot[0], np.array([0.25, 0.25, math.radians(10.0)]))
    assert len(poses) == 3 and max(poses) <= LANES
    with pytest.raises(Cancelled):
        around.predicted(other.robot[0], 3)
    with pytest.raises(Cancelled):
        around.of_each(other.robot[0], 50)


def test_poses_and_readings_are_moved_together() -> None:
    rng = np.random.default_rng(0)
    poses = np.cumsum(rng.normal(0.0, 1.0, (50, 3)), 0)
    begin = rng.normal(0.0, 3.0, 3)
    moved = moved_to(begin, poses)
    assert moved[0] == pytest.approx(begin)
    assert np.diff(moved[:, 2]) == pytest.approx(np.diff(poses[:, 2]))
    x, y, yaw = poses.T
    readings = Readings.from_columns(('a',), x=x, y=y, yaw=yaw, z=1.0 + 0 * x, z_max=5.0, half_angle=0.1)
    with_it = readings_moved(readings, poses[0], begin)
    sensors = np.stack([with_it.x, with_it.y, with_it.yaw], 1)
    assert sensors[:, :2] == pytest.approx(moved[:, :2])
    assert np.cos(sensors[:, 2] - moved[:, 2]) == pytest.approx(np.ones(50))
