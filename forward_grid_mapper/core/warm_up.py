"""Compilation of every kernel before the first reading comes, so that no callback has to wait for it."""

from __future__ import annotations

import dataclasses
import math

import numpy as np

from .common.parameters import Parameters
from .common.readings import Readings
from .learning.sensor_health import sensor_health
from .mapping import Mapper
from .maps.map_set import MapSet
from .online_map import OnlineMap


def warm_up() -> MapSet:
    """Map a square room, which calls every kernel with the types that real work has."""
    yaw = np.linspace(-math.pi, math.pi, 24, endpoint=False)
    z = 1.0 / np.maximum(np.abs(np.cos(yaw)), np.abs(np.sin(yaw)))
    readings = Readings.from_columns(('',), x=0.0, y=0.0, yaw=yaw, z=np.minimum(z, 1.4), z_max=1.4, half_angle=0.1)
    online = OnlineMap(Parameters())
    # twice the same, then a place so far away that the grid grows
    for moved in (0.0, 0.0, 40.0):
        online.add(dataclasses.replace(readings, x=readings.x + moved))
    maps = Mapper(Parameters()).run(readings)
    sensor_health(maps)
    return maps
