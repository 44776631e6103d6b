"""The likelihood of the yaw of odometry along a trajectory."""

from __future__ import annotations

import math

import numpy as np
import pytest

from forward_grid_mapper.core.common.readings import Floats
from forward_grid_mapper.core.trajectory import odometry_model
from forward_grid_mapper.core.trajectory.odometry_model import LEAST_ERROR, PIECE, log_likelihood_of_yaw
from forward_grid_mapper.core.trajectory.poses import compose, wrapped
from forward_grid_mapper.core.trajectory.scans import Scans


def turned(scans: Scans, error: Floats) -> Floats:
    """Return the nodes of odometry with another yaw, which is all that counts."""
    nodes = scans.windows.node.copy()
    nodes[:, 2] = wrapped(nodes[:, 2] + error)
    return nodes


@pytest.fixture
def pieces(scans: Scans) -> int:
    progress = scans.windows.node_progress
    return math.ceil((progress[-1] - progress[0]) / PIECE) - 1


def test_constant_errors_of_odometry_cost_nothing(scans, pieces) -> None:
    progress, yaw = scans.windows.node_progress, np.unwrap(scans.windows.node[:, 2])
    best = -pieces * math.log(LEAST_ERROR)
    assert log_likelihood_of_yaw(scans.windows, scans.windows.node) == pytest.approx(best)
    nodes = turned(scans, math.radians(4.0) * progress - 0.07 * yaw + 2.0)
    assert log_likelihood_of_yaw(scans.windows, nodes) == pytest.approx(best)
    assert log_likelihood_of_yaw(scans.windows, compose(np.array([3.0, -8.0, 2.5]), nodes)) == pytest.approx(best)


@pytest.mark.parametrize('noise', [0.5, 3.0])
def test_larger_errors_are_less_likely(scans, pieces, noise: float) -> None:
    progress = scans.windows.node_progress
    steps = np.random.default_rng(3).laplace(0.0, math.radians(noise), 1000)
    ends = progress[0] + PIECE * np.arange(1001)
    error = np.interp(progress, ends, np.concatenate([[0.0], np.cumsum(steps)]))
    found = log_likelihood_of_yaw(scans.windows, turned(scans, error))
    # nodes lie between the ends of pieces, so that the errors are interpolated
    assert found == pytest.approx(-pieces * math.log(math.radians(noise)), abs=0.3 * pieces)
    assert log_likelihood_of_yaw(scans.windows, turned(scans, 2.0 * error)) == pytest.approx(
        found - pieces * math.log(2.0)
    )


def test_short_drives_tell_nothing(scans, monkeypatch, pieces) -> None:
    monkeypatch.setattr(odometry_model, 'FEWEST_PIECES', pieces + 1)
    assert log_likelihood_of_yaw(scans.windows, scans.windows.node) == 0.0
    monkeypatch.setattr(odometry_model, 'FEWEST_PIECES', pieces)
    assert log_likelihood_of_yaw(scans.windows, scans.windows.node) > 0.0
