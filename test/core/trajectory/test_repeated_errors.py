"""Bent walls that were taken for straight ones, and errors of odometry that are independent in two visits."""

from __future__ import annotations

import itertools
import math
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest

from forward_grid_mapper.core.common.parameters import Parameters
from forward_grid_mapper.core.common.readings import Floats
from forward_grid_mapper.core.runtime.cancelling import NEVER
from forward_grid_mapper.core.trajectory import right_angles
from forward_grid_mapper.core.trajectory.attempt import ACCURACY, Drive
from forward_grid_mapper.core.trajectory.holding_out import REVISIT_AFTER, held_out
from forward_grid_mapper.core.trajectory.poses import rms_after_alignment, wrapped
from forward_grid_mapper.core.trajectory.refinement import Refiner
from forward_grid_mapper.core.trajectory.repeated_errors import (
    FEWEST_STRETCHES,
    LEAST_BEND,
    LEAST_MEAN_BEND,
    SAME_AXIS,
    SAME_PLACE,
    STRETCH,
    RepeatedErrors,
    _errors,
    are_walls_bent,
    repeated_errors,
)
from forward_grid_mapper.core.trajectory.right_angles import at_right_angles
from forward_grid_mapper.core.trajectory.scans import Scans
from forward_grid_mapper.core.trajectory.windows import cut
from forward_grid_mapper.simulation.drift import LEVELS, odometry_of, with_drift
from forward_grid_mapper.simulation.drive import drive
from forward_grid_mapper.simulation.sonar import NOISY, sonar_ring
from forward_grid_mapper.simulation.world import Floorplan, World

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


def pairs_by_brute_force(windows: Any, nodes: Floats) -> list[tuple[float, float, bool]]:
    """The rows of `repeated_errors`, from all pairs of nodes."""
    travel = np.concatenate([[0.0], np.cumsum(np.hypot(*np.diff(nodes[:, :2], axis=0).T))])
    yaw = np.unwrap(nodes[:, 2])
    error, usable = _errors(windows, travel, yaw)
    found, used = list[tuple[float, float, bool]](), list[float]()
    for k in range(len(nodes)):
        best, closest = None, SAME_PLACE
        for j in [k, *range(k)]:
            free = usable[j] and all(abs(travel[j] - at) >= STRETCH for at in used)
            if not free and j == k:
                break
            apart, angle = math.hypot(*(nodes[j, :2] - nodes[k, :2])), abs(float(wrapped(yaw[j] - yaw[k])))
            along = min(angle, math.pi - angle) < SAME_AXIS
            if free and along and travel[j] < travel[k] - REVISIT_AFTER and apart < closest:
                best, closest = j, apart
        if best is not None:
            opposite = abs(float(wrapped(yaw[best] - yaw[k]))) > math.pi / 2
            found.append((error[best], -error[k] if opposite else error[k], opposite))
            used += [travel[k], travel[best]]
    return found


@pytest.mark.parametrize('seed', range(8))
def test_pairs_of_stretches_are_those_of_brute_force(seed: int) -> None:
    rng = np.random.default_rng(seed)
    nodes, _ = out_and_back(rng.uniform(12.0, 30.0), 2)
    nodes = nodes + rng.normal(0.0, 1.0, nodes.shape) * np.array([0.05, 0.3, 0.2])
    windows = windows_with(nodes[:, 2] + rng.normal(0.0, 0.02, len(nodes)).cumsum())
    earlier, later, opposite = repeated_errors(windows, nodes)
    expected = pairs_by_brute_force(windows, nodes)
    assert len(expected) >= 2
    assert [*zip(earlier.tolist(), later.tolist(), opposite.tolist(), strict=True)] == expected


@pytest.mark.parametrize(('degrees', 'bent'), [(1.2, True), (-1.2, True), (0.8, True), (0.2, False), (0.0, False)])
@pytest.mark.parametrize('bias', [0.0, 1.5])
def test_corridor_that_bends_as_a_whole_is_detected(degrees: float, bent: bool, bias: float) -> None:
    """Odometry turns to one side on the way out, and to the other one on the way back."""
    nodes, x = out_and_back(36.0)
    travel = STEP * np.arange(len(x))
    noise = np.random.default_rng(3).normal(0.0, math.radians(0.7 * math.sqrt(STEP)), len(x)).cumsum()
    windows = windows_with(nodes[:, 2] + np.radians(degrees) * x + np.radians(bias) * travel + noise)
    assert are_walls_bent(windows, nodes) == bent


def test_corridor_that_bends_to_both_sides_is_detected() -> None:
    nodes, x = out_and_back(60.0)
    noise = np.random.default_rng(3).normal(0.0, math.radians(0.7 * math.sqrt(STEP)), len(x)).cumsum()
    windows = windows_with(nodes[:, 2] + 0.24 * np.sin(x / 8.0) + noise)
    found = repeated_errors(windows, nodes)
    assert found.mean_bend[0] < LEAST_MEAN_BEND and found.common_bend[0] > LEAST_BEND
    assert are_walls_bent(windows, nodes)


