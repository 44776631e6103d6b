"""An earlier trajectory is kept if a later run rejects its own, unless odometry is better."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from forward_grid_mapper.core.common.errors import Cancelled
from forward_grid_mapper.core.common.parameters import Parameters
from forward_grid_mapper.core.trajectory.correction import Correction
from forward_grid_mapper.core.trajectory.keeping import keep_if_not_worse
from forward_grid_mapper.core.trajectory.outcome import Refinement
from forward_grid_mapper.core.trajectory.poses import compose, rms_after_alignment
from forward_grid_mapper.core.trajectory.windows import Odometry
from forward_grid_mapper.simulation.drift import LEVELS, odometry_of, with_drift
from forward_grid_mapper.simulation.drive import drive
from forward_grid_mapper.simulation.sonar import NOISY, sonar_ring
from forward_grid_mapper.simulation.world import building_tour, building_world


def first_of(path: Odometry, part: float) -> Odometry:
    end = int(part * len(path.stamp))
    return Odometry(path.stamp[:end], path.pose[:end])


class Sample:
    """A drive with odometry that drifts, its trajectory from an earlier run, and a later run that is rejected."""

    def __init__(self) -> None:
        exact = drive(building_world(), building_tour()[:10], 0.15, sonar_ring(16), NOISY, seed=3)
        bent = with_drift(exact, LEVELS['high'], 6)
        self.exact, self.true = exact, odometry_of(exact)
        self.odometry = odometry_of(bent)
        self.refused = Refinement(False, 'the test says so', bent.readings, self.odometry, {})
        self.correction = Correction(first_of(self.odometry, 0.7), first_of(self.true, 0.7))
        self.before = Refinement(
            True, '', bent.readings, self.correction.trajectory, {'scale': 0.02}, 1.0, 0.1, 3, 0.2, noise=0.03
        )


@pytest.fixture(scope='module')
def sample() -> Sample:
    return Sample()


def outcome(sample: Sample, **changes: object) -> Refinement:
    values = {'before': sample.before, 'correction': sample.correction, 'refused': sample.refused, **changes}
    return keep_if_not_worse(**values, parameters=Parameters(), stop=np.zeros(1, np.uint8))  # type: ignore[arg-type]


def test_earlier_trajectory_is_kept_and_extended(sample: Sample) -> None:
    found = outcome(sample)
    assert found.accepted
    assert np.array_equal(found.trajectory.stamp, sample.odometry.stamp)
    end = len(sample.correction.odometry.stamp)
    assert found.trajectory.pose[:end] == pytest.approx(sample.true.pose[:end], abs=1e-9)
    later = compose(sample.correction.last, sample.odometry.pose[end:])
    assert found.trajectory.pose[end:, :2] == pytest.approx(later[:, :2])
    before, after = (rms_after_alignment(path.pose, sample.true.pose) for path in (sample.odometry, found.trajectory))
    assert after < 0.5 * before
    assert (found.calibration, found.loops, found.noise) == ({'scale': 0.02}, 3, 0.03)
    assert found.moved == pytest.approx(before, abs=0.3)
    expected = sample.correction.apply(sample.refused.readings)
    assert found.readings.x == pytest.approx(expected.x, abs=1e-6)


def test_earlier_trajectory_is_dropped_if_odometry_is_better(sample: Sample) -> None:
    # the earlier trajectory is wrong, and odometry is exact
    wrong = Correction(first_of(sample.true, 0.7), first_of(sample.odometry, 0.7))
    refused = replace(sample.refused, readings=sample.exact.readings, trajectory=sample.true)
    found = outcome(sample, correction=wrong, refused=refused)
    assert not found.accepted and found.trajectory is refused.trajectory
    assert found.reason.startswith('the test says so; and it predicts the readings better')


def test_earlier_trajectory_of_other_odometry_is_dropped(sample: Sample) -> None:
    elsewhere = Odometry(sample.odometry.stamp, compose(np.array([3.0, 0.0, 1.0]), sample.odometry.pose))
    for odometry in (elsewhere, replace(sample.odometry, stamp=sample.odometry.stamp + 10**13)):
        stamps = sample.refused.readings.stamp + odometry.stamp[0] - sample.odometry.stamp[0]
        readings = replace(sample.refused.readings, stamp=stamps)
        refused = replace(sample.refused, readings=readings, trajectory=odometry)
        assert outcome(sample, refused=refused) is refused
    nothing = replace(sample.refused, trajectory=Odometry.of(np.zeros(0, np.int64), np.zeros((0, 3))))
    assert outcome(sample, refused=nothing) is nothing


def test_earlier_trajectory_is_kept_with_thinned_odometry(sample: Sample) -> None:
    thin = Odometry(sample.odometry.stamp[3::2], sample.odometry.pose[3::2])
    readings = sample.refused.readings
    within = (readings.stamp >= thin.stamp[0]) & (readings.stamp <= thin.stamp[-1])
    refused = replace(sample.refused, readings=readings.select(within), trajectory=thin)
    found = outcome(sample, refused=refused)
    assert found.accepted
    assert found.trajectory.pose == pytest.approx(sample.correction.along(sample.odometry).pose[3::2], abs=1e-6)


def test_keeping_can_be_cancelled(sample: Sample) -> None:
    with pytest.raises(Cancelled):
        keep_if_not_worse(sample.before, sample.correction, sample.refused, Parameters(), np.ones(1, np.uint8))
