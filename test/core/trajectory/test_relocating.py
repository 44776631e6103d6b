"""Parts of a drive in a wrong place, and places where a right angle may have been lost."""

from __future__ import annotations

import math
from dataclasses import replace
from types import SimpleNamespace

import numpy as np
import pytest
from exact_tour import Tour, quietly, tour_with

from forward_grid_mapper.core.common.readings import Floats
from forward_grid_mapper.core.trajectory import hypotheses, relocating, solving
from forward_grid_mapper.core.trajectory.doubts import DOUBTFUL, doubts, slight
from forward_grid_mapper.core.trajectory.heading import Heading
from forward_grid_mapper.core.trajectory.holding_out import LEAST_SIGMAS, Gain
from forward_grid_mapper.core.trajectory.hypotheses import MOST_DOUBTFUL, solve_hypotheses
from forward_grid_mapper.core.trajectory.judging import gain_at_revisits, gain_within_visits
from forward_grid_mapper.core.trajectory.loops import APART, LENGTH, Loop
from forward_grid_mapper.core.trajectory.matching import Match
from forward_grid_mapper.core.trajectory.passes import Matches, match_preceding
from forward_grid_mapper.core.trajectory.pose_graph import solution_at
from forward_grid_mapper.core.trajectory.poses import compose, relative
from forward_grid_mapper.core.trajectory.relocating import (
    CONFIRMING,
    FEW,
    LEAST_RECOGNISED,
    RUN,
    confirmed,
    confirmed_by_places,
    displaced,
    fits_earlier_visits,
    recognised,
    revisits,
    unsupported,
    windows_of,
)
from forward_grid_mapper.core.trajectory.solving import Solver
from forward_grid_mapper.simulation.sonar import sonar_ring
from forward_grid_mapper.simulation.world import building_tour

OFF = np.array([3.2, -1.4, math.radians(3.0)])
"""Error of the way back."""


@pytest.fixture(scope='module')
def there_and_back() -> Tour:
    """Return a drive through some rooms and back."""
    path = building_tour()[:12]
    return tour_with(sonar_ring(16), np.concatenate([path, path[-2::-1]]))


def turning(tour: Tour) -> int:
    """Return the node where the robot turns back."""
    return len(tour.windows) // 2


def astray(tour: Tour) -> Floats:
    """Return the nodes with the wrong way back."""
    nodes, first = tour.windows.node.copy(), turning(tour)
    nodes[first:] = compose(compose(nodes[first], OFF), relative(nodes[first], nodes[first:]))
    return nodes


