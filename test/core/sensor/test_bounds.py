"""Bounds of the evidence from one reading, compared with the evidence of readings on many maps."""

from __future__ import annotations

import dataclasses
import math

import numpy as np
import pytest

from forward_grid_mapper.core.common.grid import Grid
from forward_grid_mapper.core.common.parameter_groups import ModelParameters
from forward_grid_mapper.core.common.parameters import Parameters
from forward_grid_mapper.core.common.readings import Readings
from forward_grid_mapper.core.evidence.evidence import Evidence
from forward_grid_mapper.core.sensor.bounds import reading_bounds
from samples import random_readings

GRID = Grid(0.1, 0, 0, 30, 20)
MODELS = [
    ModelParameters(),
    ModelParameters(p_hit=0.9, p_rand=0.05, p_lost=0.0, likelihood_exponent=1.0),
    ModelParameters(p_hit=0.3, p_rand=0.3, p_lost=0.6, sigma=0.2, likelihood_exponent=0.2),
]


def test_with_default_parameters_one_reading_gives_a_few_nats_at_most() -> None:
    bounds = reading_bounds(Parameters().model, 0.1, 5.0)
    assert 1.0 < bounds.echo_for < 3.0
    assert -3.0 < bounds.echo_against_wall < bounds.echo_against_cell < -0.5
    # A smooth wall returns no echo for several readings for each one with an echo. A door that only such readings show
    # must still open.
    assert bounds.echo_for > -5 * bounds.silence_against_wall
    assert -1.0 < bounds.silence_against_wall < bounds.silence_against_cell < -0.05
    # three echoes outweigh the costs of the two ends of a wall, two echoes do not
    assert 2 * bounds.echo_for < 2 * Parameters().search.end_cost < 3 * bounds.echo_for


@pytest.mark.parametrize('model', MODELS)
@pytest.mark.parametrize('seed', range(10))
def test_evidence_of_a_reading_is_within_the_bounds_on_any_map(model: ModelParameters, seed: int) -> None:
    rng = np.random.default_rng(seed)
    readings = dataclasses.replace(random_readings(rng, GRID, 1, z_max=2.0), sigma=np.zeros(1))
    if seed % 2:
        readings.z[:] = readings.z_max
    bounds = reading_bounds(model, GRID.resolution, float(readings.z_max[0]))
    for filled in (0.0, 0.02, 0.3):
        evidence = Evidence(GRID, model, start=(rng.random(GRID.shape) < filled).astype(np.uint8))
        evidence.extend(readings)
        values = evidence.of_occupancy()
        echo = bool(readings.echo[0])
        assert values.max() <= (bounds.echo_for if echo else 0.0) + 1e-5
        assert values.min() >= (bounds.echo_against_cell if echo else bounds.silence_against_cell) - 1e-5


@pytest.mark.parametrize('model', MODELS)
def test_bounds_are_reached(model: ModelParameters) -> None:
    model = dataclasses.replace(model, surface_offset=0.0, max_incidence_angle=math.pi / 2)
    bounds = reading_bounds(model, GRID.resolution, 2.9)
    cell = 10 * GRID.width + 15
    far = 10 * GRID.width + 25

    def evidence_of(z: float, *occupied: int) -> float:
        start = np.zeros(GRID.shape, np.uint8)
        start.ravel()[list(occupied)] = 1
        evidence = Evidence(GRID, model, start=start)
        evidence.extend(
            Readings.from_columns(x=0.05, y=1.05, yaw=0.0, z=[z], z_max=2.9, half_angle=0.001, stamp=np.arange(1))
        )
        return float(evidence.of_occupancy()[cell])

    assert evidence_of(1.5) == pytest.approx(bounds.echo_for, abs=1e-3)
    assert evidence_of(2.9) == pytest.approx(bounds.silence_against_cell, abs=1e-3)
    # one occupied cell explains an echo at most as well as a whole wall does
    assert bounds.echo_against_cell <= evidence_of(2.5, far) < 0
