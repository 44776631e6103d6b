"""Loop closures: where places are searched, and which are accepted."""

from __future__ import annotations

import math

import numpy as np
import pytest
from exact_tour import quietly, tour_with

from forward_grid_mapper.core.common.parameters import Parameters
from forward_grid_mapper.core.common.readings import Floats
from forward_grid_mapper.core.trajectory import loops
from forward_grid_mapper.core.trajectory.holding_out import held_out_blocks, predicted
from forward_grid_mapper.core.trajectory.local_map import for_matching
from forward_grid_mapper.core.trajectory.loops import AROUND, LENGTH, Loop, Places, find_loop, find_loops, loops_of
from forward_grid_mapper.core.trajectory.matching import Match
from forward_grid_mapper.core.trajectory.passes import Matches, match_preceding, match_surrounding
from forward_grid_mapper.core.trajectory.pose_graph import Edges, residuals
from forward_grid_mapper.core.trajectory.poses import compose, relative
from forward_grid_mapper.core.trajectory.scans import Scans
from forward_grid_mapper.core.trajectory.solving import Solver
from forward_grid_mapper.core.trajectory.windows import Odometry, cut
from forward_grid_mapper.simulation.drive import drive
from forward_grid_mapper.simulation.sonar import NOISY, sonar_ring
from forward_grid_mapper.simulation.world import Floorplan

BETWEEN = 22.0
"""Metres of progress between two visits to the same rooms."""

OFF = np.array([0.55, 0.3, 0.0])
SIGMA = 0.12
"""Errors of the nodes of the second visit, and the stated error: metres."""


@pytest.fixture(scope='module')
def solver() -> Solver:
    """Return the solver of a drive with exact odometry."""
    return Solver(*tour_with(sonar_ring(16)), quietly)


def wrong_by(found: list[Loop], true: Floats) -> Floats:
    """Return the error of each loop in metres."""
    return np.array([np.hypot(*np.median(residuals(true, loop.matches.edges())[:, :2], axis=0)) for loop in found])


def test_place_is_found_away_from_its_expected_pose(solver) -> None:
    scans, true = solver._scans, solver._windows.node
    second = solver._windows.node_progress > BETWEEN
    nodes = true + np.where(second[:, None], OFF, 0.0)
    samples = np.random.default_rng(0).standard_normal((40, 1, 3)) * (SIGMA, SIGMA, math.radians(1.0))
    samples = np.where(second[:, None], samples, 0.0)
    usual = match_preceding(scans, true, lambda part: None).mean_score
    found = loops_of(find_loops(scans, nodes, samples, usual, lambda part: None))
    across = [loop for loop in found if second[loop.block] != second[loop.place]]
    assert len(across) >= 3
    assert np.median(wrong_by(across, true)) < 0.15


def test_matches_and_loops_do_not_depend_on_the_number_of_threads(solver, monkeypatch) -> None:
    scans, nodes = solver._scans, solver._windows.node
    samples = np.random.default_rng(0).standard_normal((40, len(nodes), 3)) * (0.1, 0.1, 0.01)
    held = held_out_blocks(scans, 40)

    def found(threads: int) -> tuple[list[Edges], list[Loop], Floats]:
        monkeypatch.setattr(scans, 'threads', threads)
        scans.predictions.clear()
        matches = [match(scans, nodes, quietly) for match in (match_preceding, match_surrounding)]
        loops = loops_of(find_loops(scans, nodes, samples, matches[0].mean_score, quietly))
        edges = [each.edges() for each in (*matches, *(loop.matches for loop in loops))]
        return edges, loops, predicted(scans, nodes, held)

    (edges, one, alone), (others, three, together) = found(1), found(3)
    assert len(edges) > 5 and np.isfinite(alone).sum() > 5
    assert [(loop.block, loop.place) for loop in one] == [(loop.block, loop.place) for loop in three]
    for edge, other in zip(edges, others, strict=True):
        for column, same in zip(edge, other, strict=True):
            np.testing.assert_array_equal(column, same)
    np.testing.assert_array_equal(alone, together)


