"""The forward model, compared with an enumeration of all possible causes of a reading."""

from __future__ import annotations

import dataclasses
import math

import numpy as np
import pytest

import naive
from forward_grid_mapper.core.common.constants import MOST_HIT
from forward_grid_mapper.core.common.grid import Grid
from forward_grid_mapper.core.common.parameter_groups import ModelParameters
from forward_grid_mapper.core.common.readings import Readings
from forward_grid_mapper.core.learning.model_update import learn
from forward_grid_mapper.core.sensor.density import CUT, hit_parameter, hit_probability
from forward_grid_mapper.core.sensor.forward_model import ForwardModel, expectations, log_likelihood
from forward_grid_mapper.core.sensor.surface_normals import SurfaceNormals
from samples import random_readings

GRID = Grid(0.1, 3, -4, 4, 3)


def random_model(rng: np.random.Generator) -> ModelParameters:
    return ModelParameters(
        p_hit=rng.uniform(0.05, 0.98),
        p_rand=rng.uniform(0.01, 0.4),
        p_lost=rng.choice([0.0, rng.uniform(0, 0.4)]),
        sigma=rng.uniform(0.03, 0.3),
    )


@pytest.mark.parametrize('seed', range(30))
def test_log_likelihood_is_that_of_all_correspondences(seed: int) -> None:
    rng = np.random.default_rng(seed)
    readings, model = random_readings(rng, GRID, 12), random_model(rng)
    occupied = (rng.random(GRID.shape) < rng.uniform(0, 0.8)).astype(np.int8)
    expected = naive.log_likelihood(readings, GRID, occupied, model)
    assert log_likelihood(readings, GRID, occupied, model) == pytest.approx(expected, abs=1e-9)


def random_normals(rng: np.random.Generator, grid: Grid, angle: float) -> SurfaceNormals:
    """Normals of half of the cells, in random directions."""
    known, turn = rng.random(grid.shape) < 0.5, rng.uniform(0, math.pi, grid.size)
    before = np.zeros((grid.height, grid.width + 1), np.int32)
    before[:, 1:] = np.cumsum(known, axis=1)
    x, y = np.cos(turn).astype(np.float32), np.sin(turn).astype(np.float32)
    return SurfaceNormals(known.ravel().astype(np.uint8), x, y, before, math.cos(angle) ** 2)


@pytest.mark.parametrize('first', range(0, 30, 5))
def test_log_likelihood_with_normals_omits_surfaces_that_return_no_echo(first: int) -> None:
    passed = 0
    for seed in range(first, first + 5):
        rng = np.random.default_rng(400 + seed)
        readings, model = (
            random_readings(rng, GRID, 80),
            dataclasses.replace(random_model(rng), max_incidence_angle=0.6, sigma=0.05),
        )
        readings.sigma[:] *= 0.3
        normals = random_normals(rng, GRID, model.max_incidence_angle)
        occupied = (rng.random(GRID.shape) < 0.7).astype(np.int8)
        actual = expectations(readings, GRID, occupied, model, normals)
        for t in range(len(readings)):
            met = sorted(naive.obstacles(readings, t, GRID, occupied, model, normals))
            sigma = naive.sigma_of(readings, t, GRID, model)
            terms = naive.causes(readings.z[t], readings.z_max[t], sigma, met, model)
            assert actual.log_likelihood[t] == pytest.approx(math.log(sum(terms)), abs=1e-8)
            assert actual.random[t] == pytest.approx(terms[0] / sum(terms), abs=1e-8)
            assert actual.obstacles[t] == len(met)
            passed += len(naive.obstacles(readings, t, GRID, occupied, model)) - len(met)
        expected = naive.log_likelihood(readings, GRID, occupied, model, normals)
        assert log_likelihood(readings, GRID, occupied, model, normals) == pytest.approx(expected, abs=1e-6)
    assert passed > 0


def test_at_another_model_the_omitted_surfaces_stay_the_same() -> None:
    rng = np.random.default_rng(9)
    readings = random_readings(rng, GRID, 200)
    readings.sigma[:] = 0
    model = ModelParameters(sigma=0.06, max_incidence_angle=0.6, p_lost=0.0)
    forward = ForwardModel(readings, GRID, model, random_normals(rng, GRID, 0.6))
    occupied = (rng.random(GRID.shape) < 0.7).astype(np.int8)
    wider = dataclasses.replace(model, sigma=0.3)
    # if every obstacle is as far as the reading, the number of obstacles depends only on the reach
    plain = ForwardModel(readings, GRID, wider).expectations(occupied).obstacles
    fresh = ForwardModel(readings, GRID, wider, forward.normals).expectations(occupied).obstacles
    kept = forward.at(wider).expectations(occupied).obstacles
    before = ForwardModel(readings, GRID, model).expectations(occupied).obstacles
    passed = before - forward.expectations(occupied).obstacles
    assert passed.any() and np.array_equal(plain - kept, passed)
    assert (plain - fresh <= passed).all() and not np.array_equal(fresh, kept)
    assert forward.at(model).log_likelihood(occupied) == forward.log_likelihood(occupied)


