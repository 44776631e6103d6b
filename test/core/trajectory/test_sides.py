"""The sides from which surfaces are seen, compared with plain Python, and matches across a shelf with two faces."""

from __future__ import annotations

import math

import numpy as np
import pytest
from exact_tour import quietly

from forward_grid_mapper.core.common.grid import Grid
from forward_grid_mapper.core.common.parameters import Parameters
from forward_grid_mapper.core.common.readings import Readings
from forward_grid_mapper.core.runtime.cancelling import NEVER
from forward_grid_mapper.core.sensor.cone_table import cone_table
from forward_grid_mapper.core.trajectory import sides
from forward_grid_mapper.core.trajectory.local_map import cells_of, for_matching, local_map
from forward_grid_mapper.core.trajectory.loops import LENGTH, Places, find_loop
from forward_grid_mapper.core.trajectory.passes import match_preceding
from forward_grid_mapper.core.trajectory.pose_graph import residuals
from forward_grid_mapper.core.trajectory.scans import Scans
from forward_grid_mapper.core.trajectory.sides import FARTHEST, add_bearings, mean_bearings
from forward_grid_mapper.core.trajectory.windows import cut
from forward_grid_mapper.simulation.drift import odometry_of
from forward_grid_mapper.simulation.drive import drive
from forward_grid_mapper.simulation.sonar import NoiseModel, sonar_ring
from forward_grid_mapper.simulation.world import Floorplan

GRID = Grid(0.1, -20, -20, 40, 40)
DEEP = 8
"""Depth of the shelf, cells."""


def bearings(readings: Readings, occupied: np.ndarray) -> np.ndarray:
    """The sums of `add_bearings` by definition."""
    out = np.zeros((3, occupied.size))
    sigma = np.maximum(readings.sigma, Parameters().model.sigma)
    cones = cone_table(readings, GRID, Parameters().model)
    for t in np.flatnonzero(readings.echo):
        z = cones['z'][t] * GRID.resolution
        spread = cones['sigma'][t] * GRID.resolution
        assert spread >= 0.5 * sigma[t]
        for cell in np.flatnonzero(occupied):
            row, column = divmod(int(cell), GRID.width)
            u = (GRID.column + column + 0.5) * 0.1 - readings.x[t]
            v = (GRID.row + row + 0.5) * 0.1 - readings.y[t]
            d = math.hypot(u, v)
            off = (math.atan2(v, u) - readings.yaw[t] + math.pi) % (2 * math.pi) - math.pi
            if abs(off) <= readings.half_angle[t] and abs(d - z) <= FARTHEST * spread:
                weight = math.exp(-0.5 * ((d - z) / spread) ** 2)
                out[:, cell] += weight * u / d, weight * v / d, weight
    return out


def test_sums_are_those_of_the_twin() -> None:
    rng = np.random.default_rng(1)
    readings = Readings.from_columns(
        x=rng.normal(0, 0.3, 20),
        y=rng.normal(0, 0.3, 20),
        yaw=rng.uniform(-3, 3, 20),
        z=np.where(np.arange(20) % 5, rng.uniform(0.8, 1.6, 20), 3.0),
        z_max=3.0,
        half_angle=0.4,
    )
    occupied = rng.random(GRID.size) < 0.3
    sums = np.zeros((3, GRID.size))
    add_bearings(cone_table(readings, GRID, Parameters().model), GRID.shape, occupied, sums, NEVER)
    wanted = bearings(readings, occupied)
    assert (wanted[2] > 0).sum() > 50
    np.testing.assert_allclose(sums, wanted, atol=1e-9)


def seen_from(below: int, above: int) -> np.ndarray:
    """Return the mean bearings at a wall along y = 0.05 with so many echoes from each side, shape (2, 2)."""
    y = np.repeat([-0.95, 1.05], [below, above])
    ahead = np.where(y < 0, 1, -1) * math.pi / 2
    readings = Readings.from_columns(
        x=np.linspace(-0.2, 0.2, len(y)), y=y, yaw=ahead, z=np.ones(len(y)), z_max=3.0, half_angle=0.2
    )
    wall = np.zeros(GRID.shape, np.bool_)
    wall[20, 19:21] = True
    cones = cone_table(readings, GRID, Parameters().model)
    return mean_bearings(cones, GRID.shape, wall.ravel(), NEVER)[:, wall.ravel()]


@pytest.mark.parametrize(('below', 'above', 'y'), [(9, 0, 1.0), (0, 9, -1.0), (5, 5, 0.0), (9, 1, 1.0)])
def test_mean_bearing_is_known_if_one_side_was_seen(below: int, above: int, y: float) -> None:
    np.testing.assert_allclose(seen_from(below, above), [[0.0, 0.0], [y, y]], atol=0.1)


