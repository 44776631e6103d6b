"""Long stands of the robot: neither the noise nor the number of their poses changes the trajectory."""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from forward_grid_mapper.core.common.parameters import Parameters
from forward_grid_mapper.core.trajectory.poses import rms_after_alignment
from forward_grid_mapper.core.trajectory.refinement import Refiner
from forward_grid_mapper.core.trajectory.standing import without_stands
from forward_grid_mapper.core.trajectory.windows import Odometry
from forward_grid_mapper.simulation.drift import LEVELS, odometry_of, with_drift
from forward_grid_mapper.simulation.drive import drive
from forward_grid_mapper.simulation.sonar import NOISY, sonar_ring
from forward_grid_mapper.simulation.world import building_tour, building_world


def with_stand(odometry: Odometry, k: int, seconds: int, noise: float) -> Odometry:
    """The drive with a stand at pose k, in which odometry has 20 poses a second."""
    count, pause = 20 * seconds, seconds * 10**9
    stamp = odometry.stamp[k] + np.arange(1, count) * (pause // count)
    pose = odometry.pose[k] + np.random.default_rng(0).normal(0.0, noise, (count - 1, 3))
    return Odometry(
        np.concatenate([odometry.stamp[: k + 1], stamp, odometry.stamp[k + 1 :] + pause]),
        np.concatenate([odometry.pose[: k + 1], pose, odometry.pose[k + 1 :]]),
    )


def test_only_the_ends_of_long_stands_are_kept() -> None:
    pose = np.zeros((200, 3))
    pose[:, 0] = 0.02 * np.arange(200)
    driven = Odometry(np.arange(200) * 10**8, pose)
    assert without_stands(driven) is driven
    brief = with_stand(driven, 100, 50, 0.001)
    assert without_stands(brief) is brief
    for noise in (0.0, 0.001):
        long = with_stand(driven, 100, 70, noise)
        found = without_stands(long)
        assert len(found.stamp) == 201 and found.travel[-1] < driven.travel[-1] + 0.02
        assert found.stamp[[0, -1]].tolist() == long.stamp[[0, -1]].tolist()
        assert without_stands(found) is found
        # also at the end of the drive
        found = without_stands(with_stand(driven, 199, 70, noise))
        assert len(found.stamp) == 201
    # 0.5 mm/s is no stand
    slow = Odometry(np.arange(7000) * 10**8, np.stack([5e-5 * np.arange(7000), *np.zeros((2, 7000))], axis=1))
    assert without_stands(slow) is slow


def test_drive_with_an_hour_at_a_dock_is_refined_like_one_without() -> None:
    exact = drive(building_world(), building_tour()[:10], 0.15, sonar_ring(16), NOISY, seed=3)
    recording = with_drift(exact, LEVELS['high'], 6)
    odometry, readings = odometry_of(recording), recording.readings
    k = len(odometry.stamp) // 2
    expected = Refiner(Parameters()).run(readings, odometry)
    stand = with_stand(odometry, k, 3600, 0.001)
    later = replace(readings, stamp=readings.stamp + 3600 * 10**9 * (readings.stamp > odometry.stamp[k]))
    found = Refiner(Parameters()).run(later, stand)
    assert expected.accepted and found.accepted
    assert found.moved > 0.9 * expected.moved
    assert np.array_equal(found.trajectory.stamp, stand.stamp)
    drove = np.r_[0 : k + 1, len(stand.stamp) - len(odometry.stamp) + k + 1 : len(stand.stamp)]
    assert rms_after_alignment(found.trajectory.pose[drove], expected.trajectory.pose) < 0.05
