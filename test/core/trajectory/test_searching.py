"""Searching from coarse to fine, compared with evaluating all poses."""

from __future__ import annotations

import math

import numpy as np
import pytest

from forward_grid_mapper.core.common.parameters import Parameters
from forward_grid_mapper.core.common.readings import Floats
from forward_grid_mapper.core.trajectory import searching
from forward_grid_mapper.core.trajectory.likelihood import Scan, blurred, make_scan, scores
from forward_grid_mapper.core.trajectory.local_map import UNKNOWN, LocalMap, local_map
from forward_grid_mapper.core.trajectory.matching import grid_around
from forward_grid_mapper.core.trajectory.poses import compose, relative
from forward_grid_mapper.core.trajectory.searching import (
    BLUR,
    COARSER,
    EVALUATED,
    LARGE,
    STEPS,
    Searched,
    search,
)
from forward_grid_mapper.simulation.drive import drive
from forward_grid_mapper.simulation.sonar import NOISY, sonar_ring
from forward_grid_mapper.simulation.world import building_tour, building_world

MODEL = Parameters().model
NOTHING = UNKNOWN * MODEL.p_hit
APART = 0.6
"""Metres between two different places."""


@pytest.fixture(scope='module')
def places() -> list[tuple[LocalMap, Scan, Floats]]:
    """Maps along a drive, for each a scan of 2 m that is not on it, and the true pose of the scan."""
    recording = drive(building_world(), building_tour()[:12], 0.1, sonar_ring(8), NOISY, seed=2)
    readings, out = recording.readings, []
    robot = np.array([each.pose for each in recording.odometry], float)
    stamps = np.array([each.stamp for each in recording.odometry])
    for k in range(60, len(stamps) - 60, 50):
        when = np.abs(np.searchsorted(stamps, readings.stamp) - k)
        scan, rest = readings.select(when < 10), readings.select((when >= 10) & (when < 50))
        around = local_map(rest, Parameters(), np.zeros(1, np.uint8))
        sensors = relative(robot[k], np.stack([scan.x, scan.y, scan.yaw], axis=1))
        out.append((around, make_scan(scan, sensors, MODEL, 0.1, NOTHING), robot[k]))
    assert len(out) >= 5
    return out


def test_coarse_grids_are_evaluated_with_blurred_readings(places, monkeypatch) -> None:
    around, scan, true = places[0]
    by = []
    monkeypatch.setattr(searching, 'blurred', lambda scan, more, around: by.append(more) or scan)
    search(scan, around, true, SIGMA, REACH)
    assert by == pytest.approx([BLUR * times * STEPS[0] for times in COARSER])


def evaluated_all(scan: Scan, around: LocalMap, guess: Floats, sigma: Floats, reach: Floats) -> Searched:
    poses = grid_around(guess, reach, STEPS)
    prior = 0.5 * ((relative(guess, poses) / sigma) ** 2).sum(1)
    return Searched(poses, scores(scan, around, poses, max(len(scan.readings) // EVALUATED, 1)), prior)


def second(found: Searched) -> float:
    """The best value at a place away from the best pose."""
    apart = found.poses - found.best
    return float(found.values[np.hypot(apart[:, 0], apart[:, 1]) > APART].max())


SIGMA, REACH = np.array([1.0, 1.0, math.radians(8.0)]), np.array([2.1, 2.1, math.radians(15.0)])


@pytest.mark.slow
def test_large_search_finds_the_best_of_all_poses(places) -> None:
    for around, scan, true in places:
        guess = compose(true, np.array([0.7, -0.5, math.radians(6.0)]))
        found, right = (each(scan, around, guess, SIGMA, REACH) for each in (search, evaluated_all))
        assert len(found.poses) < 0.3 * len(right.poses)
        assert found.best == pytest.approx(right.best, abs=1e-9)
        # it knows the second-best place as well
        assert second(found) > second(right) - 3.0


def test_small_search_evaluates_all_poses(places) -> None:
    around, scan, true = places[0]
    reach = np.array([0.3, 0.3, math.radians(7.5)])
    found, right = (each(scan, around, true, SIGMA, reach) for each in (search, evaluated_all))
    assert len(right.poses) <= LARGE
    for one, other in zip(found, right, strict=True):
        np.testing.assert_array_equal(one, other)


def test_no_poses_out_of_reach_are_evaluated(places) -> None:
    around, scan, true = places[1]
    off = relative(true, search(scan, around, true, SIGMA, REACH).poses)
    assert (np.abs(off) <= REACH + 1e-9).all()
    assert len(np.unique(off.round(6), axis=0)) == len(off)


def test_certain_direction_is_not_searched(places) -> None:
    around, scan, true = places[2]
    reach = np.array([2.1, 0.0, math.radians(15.0)])
    off = relative(true, search(scan, around, true, SIGMA, reach).poses)
    assert np.abs(off[:, 1]).max() < 1e-9 and np.abs(off[:, 0]).max() > 1.0


def test_blurred_scan_has_a_larger_sigma(places) -> None:
    around, scan, true = places[0]
    by = 0.2
    blurry = blurred(scan, by, around)
    np.testing.assert_allclose(blurry.readings['sigma'], np.hypot(scan.readings['sigma'], by))
    farther = blurry.readings['reach'] - scan.readings['reach']
    echo = scan.readings['reach'] > scan.readings['z']
    assert (farther[echo] > 0.0).all() and (farther[~echo] == 0.0).all() and echo.any()
    poses = grid_around(true, np.array([0.3, 0.3, 0.0]), (0.15, 0.15, 0.1))
    sharp, soft = (scores(each, around, poses) for each in (scan, blurry))
    # its score falls less if it is off by a step
    assert np.ptp(soft) < np.ptp(sharp)
    # in unknown space it still scores zero
    far = np.array([[90.0, 9.0, 1.0]])
    assert scores(blurry, around, far) == pytest.approx([0.0], abs=1e-3)
    assert blurred(scan, 0.0, around).readings.tolist() == scan.readings.tolist()
