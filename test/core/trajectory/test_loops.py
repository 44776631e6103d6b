"""Places seen before: where they are looked for, and which of them are believed."""

from __future__ import annotations

import math

import numpy as np
import pytest
from exact_tour import quietly, tour_with

from forward_grid_mapper.core.trajectory import loops
from forward_grid_mapper.core.trajectory.loops import LENGTH, OTHER, Loop, Places, find_loop, find_loops
from forward_grid_mapper.core.trajectory.matching import Match
from forward_grid_mapper.core.trajectory.passes import Found, ahead
from forward_grid_mapper.core.trajectory.pose_graph import residuals
from forward_grid_mapper.core.trajectory.poses import Floats, relative
from forward_grid_mapper.core.trajectory.solving import Solver
from forward_grid_mapper.simulation.sonar import sonar_ring

BETWEEN = 22.0
"""Metres of progress between two visits of the same rooms."""

OFF = np.array([0.55, 0.3, 0.0])
SIGMA = 0.12
"""By how much nodes of the second visit are off, and what is said of it: metres."""


@pytest.fixture(scope='module')
def solver() -> Solver:
    """Return the solver of a drive whose odometry is right."""
    return Solver(*tour_with(sonar_ring(16)), quietly)


def wrong_by(found: list[Loop], true: Floats) -> Floats:
    """Return by how many metres each loop misses the right place."""
    return np.array([np.hypot(*np.median(residuals(true, loop.found.edges())[:, :2], axis=0)) for loop in found])


def test_a_place_is_found_where_the_graph_does_not_expect_it(solver) -> None:
    scans, true = solver._scans, solver._windows.node
    second = solver._windows.node_progress > BETWEEN
    nodes = true + np.where(second[:, None], OFF, 0.0)
    samples = np.random.default_rng(0).standard_normal((40, 1, 3)) * (SIGMA, SIGMA, math.radians(1.0))
    samples = np.where(second[:, None], samples, 0.0)
    usual = ahead(scans, true, lambda part: None).usual
    found = find_loops(scans, nodes, samples, usual, lambda part: None)
    across = [loop for loop in found if second[loop.block] != second[loop.place]]
    assert len(across) >= 3
    assert np.median(wrong_by(across, true)) < 0.15


def loop(true: Floats, block: int, place: int, off: float, sigma: float = 0.02) -> Loop:
    """Return a loop that puts a block aside of where it is."""
    found = Found()
    information = np.diag([sigma**-2, sigma**-2, math.radians(1.0) ** -2])
    for k in range(block - LENGTH // 2, block + LENGTH // 2):
        pose = relative(true[place], true[k]) + np.array([off, off, 0.0])
        found.add(place, k, Match(pose, information, 50.0), 50)
    return Loop(block, place, found)


def test_a_wrong_place_does_not_take_right_ones_with_it(solver) -> None:
    start = solver.along_walls()
    true, block = start.nodes, len(start.nodes) - 5
    right = [loop(true, block, place, 0.0) for place in (5, 9)]
    wrong = loop(true, block, 13, 0.7, 0.01)
    solution, kept = solver._with_loops(solver._walls(true, True), Found().edges(), [*right, wrong], start)
    assert [each.place for each in kept] == [each.place for each in right]
    assert np.hypot(*(solution.nodes - true)[:, :2].T).max() < 0.1


@pytest.mark.parametrize(('below', 'taken'), [(8.0, False), (16.0, True)])
def test_a_place_counts_only_if_the_block_fits_nowhere_else_nearly_as_well(solver, monkeypatch, below, taken) -> None:
    scans, true = solver._scans, solver._windows.node
    block = np.arange(len(true) - LENGTH, len(true))
    middle = block[LENGTH // 2]
    before = np.flatnonzero(solver._windows.node_progress < BETWEEN)
    place = int(before[np.hypot(*(true[before] - true[middle])[:, :2].T).argmin()])
    around = Places(scans, true)[place]
    fit, measure = [0.0], loops.measure

    def measured(joint, on, pose, *most):
        found = measure(joint, on, pose, *most)
        fit.append(found.score)
        return found

    def alike(elsewhere):
        def values(joint, on, poses, prior):
            off = relative(relative(true[place], true[middle]), poses)
            far = np.hypot(off[:, 0], off[:, 1]) > OTHER + 0.3
            out = np.where(far, elsewhere(), -1e3)
            out[np.abs(off).max(1).argmin()] = 1e3
            return out

        return values

    def found() -> Loop | None:
        return find_loop(scans, block, true, place, np.full(3, 0.5), around, 0.1)

    monkeypatch.setattr(loops, 'measure', measured)
    monkeypatch.setattr(loops, 'searched', alike(lambda: -1e3))
    assert found() is not None
    score = fit[1 + loops.CLIMBS]
    monkeypatch.setattr(loops, 'searched', alike(lambda: score - below))
    assert (found() is not None) == taken
