"""Mirror images behind walls, and free space that no reading passed."""

from __future__ import annotations

import math
from collections.abc import Callable

import numpy as np
import pytest

import naive
from forward_grid_mapper.core.common.grid import Grid
from forward_grid_mapper.core.common.parameter_groups import ModelParameters
from forward_grid_mapper.core.common.parameters import Parameters
from forward_grid_mapper.core.common.readings import Readings
from forward_grid_mapper.core.evidence.evidence import Evidence
from forward_grid_mapper.core.mapping import Mapper
from forward_grid_mapper.core.maps.line_of_sight import ECHO_UNIT, add_echoes, mirror_images, not_passed
from forward_grid_mapper.core.runtime import threads
from samples import random_readings

GRID = Grid(0.1, 0, 0, 30, 26)
EVERYWHERE = np.ones(GRID.shape, bool)
MODEL = ModelParameters(sigma=0.06, surface_offset=0.3)


def made(readings: Readings, occupied: np.ndarray, **options: object) -> Evidence:
    evidence = Evidence(GRID, MODEL, start=occupied.astype(np.uint8).reshape(GRID.shape), **options)
    evidence.extend(readings)
    return evidence


def some(seed: int, filled: float = 0.08) -> tuple[Readings, np.ndarray]:
    """A random map, and readings that are not on the lattice, so that none passes a corner of cells."""
    rng = np.random.default_rng(seed)
    readings = random_readings(rng, GRID, 60, z_max=2.0)
    readings.x[:] += 0.00123
    readings.y[:] -= 0.00077
    return readings, rng.random(GRID.size) < filled


@pytest.mark.parametrize('seed', range(6))
def test_echoes_and_passes_are_those_of_the_twin(seed: int) -> None:
    readings, occupied = some(seed)
    evidence = made(readings, occupied)
    echoes = np.zeros((2, GRID.size), np.int64)
    add_echoes(evidence.state, 0, len(readings), evidence.state.maps.occupied, 3.0, echoes)
    expected = naive.explained_echoes(readings, GRID, occupied, MODEL)
    assert np.abs(echoes * ECHO_UNIT - expected).max() < 1e-4
    assert 0 < expected[0].sum() < expected[1].sum()
    free = ~occupied.reshape(GRID.shape)
    actual = not_passed(evidence, free)
    assert np.array_equal(actual, naive.never_passed(readings, GRID, occupied, MODEL, free))
    assert 0 < actual.sum() < free.sum()
    twice = made(readings, occupied)
    twice.add_multiplicity(np.arange(len(readings)))
    doubled = np.zeros_like(echoes)
    add_echoes(twice.state, 0, len(readings), twice.state.maps.occupied, 3.0, doubled)
    assert np.abs(doubled - 2 * echoes).max() <= len(readings)


def test_mirror_images_are_cells_whose_echoes_had_no_free_path() -> None:
    seen = 0
    for seed in range(6):
        readings, occupied = some(seed, 0.12)
        cells = np.random.default_rng(seed).random(GRID.shape) < 0.5
        actual = mirror_images(made(readings, occupied), cells)
        assert np.array_equal(actual, naive.mirror_images(readings, GRID, occupied, MODEL, cells))
        seen += actual.sum()
    assert seen > 20


@pytest.mark.parametrize('of', [mirror_images, not_passed])
def test_number_of_threads_does_not_change_lines_of_sight(
    monkeypatch: pytest.MonkeyPatch, of: Callable[[Evidence, np.ndarray], np.ndarray]
) -> None:
    readings, occupied = some(1, 0.15)
    one = of(made(readings, occupied), EVERYWHERE)
    monkeypatch.setattr(threads, 'LEAST_PART', 20)
    assert 0 < one.sum() < one.size
    assert np.array_equal(of(made(readings, occupied, threads=3), EVERYWHERE), one)


def along_a_mirror() -> Readings:
    """A robot between a smooth wall at y = 2, which mirrors beams at large incidence angles, and a
    rough one at y = 0.
    """
    x, yaw = (values.ravel() for values in np.meshgrid(np.arange(0.5, 6.0, 0.05), np.radians(np.arange(-90, 91, 7.5))))
    up, away = yaw > 0, np.abs(np.sin(yaw))
    square = np.abs(np.abs(yaw) - math.pi / 2) < math.radians(20)
    with np.errstate(divide='ignore'):
        z = np.where(up, np.where(square, 1.0, 3.0), 1.0) / away
    return Readings.from_columns(
        ('',),
        x=x,
        y=np.full(x.shape, 1.0),
        yaw=yaw,
        z=np.minimum(z, 4.0),
        z_max=4.0,
        half_angle=math.radians(7.5),
        sigma=0.03,
    )


def test_mirror_image_behind_a_smooth_wall_is_not_mapped() -> None:
    maps = Mapper(Parameters()).run(along_a_mirror())
    xs, ys = maps.grid.centers()
    along = (xs > 1.0) & (xs < 5.0)

    def at(y: float) -> np.ndarray:
        return maps.ml[np.abs(ys - y) < 0.16][:, along] == 1

    assert at(2.0).any(axis=0).mean() > 0.9, 'the mirror itself'
    assert at(0.0).any(axis=0).mean() > 0.9, 'what is mirrored'
    behind = (ys > 2.3)[:, None] & along
    assert (maps.searched[behind] == 1).sum() > 10, 'the search has no other cause for these echoes'
    assert (maps.ml[behind] == -1).all()
    assert np.isnan(maps.uncertainty[behind & (maps.searched == 1)]).all()


def test_wall_seen_from_its_own_side_is_no_mirror_image() -> None:
    drive = along_a_mirror()
    beyond = drive.select(drive.yaw < 0)
    beyond.y[:] += 2.0
    columns = ('x', 'y', 'yaw', 'z', 'z_max', 'half_angle', 'sigma')
    both = Readings.from_columns(
        ('',), **{name: np.concatenate([getattr(drive, name), getattr(beyond, name)]) for name in columns}
    )
    maps = Mapper(Parameters()).run(both)
    xs, ys = maps.grid.centers()
    wall = maps.ml[np.abs(ys - 2.0) < 0.16][:, (xs > 1.0) & (xs < 5.0)] == 1
    assert wall.any(axis=0).mean() > 0.9