def loop(true: Floats, block: int, place: int, off: float, sigma: float = 0.02) -> Loop:
    """Return a loop that places a block beside its true place."""
    found = Matches()
    information = np.diag([sigma**-2, sigma**-2, math.radians(1.0) ** -2])
    for k in range(block - LENGTH // 2, block + LENGTH // 2):
        pose = relative(true[place], true[k]) + np.array([off, off, 0.0])
        found.add(place, k, Match(pose, information, 50.0), 50)
    return Loop(block, place, found)


def test_wrong_loop_is_dropped_and_right_ones_are_kept(solver) -> None:
    start = solver.along_walls()
    true, block = start.nodes, len(start.nodes) - 5
    right = [loop(true, block, place, 0.0) for place in (5, 9)]
    wrong = loop(true, block, 13, 0.7, 0.01)
    solution, kept = solver._with_loops(solver._walls(true, True), Matches().edges(), [*right, wrong], start)
    assert [each.place for each in kept] == [each.place for each in right]
    assert np.hypot(*(solution.nodes - true)[:, :2].T).max() < 0.1


def gallery(bays: list[int]) -> Scans:
    """Return a drive to and fro along a corridor with bays on both sides, 0.6 m wide, beginning at these columns."""
    plan = Floorplan('gallery', 210, 60)
    for wall, back in ((20, 12), (40, 48)):
        plan.wall('x', wall, (5, 200), tuple((bay, bay + 5) for bay in bays))
        for bay in bays:
            plan.wall('x', back, (bay - 1, bay + 6))
            for side in (bay - 1, bay + 6):
                plan.wall('y', side, (min(wall, back), max(wall, back)))
    for end in (5, 200):
        plan.wall('y', end, (20, 40))
    way = np.array([(2.0, 3.05), (18.0, 3.05), (2.0, 3.05)])
    recording = drive(plan.world((20, 30)), way, 0.1, sonar_ring(16), NOISY, seed=3)
    messages = recording.odometry
    odometry = Odometry.of(np.array([m.stamp for m in messages]), np.array([m.pose for m in messages], float))
    windows = cut(recording.readings, odometry)
    return Scans(windows, for_matching(Parameters()), np.zeros(1, np.uint8), np.zeros(len(windows), np.bool_))


def found_on_the_way_back(scans: Scans) -> list[Loop | None]:
    """Return the loops of blocks far from the ends of the corridor, with an uncertainty of a metre along it."""
    nodes = scans.windows.node
    usual = match_preceding(scans, nodes, lambda part: None).mean_score
    there = scans.windows.node_progress < 16.0
    out, places = [], Places(scans, nodes)
    for middle in np.flatnonzero(~there & (nodes[:, 0] > 7.0) & (nodes[:, 0] < 13.0))[::6]:
        place = int(np.abs(nodes[there, 0] - nodes[middle, 0]).argmin())
        block = np.arange(middle - LENGTH // 2, middle + LENGTH // 2)
        assert places[place] is not None
        out.append(find_loop(scans, block, nodes, place, np.array([1.0, 0.2, math.radians(2.0)]), places, usual))
    assert len(out) >= 2
    return out


def test_ambiguous_place_is_not_accepted() -> None:
    assert not any(found_on_the_way_back(gallery(list(range(10, 190, 12)))))


def test_place_is_accepted_if_distances_of_bays_differ() -> None:
    scans = gallery([15, 27, 46, 60, 78, 90, 111, 124, 144, 157, 178])
    found = found_on_the_way_back(scans)
    right = [each for each in found if each is not None]
    assert len(right) == len(found)
    assert wrong_by(right, scans.windows.node).max() < 0.1


def test_known_loops_are_not_searched_again(solver, monkeypatch) -> None:
    scans, true = solver._scans, solver._windows.node
    samples = np.random.default_rng(0).standard_normal((40, len(true), 3)) * (0.1, 0.1, 0.01)
    usual = match_preceding(scans, true, lambda part: None).mean_score
    known = find_loops(scans, true, samples, usual, lambda part: None)
    assert loops_of(known)
    # the whole drive is moved, and its end is bent
    progress = solver._windows.node_progress
    begin = progress[-1] - 8.0
    aside = 0.5 * np.sin(np.maximum(progress - begin, 0.0))
    after = compose(np.array([3.0, 1.0, 0.4]), true + np.stack([0.0 * aside, aside, 0.0 * aside], axis=1))
    kept = solver._unchanged(known, true, after)
    stays, moves = progress < begin - AROUND, progress > begin + 1.0
    same = {key for key in known if stays[[*key]].all()}
    assert loops_of(kept)
    assert same <= set(kept)
    assert not any(moves[[*key]].any() for key in kept)
    searched: list[tuple[int, int]] = []

    def search(scans, block, nodes, place, *rest) -> None:
        searched.append((int(block[len(block) // 2]), place))

    monkeypatch.setattr(loops, 'find_loop', search)
    again = find_loops(scans, true, samples, usual, lambda part: None, kept)
    assert searched and not set(searched) & set(kept)
    assert {key: again[key] for key in kept if kept[key]} == {key: loop for key, loop in kept.items() if loop}
    searched.clear()
    assert find_loops(scans, true, samples, usual, lambda part: None, known) == known
    assert not searched


def test_only_near_places_are_examined(monkeypatch: pytest.MonkeyPatch) -> None:
    k = np.arange(4000)
    there_and_back = 0.4 * np.minimum(k, 4000 - k)
    nodes = np.stack([there_and_back, 0.0 * k, np.where(k < 2000, 0.0, math.pi)], axis=1)
    examined = []
    monkeypatch.setattr(loops, 'relative', lambda frame, pose: examined.append(frame.size) or relative(frame, pose))
    samples = np.random.default_rng(0).normal(0.0, 0.1, (20, *nodes.shape))
    ((place, _),) = loops.candidates(nodes, samples, 0.4 * k, 3000)
    assert place == 1000 and sum(examined) < 0.05 * samples.size / loops.SHARED
