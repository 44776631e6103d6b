"""Corrections applied to poses and readings, also after the end of the trajectory; odometry recovered from readings."""

from __future__ import annotations

import numpy as np
import pytest

from forward_grid_mapper.core.common.readings import Readings
from forward_grid_mapper.core.trajectory.correction import Correction
from forward_grid_mapper.core.trajectory.outcome import replaced
from forward_grid_mapper.core.trajectory.poses import compose, wrapped
from forward_grid_mapper.core.trajectory.recovering import recovered, that_placed
from forward_grid_mapper.core.trajectory.windows import Odometry

MOUNTS = {'left': (0.1, 0.2, 1.0), 'right': (0.1, -0.2, -2.5)}


def some_odometry(rng: np.random.Generator, count: int) -> Odometry:
    steps = np.stack([rng.normal(0.05, 0.02, count), rng.normal(0.0, 0.01, count), rng.normal(0.0, 0.2, count)], 1)
    pose = [rng.normal(0.0, 5.0, 3)]
    for step in steps[1:]:
        pose.append(compose(pose[-1], step))
    return Odometry.of(np.cumsum(rng.integers(1, 10**8, count)), np.array(pose))


def readings_at(rng: np.random.Generator, odometry: Odometry, stamp: np.ndarray) -> Readings:
    sensor = rng.integers(0, 2, len(stamp))
    mount = np.array(list(MOUNTS.values()))[sensor]
    x, y, yaw = compose(odometry.at(stamp), mount).T
    return Readings.from_columns(
        tuple(MOUNTS), x=x, y=y, yaw=yaw, z=np.ones(len(stamp)), z_max=4.0, half_angle=0.2, stamp=stamp, sensor=sensor
    )


@pytest.mark.parametrize('seed', range(20))
def test_corrected_readings_move_with_the_robot(seed: int) -> None:
    rng = np.random.default_rng(seed)
    odometry, other = some_odometry(rng, 50), some_odometry(rng, 50)
    trajectory = Odometry(odometry.stamp, other.pose)
    correction = Correction(odometry, trajectory)
    inner = readings_at(rng, odometry, np.sort(rng.integers(odometry.stamp[0], odometry.stamp[-1], 80)))
    for name in ('x', 'y', 'yaw'):
        assert np.array_equal(
            getattr(correction.apply(inner), name), getattr(replaced(inner, odometry, trajectory), name)
        )
    # after the end, the transform is that of the end
    later = some_odometry(rng, 30)
    later = Odometry(later.stamp + odometry.stamp[-1], later.pose)
    outer = readings_at(rng, later, later.stamp[1:-1])
    moved = correction.apply(outer)
    assert np.stack([moved.x, moved.y], 1) == pytest.approx(
        compose(correction.last, np.stack([outer.x, outer.y, outer.yaw], 1))[:, :2]
    )
    assert compose(correction.last, odometry.pose[-1])[:2] == pytest.approx(trajectory.pose[-1, :2])
    assert abs(wrapped(compose(correction.last, odometry.pose[-1])[2] - trajectory.pose[-1, 2])) < 1e-9
    assert correction.moved == pytest.approx(np.hypot(*(trajectory.pose[-1] - odometry.pose[-1])[:2]))
    # other columns are unchanged
    for name in ('z', 'stamp', 'sensor', 'half_angle'):
        assert np.array_equal(getattr(moved, name), getattr(outer, name))
    # a path of the same odometry at other stamps
    stamps = np.sort(np.r_[odometry.stamp[::3], rng.integers(odometry.stamp[0], odometry.stamp[-1], 20)])
    along = correction.along(Odometry(stamps, odometry.at(stamps)))
    assert along.pose[:, :2] == pytest.approx(trajectory.at(stamps)[:, :2])
    assert np.abs(wrapped(along.pose[:, 2] - trajectory.at(stamps)[:, 2])).max() < 1e-9
    assert np.abs(np.diff(along.pose[:, 2])).max(initial=0.0) <= np.pi
    beyond = correction.along(later).pose[later.stamp > odometry.stamp[-1]]
    assert beyond[:, :2] == pytest.approx(compose(correction.last, later.pose[later.stamp > odometry.stamp[-1]])[:, :2])
    path = correction.path_of(np.r_[odometry.stamp, later.stamp], np.r_[odometry.pose, later.pose])
    at_end = int((later.stamp <= odometry.stamp[-1]).sum())
    assert len(path) == 80 - at_end
    assert path[50:] == pytest.approx(compose(correction.last, later.pose[at_end:])[:, :2])


