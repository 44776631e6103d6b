"""The pose graph of a drive: the weight of votes of walls against odometry."""

from __future__ import annotations

import math
from dataclasses import replace

import numpy as np
import pytest
from exact_tour import Tour, quietly, tour_with

from forward_grid_mapper.core.common.readings import Floats
from forward_grid_mapper.core.trajectory import solving
from forward_grid_mapper.core.trajectory.heading import Heading
from forward_grid_mapper.core.trajectory.loops import Loop, SearchResults
from forward_grid_mapper.core.trajectory.matching import Match
from forward_grid_mapper.core.trajectory.odometry_model import CALIBRATION, motions, sensitivity
from forward_grid_mapper.core.trajectory.passes import Matches, Progress
from forward_grid_mapper.core.trajectory.pose_graph import solution_at
from forward_grid_mapper.core.trajectory.poses import relative, wrapped
from forward_grid_mapper.core.trajectory.scans import Scans
from forward_grid_mapper.core.trajectory.solving import YAW_WEIGHT, MatchSolver, Solver
from forward_grid_mapper.core.trajectory.walls import SPAN
from forward_grid_mapper.core.trajectory.windows import Odometry, Windows
from forward_grid_mapper.simulation.sonar import front_array

WRONG_PART = (10.0, 22.0)
"""Metres of progress with wrong votes of walls."""


@pytest.fixture(scope='module')
def exact() -> Tour:
    """Return a drive with exact odometry, and its heading from walls."""
    return tour_with(front_array())


def solver_of(exact: tuple[Odometry, Windows, Scans, Heading], heading_of_walls: Heading) -> Solver:
    odometry, windows, scans, _ = exact
    return Solver(odometry, windows, scans, heading_of_walls, quietly)


@pytest.mark.parametrize('known', [False, True])
def test_only_the_first_search_is_as_wide_as_loop_closures_from_before_leave_it(exact, monkeypatch, known) -> None:
    """Blocks that the narrow search did not recognise are searched again."""
    odometry, windows, scans, _ = exact
    solver = MatchSolver(windows, scans, quietly, motions(odometry, windows), 0.1, sensitivity(odometry, windows))
    nodes, last, spreads, results = windows.node, len(windows) - 1, list[float](), list[SearchResults]()
    matches = Matches()
    matches.add(0, last, Match(relative(nodes[0], nodes[last]), 1e6 * np.eye(3), 30.0), 20)

    def find_loops(
        scans: Scans, nodes: Floats, samples: Floats, usual: float, watch: Progress, taken: SearchResults
    ) -> SearchResults:
        spreads.append(float(samples[:, last, :2].std()))
        results.append(taken)
        return {(last, 0): None}

    monkeypatch.setattr(solving, 'find_loops', find_loops)
    monkeypatch.setattr(solving, 'SETTLED', 0.0)
    monkeypatch.setattr(MatchSolver, '_unchanged', lambda self, results, *rest: results)
    solver.with_matches(solution_at(nodes, len(CALIBRATION)), [Loop(last, 0, matches)] if known else [])
    assert (spreads[0] < 0.01) == known
    assert spreads[1] > 0.02
    assert results == [{}, {} if known else {(last, 0): None}]


def turned(windows: Windows, nodes: Floats) -> Floats:
    """Return the turn in degrees of the nodes of this part relative to odometry, beyond that of all nodes."""
    off = wrapped(nodes[:, 2] - windows.node[:, 2])
    off = np.degrees(wrapped(off - np.median(off)))
    within = (windows.node_progress > WRONG_PART[0]) & (windows.node_progress < WRONG_PART[1])
    out: Floats = off[within]
    return out


def test_each_echo_has_a_total_weight_of_one(exact) -> None:
    _, windows, _, found = exact
    # places whose votes use an echo, away from the ends of the drive
    inner = (windows.progress > SPAN) & (windows.progress < windows.node_progress[-1] - SPAN)
    at = windows.node_progress[found.at]
    places = (np.abs(windows.progress[inner, None] - at) <= SPAN / 2).sum(1)
    assert places.mean() * YAW_WEIGHT == pytest.approx(1.0, rel=0.1)
    assert solver_of(exact, found)._yaws.part == YAW_WEIGHT


def test_walls_that_agree_with_odometry_do_not_turn_the_drive(exact) -> None:
    _, windows, _, found = exact
    nodes = solver_of(exact, found).along_walls().nodes
    assert np.abs(turned(windows, nodes)).mean() < 1.0


@pytest.mark.parametrize('degrees', [-4.0, 4.0])
def test_accurate_odometry_is_not_turned_by_a_few_wrong_places(exact, degrees) -> None:
    _, windows, _, found = exact
    at = windows.node_progress[found.at]
    astray = np.where((at > WRONG_PART[0]) & (at < WRONG_PART[1]), math.radians(degrees), 0.0)
    drifts = found.drifts._replace(noise=math.radians(0.5))
    heading_of_walls = replace(found, measured=found.correction + astray, drifts=drifts)
    nodes = solver_of(exact, heading_of_walls).along_walls().nodes
    assert np.abs(turned(windows, nodes)).mean() < abs(degrees) / 2
