"""Standard errors of learned parameters: the share of true values within them is as stated."""

from __future__ import annotations

import dataclasses
import math

import numpy as np
import pytest
from line_world import LINE, TRUTH, drawn, line_map

from forward_grid_mapper.core.common.grid import Grid
from forward_grid_mapper.core.common.parameter_groups import ModelParameters
from forward_grid_mapper.core.common.parameters import find
from forward_grid_mapper.core.common.readings import Readings
from forward_grid_mapper.core.joint_learning import settle
from forward_grid_mapper.core.learning.model_update import learn
from forward_grid_mapper.core.learning.standard_errors import (
    LEARNED,
    ParameterEstimate,
    estimating_functions,
    parameter_estimates,
)
from forward_grid_mapper.core.sensor.forward_model import ForwardModel, expectations

START = ModelParameters()


def learned(readings: Readings, start: ModelParameters = START) -> dict[str, ParameterEstimate]:
    forward = ForwardModel(readings, LINE, start)
    return parameter_estimates(forward.at(settle(forward, line_map())), line_map())


def test_intervals_contain_the_true_values_in_95_per_cent() -> None:
    rng = np.random.default_rng(3)
    drives, within, distances = 120, dict.fromkeys(LEARNED, 0), {name: [] for name in LEARNED}
    for _ in range(drives):
        for name, found in learned(drawn(rng, 600)).items():
            truth = getattr(TRUTH, name)
            within[name] += found.low <= truth <= found.high
            distances[name].append((found.value - truth) / found.error)
    for name in LEARNED:
        assert within[name] >= 0.89 * drives, within
        # they are not larger than needed either
        assert 0.7 < np.std(distances[name]) < 1.3, name
        assert abs(np.mean(distances[name])) < 0.35, name


@pytest.mark.parametrize('name', ['p_hit', 'p_rand', 'p_lost', 'sigma'])
def test_estimating_functions_are_derivatives_of_the_log_likelihood(name: str) -> None:
    readings = drawn(np.random.default_rng(4), 300)
    model = dataclasses.replace(TRUTH, p_hit=0.6)
    step = 1e-6
    high, low = (
        expectations(
            readings, LINE, line_map(), dataclasses.replace(model, **{name: getattr(model, name) + d})
        ).log_likelihood
        for d in (step, -step)
    )
    expected = (high - low) / (2 * step)
    # without an echo, the normal density around max range gives no evidence about sigma
    counts = readings.echo & (readings.z < 5.5) if name == 'sigma' else np.ones(len(readings), bool)
    found = estimating_functions(ForwardModel(readings, LINE, model), line_map())[name]
    np.testing.assert_allclose(found[counts], expected[counts], rtol=1e-4, atol=1e-4)


def test_estimating_functions_vanish_at_the_learned_values() -> None:
    readings = drawn(np.random.default_rng(5), 2000)
    model = settle(ForwardModel(readings, LINE, START), line_map())
    for name, found in parameter_estimates(ForwardModel(readings, LINE, model), line_map()).items():
        actual = estimating_functions(ForwardModel(readings, LINE, model), line_map())[name]
        total, spread = actual.sum(), actual.std() * math.sqrt(len(readings))
        assert abs(total) < 0.1 * spread, (name, found)


def test_repeated_readings_do_not_reduce_the_error() -> None:
    readings = drawn(np.random.default_rng(6), 600, repeat=1)
    repeated = drawn(np.random.default_rng(6), 600, repeat=16)
    for name in LEARNED:
        once, often = learned(readings)[name].error, learned(repeated)[name].error
        assert 0.6 * once < often < 1.7 * once, name


def test_error_does_not_depend_on_the_order_of_readings() -> None:
    rng = np.random.default_rng(7)
    readings = drawn(rng, 500, repeat=4)
    shuffled = readings.select(rng.permutation(len(readings)))
    for name in LEARNED:
        assert learned(shuffled)[name].error == pytest.approx(learned(readings)[name].error, rel=1e-6)


def test_more_readings_reduce_the_error() -> None:
    rng = np.random.default_rng(8)
    few, many = learned(drawn(rng, 500)), learned(drawn(rng, 8000))
    for name in LEARNED:
        assert 2.5 < few[name].error / many[name].error < 6.5, name
        assert few[name].readings < many[name].readings


def test_values_that_cannot_be_learned_have_a_reason() -> None:
    rng = np.random.default_rng(9)
    readings = drawn(rng, 500, dataclasses.replace(TRUTH, p_lost=0.0, sigma=0.02))
    found = learned(readings, dataclasses.replace(START, p_lost=0.0))
    assert 'without lost echoes' in found['p_lost'].bound
    assert 'half a cell' in found['sigma'].bound
    assert math.isnan(found['sigma'].error) and math.isfinite(found['p_hit'].error)
    silent = dataclasses.replace(readings, z=readings.z_max.copy())
    free = np.zeros(LINE.shape, np.int8)
    nothing = parameter_estimates(ForwardModel(silent, LINE, START), free)
    assert nothing['p_hit'].bound == nothing['sigma'].bound == 'no reading informs it'
    stated = dataclasses.replace(readings, sigma=np.full(len(readings), 0.05))
    assert parameter_estimates(ForwardModel(stated, LINE, START), line_map())['sigma'].readings == 0


def test_p_hit_of_a_large_cell_that_every_reading_hears_has_no_error() -> None:
    rng = np.random.default_rng(10)
    cells = Grid(0.5, 0, 0, 12, 1)
    wall = np.zeros(cells.shape, np.int8)
    wall[0, 5] = 1
    z = 2.35 + 0.1 * rng.standard_normal(400)
    readings = Readings.from_columns(
        ('sonar',), x=0.25, y=0.25, yaw=0.0, z=z, z_max=5.0, half_angle=0.005, stamp=np.arange(400)
    )
    forward = ForwardModel(readings, cells, dataclasses.replace(START, p_rand=0.05, p_lost=0.0, sigma=0.3))
    found = parameter_estimates(forward.at(settle(forward, wall)), wall)['p_hit']
    assert math.isnan(found.error) and found.bound == 'that of a cell lies at its largest value, 0.98'


def test_learned_values_stay_in_the_range_of_parameter_files() -> None:
    silent = Readings.from_columns(
        ('sonar',), x=0.0, y=0.05, yaw=0.0, z=[6.0] * 9, z_max=6.0, half_angle=0.005, stamp=np.arange(9)
    )
    model = dataclasses.replace(START, p_rand=1e-4, p_lost=0.9)
    for _ in range(50):
        model = learn(ForwardModel(silent, LINE, model), np.zeros(LINE.shape, np.int8))
    assert model.p_rand >= find('p_rand').low and model.p_rand + model.p_lost == pytest.approx(0.9)
