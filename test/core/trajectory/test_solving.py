"""The pose graph of a drive: what votes of walls may say against odometry."""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import replace

import numpy as np
import pytest

from forward_grid_mapper.core.common.parameters import Parameters
from forward_grid_mapper.core.trajectory.heading import Heading, heading
from forward_grid_mapper.core.trajectory.holding_out import held_out
from forward_grid_mapper.core.trajectory.local_map import for_matching
from forward_grid_mapper.core.trajectory.poses import Floats, wrapped
from forward_grid_mapper.core.trajectory.scans import Scans
from forward_grid_mapper.core.trajectory.solving import OF_YAWS, Solver
from forward_grid_mapper.core.trajectory.walls import SPAN, wall_votes
from forward_grid_mapper.core.trajectory.windows import Odometry, Windows, cut
from forward_grid_mapper.simulation.drive import drive
from forward_grid_mapper.simulation.sonar import NOISY, front_array
from forward_grid_mapper.simulation.world import building_tour, building_world

STRETCH = (10.0, 22.0)
"""Metres of progress along which walls say something else."""


@pytest.fixture(scope='module')
def exact() -> tuple[Odometry, Windows, Scans, Heading]:
    """Return a drive whose odometry is right, and what walls say of it."""
    recording = drive(building_world(), building_tour()[:20], 0.1, front_array(), NOISY, seed=3)
    messages = recording.odometry
    odometry = Odometry.of(np.array([m.stamp for m in messages]), np.array([m.pose for m in messages], float))
    windows = cut(recording.readings, odometry)
    scans = Scans(windows, for_matching(Parameters()), np.zeros(1, np.uint8), held_out(len(windows)))
    found = heading(windows, *wall_votes(windows, scans.held_out))
    assert found is not None
    return odometry, windows, scans, found


def quietly(stage: str) -> Callable[[float], None]:
    return lambda part: None


def solver_of(exact: tuple[Odometry, Windows, Scans, Heading], said: Heading) -> Solver:
    odometry, windows, scans, _ = exact
    return Solver(odometry, windows, scans, said, quietly)


def turned(windows: Windows, nodes: Floats) -> Floats:
    """Return by how many degrees the nodes of the stretch are turned against odometry, beyond all nodes."""
    off = wrapped(nodes[:, 2] - windows.node[:, 2])
    off = np.degrees(wrapped(off - np.median(off)))
    within = (windows.node_progress > STRETCH[0]) & (windows.node_progress < STRETCH[1])
    out: Floats = off[within]
    return out


def test_an_echo_counts_once(exact) -> None:
    _, windows, _, found = exact
    # places whose votes an echo has a part in, away from the ends of the drive
    inner = (windows.progress > SPAN) & (windows.progress < windows.node_progress[-1] - SPAN)
    at = windows.node_progress[found.at]
    places = (np.abs(windows.progress[inner, None] - at) <= SPAN / 2).sum(1)
    assert places.mean() * OF_YAWS == pytest.approx(1.0, rel=0.1)
    assert solver_of(exact, found)._yaws.part == OF_YAWS


def test_walls_that_say_nothing_else_turn_nothing(exact) -> None:
    _, windows, _, found = exact
    nodes = solver_of(exact, found).along_walls().nodes
    assert np.abs(turned(windows, nodes)).mean() < 1.0


@pytest.mark.parametrize('degrees', [-4.0, 4.0])
def test_odometry_that_drifts_little_is_not_turned_by_a_few_places(exact, degrees) -> None:
    _, windows, _, found = exact
    at = windows.node_progress[found.at]
    astray = np.where((at > STRETCH[0]) & (at < STRETCH[1]), math.radians(degrees), 0.0)
    drifts = found.drifts._replace(noise=math.radians(0.5))
    said = replace(found, measured=found.correction + astray, drifts=drifts)
    nodes = solver_of(exact, said).along_walls().nodes
    assert np.abs(turned(windows, nodes)).mean() < abs(degrees) / 2