@pytest.mark.parametrize('seed', range(10))
def test_expectations_are_the_share_of_each_cause(seed: int) -> None:
    rng = np.random.default_rng(100 + seed)
    readings, model = random_readings(rng, GRID, 15), random_model(rng)
    occupied = (rng.random(GRID.shape) < 0.5).astype(np.int8)
    e = expectations(readings, GRID, occupied, model)
    assert e.random + e.lost + e.no_echo + e.hit == pytest.approx(1.0, abs=1e-12)
    for t in range(len(readings)):
        met = sorted(naive.obstacles(readings, t, GRID, occupied, model))
        terms = naive.causes(readings.z[t], readings.z_max[t], naive.sigma_of(readings, t, GRID, model), met, model)
        reading_state = np.array(terms) / sum(terms)
        assert [e.random[t], e.lost[t], e.no_echo[t]] == pytest.approx(reading_state[:3], abs=1e-10)
        assert e.rank[t] == pytest.approx(sum((k + 1) * s for k, s in enumerate(reading_state[3:])), abs=1e-9)
        errors = sum(s * (readings.z[t] - d) ** 2 for s, d in zip(reading_state[3:], met, strict=True))
        assert e.squared_error[t] == pytest.approx(errors, abs=1e-10)
        assert e.obstacles[t] == len(met)


@pytest.mark.parametrize('seed', range(10))
def test_sum_over_obstacles_equals_the_sum_over_all_causes(seed: int) -> None:
    rng = np.random.default_rng(200 + seed)
    model = random_model(rng)
    for met in (rng.uniform(0, 2, n).tolist() for n in range(9)):
        z, sigma = rng.uniform(0, 2), rng.uniform(0.05, 0.5)
        enumerated = sum(naive.causes(z, 2.0, sigma, met, model))
        assert naive.likelihood(z, 2.0, sigma, met, model) == pytest.approx(enumerated, rel=1e-12)


@pytest.mark.parametrize('seed', range(6))
def test_likelihood_of_edge_case_readings_is_that_of_their_cells(seed: int) -> None:
    rng = np.random.default_rng(300 + seed)
    grid = Grid(0.1, -7, 2, 13, 11)
    readings, model = naive.awkward_readings(rng, grid, 60), random_model(rng)
    occupied = (rng.random(grid.shape) < 0.2).astype(np.int8)
    actual = expectations(readings, grid, occupied, model).log_likelihood
    for t in range(len(readings)):
        z, z_max, sigma = readings.z[t], readings.z_max[t], naive.sigma_of(readings, t, grid, model)
        away = naive.cells_of(readings, t, grid, model, 1e-9)
        ties = [abs(abs(z - d) - CUT * sigma) < 1e-9 for d in [*away.values(), z_max]]
        # without readings where rounding decides which cells belong to the cone or are within the noise
        if not any(ties) and set(away) == set(naive.cells_of(readings, t, grid, model, -1e-9)):
            met = [d for c, d in away.items() if occupied.ravel()[c]]
            assert actual[t] == pytest.approx(math.log(naive.likelihood(z, z_max, sigma, met, model)), abs=1e-9)


def test_cone_with_thousands_of_obstacles_is_followed_by_one_with_few() -> None:
    grid, rng = Grid(0.02, 0, 0, 100, 100), np.random.default_rng(3)
    readings = random_readings(rng, grid, 3)
    readings.x[:], readings.y[:], readings.yaw[:], readings.half_angle[:] = 1.003, 1.003, 0.3, [0.1, 1.2, 0.1]
    readings.z[:], readings.z_max[:] = [0.3, 0.95, 0.5], 4.0
    occupied, model = (rng.random(grid.shape) < 0.9).astype(np.int8), ModelParameters(p_hit=0.01)
    actual = expectations(readings, grid, occupied, model)
    assert actual.obstacles[1] > 1024 > max(actual.obstacles[0], actual.obstacles[2])
    # each pattern of thousands of obstacles cannot be enumerated; the sum over the causes can
    for t, (z, z_max) in enumerate(zip(readings.z, readings.z_max, strict=True)):
        met, sigma = naive.obstacles(readings, t, grid, occupied, model), naive.sigma_of(readings, t, grid, model)
        expected = naive.likelihood(z, z_max, sigma, met, naive.of_cells(model, grid))
        assert actual.log_likelihood[t] == pytest.approx(math.log(expected), abs=1e-9)


