"""Corners that are not square and are taken for right angles."""

from __future__ import annotations

import math

import numpy as np
import pytest

from forward_grid_mapper.core.common.readings import Floats
from forward_grid_mapper.core.trajectory import corners
from forward_grid_mapper.core.trajectory.corners import (
    LEAST_GAIN,
    WITHIN,
    gain_of_other_turn,
    turns_of,
    turns_supported,
    with_likeliest_turns,
    with_turn,
)
from forward_grid_mapper.core.trajectory.poses import relative, wrapped
from forward_grid_mapper.core.trajectory.scans import Scans
from forward_grid_mapper.simulation.drift import odometry_of
from forward_grid_mapper.simulation.drive import Recording


@pytest.fixture(scope='module')
def true(exact: Recording, scans: Scans) -> Floats:
    return odometry_of(exact).at(scans.windows.node_stamp)


@pytest.fixture(scope='module')
def places(scans: Scans, true: Floats) -> list[int]:
    """The middle nodes of the seven corners."""
    return turns_of(scans.windows, true, 0.0)


def turned_at(scans: Scans, nodes: Floats, places: list[int], change: float) -> Floats:
    for middle in places:
        nodes = with_turn(scans.windows, nodes, middle, change)
    return nodes


def test_turns_missing_in_odometry_are_distinguished_from_drift(scans, true, places) -> None:
    assert len(places) == 7
    assert turns_of(scans.windows, true), 'odometry drifts at some corners'
    assert turns_supported(scans, true)
    # as if the corners of 72° were square
    square = turned_at(scans, true, places, math.radians(18.0))
    assert not turns_supported(scans, square)
    assert max(gain_of_other_turn(scans, true, middle) for middle in places) < 0.0
    assert min(gain_of_other_turn(scans, square, middle) for middle in places) > LEAST_GAIN


@pytest.mark.parametrize('degrees', [-15.0, 12.0])
def test_one_wrong_corner_suffices(scans, true, places, degrees: float) -> None:
    assert not turns_supported(scans, turned_at(scans, true, places[2:3], math.radians(degrees)))


def test_a_turn_is_changed_by_the_angle_and_nowhere_else(scans, true, places) -> None:
    middle, progress = places[1], scans.windows.node_progress
    changed = with_turn(scans.windows, true, middle, 0.3)
    before, after = relative(true[:-1], true[1:]), relative(changed[:-1], changed[1:])
    more = wrapped(after[:, 2] - before[:, 2])
    assert more.sum() == pytest.approx(0.3)
    outside = np.abs(progress[:-1] - progress[middle]) > WITHIN
    np.testing.assert_allclose(after[outside], before[outside], atol=1e-12)
    first = np.flatnonzero(~outside)[0]
    np.testing.assert_array_equal(changed[: first + 1], true[: first + 1])
    np.testing.assert_allclose(np.hypot(*after[:, :2].T), np.hypot(*before[:, :2].T), atol=1e-12)
    where = np.abs(before[:, 2]) > math.radians(10.0)
    assert more[where & ~outside].sum() > 0.2, 'most of it is where the robot turns'
    np.testing.assert_allclose(relative(with_turn(scans.windows, true, middle, 0.0), true), 0.0, atol=1e-9)


def test_only_corners_that_odometry_does_not_have_are_examined(scans, true, places) -> None:
    assert turns_of(scans.windows, scans.windows.node) == []
    assert np.diff(scans.windows.node_progress[np.sort(places)]).min() > 2 * WITHIN
    changed = with_turn(scans.windows, true, places[2], math.radians(20.0))
    assert any(abs(k - places[2]) <= 1 for k in turns_of(scans.windows, changed))
    # a robot that turns around passes the same walls again, and a gentle bend is no corner
    progress = scans.windows.node_progress
    for degrees in (100.0, -60.0):
        changed = with_turn(scans.windows, true, places[2], math.radians(degrees))
        others = np.abs(progress[turns_of(scans.windows, changed, 0.0)] - progress[places[2]])
        assert len(others) == 6 and others.min() > 2 * WITHIN


def test_turns_that_differ_most_from_odometry_come_first(scans, true, places, monkeypatch) -> None:
    changed = turned_at(scans, turned_at(scans, true, places[3:4], 0.3), places[5:6], 0.6)
    first, second = turns_of(scans.windows, changed)[:2]
    progress = scans.windows.node_progress
    assert abs(progress[first] - progress[places[5]]) < WITHIN
    assert abs(progress[second] - progress[places[3]]) < WITHIN
    monkeypatch.setattr(corners, 'MOST_TURNS', 1)
    assert not turns_supported(scans, changed)
    monkeypatch.setattr(corners, 'MOST_TURNS', 0)
    assert turns_supported(scans, changed)


def test_turns_are_changed_to_the_likeliest_ones(scans, true, places) -> None:
    changes = np.radians([18.0, -12.0, 0.0, 9.0, -20.0, 14.0, -16.0])
    bent = true
    for middle, change in zip(places, changes, strict=True):
        bent = with_turn(scans.windows, bent, middle, float(change))
    before, after = (off_at(scans, nodes, true, places) for nodes in (bent, with_likeliest_turns(scans, bent)))
    np.testing.assert_allclose(before, changes, atol=1e-9)
    assert np.sqrt((after**2).mean()) < math.radians(3.0)


def off_at(scans: Scans, nodes: Floats, true: Floats, places: list[int]) -> Floats:
    """Return by how much turns of nodes are larger than the true ones, radians."""
    progress = scans.windows.node_progress
    off = np.unwrap(nodes[:, 2]) - np.unwrap(true[:, 2])
    before, after = (np.searchsorted(progress, progress[places] + side * (WITHIN + 0.4)) for side in (-1, 1))
    out: Floats = wrapped(off[np.minimum(after, len(off) - 1)] - off[before])
    return out


def test_a_turn_without_readings_is_not_doubted(scans, true, places) -> None:
    silent = scans.with_held_out(np.ones(len(scans.windows), np.bool_))
    assert gain_of_other_turn(silent, true, places[0]) == 0.0
