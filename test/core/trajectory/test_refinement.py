"""Refinement of whole drives: drift is corrected, exact odometry is kept, and unsuitable drives are rejected."""

from __future__ import annotations

import math
import threading
from dataclasses import replace

import numpy as np
import pytest
from short_tour import TOUR, bent_tour, short_tour

from forward_grid_mapper.core.common.errors import Cancelled
from forward_grid_mapper.core.common.parameters import Parameters
from forward_grid_mapper.core.common.readings import Readings
from forward_grid_mapper.core.mapping import Mapper
from forward_grid_mapper.core.trajectory import refinement, right_angles
from forward_grid_mapper.core.trajectory.heading import NOISES
from forward_grid_mapper.core.trajectory.holding_out import (
    FEWEST_BLOCKS,
    NEAR,
    REVISIT_AFTER,
    has_revisits,
    held_out,
)
from forward_grid_mapper.core.trajectory.outcome import Refinement
from forward_grid_mapper.core.trajectory.poses import compose, relative, rms_after_alignment
from forward_grid_mapper.core.trajectory.refinable import SHORTEST, unfit
from forward_grid_mapper.core.trajectory.refinement import Refiner
from forward_grid_mapper.core.trajectory.scans import Scans
from forward_grid_mapper.core.trajectory.windows import Odometry, cut
from forward_grid_mapper.simulation.drift import LEVELS, odometry_of, with_drift
from forward_grid_mapper.simulation.drive import Recording, drive
from forward_grid_mapper.simulation.sonar import NOISY, front_array, sonar_ring
from forward_grid_mapper.simulation.world import building_world


@pytest.fixture(scope='module')
def tour() -> Recording:
    return short_tour()


@pytest.fixture(scope='module')
def bent() -> tuple[Readings, Odometry]:
    return bent_tour()


@pytest.fixture(scope='module')
def stages() -> list[str]:
    """The stages reported while `outcome` was computed."""
    return []


@pytest.fixture(scope='module')
def outcome(bent, stages) -> Refinement:
    return Refiner(Parameters()).run(*bent, lambda stage, part: stages.append(stage))


def test_drift_is_corrected(tour, bent, outcome, stages) -> None:
    _, odometry = bent
    true = odometry_of(tour).pose
    before = rms_after_alignment(odometry.pose, true)
    after = rms_after_alignment(outcome.trajectory.pose, true)
    assert outcome.accepted and outcome.right_angles
    assert outcome.reason.startswith(('readings are predicted', 'with walls at right angles'))
    # walls at right angles explain all of it, so no other method is tried
    assert 'matching' in stages and 'scan matching' not in stages
    assert before > 0.8
    assert after < 0.2
    assert outcome.moved == pytest.approx(before, abs=0.2)
    assert outcome.trajectory.pose[0] == pytest.approx(odometry.pose[0], abs=1e-6)


def test_single_sensor_that_turns_on_the_robot_suffices(tour) -> None:
    """As on a servo: of each sweep of the ring, only the reading of the next sensor is kept."""
    straight = drive(building_world(), TOUR, 0.02, sonar_ring(16), NOISY, seed=3)
    recording = with_drift(straight, LEVELS['high'], 6)
    readings, odometry = recording.readings, odometry_of(recording)
    _, sweep = np.unique(readings.stamp, return_inverse=True)
    turning = readings.select(np.flatnonzero(readings.sensor == 5 * sweep % 16))
    turning = replace(turning, sensor=np.zeros(len(turning), np.int32), sensor_names=('servo',))
    outcome = Refiner(Parameters()).run(turning, odometry)
    true = odometry_of(straight).pose
    assert outcome.accepted
    assert rms_after_alignment(odometry.pose, true) > 0.7
    assert rms_after_alignment(outcome.trajectory.pose, true) < 0.3


@pytest.mark.parametrize(
    ('way', 'rounds'),
    [([[2.0, 8.85], [29.0, 8.85]], 1), ([[10.0, 8.85], [14.0, 8.85], [10.0, 8.85]], 1), (TOUR, 2)],
)
def test_revisits_are_detected(way, rounds) -> None:
    points = np.concatenate([np.array(way, float)] * rounds)
    recording = drive(building_world(), points, 0.1, front_array(), NOISY, seed=4)
    windows = cut(recording.readings, odometry_of(recording))
    scans = Scans(windows, Parameters(), np.zeros(1, np.uint8), held_out(len(windows)))
    progress, again = windows.node_progress, 0
    for k in np.flatnonzero(scans.held_out):
        others = [j for j in range(len(windows)) if abs(progress[j] - progress[k]) > REVISIT_AFTER]
        again += any(math.dist(windows.node[k, :2], windows.node[j, :2]) < NEAR for j in others)
    assert has_revisits(scans, windows.node) == (again >= FEWEST_BLOCKS) == (rounds == 2)
    far = np.arange(len(windows))[:, None] * np.array([5.0, 0.0, 0.0])
    assert not has_revisits(scans, far)


def test_readings_move_with_the_trajectory(bent, outcome) -> None:
    readings, odometry = bent
    placed = outcome.readings
    for name in ('z', 'stamp', 'sensor', 'z_max', 'half_angle'):
        assert np.array_equal(getattr(placed, name), getattr(readings, name))
    was, now = (
        relative(path.at(r.stamp), np.stack([r.x, r.y, r.yaw], 1))
        for path, r in ((odometry, readings), (outcome.trajectory, placed))
    )
    assert now[:, :2] == pytest.approx(was[:, :2], abs=1e-9)


def test_refined_map_has_a_larger_objective(bent, outcome) -> None:
    drifted, refined = (Mapper(Parameters()).run(readings).objective for readings in (bent[0], outcome.readings))
    assert refined > drifted + 0.1 * len(outcome.readings)


