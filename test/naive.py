"""Plain-Python twins of the kernels: slow, obvious, and written from the definitions alone."""

from __future__ import annotations

import itertools
import math

import numpy as np

from forward_grid_mapper.core.grid import Grid
from forward_grid_mapper.core.parameters import ModelParameters
from forward_grid_mapper.core.readings import Readings


def axis_crosses(x: float, y: float, yaw: float, length: float, left: float, bottom: float, size: float) -> bool:
    """Whether the segment from (x, y) touches the square whose lower left corner is (left, bottom)."""
    low, high = 0.0, length
    for start, step, edge in ((x, math.cos(yaw), left), (y, math.sin(yaw), bottom)):
        if abs(step) < 1e-12:
            if not edge <= start <= edge + size:
                return False
            continue
        a, b = sorted(((edge - start) / step, (edge + size - start) / step))
        low, high = max(low, a), min(high, b)
    return low <= high


def cell_distance(x: float, y: float, cx: float, cy: float, size: float, nearest: bool) -> float:
    dx, dy = cx - x, cy - y
    if nearest:
        dx, dy = max(abs(dx) - size / 2, 0.0), max(abs(dy) - size / 2, 0.0)
    return math.hypot(dx, dy)


def cone_cells(
    pose: tuple[float, float, float],
    half_angle: float,
    reach: float,
    grid: Grid,
    nearest: bool = False,
    slack: float = 0.0,
) -> dict[int, float]:
    """Cells of a cone and their distances in metres; `slack` widens it, to tell rounding from error."""
    x, y, yaw = pose
    cells = {}
    xs, ys = grid.centers()
    for row, cy in enumerate(ys):
        for column, cx in enumerate(xs):
            d = cell_distance(x, y, cx, cy, grid.resolution, nearest)
            if d > reach + slack:
                continue
            off_axis = abs(math.remainder(math.atan2(cy - y, cx - x) - yaw, 2 * math.pi))
            size = grid.resolution
            crossed = axis_crosses(x, y, yaw, reach, cx - size / 2 - slack, cy - size / 2 - slack, size + 2 * slack)
            if off_axis <= half_angle + slack or crossed:
                cells[row * grid.width + column] = d
    return cells


def normal(z: float, mean: float, sigma: float, cut: float) -> float:
    error = (z - mean) / sigma
    return math.exp(-0.5 * error * error) / (math.sqrt(2 * math.pi) * sigma) if abs(error) <= cut else 0.0


def causes(z: float, z_max: float, sigma: float, distances: list[float], model: ModelParameters) -> list[float]:
    """Density of the reading together with each cause: chance, lost echo, no obstacle, first obstacle, second, …

    Every pattern of obstacles that would return the echo and obstacles that would not is enumerated; the nearest that
    would return it explains the reading.
    """
    distances = sorted(distances)
    share = 1 - model.p_rand - model.p_lost
    out = [model.p_rand / z_max, model.p_lost * normal(z, z_max, sigma, model.cut)] + [0.0] * (len(distances) + 1)
    for pattern in itertools.product((True, False), repeat=len(distances)):
        p = share * math.prod(model.p_hit if answers else 1 - model.p_hit for answers in pattern)
        if any(pattern):
            k = pattern.index(True)
            out[3 + k] += p * normal(z, distances[k], sigma, model.cut)
        else:
            out[2] += p * normal(z, z_max, sigma, model.cut)
    return out


def sigma_of(readings: Readings, t: int, grid: Grid, model: ModelParameters) -> float:
    return max(readings.sigma[t] if readings.sigma[t] > 0 else model.sigma, grid.resolution / 2)


def obstacles(readings: Readings, t: int, grid: Grid, occupied: np.ndarray, model: ModelParameters) -> list[float]:
    """Distances of the occupied cells that reading t can meet."""
    sigma = sigma_of(readings, t, grid, model)
    reach = readings.z[t] + model.cut * sigma
    reach = reach if reach < readings.z_max[t] else readings.z_max[t]
    pose = (readings.x[t], readings.y[t], readings.yaw[t])
    cells = cone_cells(pose, readings.half_angle[t], reach, grid, model.cell_distance == 'nearest')
    return [d for c, d in cells.items() if occupied.ravel()[c] == 1]


def log_likelihood(readings: Readings, grid: Grid, occupied: np.ndarray, model: ModelParameters) -> float:
    total = 0.0
    for t in range(len(readings)):
        met = obstacles(readings, t, grid, occupied, model)
        total += math.log(sum(causes(readings.z[t], readings.z_max[t], sigma_of(readings, t, grid, model), met, model)))
    return total


def live_log_odds(readings: Readings, grid: Grid, depth: float, logits: tuple[float, float, float]) -> np.ndarray:
    """The standard map; `logits` of occupied, free, and free without echo."""
    out = np.full(grid.size, np.nan)
    xs, ys = grid.centers()
    for t in range(len(readings)):
        x, y, yaw, z = readings.x[t], readings.y[t], readings.yaw[t], readings.z[t]
        echo = z < readings.z_max[t]
        for c, d in cone_cells((x, y, yaw), readings.half_angle[t], z + depth, grid).items():
            bearing = math.atan2(ys[c // grid.width] - y, xs[c % grid.width] - x)
            wide = 0.75 * grid.resolution
            half_angle = max(readings.half_angle[t], wide / max(d, wide))
            weight = max(0.0, 1 - (math.remainder(bearing - yaw, 2 * math.pi) / half_angle) ** 2)
            if d < (z - depth if echo else z):
                out[c] = np.nansum([out[c], weight * logits[1 if echo else 2]])
            elif echo:
                out[c] = np.nansum([out[c], weight * logits[0]])
    return out.reshape(grid.shape)