@pytest.mark.parametrize('seed', range(20))
def test_missing_odometry_is_recovered_from_readings(seed: int) -> None:
    rng = np.random.default_rng(seed)
    odometry = some_odometry(rng, 60)
    readings = readings_at(rng, odometry, rng.permutation(odometry.stamp))
    late = Odometry(odometry.stamp[40:], odometry.pose[40:])
    whole = recovered(late, readings, MOUNTS)
    assert np.array_equal(whole.stamp, odometry.stamp)
    assert whole.pose[:, :2] == pytest.approx(odometry.pose[:, :2])
    assert np.abs(wrapped(whole.pose[:, 2] - odometry.pose[:, 2])).max() < 1e-9
    nothing = Odometry.of(np.zeros(0, np.int64), np.zeros((0, 3)))
    assert np.array_equal(recovered(nothing, readings, MOUNTS).stamp, odometry.stamp)
    # sensors with unknown pose give no odometry
    only = recovered(late, readings, {'left': MOUNTS['left']})
    assert set(only.stamp[: -len(late.stamp)]) == set(readings.stamp[readings.sensor == 0]) - set(late.stamp)
    assert recovered(late, readings, {}) is late
    assert recovered(odometry, readings, MOUNTS) is odometry


@pytest.mark.parametrize('moved', [(0.3, 0.0, 0.0), (0.0, 0.0, 0.4), (0.0, 0.0, -3.0)])
def test_odometry_of_readings_taken_elsewhere_is_left_out(moved: tuple[float, float, float]) -> None:
    rng = np.random.default_rng(4)
    odometry = some_odometry(rng, 60)
    # the clock jumped back: half of these times came before, when the robot stood elsewhere, or looked elsewhere
    before = Odometry(odometry.stamp, compose(odometry.pose, np.array(moved)))
    early = readings_at(rng, before, odometry.stamp[:30])
    assert np.array_equal(that_placed(early, odometry, MOUNTS).stamp, odometry.stamp[30:])
    assert that_placed(readings_at(rng, odometry, odometry.stamp), odometry, MOUNTS) is odometry
    turned = Odometry(odometry.stamp, odometry.pose + np.array([0.0, 0.0, 2 * np.pi]))
    assert that_placed(readings_at(rng, turned, odometry.stamp), odometry, MOUNTS) is odometry


@pytest.mark.parametrize('seed', range(10))
def test_correction_is_extended_and_cut_off(seed: int) -> None:
    rng = np.random.default_rng(seed)
    odometry, other = some_odometry(rng, 60), some_odometry(rng, 60)
    begin, end = sorted(rng.integers(1, 59, 2).tolist())
    first = Correction(
        Odometry(odometry.stamp[: end + 1], odometry.pose[: end + 1]),
        Odometry(odometry.stamp[: end + 1], other.pose[: end + 1]),
    )
    # new poses overlap, and old ones stay
    later = slice(begin, None)
    moved = Odometry(odometry.stamp[later], other.pose[later] + 1.0)
    longer = first.continued(Odometry(odometry.stamp[later], odometry.pose[later]), moved)
    assert np.array_equal(longer.trajectory.stamp, odometry.stamp)
    assert np.array_equal(longer.odometry.pose, odometry.pose)
    assert np.array_equal(longer.trajectory.pose, np.concatenate([other.pose[: end + 1], other.pose[end + 1 :] + 1.0]))
    back = longer.until(first.end)
    assert np.array_equal(back.trajectory.pose, first.trajectory.pose)
    assert back.last == pytest.approx(first.last)
    assert len(longer.until(0).trajectory.stamp) == 1


def test_bounded_correction_drops_poses_that_interpolation_replaces() -> None:
    # along a straight line, most poses are not needed
    straight = np.stack([np.linspace(0.0, 4.0, 400), np.zeros(400), np.zeros(400)], 1)
    odometry = Odometry(10**8 * np.arange(400), straight)
    correction = Correction(odometry, Odometry(odometry.stamp, compose(np.array([1.0, 2.0, 0.5]), straight)))
    assert correction.bounded(400) is correction
    fewer = correction.bounded(100)
    assert 10 < len(fewer.odometry.stamp) <= 100
    assert np.array_equal(fewer.odometry.stamp, fewer.trajectory.stamp)
    assert fewer.odometry.stamp[[0, -1]].tolist() == odometry.stamp[[0, -1]].tolist()
    assert fewer.trajectory.at(odometry.stamp) == pytest.approx(correction.trajectory.pose)
    assert fewer.last == pytest.approx(correction.last)