@pytest.mark.parametrize('noise', [0.7, 3.0])
@pytest.mark.parametrize('rounds', [1, 3])
def test_independent_errors_are_hardly_ever_taken_for_bent_walls(noise: float, rounds: int) -> None:
    nodes, x = out_and_back(36.0, rounds)
    rng, found = np.random.default_rng(0), 0
    for _ in range(300):
        drift = rng.normal(0.0, math.radians(noise * math.sqrt(STEP)), len(x)).cumsum()
        found += are_walls_bent(windows_with(nodes[:, 2] + drift), nodes)
    assert found <= 6


def test_bends_are_those_of_the_formulas() -> None:
    rng = np.random.default_rng(1)
    a, b = rng.normal(0.05, 0.03, (2, 9))
    opposite = np.arange(9) != 4
    found = RepeatedErrors(b, a, opposite)
    c, d = ((a + b) / 2)[opposite], ((a - b) / 2)[opposite]
    s2 = (sum((each - sum(c) / 8) ** 2 for each in c) + sum(each**2 for each in d)) / 15
    assert found.mean_bend == pytest.approx((sum(c) / 8, sum(c) / 8 / math.sqrt(s2 / 8)))
    r = sum(a * b) / math.sqrt(sum(a**2) * sum(b**2))
    assert found.common_bend == pytest.approx((math.sqrt(sum(a * b) / 9), math.atanh(r) * math.sqrt(7)))
    few = FEWEST_STRETCHES - 1
    assert RepeatedErrors(b[:few], a[:few], opposite[:few]).mean_bend == (0.0, 0.0)
    assert RepeatedErrors(b[:few], a[:few], opposite[:few]).common_bend == (0.0, 0.0)
    assert RepeatedErrors(-b, a, opposite).common_bend == (0.0, 0.0)


def two_ways(back: bool, aside: float = 0.0, angle: float = 0.0, turns: float = 0.0) -> Floats:
    """Nodes along a corridor of 40 m, a detour, and the corridor again: aside, turned around its middle, or back."""
    out = np.arange(0.0, 40.0, STEP)
    first = np.column_stack([out, np.zeros(len(out)), np.zeros(len(out))])
    # turning on the way, by less than half a turn from one node to the next, and by a right angle at both ends
    yaw = np.linspace(0.0, angle + math.pi * back + 2 * math.pi * turns, 30) + math.pi / 2
    detour = np.column_stack([np.full(30, 20.0), 50.0 + STEP * np.arange(30), yaw])
    along = (out - 20.0)[::-1] if back else out - 20.0
    second = np.column_stack(
        [20.0 + along * math.cos(angle), aside + along * math.sin(angle), np.full(len(out), angle)]
    )
    second[:, 2] += math.pi * back + 2 * math.pi * turns
    return np.concatenate([first, detour, second])


@pytest.mark.parametrize('back', [False, True])
@pytest.mark.parametrize('turns', [0, -3])
def test_errors_are_those_of_their_stretches(back: bool, turns: int) -> None:
    """The sign of one from the other side is turned around, and no stretch is used twice."""
    nodes = two_ways(back, turns=turns)
    errors = 0.1 * np.sin(nodes[:, 0] / 5.0)
    found = repeated_errors(windows_with(nodes[:, 2] + errors), nodes)
    assert 40.0 / STRETCH - 2.0 <= len(found.later) <= 40.0 / STRETCH
    assert found.opposite.all() == back and found.opposite.any() == back
    # both in the direction of the first visit, but for the mean error, which has the direction of driving
    apart = found.later - found.earlier
    assert apart == pytest.approx(apart.mean(), abs=0.004)
    assert np.ptp(found.later) == pytest.approx(2 * 0.1 * 2 * math.sin(STRETCH / 10.0) / STRETCH, rel=0.15)
    wrapped_yaw = nodes.copy()
    wrapped_yaw[:, 2] = (nodes[:, 2] + 3.0) % (2 * math.pi)
    again = repeated_errors(windows_with((nodes[:, 2] + errors) % (2 * math.pi)), wrapped_yaw)
    assert again.later == pytest.approx(found.later, abs=1e-9)


@pytest.mark.parametrize(
    ('aside', 'degrees', 'paired'), [(0.8, 0.0, True), (1.2, 0.0, False), (0.0, 25.0, True), (0.0, 40.0, False)]
)
def test_stretches_of_one_pair_are_at_the_same_place(aside: float, degrees: float, paired: bool) -> None:
    nodes = two_ways(False, aside, math.radians(degrees))
    found = repeated_errors(windows_with(nodes[:, 2]), nodes)
    assert (len(found.later) > 0) == paired


def test_stretches_of_a_pair_are_at_most_a_metre_apart_and_used_once() -> None:
    nodes = two_ways(True)
    # the error of a metre is x in mrad, so that it tells places apart
    found = repeated_errors(windows_with(nodes[:, 2] + 1e-3 * nodes[:, 0] ** 2 / 2.0), nodes)
    earlier, later = 1e3 * found.earlier, 1e3 * found.later
    assert np.diff(np.sort(earlier)).min() > 0.9 * STRETCH, 'no two of them overlap'
    # stretches are cut at nodes, half a step ahead of their middle in the direction of driving
    assert np.abs(later - earlier).max() < SAME_PLACE + STEP