def found_at(tour: Tour, blocks: list[int], place: int) -> list[Loop]:
    """Return loops of these blocks, by number, with a place."""
    return [Loop(block * LENGTH + LENGTH // 2, place, Matches()) for block in blocks]


def test_long_part_is_found_farther_away_than_single_blocks(there_and_back) -> None:
    scans, true = there_and_back.scans, there_and_back.windows.node
    blocks = revisits(scans, true)
    stretch = windows_of(blocks[blocks * LENGTH > turning(there_and_back)][:RUN], len(true))
    moved = displaced(scans, astray(there_and_back), stretch)
    assert moved is not None
    assert np.hypot(*(moved - true)[stretch, :2].T).max() < 0.35
    rest = np.setdiff1d(np.arange(len(true)), stretch)
    np.testing.assert_array_equal(moved[rest], astray(there_and_back)[rest])
    assert displaced(scans, true, stretch) is None


def torn(tour: Tour) -> Floats:
    """Return the nodes with the way back far from the way there."""
    return tour.windows.node + (np.arange(len(tour.windows)) >= turning(tour))[:, None] * (60.0, 0.0, 0.0)


def test_trajectory_is_confirmed_by_the_places_to_which_it_comes_back(there_and_back) -> None:
    scans, true = there_and_back.scans, there_and_back.windows.node
    blocks = revisits(scans, true).tolist()
    nowhere_again = np.arange(len(true))[:, None] * (5.0, 0.0, 0.0)
    assert len(blocks) > 5 and not len(revisits(scans, nowhere_again))
    most = math.ceil(LEAST_RECOGNISED * len(blocks))
    assert confirmed_by_places(scans, true, found_at(there_and_back, blocks[:most], 0))
    assert not confirmed_by_places(scans, true, found_at(there_and_back, blocks[: most - 1], 0))
    # by odometry, it comes back to many places
    assert not confirmed_by_places(scans, nowhere_again, [])
    assert not confirmed_by_places(scans, nowhere_again, found_at(there_and_back, blocks[:1], 0))


def test_trajectory_of_a_drive_without_revisits_needs_no_places() -> None:
    tour = tour_with(sonar_ring(16), building_tour()[:4])
    assert not len(revisits(tour.scans, tour.windows.node))
    assert confirmed_by_places(tour.scans, tour.windows.node, [])
    assert fits_earlier_visits(tour.scans, tour.windows.node, [])


def scored(loops: list[Loop], nats: float) -> list[Loop]:
    """Return the loops with this mean score of a reading."""
    for loop in loops:
        loop.matches.score, loop.matches.readings = 10.0 * nats, 10
    return loops


def test_blocks_that_are_not_recognised_may_fit_where_they_lie(there_and_back, monkeypatch) -> None:
    scans, true = there_and_back.scans, there_and_back.windows.node
    blocks = revisits(scans, true).tolist()
    some = scored(found_at(there_and_back, blocks[: math.ceil(0.6 * len(blocks))], 0), 0.8)
    assert not confirmed_by_places(scans, true, some)
    assert fits_earlier_visits(scans, true, some)
    # they do not fit as well as this, nor half a metre beside
    assert not fits_earlier_visits(scans, true, scored(some, 3.0))
    beside = true + (np.arange(len(true)) >= turning(there_and_back))[:, None] * (0.3, 0.5, 0.0)
    assert not fits_earlier_visits(scans, beside, scored(some, 0.8))
    few = scored(found_at(there_and_back, blocks[: int(0.4 * len(blocks))], 0), 0.8)
    assert not fits_earlier_visits(scans, true, few)
    assert not fits_earlier_visits(scans, true, [])
    # if nearly all are recognised, the others are not examined
    monkeypatch.setattr(relocating, '_fits', None)
    most = scored(found_at(there_and_back, blocks[: math.ceil(LEAST_RECOGNISED * len(blocks))], 0), 3.0)
    assert fits_earlier_visits(scans, true, most)


def test_torn_trajectory_is_better_on_maps_of_all_visits_only(there_and_back) -> None:
    scans, true = there_and_back.scans, there_and_back.windows.node
    # the two visits contradict each other a little, but the torn trajectory is much worse
    drifting = true + (np.arange(len(true)) >= turning(there_and_back))[:, None] * (0.0, 0.6, 0.0)
    assert gain_at_revisits(scans, drifting, torn(there_and_back)).sigmas > LEAST_SIGMAS
    within = gain_within_visits(scans, drifting, torn(there_and_back))
    assert np.isfinite(within.error) and abs(within.sigmas) < LEAST_SIGMAS


@pytest.mark.slow
def test_misplaced_part_is_moved_to_its_place(there_and_back) -> None:
    true, first = there_and_back.windows.node, turning(there_and_back)
    solver = Solver(*there_and_back, quietly)
    found = match_preceding(there_and_back.scans, true, lambda part: None)
    wrong = solution_at(astray(there_and_back), 4)
    solution, loops = solver._with_stretches_relocated(found.edges(), [], wrong, found.mean_score)
    off = relative(solution.nodes[0], solution.nodes) - relative(true[0], true)
    assert np.hypot(off[:, 0], off[:, 1]).max() < 0.3
    assert all(loop.block >= first > loop.place for loop in loops)
    assert len(loops) > FEW


def test_other_place_is_rejected_unless_it_predicts_readings_better(there_and_back, monkeypatch) -> None:
    true, first = there_and_back.windows.node, turning(there_and_back)

    def aside(scans, nodes, stretch) -> Floats:
        out = nodes.copy()
        out[stretch] += (0.0, 1.5, 0.0)
        return out

    def loops_there(scans, nodes, stretch, usual) -> list[Loop]:
        out = []
        for block in stretch.reshape(-1, LENGTH):
            found = Matches()
            for k in block:
                found.add(0, int(k), Match(relative(nodes[0], nodes[k]), np.diag([1e4, 1e4, 1e3]), 50.0), 50)
            out.append(Loop(int(block[LENGTH // 2]), 0, found))
        return out

    monkeypatch.setattr(solving, 'displaced', aside)
    monkeypatch.setattr(solving, 'loops_at', loops_there)
    solver, start = Solver(*there_and_back, quietly), solution_at(true, 4)
    blocks = revisits(there_and_back.scans, true)
    blocks = blocks[blocks * LENGTH > first][:RUN]
    solution, loops = solver._relocated(blocks, Matches().edges(), [], start, 1.0)
    assert solution is start
    assert loops == []


def test_correctly_placed_drive_is_unchanged(there_and_back) -> None:
    solver, true = Solver(*there_and_back, quietly), there_and_back.windows.node
    start = solution_at(true, 4)
    solution, loops = solver._with_stretches_relocated(Matches().edges(), [], start, 1.0)
    assert solution is start
    assert loops == []


def test_only_parts_with_few_recognised_blocks_are_searched() -> None:
    blocks = np.arange(10, 30)
    assert unsupported(blocks, set(range(10, 30)), 0) is None
    lost = set(range(10, 20)) | {24}
    stretch = unsupported(blocks, lost, 0)
    assert stretch is not None
    assert len(stretch) == RUN
    assert len(lost.intersection(stretch.tolist())) <= 1
    assert stretch[0] >= 19
    # blocks that are far apart form no part
    assert unsupported(np.arange(10, 100, 5), set(), 0) is None
    assert unsupported(blocks[: RUN - 1], set(), 0) is None
    assert unsupported(blocks, set(), int(blocks[-1])) is None


def test_place_is_confirmed_if_blocks_before_it_are_recognised(there_and_back) -> None:
    scans, nodes, middle = there_and_back.scans, there_and_back.windows.node, turning(there_and_back)
    after = [block for block in revisits(scans, nodes).tolist() if block * LENGTH > middle]
    assert len(after) >= 2 * CONFIRMING
    assert confirmed(scans, nodes, found_at(there_and_back, after, 4), middle)
    assert not confirmed(scans, nodes, found_at(there_and_back, after[: len(after) // 2], 4), middle)
    assert not confirmed(scans, nodes, found_at(there_and_back, after, middle), middle)
    assert not confirmed(scans, nodes, [], middle)
    assert recognised(found_at(there_and_back, after, 4)) == set(after)


def test_doubtful_place_is_in_the_middle_of_a_drop_of_certainty() -> None:
    at = np.arange(0, 60, 3)
    certain = np.ones(20)
    certain[6:] -= 0.1
    certain[7:] -= 0.2
    certain[8:] -= 0.1
    certain[17:] -= 0.05
    assert [(node, round(p, 6)) for node, p in doubts(at, certain)] == [(21, 0.4), (51, 0.05)]
    assert doubts(at, np.ones(20)) == ()
    assert slight(at, certain) == slight(at, np.ones(20)) == ()
    little = np.linspace(1.0, 1.0 - DOUBTFUL / 2, 20)
    assert doubts(at, little) == ()
    assert np.array(slight(at, little)) == pytest.approx(np.column_stack([at[1:], np.full(19, DOUBTFUL / 38)]))
    # the rest is slight doubts, and nothing is counted twice
    both = certain * little
    total = sum(p for _, p in (*doubts(at, both), *slight(at, both)))
    assert total == pytest.approx(1.0 - both[-1], abs=1e-9)


@pytest.mark.parametrize('lost', [0, pytest.param(1, marks=pytest.mark.slow)])
def test_lost_right_angle_is_corrected(there_and_back, lost) -> None:
    odometry, windows, scans, heading = there_and_back
    node, true = turning(there_and_back) - 6, windows.node

    def solver_of(other: Heading) -> Solver:
        return Solver(odometry, windows, scans, other, quietly)

    # slight doubts are resolved as well if places were recognised, but not at the end of the drive
    little = (node, 0.02), (len(windows) - 2, 0.03)
    # before the first metres nothing was seen, so a doubt there stays, and does not prevent the others
    open_doubts = (1, 0.03), (node, 0.4)
    doubtful = replace(heading.turned(node, lost * math.pi / 2), certainty=0.52, doubts=open_doubts, slight=little)
    solver = solver_of(doubtful)
    found = solve_hypotheses(scans, doubtful, solver, solver.along_walls(), solver_of)
    assert found.certainty == pytest.approx(0.94)
    off = relative(found.solution.nodes[0], found.solution.nodes) - relative(true[0], true)
    assert np.hypot(off[:, 0], off[:, 1]).max() < 0.3
    assert (found.solver is solver) == (lost == 0)


@pytest.mark.slow
def test_doubt_without_revisits_stays(there_and_back) -> None:
    odometry, windows, scans, heading = there_and_back
    solvers: list[Solver] = []

    def solver_of(other: Heading) -> Solver:
        solvers.append(Solver(odometry, windows, scans, other, quietly))
        return solvers[-1]

    last = len(windows) - 2
    doubtful = replace(heading, certainty=0.6, doubts=tuple((last - k, 0.1) for k in range(MOST_DOUBTFUL + 1)))
    first = solver_of(doubtful)
    found = solve_hypotheses(scans, doubtful, first, first.along_walls(), solver_of)
    assert found.certainty == pytest.approx(0.6)
    # more doubts would need too many solutions
    assert solvers == [first]


@pytest.mark.parametrize('recognises', [False, True])
@pytest.mark.parametrize('lost', [[], [30], [50], [30, 50], [20, 30, 50]])
def test_lost_right_angles_are_examined_one_after_the_other(there_and_back, monkeypatch, lost, recognises) -> None:
    """With solutions that are right up to the first lost right angle."""
    _, windows, scans, right = there_and_back
    examined_at = 20, 30, 50
    assert windows.node_progress[examined_at[0]] > APART
    solutions: list[Heading] = []

    def first_lost(heading: Heading) -> float:
        turns = np.round((heading.correction - right.correction) / (math.pi / 2))
        before = [int(np.searchsorted(right.at, node)) - 1 for node in examined_at]
        return min(
            (node for node, k in zip(examined_at, before, strict=True) if turns[k] != turns[k + 1]), default=99.0
        )

    def matched(scans, heading, solver, along) -> hypotheses.Solved:
        solutions.append(heading)
        solution = solution_at(np.full((1, 3), first_lost(heading)), 4)
        return hypotheses.Solved(heading, solver, solution, solution, [], heading.certainty)

    monkeypatch.setattr(hypotheses, '_solve_with', matched)
    monkeypatch.setattr(hypotheses, 'confirmed', lambda scans, nodes, loops, node: recognises and nodes[0, 0] > node)
    monkeypatch.setattr(hypotheses, 'predicted', lambda scans, nodes, blocks: nodes[0, :1])
    monkeypatch.setattr(hypotheses, 'gain', lambda before, after: Gain(float(after[0] - before[0]), 1.0))
    # one more doubt before the first metres, which is neither examined nor counted
    heading = replace(right, certainty=0.65, doubts=((1, 0.05), *((node, 0.1) for node in examined_at)))
    for node in lost:
        heading = heading.turned(node, math.pi / 2)
    solver = SimpleNamespace(along_walls=lambda: None)
    found = solve_hypotheses(scans, heading, solver, None, lambda other: solver)
    assert found.heading.correction == pytest.approx(right.correction)
    # if nothing is recognised, all are examined. Those that are better turned are resolved; of several that are not,
    # two may cancel.
    assert len(solutions) == 1 + 2 * (len(lost) if recognises else len(examined_at))
    # recognised places were counted by the matching
    known = [] if recognises else lost
    assert found.certainty == pytest.approx(0.65 + 0.1 * len(known))
    assert [node for node, _ in found.heading.doubts] == [1, *(node for node in examined_at if node not in known)]


def test_doubt_stays_if_no_solution_predicts_readings_better(there_and_back, monkeypatch) -> None:
    _, _, scans, right = there_and_back

    def matched(scans, heading, solver, along) -> hypotheses.Solved:
        solution = solution_at(np.zeros((1, 3)), 4)
        return hypotheses.Solved(heading, solver, solution, solution, [], heading.certainty)

    monkeypatch.setattr(hypotheses, '_solve_with', matched)
    monkeypatch.setattr(hypotheses, 'confirmed', lambda scans, nodes, loops, node: False)
    monkeypatch.setattr(hypotheses, 'predicted', lambda scans, nodes, blocks: np.zeros(9))
    heading, solver = replace(right, certainty=0.7, doubts=((30, 0.3),)), SimpleNamespace(along_walls=lambda: None)
    found = solve_hypotheses(scans, heading, solver, None, lambda other: solver)
    assert found.heading is heading and found.certainty == 0.7


@pytest.mark.parametrize('turned_at', [(30,), (30, 50)])
def test_unturned_solution_resolves_only_a_single_doubt(there_and_back, monkeypatch, turned_at) -> None:
    _, _, scans, right = there_and_back

    def matched(scans, heading, solver, along) -> hypotheses.Solved:
        off = float(np.abs(heading.correction - right.correction).max())
        solution = solution_at(np.full((1, 3), -off), 4)
        return hypotheses.Solved(heading, solver, solution, solution, [], heading.certainty)

    monkeypatch.setattr(hypotheses, '_solve_with', matched)
    monkeypatch.setattr(hypotheses, 'confirmed', lambda scans, nodes, loops, node: False)
    monkeypatch.setattr(hypotheses, 'predicted', lambda scans, nodes, blocks: nodes[0, :1])
    monkeypatch.setattr(hypotheses, 'gain', lambda before, after: Gain(float(after[0] - before[0]), 0.1))
    heading = replace(right, certainty=0.7, doubts=tuple((node, 0.1) for node in turned_at))
    solver = SimpleNamespace(along_walls=lambda: None)
    found = solve_hypotheses(scans, heading, solver, None, lambda other: solver)
    assert found.heading.correction == pytest.approx(right.correction)
    assert found.certainty == pytest.approx(0.8 if len(turned_at) == 1 else 0.7)


@pytest.mark.parametrize('sign', [1.0, -1.0])
def test_drive_and_its_mirror_image_are_turned_alike(there_and_back, monkeypatch, sign) -> None:
    """If both turns are better than none, and blocks are recognised with both, the better one is used."""
    _, _, scans, right = there_and_back

    def matched(scans, heading, solver, along) -> hypotheses.Solved:
        turned = sign * float((heading.correction - right.correction)[-1])
        solution = solution_at(np.full((1, 3), {0: 0.0, 1: 5.0, -1: 6.0}[round(2 * turned / math.pi)]), 4)
        return hypotheses.Solved(heading, solver, solution, solution, [], heading.certainty)

    monkeypatch.setattr(hypotheses, '_solve_with', matched)
    monkeypatch.setattr(hypotheses, 'confirmed', lambda scans, nodes, loops, node: nodes[0, 0] > 0.0)
    monkeypatch.setattr(hypotheses, 'predicted', lambda scans, nodes, blocks: nodes[0, :1])
    monkeypatch.setattr(hypotheses, 'gain', lambda before, after: Gain(float(after[0] - before[0]), 1.0))
    heading, solver = replace(right, certainty=0.7, doubts=((30, 0.3),)), SimpleNamespace(along_walls=lambda: None)
    found = solve_hypotheses(scans, heading, solver, None, lambda other: solver)
    assert found.solution.nodes[0, 0] == 6.0
