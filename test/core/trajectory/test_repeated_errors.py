"""Bent walls that were taken for straight ones, and errors of odometry that are independent in two visits."""

from __future__ import annotations

import math
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest

from forward_grid_mapper.core.common.readings import Floats
from forward_grid_mapper.core.trajectory.repeated_errors import LEAST_BEND, STRETCH, are_walls_bent, repeated_errors

STEP = 0.4


def windows_with(yaw: Floats) -> Any:
    """Windows of odometry with these yaws; its positions do not matter."""
    return SimpleNamespace(node=np.column_stack([np.zeros((len(yaw), 2)), yaw]))


def out_and_back(metres: float, rounds: int = 1) -> tuple[Floats, Floats]:
    """Nodes along a straight corridor and back, and the position of each in the corridor."""
    out = np.arange(0.0, metres, STEP)
    one = np.concatenate([out, out[::-1]])
    x = np.tile(one, rounds)
    yaw = np.tile(np.concatenate([np.zeros(len(out)), np.full(len(out), math.pi)]), rounds)
    return np.column_stack([x, np.zeros(len(x)), yaw]), x


@pytest.mark.parametrize(('degrees', 'bent'), [(1.2, True), (-1.2, True), (0.4, False), (0.0, False)])
@pytest.mark.parametrize('bias', [0.0, 1.5])
def test_corridor_that_bends_as_a_whole_is_detected(degrees: float, bent: bool, bias: float) -> None:
    """Odometry turns to one side on the way out, and to the other one on the way back."""
    nodes, x = out_and_back(36.0)
    travel = STEP * np.arange(len(x))
    noise = np.random.default_rng(3).normal(0.0, math.radians(0.7 * math.sqrt(STEP)), len(x)).cumsum()
    windows = windows_with(nodes[:, 2] + np.radians(degrees) * x + np.radians(bias) * travel + noise)
    assert are_walls_bent(windows, nodes) == bent


def test_independent_errors_are_hardly_ever_taken_for_bent_walls() -> None:
    nodes, x = out_and_back(36.0, 2)
    rng, found = np.random.default_rng(0), 0
    for _ in range(300):
        drift = rng.normal(0.0, math.radians(3.0 * math.sqrt(STEP)), len(x)).cumsum()
        found += are_walls_bent(windows_with(nodes[:, 2] + drift), nodes)
    assert found <= 6


@pytest.mark.parametrize('turned', [1.0, -1.0])
def test_visits_in_both_directions_are_compared(turned: float) -> None:
    """Each error is that of its stretch, and the sign of one from the other side is turned around."""
    out = np.arange(0.0, 40.0, STEP)
    second = out if turned > 0 else out[::-1]
    nodes = np.zeros((2 * len(out) + 30, 3))
    # a detour far from the corridor in between
    nodes[:, 0] = np.concatenate([out, np.full(30, 20.0), second])
    nodes[len(out) : len(out) + 30, 1] = 50.0 + STEP * np.arange(30)
    nodes[len(out) : len(out) + 30, 2] = math.pi / 2
    nodes[len(out) + 30 :, 2] = 0.0 if turned > 0 else math.pi
    bend = 0.1 * np.sin(nodes[:, 0] / 5.0)
    first, again = repeated_errors(windows_with(nodes[:, 2] + bend), nodes)
    assert len(first) == pytest.approx(40.0 / STRETCH, abs=1.5)
    off = 2.0 * abs(float(np.mean(np.concatenate([first, turned * again]))))
    assert first == pytest.approx(again, abs=off + 0.02)
    assert np.corrcoef(first, again)[0, 1] > 0.95


def test_turns_and_single_visits_are_left_out() -> None:
    nodes, x = out_and_back(36.0)
    once = nodes[: len(nodes) // 2]
    assert [len(part) for part in repeated_errors(windows_with(once[:, 2]), once)] == [0, 0]
    weaving = nodes.copy()
    weaving[:, 2] += math.radians(20.0) * np.sin(2 * math.pi * x / 4.0)
    assert [len(part) for part in repeated_errors(windows_with(weaving[:, 2]), weaving)] == [0, 0]
    assert not are_walls_bent(windows_with(weaving[:, 2]), weaving)
    short = nodes[:5]
    assert not are_walls_bent(windows_with(short[:, 2] + x[:5]), short)


def test_small_bends_do_not_count() -> None:
    """Walls that are not quite parallel repeat themselves exactly, too."""
    nodes, x = out_and_back(36.0)
    for factor, bent in ((0.9, False), (1.2, True)):
        assert are_walls_bent(windows_with(nodes[:, 2] + factor * LEAST_BEND * x), nodes) == bent
