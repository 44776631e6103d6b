"""Fitting trajectories to their own maps before their J is compared."""

from __future__ import annotations

import math

import numpy as np
import pytest
from pentagon_drive import quietly, scans_of

from forward_grid_mapper.core.common.errors import Cancelled, InputError
from forward_grid_mapper.core.common.readings import Floats
from forward_grid_mapper.core.trajectory import fitting
from forward_grid_mapper.core.trajectory.fitting import fitted, gain_when_fitted
from forward_grid_mapper.core.trajectory.holding_out import LEAST_SIGMAS, Gain
from forward_grid_mapper.core.trajectory.judging import gain_of_objective
from forward_grid_mapper.core.trajectory.matching import measure
from forward_grid_mapper.core.trajectory.poses import compose, relative, rms_after_alignment, wrapped
from forward_grid_mapper.core.trajectory.scans import Scans
from forward_grid_mapper.simulation.drift import odometry_of


@pytest.fixture(scope='module')
def true(exact, scans) -> Floats:
    return odometry_of(exact).at(scans.windows.node_stamp)


@pytest.fixture(scope='module')
def rough(scans, true: Floats) -> Floats:
    """The true trajectory, but it swerves by 3° and 3 cm every 3 m."""
    phase = 2.0 * math.pi / 3.0 * (scans.windows.node_progress - scans.windows.node_progress[0])
    aside = math.radians(3.0) * 3.0 / (2.0 * math.pi) * (1.0 - np.cos(phase))
    return compose(true, np.stack([0.0 * phase, aside, math.radians(3.0) * np.sin(phase)], axis=1))


@pytest.fixture(scope='module')
def fitted_rough(scans, rough: Floats) -> Floats:
    return fitted(scans, rough)


def bent_by(nodes: Floats, angle: float) -> Floats:
    """The nodes of a trajectory that turns by `angle` more, evenly from its beginning to its end."""
    steps = relative(nodes[:-1], nodes[1:])
    steps[:, 2] += angle / len(steps)
    bent = nodes[:1]
    for step in steps:
        bent = np.concatenate([bent, compose(bent[-1:], step[None])])
    return bent


def yaw_error(nodes: Floats, true: Floats) -> float:
    return float(np.std(wrapped(nodes[:, 2] - true[:, 2])))


def test_fitting_takes_back_small_errors(scans, true, rough, fitted_rough) -> None:
    assert yaw_error(fitted_rough, true) < 0.6 * yaw_error(rough, true)
    assert rms_after_alignment(fitted_rough, true) < rms_after_alignment(rough, true)
    np.testing.assert_allclose(fitted_rough[0], rough[0], atol=1e-6)
    missing = scans.objective(true) - scans.objective(rough)
    assert missing > 400.0
    assert scans.objective(fitted_rough) - scans.objective(rough) > 0.8 * missing


def test_fitting_leaves_a_trajectory_where_it_is(scans, true) -> None:
    wrong = bent_by(true, math.radians(60.0))
    assert rms_after_alignment(wrong, true) > 1.0
    assert rms_after_alignment(fitted(scans, wrong), wrong) < 0.1


def test_fitting_does_not_depend_on_the_frame(scans, rough, fitted_rough) -> None:
    frame = np.array([5.0, -3.0, math.radians(90.0)])
    moved = fitted(scans, compose(frame, rough))
    np.testing.assert_allclose(relative(frame, moved)[:, :2], fitted_rough[:, :2], atol=2e-3)


def test_held_out_readings_have_no_effect(scans, rough) -> None:
    found = fitting._matched_with_map(scans, rough, quietly)
    assert not scans.held_out[found.second].any()
    assert not found.first.any()
    # the first node is fixed, but the other windows of its block are matched
    assert found.second.tolist()[:2] == [k for k in (1, 2, 3) if not scans.held_out[k]][:2]


