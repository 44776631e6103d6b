"""Echoes of dynamic objects, compared with their twin in plain Python."""

from __future__ import annotations

import numpy as np
import pytest

import naive
from forward_grid_mapper.core.common.grid import Grid
from forward_grid_mapper.core.common.parameter_groups import ModelParameters
from forward_grid_mapper.core.maps.dynamic import dynamic_echoes
from forward_grid_mapper.core.sensor.forward_model import ForwardModel
from samples import random_readings

GRID = Grid(0.1, -3, 2, 30, 26)
MODEL = ModelParameters(sigma=0.06, surface_offset=0.3)


@pytest.mark.parametrize('seed', range(4))
def test_unexplained_echoes_are_counted_in_the_free_cells_in_which_they_end(seed: int) -> None:
    rng = np.random.default_rng(seed)
    readings = random_readings(rng, GRID, 60, z_max=2.0)
    # not on the lattice, so that rounding does not decide whether a cell is in a cone
    readings.x[:] += 0.00123
    readings.y[:] -= 0.00077
    unexplained, ml = rng.random(60) < 0.5, rng.choice(np.array([-1, 0, 1], np.int8), GRID.shape)
    expected = np.zeros(GRID.size)
    for t in np.flatnonzero(unexplained & readings.echo):
        for c, d in naive.cells_of(readings, t, GRID, MODEL).items():
            expected[c] += abs(d - readings.z[t]) <= naive.sigma_of(readings, t, GRID, MODEL)
    expected[ml.ravel() != 0] = 0
    found = dynamic_echoes(ForwardModel(readings, GRID, MODEL), unexplained, ml)
    assert np.array_equal(found.ravel(), expected)
    assert expected.max() > 1