def around_a_shelf() -> Scans:
    """Return a drive around a shelf: along one of its faces, back along the other, and along the first again."""
    plan = Floorplan('shelf', 130, 70)
    plan.box((5, 5), (124, 5 + 2 * 24 + DEEP))
    plan.box((25, 29), (104, 29 + DEEP))
    path = np.array([[1.5, 1.7], [11.5, 1.7], [11.5, 4.9], [1.5, 4.9], [1.5, 1.7], [11.5, 1.7]])
    recording = drive(plan.world((15, 15)), path, 0.1, sonar_ring(8), NoiseModel(0.02, 0.02, 0.0), seed=2)
    windows = cut(recording.readings, odometry_of(recording))
    none = np.zeros(len(windows), np.bool_)
    return Scans(windows, Parameters(), NEVER.copy(), none)


@pytest.fixture(scope='module')
def shelf() -> Scans:
    return around_a_shelf()


def closed(scans: Scans, upper: bool) -> list[float]:
    """Return the errors across the shelf of loop closures with the lower aisle at the true poses, metres.

    They are those of blocks in the `upper` aisle, or in the lower one when the robot comes there again.
    """
    nodes, progress = scans.windows.node, scans.windows.node_progress
    usual = match_preceding(scans, nodes, quietly).mean_score
    places, out = Places(scans, nodes), list[float]()
    low, middle_part = nodes[:, 1] < 2.0, np.abs(nodes[:, 0] - 6.5) < 2.5
    first = low & (progress < progress[-1] / 2)
    for middle in np.flatnonzero((nodes[:, 1] > 4.5 if upper else low & ~first) & middle_part)[::LENGTH]:
        block = np.arange(middle - LENGTH // 2, middle + LENGTH // 2)
        other = np.flatnonzero(first)
        place = int(other[np.abs(nodes[other, 0] - nodes[middle, 0]).argmin()])
        found = find_loop(scans, block, nodes, place, np.array([0.4, 0.4, 0.03]), places, usual)
        if found is not None:
            out.append(float(np.abs(np.median(residuals(nodes, found.matches.edges())[:, 1]))))
    return out


def test_no_match_takes_one_face_of_a_shelf_for_the_other(shelf: Scans, monkeypatch: pytest.MonkeyPatch) -> None:
    assert max(closed(shelf, upper=True), default=0.0) < 0.25
    in_the_same_aisle = closed(shelf, upper=False)
    assert in_the_same_aisle and max(in_the_same_aisle) < 0.1
    # without sides, both faces are matched
    monkeypatch.setattr(sides, 'ONE_SIDE', 2.0)
    assert max(closed(shelf, upper=True), default=0.0) > 0.5


def test_local_map_knows_the_side_of_most_walls(shelf: Scans) -> None:
    windows = shelf.windows
    first = windows.readings.select(np.flatnonzero(windows.readings.y < 2.2))
    made = local_map(first, for_matching(Parameters()), NEVER.copy())
    surfaces = made.cells[:-1][made.cells[:-1, 0] > 0.5]
    assert len(surfaces) > 100 and np.isfinite(surfaces[:, 3]).mean() > 0.9


@pytest.mark.parametrize('normal', [None, 0.3, -0.3, 0.3 + math.pi])
def test_rays_from_behind_meet_an_unknown_surface(normal: float | None) -> None:
    """The surface was seen along the x axis."""
    x, y = (0.0, 0.0) if normal is None else (math.cos(normal), math.sin(normal))
    hit, x, y = (np.full((1, 2), value, np.float32) for value in (0.7, x, y))
    cells = cells_of(hit, x, y, np.array([[1.0, 0.0], [0.0, 0.0]], np.float32))

    def product(cell: int, angle: float) -> float:
        return float(cells[cell, 1:3] @ (math.cos(angle), math.sin(angle)))

    assert all(product(0, angle) > cells[0, 3] for angle in np.radians([-70, 0, 70]))
    assert all(product(0, angle) < cells[0, 3] for angle in np.radians([130, 180, 230]))
    if normal is None:
        # no ray is beyond the incidence angle
        assert all(product(0, angle) ** 2 > 1.0 for angle in np.radians([0, 45, 89, 100, 180]))
    # the other surface was seen from both sides, and cells outside are unknown
    for cell in (1, -1):
        assert not any(product(cell, angle) < cells[cell, 3] for angle in np.radians([0, 90, 180, 270]))
