"""A row of cells with three obstacles, and readings along it drawn from the model."""

from __future__ import annotations

import numpy as np

from forward_grid_mapper.core.common.grid import Grid
from forward_grid_mapper.core.common.parameter_groups import ModelParameters
from forward_grid_mapper.core.common.readings import Readings

LINE = Grid(0.1, 0, 0, 62, 1)
OBSTACLES = (20, 35, 50)
Z_MAX = 6.0
TRUTH = ModelParameters(p_hit=0.5, p_rand=0.1, p_lost=0.15, sigma=0.08)


def line_map() -> np.ndarray:
    """The map of `LINE` with its obstacles."""
    made = np.zeros(LINE.shape, np.int8)
    made[0, list(OBSTACLES)] = 1
    return made


def drawn(rng: np.random.Generator, count: int, model: ModelParameters = TRUTH, repeat: int = 1) -> Readings:
    """Readings of a sensor that looks along the line; each is repeated `repeat` times."""
    distance = 0.05 + 0.1 * (np.array([*OBSTACLES, 0]) - model.surface_offset)
    distance[-1] = Z_MAX
    answers = np.c_[rng.random((count, len(OBSTACLES))) < model.p_hit, np.ones(count, bool)]
    first = answers.argmax(1)
    z = np.minimum(distance[first] + model.sigma * rng.standard_normal(count), Z_MAX)
    cause = rng.random(count)
    z = np.where((first == len(OBSTACLES)) | (cause < model.p_lost), Z_MAX, z)
    z = np.where(cause > 1 - model.p_rand, rng.uniform(0, Z_MAX, count), z)
    z = np.repeat(z, repeat)
    return Readings.from_columns(
        ('sonar',), x=0.0, y=0.05, yaw=0.0, z=z, z_max=Z_MAX, half_angle=0.005, stamp=np.arange(len(z))
    )
