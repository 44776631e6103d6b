"""Compilation of all kernels before the first reading, so that nothing has to wait for it later.

The order is that in which they are needed: live map, online map, EM, and trajectories.
"""

from __future__ import annotations

import dataclasses
import math
from collections.abc import Callable

import numpy as np

from .common.parameters import Parameters
from .common.readings import Readings
from .evidence.evidence import Evidence
from .learning.sensor_health import sensor_health
from .mapping import Mapper
from .maps.cell_evidence import cell_evidence
from .maps.log_odds_map import LogOddsMap, map_grid
from .maps.map_set import MapSet
from .online_map import OnlineMap
from .trajectory.hidden_markov import smooth
from .trajectory.holding_out import held_out
from .trajectory.likelihood import scores
from .trajectory.scans import Scans
from .trajectory.walls import wall_votes
from .trajectory.windows import Odometry, cut


def _square_room() -> Readings:
    yaw = np.linspace(-math.pi, math.pi, 24, endpoint=False)
    z = 1.0 / np.maximum(np.abs(np.cos(yaw)), np.abs(np.sin(yaw)))
    return Readings.from_columns(('',), x=0.0, y=0.0, yaw=yaw, z=np.minimum(z, 1.4), z_max=1.4, half_angle=0.1)


def _flip_at_once(readings: Readings) -> None:
    # the search of such a small room makes no parallel updates
    parameters = Parameters()
    evidence = Evidence(map_grid(readings, parameters), parameters.model)
    evidence.extend(readings)
    evidence.flip(np.zeros(1, np.int64))


def warm_up_live_map() -> None:
    """Compile the kernels of the live map."""
    live = LogOddsMap(Parameters())
    live.add(_square_room())
    live.probability()


def warm_up_online_map() -> None:
    """Compile the kernels of the online map."""
    readings, online = _square_room(), OnlineMap(Parameters())
    # twice the same readings, then others so far away that the grid grows
    for moved in (0.0, 0.0, 40.0):
        online.add(dataclasses.replace(readings, x=readings.x + moved))
    online.maps()
    _flip_at_once(readings)


def warm_up_em() -> MapSet:
    """Compile the kernels of EM, of the steps after it, and of the page that is saved with the maps."""
    _flip_at_once(_square_room())
    maps = Mapper(Parameters()).run(_square_room())
    sensor_health(maps)
    cell_evidence(maps.readings, maps.grid, maps.ml, maps.parameters, maps.normals, (0.5, 0.5))
    return maps


def warm_up_trajectory() -> None:
    """Compile the kernels for trajectories, besides those of EM, on a drive of two metres."""
    room, steps = _square_room(), 20
    at, sensor = np.repeat(np.arange(steps), len(room)), np.tile(np.arange(len(room)), steps)
    readings = dataclasses.replace(
        room.select(sensor), x=np.asarray(0.1 * at, np.float64), stamp=at * 10**8, sensor=sensor.astype(np.int32)
    )
    path = np.zeros((steps, 3))
    path[:, 0] = 0.1 * np.arange(steps)
    windows = cut(readings, Odometry.of(np.arange(steps) * 10**8, path))
    scans = Scans(windows, Parameters(), np.zeros(1, np.uint8), held_out(len(windows)))
    wall_votes(windows, scans.held_out)
    # such a short drive has too few votes for a heading
    smooth(np.ones((2, 1, 4)), np.full((1, 4), 0.25), np.zeros(1), np.full(4, 0.25))
    around = scans.map(np.arange(len(windows)), windows.node[0], windows.node)
    assert around is not None
    scores(scans.scan[0], around, windows.node)


STEPS: dict[str, Callable[[], object]] = {
    'live map': warm_up_live_map,
    'online map': warm_up_online_map,
    'EM': warm_up_em,
    'trajectory': warm_up_trajectory,
}
"""The steps of the compilation, in this order."""


def warm_up() -> MapSet:
    """Map a square room in all ways, which calls all kernels with the types of real data."""
    warm_up_live_map()
    warm_up_online_map()
    warm_up_trajectory()
    return warm_up_em()
