"""How certain a calibration is: stated errors agree with real ones, and what is not told is left out."""

from __future__ import annotations

import math

import numpy as np
import pytest

from forward_grid_mapper.core.common.parameters import Parameters
from forward_grid_mapper.core.trajectory.certainty import (
    Estimate,
    combined_calibration,
    determined_calibration,
    parabola_top,
    thinned,
    translation_errors,
    yaw_errors,
)
from forward_grid_mapper.core.trajectory.odometry_model import CALIBRATION, calibrated
from forward_grid_mapper.core.trajectory.outcome import replaced
from forward_grid_mapper.core.trajectory.windows import Odometry
from forward_grid_mapper.simulation.drift import odometry_of
from forward_grid_mapper.simulation.drive import Recording, drive
from forward_grid_mapper.simulation.sonar import NOISY, front_array
from forward_grid_mapper.simulation.world import building_tour, building_world

STOP = np.zeros(1, np.uint8)


@pytest.fixture(scope='module')
def tour() -> Recording:
    return drive(building_world(), building_tour()[:14], 0.1, front_array(), NOISY, seed=3)


def vector(**values: float) -> np.ndarray:
    return np.array([values.get(name, 0.0) for name in CALIBRATION])


def test_stated_errors_of_the_yaw_agree_with_real_ones(tour: Recording) -> None:
    true = odometry_of(tour)
    off: dict[str, list[float]] = {'bias': [], 'turn_scale': []}
    for seed in range(60):
        rng = np.random.default_rng(seed)
        want = {'bias': rng.normal(0, 0.01), 'turn_scale': rng.normal(0, 0.02)}
        measured = calibrated(true, -vector(**want))
        # what no calibration makes right: a random walk of 2 degrees a √metre
        walk = np.cumsum(rng.normal(0, math.radians(2.0), len(true.stamp)) * np.sqrt(np.diff(true.travel, prepend=0)))
        odometry = Odometry(true.stamp, measured.pose + np.stack([0 * walk, 0 * walk, walk], 1))
        for name, (value, sigma) in yaw_errors(odometry, true).items():
            off[name].append((value - want[name]) / sigma)
    for name, z in off.items():
        assert 0.6 < np.sqrt(np.mean(np.square(z))) < 1.6, name


def test_nothing_is_told_of_a_short_drive(tour: Recording) -> None:
    whole = odometry_of(tour)
    last = int(np.searchsorted(whole.progress, 6.0))
    short = Odometry(whole.stamp[:last], whole.pose[:last])
    assert yaw_errors(short, short) == {}


def test_the_top_of_parabolas_is_found_with_its_error() -> None:
    rng = np.random.default_rng(0)
    z = []
    for _ in range(200):
        tops, curved = rng.normal(0.3, 0.8, 40), rng.uniform(0.5, 2.0, 40)
        low, middle, high = (-0.5 * curved * (x - tops) ** 2 for x in (-1.0, 0.0, 1.0))
        low[0] = np.nan
        told = parabola_top(low, middle, high)
        assert told is not None
        wanted = (curved[1:] * tops[1:]).sum() / curved[1:].sum()
        assert told.value == pytest.approx(wanted)
        z.append((told.value - 0.3) / told.sigma)
    assert 0.8 < np.std(z) < 1.25


def test_what_is_not_curved_has_no_top() -> None:
    flat = np.zeros(20)
    assert parabola_top(flat, flat, flat) is None
    assert parabola_top(flat + 1, flat, flat + 1) is None
    assert parabola_top(flat - 9, flat, flat + 8.9) is None, 'it lies too far away'
    assert parabola_top(flat[:5] - 1, flat[:5], flat[:5] - 1) is None


@pytest.mark.slow
def test_a_scale_is_told_or_nothing_is_said(tour: Recording) -> None:
    true = odometry_of(tour)
    want = {'scale': 0.03, 'heading': -0.02}
    odometry = calibrated(true, -vector(**want))
    readings = replaced(tour.readings, true, odometry)
    told = translation_errors(readings, odometry, true, {}, Parameters(), STOP)
    assert told
    for name, (value, sigma) in told.items():
        assert abs(value - want[name]) < 3 * math.hypot(sigma, 0.005), name


def test_only_what_is_certain_is_handed_on(tour: Recording) -> None:
    true = odometry_of(tour)
    told = determined_calibration(tour.readings, true, true, {}, Parameters(), STOP)
    assert list(told) == [name for name in CALIBRATION if name in told]
    assert {'bias', 'turn_scale'} <= set(told)
    for value, sigma in told.values():
        assert abs(value) < 3 * sigma


def test_calibrations_one_after_the_other_are_one(tour: Recording) -> None:
    odometry = odometry_of(tour)
    one = dict(zip(CALIBRATION, (0.03, 0.01, 0.02, -0.03), strict=True))
    other = {name: Estimate(value, 0.001) for name, value in zip(CALIBRATION, (-0.01, 0.02, -0.01, 0.02), strict=True)}
    both = combined_calibration(one, other)
    there = calibrated(calibrated(odometry, vector(**one)), vector(**{k: v.value for k, v in other.items()}))
    at_once = calibrated(odometry, vector(**{k: v.value for k, v in both.items()}))
    assert at_once.pose[:, 2] == pytest.approx(there.pose[:, 2], abs=0.01)
    assert at_once.pose[:, :2] == pytest.approx(there.pose[:, :2], abs=0.15)
    assert combined_calibration({}, other) == {name: pytest.approx(told) for name, told in other.items()}


def test_thinned_readings_are_of_all_sensors_and_times(tour: Recording) -> None:
    few = thinned(tour.readings, 4)
    assert len(few) == pytest.approx(len(tour.readings) / 4, rel=0.05)
    assert np.array_equal(np.unique(few.sensor), np.unique(tour.readings.sensor))
    assert (np.diff(few.stamp) >= 0).all()
    assert len(np.unique(few.stamp)) > 0.9 * len(np.unique(tour.readings.stamp))
    assert len(thinned(tour.readings, 1)) == len(tour.readings)
