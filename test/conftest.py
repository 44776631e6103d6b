"""What the tests share."""

from __future__ import annotations

import sys
from pathlib import Path

import numpy as np
import pytest

from forward_grid_mapper.core.grid import Grid
from forward_grid_mapper.core.readings import Readings

sys.path.insert(0, str(Path(__file__).parent))

SHARED = Path(__file__).resolve().parents[2] / 'shared'


@pytest.fixture
def shared() -> Path:
    """The folder of real recordings beside the checkout."""
    if not (SHARED / 'data').is_dir():
        pytest.skip(f'the real recordings are not at {SHARED}')
    return SHARED


def random_readings(rng: np.random.Generator, grid: Grid, count: int, z_max: float = 0.0) -> Readings:
    """Readings from random places of the grid in random directions, one in four without echo."""
    left, right, bottom, top = grid.extent
    z_max = z_max or 1.2 * max(right - left, top - bottom)
    z = rng.uniform(0.05, 1.0, count) * z_max
    return Readings.from_columns(
        names=('sonar',),
        x=rng.uniform(left, right, count),
        y=rng.uniform(bottom, top, count),
        yaw=rng.uniform(-7, 7, count),
        z=np.where(rng.random(count) < 0.25, z_max, z),
        z_max=z_max,
        half_angle=rng.uniform(0.03, 1.2, count),
        sigma=np.where(rng.random(count) < 0.5, 0.0, rng.uniform(0.02, 0.2, count)),
        stamp=np.arange(count),
    )
