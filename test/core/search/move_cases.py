"""Evidence of random readings on a small map, and the gains of moves by plain Python."""

from __future__ import annotations

import math

import numpy as np
import pytest
from hypothesis import strategies as st

import naive
from forward_grid_mapper.core.common.grid import Grid
from forward_grid_mapper.core.common.parameter_groups import ModelParameters
from forward_grid_mapper.core.common.readings import Readings
from forward_grid_mapper.core.evidence.evidence import Evidence
from forward_grid_mapper.core.evidence.fixed_point import QUANTUM
from forward_grid_mapper.core.search.prior import Prior
from forward_grid_mapper.core.sensor.forward_model import log_likelihood
from samples import plain_model, random_readings

GRID = Grid(0.1, 0, 0, 12, 9)
seeds = st.integers(0, 2**32 - 1)


def random_case(
    seed: int, count: int = 40, memory: float = math.inf, filled: float = 0.15
) -> tuple[Evidence, Readings]:
    rng = np.random.default_rng(seed)
    readings = (naive.awkward_readings, random_readings)[seed % 2](rng, GRID, count)
    # not on the lattice, so that rounding does not decide on which side of the cut a cell is
    readings.x[:] += 0.001234
    readings.y[:] -= 0.000777
    readings.z[:] = np.minimum(readings.z + 0.000345, readings.z_max)
    readings.sigma[:] *= 1.0017
    model = plain_model(
        p_hit=rng.choice([0.05, 0.6, 0.98]),
        p_rand=rng.choice([0.001, 0.1, 0.4]),
        p_lost=rng.choice([0.0, 0.25]),
        sigma=rng.choice([0.01, 0.06]),
    )
    evidence = Evidence(GRID, model, memory=memory, start=rng.random(GRID.shape) < filled)
    evidence.extend(readings)
    return evidence, readings


def model_of(evidence: Evidence) -> ModelParameters:
    return evidence.model


def prior_of(name: str) -> Prior:
    """A prior in sixteenths of a nat, so that sums are exact in any order."""
    if name in ('none', 'less'):
        return Prior(np.full(GRID.size, {'none': 0.0, 'less': -0.5}[name]), np.zeros(256))
    rng = np.random.default_rng(256)
    return Prior(rng.integers(-30, -5, GRID.size) / 16, rng.integers(-24, 16, 256) / 16)


PRIORS = pytest.mark.parametrize('prior', [prior_of('less'), prior_of('shapes')], ids=['independent', 'shapes'])


def height(evidence: Evidence, readings: Readings, prior: Prior) -> float:
    shaped = evidence.state.maps.occupied.reshape(GRID.shape)
    return log_likelihood(readings, GRID, shaped, model_of(evidence)) + naive.log_prior(prior, shaped, GRID.shape)


def gain(evidence: Evidence, prior: Prior, c: int) -> float:
    maps = evidence.state.maps
    return int(maps.evidence[c]) * QUANTUM + naive.prior_gain(prior, maps.occupied, c, GRID.shape)


def neighbours(c: int) -> list[int]:
    row, column = divmod(c, GRID.width)
    return [
        y * GRID.width + x
        for y in range(max(row - 1, 0), min(row + 2, GRID.height))
        for x in range(max(column - 1, 0), min(column + 2, GRID.width))
        if (y, x) != (row, column)
    ]
