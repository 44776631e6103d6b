"""Matching alone: rounds of matching and loop closing, and the scale of the trajectory."""

from __future__ import annotations

import math
from collections.abc import Sequence

import numpy as np
import pytest
from pentagon_drive import quietly

from forward_grid_mapper.core.common.errors import InputError
from forward_grid_mapper.core.common.readings import Floats
from forward_grid_mapper.core.trajectory import any_angle, scan_matching
from forward_grid_mapper.core.trajectory import scans as scans_module
from forward_grid_mapper.core.trajectory.holding_out import held_out
from forward_grid_mapper.core.trajectory.loops import Loop
from forward_grid_mapper.core.trajectory.matching import Match
from forward_grid_mapper.core.trajectory.odometry_model import CALIBRATION
from forward_grid_mapper.core.trajectory.passes import Matches, Progress
from forward_grid_mapper.core.trajectory.pose_graph import Solution, solution_at
from forward_grid_mapper.core.trajectory.poses import compose, relative
from forward_grid_mapper.core.trajectory.scan_matching import TRUSTS, Trust
from forward_grid_mapper.core.trajectory.scans import Scans


class Trials:
    """A solver that moves the second half of a drive by a metre in each round, and records its arguments.

    Parameters
    ----------
    values : list of float, float
        The part of the blocks that are recognised in each round, and its J.
    far : float or list of float
        Metres by which each round moves the nodes.
    others : tuple of int
        Further folds that are tried.
    of_odometry : float, float
        The part of the blocks that are recognised from odometry as the start, and J; the nodes stay there.
    """

    def __init__(
        self,
        monkeypatch,
        values: list[tuple[float, float]],
        far: float | list[float] = 1.0,
        others: tuple[int, ...] = (),
        of_odometry: tuple[float, float] = (0.0, -math.inf),
    ) -> None:
        monkeypatch.setattr(any_angle, 'OTHERS', others)
        monkeypatch.setattr(any_angle, 'at_likeliest_scale', lambda scans, nodes, watch: (nodes, 1.0))
        # otherwise all starts would agree
        monkeypatch.setattr(any_angle, 'AGREED', 0.0)
        self.calls: list[tuple[Floats, float]] = []
        self._far = far
        self.loops: list[Loop] = []
        self.found_before: list[Sequence[Loop]] = []
        monkeypatch.setattr(any_angle, 'MatchSolver', self._solver)
        monkeypatch.setattr(any_angle, 'scan_matched', lambda scans, trust, watch: scans.windows.node)
        monkeypatch.setattr(any_angle, 'recognised_part', lambda *rest: self._now()[0])
        monkeypatch.setattr(Scans, 'objective', lambda *rest: self._now()[1] if self.calls else 0.0)
        monkeypatch.setattr(any_angle, 'log_likelihood_of_yaw', lambda *rest: 0.0)
        self._values, self._of_odometry = values, of_odometry
        self.is_from_odometry = False
        self.times_from_odometry = 0

    def _now(self) -> tuple[float, float]:
        return self._of_odometry if self.is_from_odometry else self._values[len(self.calls) - 1]

    def _solver(self, windows, scans, say, motion: Floats, noise: float, change) -> Trials:
        self.is_from_odometry = noise == any_angle.SMALL_YAW_NOISE
        if self.is_from_odometry:
            self.times_from_odometry += 1
            return self
        self.calls.append((motion, noise))
        self.change = change
        return self

    def with_matches(self, solution: Solution, found_before: Sequence[Loop] = ()) -> tuple[Solution, list[Loop]]:
        if self.is_from_odometry:
            return solution, []
        self.found_before.append(found_before)
        nodes = solution.nodes.copy()
        np.testing.assert_array_equal(self.calls[-1][0], relative(nodes[:-1], nodes[1:]))
        far = self._far
        nodes[len(nodes) // 2 :, 0] += far[len(self.calls) - 1] if isinstance(far, list) else far
        return solution_at(nodes, 4), self.loops


def test_map_of_the_whole_drive_is_made_once_for_the_same_nodes(scans, monkeypatch) -> None:
    nodes = scans.windows.node + np.array([0.5, 0.0, 0.0])
    value, windows = scans.explained(nodes)
    assert len(windows) == len(nodes)

    def again(*rest) -> None:
        raise AssertionError

    monkeypatch.setattr(scans_module, 'explained', again)
    assert scans.explained(nodes.copy())[1] is windows
    assert scans.objective(nodes.copy()) == value
    with pytest.raises(AssertionError):
        scans.explained(nodes + 0.1)


@pytest.mark.parametrize(
    ('values', 'rounds'),
    [
        ([(0.96, 1.0)], 1),
        ([(0.5, 1.0), (0.96, 2.0)], 2),
        # it may begin below that of odometry
        ([(0.5, -1.0), (0.96, 2.0)], 2),
        # if J does not grow in a round, another trust is tried
        ([(0.5, 1.0), (0.5, 0.5), (0.96, 3.0)], 1),
        ([(0.5, 1.0), (0.5, 2.0), (0.96, 1.5), (0.96, 1.0)], 2),
        ([(0.5, 1.0), (0.5, 1.0), (0.96, 0.5)], 1),
        ([(0.5, 1.0 + k) for k in range(2 * any_angle.ROUNDS)], any_angle.ROUNDS),
    ],
)
def test_rounds_continue_while_few_places_are_recognised_and_j_grows(
    bent, scans, monkeypatch, values: list[tuple[float, float]], rounds: int
) -> None:
    trials = Trials(monkeypatch, values)
    found = any_angle.match_drive(bent[1], scans, lambda stage: quietly)
    assert found is not None
    assert len(trials.calls) == len(values)
    assert found.value == max(value for _, value in values)
    assert found.nodes[-1, 0] - scans.windows.node[-1, 0] == pytest.approx(rounds)


def test_round_whose_map_would_be_too_large_is_the_last(bent, scans, monkeypatch) -> None:
    trials, objective = Trials(monkeypatch, [(0.5, 1.0), (0.96, 2.0), (0.96, 0.5)]), Scans.objective

    def limited(s: Scans, nodes: Floats) -> float:
        if len(trials.calls) == 2:
            raise InputError('the map would be too large')
        return objective(s, nodes)

    monkeypatch.setattr(Scans, 'objective', limited)
    found = any_angle.match_drive(bent[1], scans, lambda stage: quietly)
    assert found is not None
    # the other start is tried
    assert (len(trials.calls), found.value) == (3, 1.0)


@pytest.mark.parametrize(
    'values', [[(0.96, -1.0)], [(0.5, -2.0), (0.5, -3.0)], [(0.5, -2.0), (0.5, -1.0), (0.5, -2.0)]]
)
def test_without_gain_over_odometry_no_other_scan_matching_is_tried(
    bent, scans, monkeypatch, values: list[tuple[float, float]]
) -> None:
    trials = Trials(monkeypatch, values)
    assert any_angle.match_drive(bent[1], scans, lambda stage: quietly) is None
    assert len(trials.calls) == len(values)


def test_round_that_moves_nothing_is_the_last(bent, scans, monkeypatch) -> None:
    trials = Trials(monkeypatch, [(0.5, 1.0), (0.5, 2.0)], far=0.01)
    assert any_angle.match_drive(bent[1], scans, lambda stage: quietly) is not None
    assert len(trials.calls) == len(TRUSTS)


def test_given_noise_of_odometry_is_used(bent, scans, monkeypatch) -> None:
    trusts: list[scan_matching.Trust] = []
    trials = Trials(monkeypatch, [(0.5, 1.0 + k) for k in range(5)], far=0.0)
    monkeypatch.setattr(any_angle, 'scan_matched', lambda scans, trust, _: trusts.append(trust) or scans.windows.node)
    for noise in (0.0, 0.01):
        any_angle.match_drive(bent[1], scans, lambda stage: quietly, noise)
    assert trusts == [*TRUSTS, *(trust._replace(yaw=0.01) for trust in TRUSTS)]
    assert [noise for _, noise in trials.calls] == [any_angle.REMAINING_YAW_NOISE] * 2 + [0.01] * 3


def test_rounds_end_early_below_the_j_of_a_known_trajectory(bent, scans, monkeypatch) -> None:
    trials, objective = Trials(monkeypatch, [(0.5, 1.0), (0.5, 2.0)]), Scans.objective
    known = scans.windows.node + 1.0
    monkeypatch.setattr(Scans, 'objective', lambda s, nodes: 3.0 if nodes is known else objective(s, nodes))
    assert any_angle.match_drive(bent[1], scans, lambda stage: quietly, 0.0, known) is None
    assert len(trials.calls) == 1


@pytest.mark.parametrize(
    ('values', 'begins', 'value'),
    [
        # also if most places are recognised from the first
        ([(0.96, 1.0), (0.96, 0.5)], [0.0, 5.0], 1.0),
        ([(0.96, 1.0), (0.96, 2.0)], [0.0, 5.0], 2.0),
        ([(0.5, 1.0), (0.5, 0.5), (0.96, 3.0)], [0.0, 1.0, 5.0], 3.0),
        ([(0.5, 1.0), (0.5, 0.5), (0.5, 0.5), (0.5, 0.2), (0.96, 3.0)], [0.0, 1.0, 5.0, 6.0, 0.0], 3.0),
        # J may grow beyond that of the first start in a later round
        ([(0.5, 2.0), (0.5, 0.5), (0.5, 1.0), (0.96, 3.0)], [0.0, 1.0, 5.0, 6.0], 3.0),
        ([(0.5, 2.0), (0.5, 0.5), (0.5, 1.0), (0.96, 1.5), (0.96, 1.5)], [0.0, 1.0, 5.0, 6.0, 0.0], 2.0),
        # also if J of the first is no larger than that of odometry
        ([(0.96, -1.0), (0.96, 1.0)], [0.0, 5.0], 1.0),
        ([(0.96, -1.0), (0.96, -1.0)], [0.0, 5.0], None),
    ],
)
def test_given_nodes_are_another_start(
    bent, scans, monkeypatch, values: list[tuple[float, float]], begins: list[float], value: float | None
) -> None:
    trials, solve, seen = Trials(monkeypatch, values), Trials.with_matches, list[float]()
    start = scans.windows.node + np.array([5.0, 0.0, 0.0])

    def with_matches(trial: Trials, solution: Solution, found_before: Sequence[Loop]) -> tuple[Solution, list[Loop]]:
        if not trial.is_from_odometry:
            seen.append(solution.nodes[-1, 0] - scans.windows.node[-1, 0])
        return solve(trial, solution, found_before)

    monkeypatch.setattr(Trials, 'with_matches', with_matches)
    found = any_angle.match_drive(bent[1], scans, lambda stage: quietly, start=start)
    assert (found and found.value) == value
    assert seen == pytest.approx(begins)
    assert len(trials.calls) == len(values)


@pytest.mark.parametrize(
    ('values', 'folds', 'value', 'fold'),
    [
        # the last of the first fold, then one or two others
        ([(0.5, 2.0), (0.5, 1.0), (0.96, 1.0), (0.96, 3.0)], 1, 3.0, 0),
        ([(0.5, 2.0), (0.5, 1.0), (0.96, 1.0), (0.96, 1.5), (0.96, 3.0)], 2, 3.0, 2),
        ([(0.5, 2.0), (0.5, 1.0), (0.96, 1.0), (0.96, 1.5), (0.96, 1.9)], 2, 2.0, None),
        ([(0.96, 2.0)], 0, 2.0, None),
        ([(0.96, -1.0)], 0, None, None),
    ],
)
def test_search_that_got_lost_is_repeated_with_other_windows_held_out(
    bent, scans, monkeypatch, values: list[tuple[float, float]], folds: int, value: float | None, fold: int | None
) -> None:
    trials, held = Trials(monkeypatch, values, others=(0, 2)), list[Scans]()

    def scan_matched(s: Scans, trust: Trust, watch) -> Floats:
        held.append(s)
        return s.windows.node

    monkeypatch.setattr(any_angle, 'scan_matched', scan_matched)
    found = any_angle.match_drive(bent[1], scans, lambda stage: quietly)
    assert len(trials.calls) == len(values)
    assert (found and found.value) == value
    others = [each for each in held if each is not scans]
    assert len(others) == folds
    if found is not None:
        # it must be judged by the windows that were held out when it was made
        assert found.scans is (scans if fold is None else others[(0, 2).index(fold)])
        np.testing.assert_array_equal(
            found.scans.held_out, held_out(len(scans.windows), *([] if fold is None else [fold]))
        )


@pytest.mark.parametrize(
    ('values', 'moves', 'value'),
    [
        # the second start leads to the same trajectory, with a smaller J, and with a larger one
        ([(0.5, 2.0), (0.5, 1.0), (0.9, 1.5)], [1.0, 0.0, 1.1], 2.0),
        ([(0.9, 2.0), (0.9, 3.0)], [1.0, 1.1], 3.0),
        # only that of the second other fold does
        ([(0.9, 2.0), (0.9, 1.5), (0.9, 1.0), (0.9, 1.0)], [1.0, 9.0, 5.0, 1.1], 2.0),
        ([(0.9, 2.0), (0.9, 1.5), (0.9, 3.0), (0.9, 1.0)], [1.0, 9.0, 5.0, 5.1], 3.0),
    ],
)
def test_search_ends_if_two_starts_agree(
    bent, scans, monkeypatch, values: list[tuple[float, float]], moves: list[float], value: float
) -> None:
    trials = Trials(monkeypatch, values, moves, others=(0, 2, 4))
    monkeypatch.setattr(any_angle, 'AGREED', 0.15)
    found = any_angle.match_drive(bent[1], scans, lambda stage: quietly)
    assert found is not None
    assert (found.agreed, found.value, len(trials.calls)) == (True, value, len(values))


def test_trajectories_agree_if_only_their_sizes_differ(scans) -> None:
    nodes = scans.windows.node
    assert any_angle._agree(nodes, compose(np.array([9.0, -3.0, 1.0]), nodes * [1.07, 1.07, 1.0]))
    bent = nodes.copy()
    bent[len(nodes) // 2 :, 0] += 1.0
    assert not any_angle._agree(nodes, bent)


class Scales:
    """Makes drives larger by a factor, and records what it gets."""

    def __init__(self, monkeypatch, factor: float) -> None:
        self.factor, self.seen = factor, list[Floats]()
        monkeypatch.setattr(any_angle, 'at_likeliest_scale', self._scaled)

    def _scaled(self, scans: Scans, nodes: Floats, watch: Progress) -> tuple[Floats, float]:
        self.seen.append(nodes)
        return nodes * [self.factor, self.factor, 1.0], self.factor


@pytest.mark.parametrize(('values', 'value'), [([1.0, 2.0], 2.0), ([1.0, 0.9], 1.0)])
def test_next_round_holds_the_scale_that_was_found(bent, scans, monkeypatch, values: list[float], value: float) -> None:
    trials, scales = Trials(monkeypatch, [(0.96, each) for each in values], far=0.0), Scales(monkeypatch, 1.05)
    found = any_angle.match_drive(bent[1], scans, lambda stage: quietly)
    assert found is not None
    # nothing is matched again unless J grows, and the scale is not examined again
    assert (found.value, len(trials.calls), len(scales.seen)) == (value, 2, 1)
    assert found.nodes == pytest.approx(scans.windows.node * [1.05, 1.05, 1.0])
    assert not trials.change[:, :, CALIBRATION.index('scale')].any()
    assert trials.change[:, :, CALIBRATION.index('bias')].any()


def test_drive_at_the_right_scale_is_not_matched_again(bent, scans, monkeypatch) -> None:
    trials = Trials(monkeypatch, [(0.96, 1.0)], far=0.0)
    Scales(monkeypatch, 1.0)
    found = any_angle.match_drive(bent[1], scans, lambda stage: quietly)
    assert found is not None
    assert (found.value, len(trials.calls)) == (1.0, 1)


def test_only_the_best_drive_is_scaled(bent, scans, monkeypatch) -> None:
    Trials(monkeypatch, [(0.5, 2.0), (0.5, 1.5), (0.96, 1.0), (0.96, 2.5)], [1.0, 0.0, 5.0, 0.0])
    scales = Scales(monkeypatch, 1.05)
    found = any_angle.match_drive(bent[1], scans, lambda stage: quietly)
    assert found is not None
    assert [nodes[-1, 0] - scans.windows.node[-1, 0] for nodes in scales.seen] == pytest.approx([1.0])
    assert found.value == 2.5


def test_first_round_at_another_scale_searches_near_the_loop_closures_before(bent, scans, monkeypatch) -> None:
    trials, matches = Trials(monkeypatch, [(0.96, 1.0), (0.5, 2.0), (0.96, 3.0)]), Matches()
    matches.add(3, 40, Match(np.array([0.5, -0.2, 0.1]), np.eye(3), 30.0), 20)
    trials.loops = [Loop(40, 3, matches)]
    Scales(monkeypatch, 1.07)
    assert any_angle.match_drive(bent[1], scans, lambda stage: quietly) is not None
    assert [len(loops) for loops in trials.found_before] == [0, 1, 0]
    # places lie in the frames of nodes, so they move apart as the drive does
    now = trials.found_before[1][0].matches
    assert now.edges().pose[0] == pytest.approx([0.535, -0.214, 0.1])
    assert now.mean_score == matches.mean_score
    assert matches.edges().pose[0] == pytest.approx([0.5, -0.2, 0.1])


@pytest.mark.parametrize(
    ('first', 'of_odometry', 'is_taken', 'times'),
    [
        # if nearly all places are recognised from scan matching, odometry is no start
        ((0.96, 1.0), (0.96, 2.0), False, 0),
        ((0.5, 1.0), (0.96, 2.0), True, 1),
        # with a smaller J, and with one that is not larger than that of odometry as it is
        ((0.9, 3.0), (0.96, 2.0), False, 1),
        ((0.9, 3.0), (0.96, -1.0), False, 1),
    ],
)
def test_odometry_is_a_start_of_its_own(
    bent, scans, monkeypatch, first, of_odometry, is_taken: bool, times: int
) -> None:
    trials = Trials(monkeypatch, [first, (0.5, 0.5), (0.96, 0.0)], of_odometry=of_odometry)
    found = any_angle.match_drive(bent[1], scans, lambda stage: quietly)
    assert found is not None
    assert np.array_equal(found.nodes, scans.windows.node) == is_taken
    assert found.value == (of_odometry if is_taken else first)[1]
    assert trials.times_from_odometry == times


def test_odometry_is_no_start_if_a_trajectory_shows_that_it_is_wrong(bent, scans, monkeypatch) -> None:
    trials = Trials(monkeypatch, [(0.5, 1.0), (0.5, 0.5), (0.96, 0.5)], of_odometry=(0.96, 2.0))
    known = scans.windows.node + 1.0
    assert any_angle.match_drive(bent[1], scans, lambda stage: quietly, 0.0, known) is not None
    assert trials.times_from_odometry == 0


@pytest.mark.parametrize(('likelihood', 'is_taken'), [(0.5, False), (1.5, True)])
def test_odometry_is_likelier_along_a_trajectory_near_it(
    bent, scans, monkeypatch, likelihood: float, is_taken: bool
) -> None:
    Trials(monkeypatch, [(0.9, 2.0), (0.96, 0.0)], of_odometry=(0.96, 1.0))

    def of_yaw(windows, nodes: Floats) -> float:
        return likelihood if np.array_equal(nodes, windows.node) else 0.0

    monkeypatch.setattr(any_angle, 'log_likelihood_of_yaw', of_yaw)
    found = any_angle.match_drive(bent[1], scans, lambda stage: quietly)
    assert found is not None
    assert np.array_equal(found.nodes, scans.windows.node) == is_taken


@pytest.mark.parametrize(('likelihood', 'times'), [(0.5, 1), (1.5, 2)])
def test_search_from_odometry_ends_if_it_cannot_become_the_best(
    bent, scans, monkeypatch, likelihood: float, times: int
) -> None:
    trials = Trials(monkeypatch, [(0.9, 3.0), (0.96, 0.0)], of_odometry=(0.5, 2.0))
    # otherwise a round that moves nothing is the last
    monkeypatch.setattr(any_angle, 'SETTLED', -1.0)

    def of_yaw(windows, nodes: Floats) -> float:
        return likelihood if np.array_equal(nodes, windows.node) else 0.0

    monkeypatch.setattr(any_angle, 'log_likelihood_of_yaw', of_yaw)
    assert any_angle.match_drive(bent[1], scans, lambda stage: quietly) is not None
    assert trials.times_from_odometry == times


@pytest.mark.parametrize(('first', 'noise'), [(0.96, any_angle.REMAINING_YAW_NOISE), (0.5, any_angle.SMALL_YAW_NOISE)])
def test_after_scaling_odometry_is_trusted_as_it_was_before(
    bent, scans, monkeypatch, first: float, noise: float
) -> None:
    trials = Trials(monkeypatch, [(first, 1.0)] * 2, far=0.0, of_odometry=(0.96, 2.0))
    Scales(monkeypatch, 1.05)
    asked, solver = list[float](), trials._solver

    def solve(windows, scans, say, motion: Floats, noise: float, change) -> Trials:
        asked.append(noise)
        return solver(windows, scans, say, motion, noise, change)

    monkeypatch.setattr(any_angle, 'MatchSolver', solve)
    assert any_angle.match_drive(bent[1], scans, lambda stage: quietly) is not None
    assert asked[-1] == noise
