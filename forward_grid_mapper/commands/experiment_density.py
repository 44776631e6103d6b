"""The density of a range given a map with two obstacles in the cone and one beside it, as in the paper's Fig. 3."""

from __future__ import annotations

import numpy as np

from ..core.common.grid import Grid
from ..core.common.parameters import Parameters
from ..core.common.readings import Readings
from ..core.sensor.density import hit_probability
from ..core.sensor.forward_model import expectations
from ..files.panels import Curve, FigureTile

NEAR, FAR, BESIDE = (1.5, 0.05), (2.6, -0.1), (2.0, 1.1)
"""Positions of the obstacles in the sensor's frame, metres: two in the cone, one beside it."""

MAX_RANGE = 4.0
HALF_ANGLE = np.radians(12.0)
STEP = 0.005


def density_of_ranges(parameters: Parameters) -> tuple[Curve, FigureTile]:
    """Return p(z | m) for all ranges up to the largest, and the map with the cone of one reading.

    The likelihood is computed by the mapper's function, for each range.
    """
    resolution = parameters.grid.resolution
    width, height = (int(np.ceil(length / resolution)) for length in (MAX_RANGE + 1.0, 2.8))
    grid = Grid(resolution, -int(np.ceil(0.5 / resolution)), -height // 2, width, height)
    occupied = np.zeros(grid.shape, np.int8)
    xy = np.array([NEAR, FAR, BESIDE])
    occupied[grid.cells_of(xy[:, 0], xy[:, 1])] = 1
    z = np.arange(STEP, MAX_RANGE + STEP / 2, STEP)
    same = dict.fromkeys(('x', 'y', 'yaw'), np.zeros(len(z)))
    readings = Readings.from_columns(('sonar',), z=z, z_max=MAX_RANGE, half_angle=HALF_ANGLE, **same)
    found = expectations(readings, grid, occupied, parameters.model)
    cone = readings.select(slice(len(z) - 1, None))
    return Curve(z, np.exp(found.log_likelihood)), FigureTile('the map and the cone', grid, occupied, cone)


def density_table(curve: Curve, parameters: Parameters) -> str:
    """Return the peaks of the curve, and their causes."""
    model, z, p = parameters.model, curve.x, curve.y
    hit = hit_probability(model, parameters.grid.resolution)
    weight = 1.0 - model.p_rand - model.p_lost
    lines = [
        "The density of a range, given two obstacles in the cone and one beside it (the paper's Fig. 3)",
        '',
        f'{"":28s}{"at, m":>8s}{"density, 1/m":>14s}{"weight":>9s}',
    ]
    between, behind = (NEAR[0] + FAR[0]) / 2, (FAR[0] + MAX_RANGE) / 2
    parts = (
        ('first obstacle', 0.0, between, weight * hit),
        ('second obstacle', between, behind, weight * (1.0 - hit) * hit),
        ('nothing hit', behind, MAX_RANGE + STEP, weight * (1.0 - hit) ** 2),
    )
    for name, low, high, share in parts:
        k = np.flatnonzero((z >= low) & (z < high))
        at = k[int(p[k].argmax())]
        lines.append(f'{name:28s}{z[at]:8.2f}{p[at]:14.3f}{share:9.3f}')
    if model.p_lost:
        # at the same range as 'nothing hit'
        lines.append(f'{"echo lost":28s}{MAX_RANGE:8.2f}{p[-1]:14.3f}{model.p_lost:9.3f}')
    lines.append(f'{"chance, everywhere":28s}{"":8s}{p.min():14.3f}{model.p_rand:9.3f}')
    lines.append('')
    lines.append(f'The obstacle beside the cone, at {BESIDE[0]:.1f} m, has no effect.')
    return '\n'.join(lines)
