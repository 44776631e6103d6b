"""A made-up `MapSet` for the tests of this folder."""

from __future__ import annotations

from typing import Any

import numpy as np

from forward_grid_mapper.core.common.grid import Grid
from forward_grid_mapper.core.common.parameters import Parameters
from forward_grid_mapper.core.common.readings import Readings
from forward_grid_mapper.core.maps.map_set import MapSet


def made_maps(
    width: int = 40,
    height: int = 30,
    readings: int = 60,
    settings: dict[str, Any] | None = None,
    statistics: dict[str, Any] | None = None,
) -> MapSet:
    """Return a room with walls all round, in a grid whose outer cells no reading observed."""
    random = np.random.default_rng(1)
    ml = np.full((height, width), -1, np.int8)
    ml[2:-2, 2:-2] = 1
    ml[3:-3, 3:-3] = 0
    unknown = ml == -1
    columns = Readings.from_columns(
        ('sonar_left', 'sonar_right'),
        x=random.uniform(0, 1, readings),
        y=random.uniform(0, 1, readings),
        yaw=random.uniform(-3, 3, readings),
        z=np.where(np.arange(readings) % 4 == 0, 3.0, random.uniform(0.3, 2, readings)),
        z_max=np.full(readings, 3.0),
        half_angle=np.full(readings, 0.13),
        sensor=np.arange(readings) % 2,
    )
    return MapSet(
        grid=Grid(0.1, -width // 2, -height // 2, width, height),
        live=np.where(unknown, np.nan, random.uniform(0, 1, ml.shape)).astype(np.float32),
        ml=ml,
        uncertainty=np.where(unknown, np.nan, 0.1 + 0.8 * ml).astype(np.float32),
        readings=columns,
        unexplained=np.arange(readings) % 10 == 0,
        log_likelihood=-123.5,
        objective=-150.25,
        parameters=Parameters().varied(settings or {}),
        statistics=statistics or {},
    )
