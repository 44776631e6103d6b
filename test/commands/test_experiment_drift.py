"""`experiment drift`: its scores, compared with brute force, and the command on a short drive."""

from __future__ import annotations

import math
import re
from pathlib import Path

import numpy as np
import pytest
from drive_samples import code_of

from forward_grid_mapper.commands import experiment, experiment_drift
from forward_grid_mapper.commands.experiment_drift import RADIUS, aligned, navigable, on_world
from forward_grid_mapper.core.common.grid import Grid
from forward_grid_mapper.core.trajectory.poses import compose
from forward_grid_mapper.simulation.drive import drive
from forward_grid_mapper.simulation.sonar import NOISY, sonar_ring
from forward_grid_mapper.simulation.world import building_tour, building_world, door_world


def test_navigable_cells_have_free_space_around_them() -> None:
    free = np.random.default_rng(0).random((25, 31)) > 0.03
    found = navigable(free, 0.1)
    for row, column in np.ndindex(free.shape):
        room = True
        for dy in range(-3, 4):
            for dx in range(-3, 4):
                if math.hypot(dx, dy) * 0.1 <= RADIUS:
                    y, x = row + dy, column + dx
                    room &= 0 <= y < free.shape[0] and 0 <= x < free.shape[1] and bool(free[y, x])
        assert found[row, column] == room
    assert 0 < found.sum() < free.sum()


def test_map_is_transferred_to_the_cells_of_the_world() -> None:
    world = door_world()
    assert np.array_equal(on_world(world.reference, world.grid, world), world.reference)
    part = Grid(world.grid.resolution, world.grid.column + 5, world.grid.row + 3, 4, 2)
    there = on_world(np.ones(part.shape, np.int8), part, world)
    rows, columns = np.nonzero(there == 1)
    assert (rows.min(), rows.max(), columns.min(), columns.max()) == (3, 4, 5, 8)
    assert np.count_nonzero(there >= 0) == 8


def test_alignment_reverses_a_rigid_motion() -> None:
    rng = np.random.default_rng(1)
    true = np.cumsum(rng.normal(0, 1, (40, 3)), 0)
    moved = compose(np.array([3.0, -2.0, 0.7]), true)
    back = compose(aligned(moved, true), moved)
    assert back[:, :2] == pytest.approx(true[:, :2])


@pytest.mark.slow
def test_experiment_drift_compares_true_odometry_and_refined(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    tour = building_tour()[:10]
    short = {'building': lambda seed: drive(building_world(), tour, 0.15, sonar_ring(16), NOISY, seed)}
    monkeypatch.setattr(experiment_drift, 'WORLDS', short)
    assert code_of(experiment.main, 'drift', '--seeds', 1, '-o', tmp_path / 'drift') == 0
    out = capsys.readouterr().out
    figures = r'(\d+\.\d\d) +\d+\.\d\d +(\d\.\d{3}) +(\d\.\d{3})'
    rows = re.findall(rf'^building +(true|odometry|refined) +{figures}', out, re.MULTILINE)
    assert [row[0] for row in rows] == ['true', 'odometry', 'refined']
    ate, f1, iou = (np.array([float(row[k]) for row in rows]) for k in (1, 2, 3))
    assert ate[0] == 0.0
    assert ate[2] <= ate[1]
    assert f1[0] >= f1[1]
    assert iou[0] > 0.8
    assert iou[0] > iou[1]
    assert {path.name for path in (tmp_path / 'drift').iterdir()} == {'figure_building.png', 'table.txt'}
    assert (tmp_path / 'drift' / 'figure_building.png').read_bytes().startswith(b'\x89PNG')