def test_exact_odometry_is_kept(tour, monkeypatch) -> None:
    odometry = odometry_of(tour)
    # walls are at right angles along it, so no other method is tried
    monkeypatch.setattr(refinement, 'match_drive', None)
    left = Refiner(Parameters()).run(tour.readings, odometry)
    assert not left.accepted
    assert left.reason
    assert left.readings is tour.readings
    assert left.trajectory is odometry


def test_moved_drive_gives_the_moved_trajectory(bent, outcome) -> None:
    readings, odometry = bent
    home = np.array([3.0, -12.0, math.pi / 2])
    sensors = compose(home, np.stack([readings.x, readings.y, readings.yaw], 1))
    moved = replace(readings, x=sensors[:, 0].copy(), y=sensors[:, 1].copy(), yaw=sensors[:, 2].copy())
    other = Refiner(Parameters()).run(moved, Odometry.of(odometry.stamp, compose(home, odometry.pose)))
    assert other.accepted
    back = relative(home, other.trajectory.pose)
    assert np.hypot(*(back - outcome.trajectory.pose)[:, :2].T).max() < 0.2


def test_refinement_can_be_cancelled(bent) -> None:
    refiner = Refiner(Parameters())
    stages = []

    def watch(stage: str, part: float) -> None:
        stages.append(stage)
        if stage == 'matching':
            threading.Thread(target=refiner.cancel).run()

    with pytest.raises(Cancelled):
        refiner.run(*bent, watch)
    assert stages[-1] == 'matching'


def still(readings: Readings, odometry: Odometry) -> tuple[Readings, Odometry]:
    return readings, replace(odometry, pose=np.zeros_like(odometry.pose))


def short(readings: Readings, odometry: Odometry, metres: float = 2.0) -> tuple[Readings, Odometry]:
    last = int(np.searchsorted(odometry.travel, metres))
    kept = readings.stamp <= odometry.stamp[last]
    return readings.select(kept), Odometry(odometry.stamp[: last + 1], odometry.pose[: last + 1])


def nearly_long_enough(readings: Readings, odometry: Odometry) -> tuple[Readings, Odometry]:
    readings, odometry = short(readings, odometry, SHORTEST)
    by = (SHORTEST - 0.01) / odometry.travel[-1]
    return readings, Odometry(odometry.stamp, odometry.pose * [by, by, 1.0])


def without_echoes(readings: Readings, odometry: Odometry) -> tuple[Readings, Odometry]:
    return replace(readings, z=readings.z_max.copy()), odometry


def one_sensor(readings: Readings, odometry: Odometry) -> tuple[Readings, Odometry]:
    return readings.select(np.repeat(np.flatnonzero(readings.sensor == 0), 2)), odometry


def one_sensor_to_the_side(readings: Readings, odometry: Odometry) -> tuple[Readings, Odometry]:
    kept, odometry = one_sensor(readings, odometry)
    return replace(kept, yaw=kept.yaw + np.pi / 2), odometry


def late(readings: Readings, odometry: Odometry) -> tuple[Readings, Odometry]:
    half = len(odometry.stamp) // 2
    return readings, Odometry(odometry.stamp[half:], odometry.pose[half:])


def nothing(readings: Readings, odometry: Odometry) -> tuple[Readings, Odometry]:
    return readings, Odometry.of(np.zeros(0, np.int64), np.zeros((0, 3)))


@pytest.mark.parametrize(
    ('spoiled', 'word'),
    [
        (short, '2.0 m long'),
        (still, '0.0 m long'),
        (nearly_long_enough, 'the drive is 7.9 m long; the drift of odometry can be measured from 8 m'),
        (without_echoes, 'have an echo'),
        (one_sensor, 'one sensor'),
        (one_sensor_to_the_side, 'one sensor'),
        (late, 'without odometry'),
        (nothing, "no poses of odometry, as in a journal or after a jump of odometry's clock"),
    ],
)
def test_unsuitable_drive_is_not_refined_with_reason(bent, spoiled, word) -> None:
    readings, odometry = spoiled(*bent)
    left = Refiner(Parameters()).run(readings, odometry)
    assert not left.accepted
    assert word in left.reason
    assert left.readings is readings
    assert left.trajectory is odometry
    assert unfit(*bent) == ''


def test_drive_with_random_ranges_is_not_refined(bent) -> None:
    readings, odometry = bent
    z = np.random.default_rng(0).uniform(0.2, 5.9, len(readings))
    assert not Refiner(Parameters()).run(replace(readings, z=z), odometry).accepted


def test_straight_drive_without_revisits_is_no_worse() -> None:
    recording = drive(building_world(), np.array([[2.0, 8.85], [29.0, 8.85]]), 0.1, front_array(), NOISY, seed=4)
    bent = with_drift(recording, LEVELS['middle'], 3)
    true, odometry = odometry_of(recording).pose, odometry_of(bent)
    left = Refiner(Parameters()).run(bent.readings, odometry)
    assert rms_after_alignment(left.trajectory.pose, true) < rms_after_alignment(odometry.pose, true) + 0.02


def test_noise_of_odometry_is_estimated_or_given(bent, monkeypatch) -> None:
    seen = []

    def look(windows, at, votes, noises) -> None:
        seen.append(noises)

    monkeypatch.setattr(right_angles, 'heading', look)
    monkeypatch.setattr(refinement, 'match_drive', lambda *rest: None)
    for given in ({}, {'odometry_noise': 0.04}):
        found = Refiner(Parameters.from_flat(given)).run(*bent)
        assert found.reason.startswith(right_angles.NO_WALLS)
    assert seen == [NOISES, (0.04,)]
