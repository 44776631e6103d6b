"""The default pipeline, compared with plain Python: normals, gains, the end of the search, and the final maps."""

from __future__ import annotations

import math
from dataclasses import dataclass
from functools import cache

import numpy as np
import pytest

import naive
from forward_grid_mapper.core.common.constants import EXTENSION, LEAST_AGREEMENT, LEAST_WEIGHT
from forward_grid_mapper.core.common.grid import Grid
from forward_grid_mapper.core.common.parameters import Parameters
from forward_grid_mapper.core.common.readings import Readings
from forward_grid_mapper.core.mapping import Mapper
from forward_grid_mapper.core.maps.map_set import MapSet
from forward_grid_mapper.core.maps.traversed import traversed_cells
from forward_grid_mapper.core.search.prior import Prior, wall_prior
from forward_grid_mapper.core.search.search import LEAST

SEEDS = range(3)


def corner(seed: int, count: int = 70) -> Readings:
    """Readings of a robot in the corner of two walls; at large incidence they have no echo, and some are random."""
    rng = np.random.default_rng(seed)
    x, y = 0.3 + 0.5 * rng.random(count), 0.3 + 0.5 * rng.random(count)
    yaw = rng.uniform(-0.6, 2.2, count)
    z_max = 1.6
    to_wall = np.stack([(1.4 - x) / np.cos(yaw), (1.3 - y) / np.sin(yaw)])
    to_wall[~(to_wall > 0)] = np.inf
    slant = np.where(to_wall[0] < to_wall[1], np.abs(yaw), np.abs(yaw - math.pi / 2))
    z = np.where(slant < 0.5, to_wall.min(axis=0) + 0.03 * rng.standard_normal(count), z_max)
    z = np.where(rng.random(count) < 0.1, rng.uniform(0.2, z_max, count), z)
    return Readings.from_columns(
        ('front', 'side'),
        x=x,
        y=y,
        yaw=yaw,
        z=np.clip(z, 0.05, z_max),
        z_max=z_max,
        half_angle=rng.choice([0.1, 0.2], count),
        stamp=np.arange(count) * 50_000_000,
        sensor=np.arange(count) % 2,
    )


@dataclass(frozen=True)
class Case:
    """The default maps of some readings, and the map found by the search."""

    maps: MapSet
    searched: np.ndarray
    traversed: np.ndarray

    @property
    def inputs(self) -> tuple[Readings, Grid, np.ndarray]:
        return self.maps.readings, self.maps.grid, self.searched

    @property
    def passes(self) -> np.ndarray:
        return naive.passed(*self.inputs, self.maps.parameters.model)

    @property
    def prior(self) -> Prior:
        search = self.maps.parameters.search
        return wall_prior(search, self.traversed.ravel(), self.maps.grid.resolution)


@cache
def case(seed: int) -> Case:
    mapper, seen = Mapper(Parameters()), []
    maps = mapper.run(corner(seed), lambda stage, progress: seen.append(mapper.so_far()) if progress else None)
    _, searched = seen[-1]
    return Case(maps, (searched == 1).astype(np.uint8), traversed_cells(maps.readings, maps.grid))


@cache
def evidence(seed: int) -> np.ndarray:
    """Evidence of each cell, given the map found by the search, from sums over all correspondences."""
    c = case(seed)
    return naive.evidence(*c.inputs, c.maps.parameters.model, c.maps.normals)


@pytest.mark.parametrize('seed', SEEDS)
def test_normals_are_those_of_the_twin(seed: int) -> None:
    maps = case(seed).maps
    sums = naive.normals(maps.readings, maps.grid, maps.parameters.model)
    cosine, sine, mass = (naive.box_sum(values) for values in sums)
    length = np.hypot(cosine, sine)
    clear = (np.abs(mass - LEAST_WEIGHT) > 1e-2) & (np.abs(length - LEAST_AGREEMENT * mass) > 1e-2)
    known = (mass >= LEAST_WEIGHT) & (length >= LEAST_AGREEMENT * mass)
    assert np.array_equal(maps.normals.known.reshape(maps.grid.shape)[clear], known[clear])
    assert known.sum() > 10
    left_out = [naive.left_out(maps.readings, t, maps.grid, maps.parameters.model, maps.normals) for t in range(70)]
    assert any(left_out), 'no reading passes a surface'