def test_poses_are_those_on_the_map_of_all_other_windows_around(scans, rough) -> None:
    found = fitting._matched_with_map(scans, rough, quietly)
    block = np.arange(40, 44)
    near = np.hypot(*(rough[:, :2] - rough[block, :2].mean(0)).T) < fitting.NEAR
    near[block] = False
    # the robot drives along this side of the pentagon twice
    assert np.ptp(scans.windows.node_progress[near]) > 10.0
    around = scans.map(np.flatnonzero(near), rough[40], rough, fitting.ON_MAP)
    for k in block[~scans.held_out[block]]:
        match = measure(scans.scan[k], around, relative(rough[40], rough[k]), fitting.EVALUATED)
        (edge,) = np.flatnonzero(found.second == k)
        np.testing.assert_allclose(compose(rough[0], found.pose[edge])[:2], compose(rough[40], match.pose)[:2])
        # the same change of the pose costs the same in both frames
        step = np.array([0.03, 0.01, 0.02])
        turned = step.copy()
        angle = rough[40, 2] - rough[0, 2]
        turned[:2] = np.array([[math.cos(angle), -math.sin(angle)], [math.sin(angle), math.cos(angle)]]) @ step[:2]
        assert turned @ found.information[edge] @ turned == pytest.approx(step @ match.information @ step)


def test_trajectories_are_compared_after_both_were_fitted(scans, true, rough) -> None:
    # a way that is too small everywhere contradicts itself less than the right one with small errors
    wrong = true * (0.98, 0.98, 1.0)
    assert rms_after_alignment(wrong, true) > 2.0 * rms_after_alignment(rough, true)
    assert gain_of_objective(scans, rough, wrong).sigmas > LEAST_SIGMAS
    assert gain_when_fitted(scans, rough, wrong).sigmas < LEAST_SIGMAS


def test_both_trajectories_are_fitted(scans, true, rough, fitted_rough, monkeypatch) -> None:
    compared = []
    monkeypatch.setattr(fitting, 'gain_of_objective', lambda s, *nodes: compared.append(nodes) or Gain(5.0, 1.0))
    reported: list[float] = []
    gain_when_fitted(scans, true, rough, reported.append)
    (first, second), (_, of_rough) = compared
    assert first is true and second is rough
    np.testing.assert_array_equal(of_rough, fitted_rough)
    assert reported == sorted(reported) and reported[0] == 0.0 and 0.9 < reported[-1] < 1.0


def test_gain_is_that_before_fitting_if_a_fitted_trajectory_needs_too_large_a_map(scans, true, monkeypatch) -> None:
    objective, known = Scans.explained, (scans.windows.node.tobytes(), true.tobytes())

    def explained(self: Scans, nodes: Floats) -> tuple[float, Floats]:
        if nodes.tobytes() not in known:
            raise InputError('too large')
        return objective(self, nodes)

    monkeypatch.setattr(Scans, 'explained', explained)
    better = gain_of_objective(scans, scans.windows.node, true)
    assert gain_when_fitted(scans, scans.windows.node, true) == better


def test_fitting_can_be_cancelled(bent, rough) -> None:
    cancelled = scans_of(*bent)
    cancelled._stop[0] = 1
    with pytest.raises(Cancelled):
        fitted(cancelled, rough)


def test_without_matches_the_trajectory_stays(scans, rough) -> None:
    far_apart = rough * (1e3, 1e3, 1.0)
    np.testing.assert_allclose(fitted(scans, far_apart), far_apart, atol=1e-9)


def test_a_much_better_trajectory_stays_so(scans, true) -> None:
    assert gain_when_fitted(scans, scans.windows.node, true).sigmas > LEAST_SIGMAS


def test_nothing_is_fitted_if_j_is_hardly_larger(scans, true, monkeypatch) -> None:
    monkeypatch.setattr(fitting, 'fitted', lambda *rest: pytest.fail('fitted'))
    assert gain_when_fitted(scans, true, scans.windows.node) == gain_of_objective(scans, true, scans.windows.node)