def test_p_lost_of_zero_is_the_papers_model() -> None:
    rng = np.random.default_rng(7)
    readings = random_readings(rng, GRID, 20)
    occupied = (rng.random(GRID.shape) < 0.3).astype(np.int8)
    assert (expectations(readings, GRID, occupied, ModelParameters(p_lost=0.0)).lost == 0).all()


def test_only_readings_without_echo_have_the_cause_lost() -> None:
    readings = random_readings(np.random.default_rng(7), GRID, 40)
    readings.z[:10] = readings.z_max[:10] - 0.01
    readings.z[10:20] = readings.z_max[10:20]
    lost = expectations(readings, GRID, np.zeros(GRID.shape, np.int8), ModelParameters()).lost
    assert np.array_equal(lost > 0, ~readings.echo)


def sample(rng: np.random.Generator, readings, grid, occupied, model):
    """Draw the ranges of `readings` from the model itself."""
    z = []
    for t in range(len(readings)):
        met = sorted(naive.obstacles(dataclasses.replace(readings, z=readings.z_max), t, grid, occupied, model))
        u = rng.random()
        if u < model.p_rand:
            z.append(rng.uniform(0, readings.z_max[t]))
            continue
        hit = [d for d in met if rng.random() < model.p_hit] if u >= model.p_rand + model.p_lost else []
        z.append(min(rng.normal(hit[0], model.sigma), readings.z_max[t]) if hit else readings.z_max[t])
    return dataclasses.replace(readings, z=np.abs(z))


@pytest.mark.slow
def test_learning_on_the_true_map_finds_the_true_parameters() -> None:
    rng = np.random.default_rng(5)
    grid = Grid(0.1, 0, 0, 30, 30)
    truth = ModelParameters(p_hit=0.4, p_rand=0.1, p_lost=0.2, sigma=0.07)
    occupied = (rng.random(grid.shape) < 0.03).astype(np.int8)
    readings = random_readings(rng, grid, 1500, z_max=3.5)
    readings.half_angle[:] = 0.2
    readings.sigma[:] = 0
    readings = sample(rng, readings, grid, occupied, truth)
    model = ModelParameters(p_hit=0.8, p_rand=0.03, p_lost=0.05, sigma=0.12)
    for _ in range(40):
        model = learn(ForwardModel(readings, grid, model), occupied)
    assert model.p_hit == pytest.approx(truth.p_hit, abs=0.05)
    assert model.p_rand == pytest.approx(truth.p_rand, abs=0.03)
    assert model.p_lost == pytest.approx(truth.p_lost, abs=0.05)
    assert model.sigma == pytest.approx(truth.sigma, abs=0.01)


def test_learning_never_lowers_the_likelihood() -> None:
    rng = np.random.default_rng(6)
    grid = Grid(0.1, 0, 0, 15, 15)
    readings = random_readings(rng, grid, 200)
    readings.sigma[:] = 0
    occupied = (rng.random(grid.shape) < 0.1).astype(np.int8)
    model = ModelParameters(p_hit=0.7, p_rand=0.2, p_lost=0.1, sigma=0.3)
    before = -math.inf
    for _ in range(10):
        now = log_likelihood(readings, grid, occupied, model)
        assert now >= before - 1e-9
        before, model = now, learn(ForwardModel(readings, grid, model), occupied)


@pytest.mark.parametrize('parts', [2, 4])
def test_likelihood_of_a_wall_does_not_depend_on_the_cell_size(parts: int) -> None:
    model = ModelParameters(p_hit=0.6, p_rand=0.1, p_lost=0.1, sigma=0.1, surface_offset=0.0)
    actual = []
    for k in (1, parts):
        grid = Grid(0.1 / k, 0, 0, 20 * k, 20 * k)
        wall = np.zeros(grid.shape, np.uint8)
        # a line about 1.05 m from the sensor
        wall[10 * k + k // 2] = 1
        readings = Readings.from_columns(
            x=1.0, y=0.0, yaw=math.pi / 2, z=[1.05, 0.5, 2.0], z_max=2.0, half_angle=0.3, stamp=np.arange(3)
        )
        actual.append(expectations(readings, grid, wall, model).log_likelihood)
    assert actual[1] == pytest.approx(actual[0], abs=0.1)


@pytest.mark.parametrize('resolution', [0.01, 0.1, 0.3])
def test_p_hit_is_converted_to_the_cell_size_and_back(resolution: float) -> None:
    for p_hit in (0.01, 0.3, 0.7, 0.9):
        model = ModelParameters(p_hit=p_hit)
        of_cell = hit_probability(model, resolution)
        assert 0 < of_cell <= MOST_HIT
        assert (1 - of_cell) ** (0.1 / resolution) == pytest.approx(1 - p_hit) or of_cell == MOST_HIT
        if of_cell < MOST_HIT:
            assert hit_parameter(of_cell, resolution) == pytest.approx(p_hit)
    assert hit_probability(ModelParameters(p_hit=0.7), 0.1) == pytest.approx(0.7)