@pytest.mark.parametrize('seed', SEEDS)
def test_likelihood_and_objective_are_those_of_the_twin(seed: int) -> None:
    c = case(seed)
    maps, model = c.maps, c.maps.parameters.model
    likelihood = naive.log_likelihood(maps.readings, maps.grid, maps.ml, model, maps.normals)
    assert maps.log_likelihood == pytest.approx(likelihood, abs=1e-5)
    prior = naive.log_prior(c.prior, maps.ml == 1, maps.grid.shape)
    assert maps.objective == pytest.approx(likelihood + prior, abs=1e-5)
    # logs are integers of rounded likelihoods
    searched = naive.log_likelihood(*c.inputs, model, maps.normals)
    assert maps.statistics['searched_log_likelihood'] == pytest.approx(searched, abs=1e-4)
    for t in range(len(maps.readings)):
        met = naive.obstacles(maps.readings, t, maps.grid, maps.ml, model, maps.normals)
        sigma = naive.sigma_of(maps.readings, t, maps.grid, model)
        terms = naive.causes(maps.readings.z[t], maps.readings.z_max[t], sigma, met[:12], model)
        if len(met) <= 12:
            assert maps.unexplained[t] == (terms[0] > 0.5 * sum(terms))


@pytest.mark.parametrize('seed', SEEDS)
def test_no_single_flip_gains_at_the_end_of_the_search(seed: int) -> None:
    c = case(seed)
    assert c.maps.statistics['converged']
    nats, occupied = evidence(seed), c.searched.ravel()
    assert occupied.sum() > 10
    for cell in np.flatnonzero(nats):
        data = -nats[cell] if occupied[cell] else nats[cell]
        gain = data + naive.prior_gain(c.prior, occupied, cell, c.maps.grid.shape)
        assert gain < LEAST[0] + LEAST[1] * len(c.maps.readings) + 1e-4


@pytest.mark.parametrize('seed', SEEDS)
def test_final_map_is_that_of_the_twin(seed: int) -> None:
    c = case(seed)
    search, model = c.maps.parameters.search, c.maps.parameters.model
    least = search.least_passed, search.least_noticed
    expected = naive.final_map(*c.inputs, model, c.maps.normals, c.traversed, round(EXTENSION / 0.1), least)
    assert np.array_equal(c.maps.ml, expected)
    assert set(np.unique(expected)) == {-1, 0, 1}


@pytest.mark.parametrize('seed', SEEDS)
def test_uncertainty_map_is_that_of_the_twin(seed: int) -> None:
    c = case(seed)
    search, grid = c.maps.parameters.search, c.maps.grid
    nats, passes = evidence(seed), c.passes
    expected = naive.calibrated(
        nats.reshape(grid.shape), passes.sum(axis=0).reshape(grid.shape), c.maps.ml, search.alpha
    )
    model = c.maps.parameters.model
    noticing = naive.noticing(passes, model.p_hit, naive.usual_limits(model))
    for cell, q in enumerate(c.maps.uncertainty.ravel()):
        if np.isnan(q):
            assert c.maps.ml.ravel()[cell] == -1
            assert abs(nats[cell]) < 0.1 + 1e-4 or (nats[cell] < 0 and noticing[cell] < 0.1 + 1e-4)
        elif c.traversed.ravel()[cell]:
            # at the position of the robot, a cell cannot be occupied
            assert q == 0
        else:
            assert q == pytest.approx(expected.ravel()[cell], abs=1e-4)


def in_room(x: float, y: float, bearing: float, half: float) -> float:
    """Return the distance to the nearest wall in a cone, in a room of 6 by 5 metres."""
    angles = bearing + np.linspace(-half, half, 31)
    c, s = np.cos(angles), np.sin(angles)
    across = np.where(c > 0, 6.0 - x, x) / np.maximum(np.abs(c), 1e-9)
    along = np.where(s > 0, 5.0 - y, y) / np.maximum(np.abs(s), 1e-9)
    return float(np.minimum(across, along).min())


@pytest.mark.parametrize(('sonars', 'turns'), [(1, 4), (3, 2), (8, 1)])
def test_robot_that_turns_on_the_spot_maps_the_room_as_free(sonars: int, turns: int) -> None:
    # each place is seen from one direction only, so it takes about seven readings that pass
    x, y, half = 2.5, 2.2, 0.13
    bearings = np.arange(72 * turns)[:, None] * (2 * np.pi / 72) + np.arange(sonars) * (2 * np.pi / 8)
    z = [min(in_room(x, y, bearing, half), 4.0) for bearing in bearings.ravel()]
    readings = Readings.from_columns(x=x, y=y, yaw=bearings.ravel(), z=z, z_max=4.0, half_angle=half)
    maps = Mapper(Parameters()).run(readings)
    xs, ys = np.meshgrid(np.arange(0.35, 5.7, 0.1), np.arange(0.35, 4.7, 0.1))
    rows, columns = maps.grid.cells_of(xs.ravel(), ys.ravel())
    assert (maps.ml[rows, columns] == 0).mean() > 0.9
