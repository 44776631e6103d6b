"""Standard errors of a calibration: they agree with real errors, and undetermined values are left out."""

from __future__ import annotations

import math

import numpy as np
import pytest

from forward_grid_mapper.core.common.parameters import Parameters
from forward_grid_mapper.core.trajectory.certainty import (
    CalibrationEstimate,
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


@pytest.mark.parametrize('noise', [2.0, 5.0])
def test_standard_errors_of_the_yaw_agree_with_real_errors(tour: Recording, noise: float) -> None:
    true = odometry_of(tour)
    off: dict[str, list[float]] = {'bias': [], 'turn_scale': []}
    for seed in range(60):
        rng = np.random.default_rng(seed)
        want = {'bias': rng.normal(0, 0.01), 'turn_scale': rng.normal(0, 0.02)}
        measured = calibrated(true, -vector(**want))
        # a calibration does not correct this: a random walk, degrees a √metre
        walk = np.cumsum(rng.normal(0, math.radians(noise), len(true.stamp)) * np.sqrt(np.diff(true.travel, prepend=0)))
        odometry = Odometry(true.stamp, measured.pose + np.stack([0 * walk, 0 * walk, walk], 1))
        for name, (value, sigma) in yaw_errors(odometry, true).items():
            off[name].append((value - want[name]) / sigma)
    for name, z in off.items():
        assert 0.6 < np.sqrt(np.mean(np.square(z))) < 1.6, name
        assert abs(np.mean(z)) < 0.4, f'{name} is biased'


def test_short_drive_gives_no_errors_of_the_yaw(tour: Recording) -> None:
    whole = odometry_of(tour)
    last = int(np.searchsorted(whole.progress, 6.0))
    short = Odometry(whole.stamp[:last], whole.pose[:last])
    assert yaw_errors(short, short) == {}


def test_maximum_of_parabolas_is_found_with_its_error() -> None:
    rng = np.random.default_rng(0)
    z = []
    for _ in range(200):
        tops, curved = rng.normal(0.3, 0.8, 40), rng.uniform(0.5, 2.0, 40)
        low, middle, high = (-0.5 * curved * (x - tops) ** 2 for x in (-1.0, 0.0, 1.0))
        low[0] = np.nan
        maximum = parabola_top(low, middle, high)
        assert maximum is not None
        wanted = (curved[1:] * tops[1:]).sum() / curved[1:].sum()
        assert maximum.value == pytest.approx(wanted)
        z.append((maximum.value - 0.3) / maximum.sigma)
    assert 0.8 < np.std(z) < 1.25


def test_flat_or_far_parabola_has_no_maximum() -> None:
    flat = np.zeros(20)
    assert parabola_top(flat, flat, flat) is None
    assert parabola_top(flat + 1, flat, flat + 1) is None
    assert parabola_top(flat - 9, flat, flat + 8.9) is None, 'it lies too far away'
    assert parabola_top(flat[:5] - 1, flat[:5], flat[:5] - 1) is None


@pytest.mark.slow
def test_scale_is_right_or_left_out(tour: Recording) -> None:
    true = odometry_of(tour)
    want = {'scale': 0.03, 'heading': -0.02}
    odometry = calibrated(true, -vector(**want))
    readings = replaced(tour.readings, true, odometry)
    actual = translation_errors(readings, odometry, true, {}, Parameters(), STOP)
    assert actual
    for name, (value, sigma) in actual.items():
        assert abs(value - want[name]) < 3 * math.hypot(sigma, 0.005), name


def test_only_certain_values_are_returned(tour: Recording) -> None:
    true = odometry_of(tour)
    actual = determined_calibration(tour.readings, true, true, {}, Parameters(), STOP)
    assert list(actual) == [name for name in CALIBRATION if name in actual]
    assert {'bias', 'turn_scale'} <= set(actual)
    for value, sigma in actual.values():
        assert abs(value) < 3 * sigma


def test_two_calibrations_are_combined_to_one(tour: Recording) -> None:
    odometry = odometry_of(tour)
    one = dict(zip(CALIBRATION, (0.03, 0.01, 0.02, -0.03), strict=True))
    other = {
        name: CalibrationEstimate(value, 0.001)
        for name, value in zip(CALIBRATION, (-0.01, 0.02, -0.01, 0.02), strict=True)
    }
    both = combined_calibration(one, other)
    there = calibrated(calibrated(odometry, vector(**one)), vector(**{k: v.value for k, v in other.items()}))
    at_once = calibrated(odometry, vector(**{k: v.value for k, v in both.items()}))
    assert at_once.pose[:, 2] == pytest.approx(there.pose[:, 2], abs=0.01)
    assert at_once.pose[:, :2] == pytest.approx(there.pose[:, :2], abs=0.15)
    assert combined_calibration({}, other) == {name: pytest.approx(actual) for name, actual in other.items()}


def test_thinned_readings_cover_all_sensors_and_times(tour: Recording) -> None:
    few = thinned(tour.readings, 4)
    assert len(few) == pytest.approx(len(tour.readings) / 4, rel=0.05)
    assert np.array_equal(np.unique(few.sensor), np.unique(tour.readings.sensor))
    assert (np.diff(few.stamp) >= 0).all()
    assert len(np.unique(few.stamp)) > 0.9 * len(np.unique(tour.readings.stamp))
    assert len(thinned(tour.readings, 1)) == len(tour.readings)
