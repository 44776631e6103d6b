"""Windows of a drive: nodes are in the middle of windows and in order, also after standstills."""

from __future__ import annotations

import numpy as np
import pytest

from forward_grid_mapper.core.common.readings import Readings
from forward_grid_mapper.core.trajectory import windows
from forward_grid_mapper.core.trajectory.windows import STILL, Odometry, corrected, cut


def driven(steps: list[tuple[float, float]]) -> tuple[Readings, Odometry]:
    """A drive along x in steps of (seconds, metres), with a reading of each of two sensors at each pose."""
    seconds, metres = np.cumsum([(0.0, 0.0), *steps], axis=0).T
    stamp = np.round(seconds * 1e9).astype(np.int64)
    odometry = Odometry.of(stamp, np.stack([metres, 0.0 * metres, 0.0 * metres], axis=1))
    both = {'x': np.repeat(metres, 2), 'stamp': np.repeat(stamp, 2), 'sensor': np.tile([0, 1], len(stamp))}
    return Readings.from_columns(
        ('left', 'right'), **both, y=0.0, yaw=0.0, z=both['x'] * 0.0 + 1.0, z_max=3.0, half_angle=0.1
    ), odometry


@pytest.mark.parametrize('last', [0.3, 0.6, 0.9, 1.3, 2.4, 12.0])
@pytest.mark.parametrize('lasts', [0.1, 10.0, 60.0])
@pytest.mark.parametrize('stop', [0, 3, 100])
def test_nodes_are_distinct_after_a_standstill(last: float, lasts: float, stop: int) -> None:
    readings, odometry = driven([(0.1, 0.02)] * 100 + [(0.1, 0.0)] * stop + [(lasts, last)])
    found = cut(readings, odometry)
    assert (np.diff(found.node_progress) > 0.0).all()
    middle = 0.2 + 0.4 * np.arange(len(found))
    # one of them may be at the standstill, or nearer to it
    assert np.isin(np.flatnonzero(np.abs(found.node[:, 0] - middle) > 1e-6), [5] if stop else []).all()
    same = corrected(odometry.progress, odometry.pose, found.node_progress, found.node, found.node)
    assert same == pytest.approx(odometry.pose, abs=1e-9)


def test_nodes_of_slow_odometry_are_on_the_path() -> None:
    rng = np.random.default_rng(3)
    for _ in range(20):
        steps = [(1.0, 0.8 * float(moves)) for moves in rng.random(60) < 0.5]
        readings, odometry = driven([(1.0, 0.8), *steps, (1.0, 0.8)])
        found = cut(readings, odometry)
        assert (np.diff(found.node_progress) > 0.0).all()
        assert found.travel == pytest.approx(found.node[:, 0], abs=1e-6)


@pytest.mark.parametrize('seed', range(5))
def test_readings_at_standstill_are_those_of_a_loop_over_each_sensor(seed: int) -> None:
    rng = np.random.default_rng(seed)
    steps = rng.normal(0.0, 0.006, (400, 3)) * (rng.random((400, 1)) < 0.5)
    pose, sensor = np.cumsum(steps, axis=0), rng.integers(0, 4, 400).astype(np.int32)
    expected = np.zeros(400, np.bool_)
    for number in range(4):
        last = None
        for t in np.flatnonzero(sensor == number):
            if last is not None and np.hypot(*(pose[t] - last)[:2]) < STILL and abs(pose[t, 2] - last[2]) < STILL:
                expected[t] = True
            else:
                last = pose[t]
    assert 50 < np.count_nonzero(expected) < 350
    assert np.array_equal(windows._still(pose, sensor), expected)
    assert not len(windows._still(pose[:0], sensor[:0]))
