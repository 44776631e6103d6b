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
from forward_grid_mapper.core.trajectory.any_angle import MatchedDrive
from forward_grid_mapper.core.trajectory.holding_out import Gain, held_out
from forward_grid_mapper.core.trajectory.loops import Loop
from forward_grid_mapper.core.trajectory.matching import Match
from forward_grid_mapper.core.trajectory.odometry_model import CALIBRATION
from forward_grid_mapper.core.trajectory.passes import Matches, Progress
from forward_grid_mapper.core.trajectory.pose_graph import Solution, solution_at
from forward_grid_mapper.core.trajectory.poses import compose, relative
from forward_grid_mapper.core.trajectory.scan_matching import TRUSTS, Trust
from forward_grid_mapper.core.trajectory.scans import Scans
from forward_grid_mapper.simulation.drift import odometry_of


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
    """

    def __init__(
        self,
        monkeypatch,
        values: list[tuple[float, float]],
        far: float | list[float] = 1.0,
        others: tuple[int, ...] = (),
    ) -> None:
        monkeypatch.setattr(any_angle, 'OTHERS', others)
        # otherwise all starts would agree
        monkeypatch.setattr(any_angle, 'AGREED', 0.0)
        self.calls: list[tuple[Floats, float]] = []
        self._far = far
        self.loops: list[Loop] = []
        self.found_before: list[Sequence[Loop]] = []
        monkeypatch.setattr(any_angle, 'MatchSolver', self._solver)
        monkeypatch.setattr(any_angle, 'scan_matched', lambda scans, trust, watch: scans.windows.node)
        monkeypatch.setattr(Scans, 'objective', lambda *rest: values[len(self.calls) - 1][1] if self.calls else 0.0)
        monkeypatch.setattr(any_angle, 'recognised_part', lambda *rest: values[len(self.calls) - 1][0])

    def _solver(self, windows, scans, say, motion: Floats, noise: float, change) -> Trials:
        self.calls.append((motion, noise))
        self.change = change
        return self

    def with_matches(self, solution: Solution, found_before: Sequence[Loop] = ()) -> tuple[Solution, list[Loop]]:
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


def test_without_gain_over_odometry_no_more_rounds_are_tried(bent, scans, monkeypatch) -> None:
    trials = Trials(monkeypatch, [(0.5, -1.0)])
    assert any_angle.match_drive(bent[1], scans, lambda stage: quietly) is None
    assert len(trials.calls) == 1


def test_round_that_moves_nothing_is_the_last(bent, scans, monkeypatch) -> None:
    trials = Trials(monkeypatch, [(0.5, 1.0), (0.5, 2.0)], far=0.01)
    assert any_angle.match_drive(bent[1], scans, lambda stage: quietly) is not None
    assert len(trials.calls) == len(TRUSTS)


def test_given_noise_of_odometry_is_used(bent, scans, monkeypatch) -> None:
    trusts: list[scan_matching.Trust] = []
    trials = Trials(monkeypatch, [(0.5, 1.0 + k) for k in range(4)], far=0.0)
    monkeypatch.setattr(any_angle, 'scan_matched', lambda scans, trust, _: trusts.append(trust) or scans.windows.node)
    for noise in (0.0, 0.01):
        any_angle.match_drive(bent[1], scans, lambda stage: quietly, noise)
    assert trusts == [*TRUSTS, *(trust._replace(yaw=0.01) for trust in TRUSTS)]
    assert [noise for _, noise in trials.calls] == [any_angle.REMAINING_YAW_NOISE] * 2 + [0.01] * 2


def test_rounds_end_early_below_the_j_of_a_known_trajectory(bent, scans, monkeypatch) -> None:
    trials, objective = Trials(monkeypatch, [(0.5, 1.0), (0.5, 2.0)]), Scans.objective
    known = scans.windows.node + 1.0
    monkeypatch.setattr(Scans, 'objective', lambda s, nodes: 3.0 if nodes is known else objective(s, nodes))
    assert any_angle.match_drive(bent[1], scans, lambda stage: quietly, 0.0, known) is None
    assert len(trials.calls) == 1


@pytest.mark.parametrize(
    ('values', 'begins', 'value'),
    [
        # nothing more is tried if most places are recognised
        ([(0.96, 1.0)], [0.0], 1.0),
        ([(0.5, 1.0), (0.5, 0.5), (0.96, 3.0)], [0.0, 1.0, 5.0], 3.0),
        ([(0.5, 1.0), (0.5, 0.5), (0.5, 0.5), (0.5, 0.2), (0.96, 3.0)], [0.0, 1.0, 5.0, 6.0, 0.0], 3.0),
        # from given nodes, J may grow beyond that of the first start in a later round
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
        ([(0.5, 2.0), (0.5, 1.0), (0.5, 1.5)], [1.0, 0.0, 1.1], 2.0),
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


def scaled_from(scans: Scans, nodes: Floats, loops: Sequence[Loop] = ()) -> MatchedDrive:
    """Return the drive at the best scale, and the same object if this is the one that it has."""
    found = MatchedDrive(nodes, [*loops], scans.objective(nodes), 1.0, scans)
    moved = any_angle._scaled(found, lambda part: None)
    assert (moved is found) == (moved.nodes is nodes)
    return moved


@pytest.mark.parametrize('factor', [0.9, 1.1])
def test_wrong_scale_of_a_drive_is_found_by_its_objective(exact, scans, factor: float) -> None:
    true = odometry_of(exact).at(scans.windows.node_stamp)
    wrong = np.column_stack([factor * true[:, :2], true[:, 2]])
    moved = scaled_from(scans, wrong)
    found = moved.nodes
    assert moved.value == scans.objective(found)
    scale = np.hypot(*(found[-1, :2] - found[0, :2])) / np.hypot(*(true[-1, :2] - true[0, :2]))
    assert scale == pytest.approx(1.0, abs=0.02)
    assert np.array_equal(found[0], wrong[0])
    assert np.array_equal(found[:, 2], wrong[:, 2])


def test_right_scale_of_a_drive_is_kept(exact, scans) -> None:
    true = odometry_of(exact).at(scans.windows.node_stamp)
    assert scaled_from(scans, true).nodes is true


class Scaled:
    """A drive whose J is a parabola of the logarithm of its scale."""

    def __init__(self, monkeypatch, best: float, *sigmas: float) -> None:
        self.nodes = np.array([[1.0, 2.0, 0.3], [4.0, 6.0, 0.5]])
        self._best = best
        self.fitted: list[tuple[Floats, Floats]] = []
        monkeypatch.setattr(any_angle, 'gain_of_objective', lambda *rest: Gain(sigmas[0], 1.0))

        def gain_of_fitted(scans: Scans, before: Floats, after: Floats, watch: Progress) -> Gain:
            self.fitted.append((before, after))
            return Gain(sigmas[-1], 1.0)

        monkeypatch.setattr(any_angle, 'gain_of_fitted', gain_of_fitted)

    def objective(self, nodes: Floats) -> float:
        scale = np.hypot(*(nodes[1] - nodes[0])[:2]) / 5.0
        return -100.0 * (math.log(scale / self._best) / math.log(any_angle.SCALE_STEP)) ** 2

    def scale(self) -> float:
        found = scaled_from(self, self.nodes).nodes  # type: ignore[arg-type]
        return float(np.hypot(*(found[1] - found[0])[:2])) / 5.0


@pytest.mark.parametrize(
    ('best', 'sigmas', 'scale'),
    [
        (1.07, 3.0, 1.07),
        (0.91, 3.0, 0.91),
        (1.02, 3.0, 1.02),
        # a change of less than half a step, one that is not proven, and one that is too large
        (1.01, 3.0, 1.0),
        (1.07, 2.0, 1.0),
        (1.4, 3.0, 1.0),
    ],
)
def test_scale_is_the_top_of_the_objective_if_that_is_clear(
    monkeypatch, best: float, sigmas: float, scale: float
) -> None:
    assert Scaled(monkeypatch, best, sigmas).scale() == pytest.approx(scale)


@pytest.mark.parametrize(('sigmas', 'scale'), [((0.96, 3.0), 1.0), ((2.2, 2.2), 1.0), ((1.0, 2.3), 1.07)])
def test_both_are_fitted_if_the_scale_may_be_wrong(monkeypatch, sigmas: tuple[float, ...], scale: float) -> None:
    drive = Scaled(monkeypatch, 1.07, *sigmas)
    assert drive.scale() == pytest.approx(scale)
    assert len(drive.fitted) == (sigmas[0] >= any_angle.WORTH_FITTING)
    for pair in drive.fitted:
        sizes = [np.hypot(*(nodes[1] - nodes[0])[:2]) / 5.0 for nodes in pair]
        assert sizes == pytest.approx([1.0, 1.07])


def test_scale_is_kept_if_the_map_of_a_fitted_trajectory_would_be_too_large(monkeypatch) -> None:
    drive, asked = Scaled(monkeypatch, 1.07, 2.0), list[Floats]()

    def gain_of_fitted(scans: Scans, before: Floats, after: Floats, watch: Progress) -> Gain:
        asked.append(after)
        raise InputError('the map would be too large')

    monkeypatch.setattr(any_angle, 'gain_of_fitted', gain_of_fitted)
    assert drive.scale() == 1.0
    assert len(asked) == 1


def test_scale_whose_map_would_be_too_large_is_not_taken(exact, scans, monkeypatch) -> None:
    true = odometry_of(exact).at(scans.windows.node_stamp)
    wrong, objective = np.column_stack([0.9 * true[:, :2], true[:, 2]]), Scans.objective
    widest = np.ptp(wrong[:, 0]) * 1.05

    def limited(s: Scans, nodes: Floats) -> float:
        if np.ptp(nodes[:, 0]) > widest:
            raise InputError('the map would be too large')
        return objective(s, nodes)

    monkeypatch.setattr(Scans, 'objective', limited)
    found = scaled_from(scans, wrong).nodes
    assert np.ptp(found[:, 0]) == pytest.approx(np.ptp(wrong[:, 0]) * any_angle.SCALE_STEP)


def test_next_round_holds_the_scale_that_was_found(bent, scans, monkeypatch) -> None:
    trials = Trials(monkeypatch, [(0.96, 1.0), (0.96, 2.0)], far=0.0)
    larger = scans.windows.node * [1.05, 1.05, 1.0]

    def scaled(found: MatchedDrive, watch: Progress) -> MatchedDrive:
        return found._replace(nodes=larger) if len(trials.calls) == 1 else found

    monkeypatch.setattr(any_angle, '_scaled', scaled)
    found = any_angle.match_drive(bent[1], scans, lambda stage: quietly)
    assert found is not None
    assert len(trials.calls) == 2
    assert found.nodes == pytest.approx(larger)
    assert not trials.change[:, :, CALIBRATION.index('scale')].any()
    assert trials.change[:, :, CALIBRATION.index('bias')].any()


def test_first_round_at_another_scale_searches_near_the_loop_closures_before(bent, scans, monkeypatch) -> None:
    trials = Trials(monkeypatch, [(0.96, 1.0), (0.5, 2.0), (0.96, 3.0)])
    before, now, examined = Loop(40, 3, Matches()), Loop(40, 3, Matches()), list[MatchedDrive]()
    trials.loops = [before]

    def scaled(found: MatchedDrive, watch: Progress) -> MatchedDrive:
        examined.append(found)
        assert found.loops == [before]
        return found._replace(nodes=found.nodes * [1.05, 1.05, 1.0], loops=[now])

    monkeypatch.setattr(any_angle, '_scaled', scaled)
    found = any_angle.match_drive(bent[1], scans, lambda stage: quietly)
    assert found is not None
    assert [list(loops) for loops in trials.found_before] == [[], [now], []]
    # the scale is examined once more at the end, without another round
    assert len(examined) == 2
    assert found.nodes[1, :2] == pytest.approx(1.05**2 * scans.windows.node[1, :2])


def test_loop_closures_are_scaled_with_the_drive(monkeypatch) -> None:
    drive, matches = Scaled(monkeypatch, 1.07, 3.0), Matches()
    matches.add(3, 40, Match(np.array([0.5, -0.2, 0.1]), np.eye(3), 30.0), 20)
    found = scaled_from(drive, drive.nodes, [Loop(40, 3, matches)])  # type: ignore[arg-type]
    assert found.loops[0].matches.edges().pose[0] == pytest.approx([0.535, -0.214, 0.1])
    assert found.loops[0].matches.mean_score == matches.mean_score
    assert matches.edges().pose[0] == pytest.approx([0.5, -0.2, 0.1])