def test_stretches_are_whole() -> None:
    nodes, _ = out_and_back(12.0)
    travel = np.concatenate([[0.0], np.cumsum(np.hypot(*np.diff(nodes[:, :2], axis=0).T))])
    usable = _errors(windows_with(nodes[:, 2]), travel, np.zeros(len(nodes)))[1]
    assert usable.tolist() == [STRETCH / 2 <= at <= travel[-1] - STRETCH / 2 for at in travel.tolist()]


def test_constant_errors_of_metres_and_turns_do_not_count() -> None:
    nodes, x = out_and_back(36.0)
    nodes[:, 2] += 0.15 * np.sin(x / 2.0)
    travel = STEP * np.arange(len(x))
    found = repeated_errors(windows_with(1.2 * nodes[:, 2] + 0.03 * travel), nodes)
    assert len(found.later) >= FEWEST_STRETCHES
    assert found.later == pytest.approx(0.0, abs=1e-9) and found.earlier == pytest.approx(0.0, abs=1e-9)


def test_turns_and_single_visits_are_left_out() -> None:
    nodes, x = out_and_back(36.0)
    once = nodes[: len(nodes) // 2]
    assert not len(repeated_errors(windows_with(once[:, 2]), once).later)
    weaving = nodes.copy()
    weaving[:, 2] += math.radians(20.0) * np.sin(2 * math.pi * x / 4.0)
    assert not len(repeated_errors(windows_with(weaving[:, 2]), weaving).later)
    assert not are_walls_bent(windows_with(weaving[:, 2] + x), weaving)
    short = nodes[:5]
    assert not are_walls_bent(windows_with(short[:, 2] + x[:5]), short)


def test_small_bends_do_not_count() -> None:
    """Walls that are not quite parallel repeat themselves exactly, too."""
    nodes, x = out_and_back(36.0)
    for factor, bent in ((0.9, False), (1.2, True)):
        assert are_walls_bent(windows_with(nodes[:, 2] + factor * LEAST_MEAN_BEND * x), nodes) == bent


RADIUS, LENGTH, HALF = 70.0, 34.0, 1.1
"""Metres: the radius of a corridor that bends to the left, its length, and half of its width."""


def in_corridor(along: float, aside: float) -> Floats:
    """The place at this distance along the middle line, and to the left of it."""
    angle = along / RADIUS
    return 3.0 + np.array([(RADIUS - aside) * math.sin(angle), RADIUS - (RADIUS - aside) * math.cos(angle)])


def bent_corridor() -> tuple[World, Floats]:
    """The corridor with niches and cupboards, and the corners of a path there and back."""
    plan, pieces = Floorplan('bent', 420, 240), 12

    def line(*places: Floats) -> None:
        cells = [tuple(np.floor(10 * place).astype(int).tolist()) for place in places]
        for start, end in itertools.pairwise(cells):
            plan.line(start, end)

    for side in (-HALF, HALF):
        for k in range(pieces):
            begin, end = LENGTH * k / pieces, LENGTH * (k + 1) / pieces
            inner = side + math.copysign(0.3 if (k + (side > 0)) % 3 else -0.3, side)
            curve = [(along, side) for along in np.arange(begin, end - 1.0, 0.4)]
            corners = [(end - 1.0, side), (end - 1.0, inner), (end, inner), (end, side)]
            line(*(in_corridor(*place) for place in curve + corners))
    for end in (0.0, LENGTH):
        line(in_corridor(end, -HALF - 0.4), in_corridor(end, HALF + 0.4))
    out = [in_corridor(along, 0.0) for along in np.arange(1.5, LENGTH - 1.4, 2.0)]
    return plan.world(tuple(np.floor(10 * out[0]).astype(int).tolist())), np.array([*out, *out[-2::-1]])


@pytest.mark.slow
def test_bent_corridor_is_not_straightened(monkeypatch: pytest.MonkeyPatch) -> None:
    exact = drive(*bent_corridor(), 0.12, sonar_ring(16), NOISY, seed=4)
    recording = with_drift(exact, LEVELS['low'], 2)
    true, odometry = odometry_of(exact).pose, odometry_of(recording)
    before = rms_after_alignment(odometry.pose, true)
    found = Refiner(Parameters()).run(recording.readings, odometry)
    assert found.accepted and not found.right_angles
    assert rms_after_alignment(found.trajectory.pose, true) < 0.7 * before
    monkeypatch.setattr(right_angles, 'are_walls_bent', lambda *rest: False)
    windows = cut(recording.readings, odometry)
    scans = Scans(windows, Parameters(), NEVER.copy(), held_out(len(windows)))
    of_drive = Drive(recording.readings, odometry, windows, scans)
    straight = at_right_angles(of_drive, 0.0, ACCURACY, lambda stage: lambda part: None).refinement
    assert straight.accepted
    assert rms_after_alignment(straight.trajectory.pose, true) > before, 'otherwise this drive shows nothing'
