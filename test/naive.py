"""Twins of the kernels in plain Python: slow, obvious, and written only from the definitions."""

from __future__ import annotations

import dataclasses
import itertools
import math

import numpy as np

from forward_grid_mapper.core.common.constants import (
    CONTRAST,
    FEW_ECHOES,
    FEW_READINGS,
    FREE_GROWTH,
    GAIN,
    IMAGE_AROUND,
    LEAST_IN_SIGHT,
    LEAST_RATE,
    LEAST_STRENGTH,
    MOST_AGAINST_EXTENSION,
    SAME_WALL,
    STRAIGHT_RUN,
)
from forward_grid_mapper.core.common.grid import Grid
from forward_grid_mapper.core.common.parameter_groups import ModelParameters
from forward_grid_mapper.core.common.readings import Readings
from forward_grid_mapper.core.evidence.state import State
from forward_grid_mapper.core.evidence.tile_index import Tiles
from forward_grid_mapper.core.search.prior import Prior
from forward_grid_mapper.core.sensor.density import CUT
from forward_grid_mapper.core.sensor.surface_normals import THROUGH, SurfaceNormals


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


def cone_cells(
    pose: tuple[float, float, float],
    half_angle: float,
    reach: float,
    grid: Grid,
    slack: float = 0.0,
) -> dict[int, float]:
    """Cells of a cone and their distances in metres; `slack` widens it, to distinguish rounding from errors."""
    x, y, yaw = pose
    cells = {}
    xs, ys = grid.centers()
    for row, cy in enumerate(ys):
        for column, cx in enumerate(xs):
            d = math.hypot(cx - x, cy - y)
            if d > reach + slack:
                continue
            off_axis = abs(math.remainder(math.atan2(cy - y, cx - x) - yaw, 2 * math.pi))
            size = grid.resolution
            crossed = axis_crosses(x, y, yaw, reach, cx - size / 2 - slack, cy - size / 2 - slack, size + 2 * slack)
            if off_axis <= half_angle + slack or crossed:
                cells[row * grid.width + column] = d
    return cells


def normal(z: float, mean: float, sigma: float) -> float:
    error = (z - mean) / sigma
    return math.exp(-0.5 * error * error) / (math.sqrt(2 * math.pi) * sigma) if abs(error) <= CUT else 0.0


def of_cells(model: ModelParameters, grid: Grid) -> ModelParameters:
    """The model with p_hit of a cell: a wall of 0.1 m is missed if all of its cells miss it."""
    return dataclasses.replace(model, p_hit=min(1 - (1 - model.p_hit) ** (grid.resolution / 0.1), 0.98))


def lost(z: float, z_max: float, sigma: float, model: ModelParameters) -> float:
    """Density of a lost echo, which is no echo, so the range is the largest."""
    return model.p_lost * normal(z, z_max, sigma) if z >= z_max else 0.0


def causes(z: float, z_max: float, sigma: float, distances: list[float], model: ModelParameters) -> list[float]:
    """Density of the reading together with each cause: random, lost echo, no obstacle, first obstacle, second, …

    All patterns of obstacles that would return the echo and obstacles that would not are enumerated; the nearest that
    would return it explains the reading.
    """
    distances = sorted(distances)
    mixture_weight = 1 - model.p_rand - model.p_lost
    out = [model.p_rand / z_max, lost(z, z_max, sigma, model)] + [0.0] * (len(distances) + 1)
    for pattern in itertools.product((True, False), repeat=len(distances)):
        p = mixture_weight * math.prod(model.p_hit if answers else 1 - model.p_hit for answers in pattern)
        if any(pattern):
            k = pattern.index(True)
            out[3 + k] += p * normal(z, distances[k], sigma)
        else:
            out[2] += p * normal(z, z_max, sigma)
    return out


def sigma_of(readings: Readings, t: int, grid: Grid, model: ModelParameters) -> float:
    return max(readings.sigma[t] if readings.sigma[t] > 0 else model.sigma, grid.resolution / 2)


def left_out(
    readings: Readings, t: int, grid: Grid, model: ModelParameters, normals: SurfaceNormals | None
) -> set[int]:
    """The cells that reading t meets beyond the incidence angle and passes, by definition."""
    if normals is None or not len(normals.known):
        return set()
    xs, ys = grid.centers()
    out = set()
    for c in cells_of(readings, t, grid, model):
        dx, dy = xs[c % grid.width] - readings.x[t], ys[c // grid.width] - readings.y[t]
        d = math.hypot(dx, dy) - surface(grid, model)
        if normals.known[c] and d < readings.z[t] - THROUGH * sigma_of(readings, t, grid, model):
            along = abs(normals.x[c] * dx + normals.y[c] * dy)
            if along / math.hypot(dx, dy) < math.cos(model.max_incidence_angle):
                out.add(c)
    return out


def obstacles(
    readings: Readings,
    t: int,
    grid: Grid,
    occupied: np.ndarray,
    model: ModelParameters,
    normals: SurfaceNormals | None = None,
) -> list[float]:
    """Distances of the occupied cells that reading t may meet."""
    passed = left_out(readings, t, grid, model, normals)
    cells = cells_of(readings, t, grid, model)
    return [d for c, d in cells.items() if occupied.ravel()[c] == 1 and c not in passed]


def likelihood(z: float, z_max: float, sigma: float, distances: list[float], model: ModelParameters) -> float:
    """The density of a reading as the sum over its causes, from near to far."""
    mixture_weight = 1 - model.p_rand - model.p_lost
    total = model.p_rand / z_max + lost(z, z_max, sigma, model)
    for d in sorted(distances):
        total += mixture_weight * model.p_hit * normal(z, d, sigma)
        mixture_weight *= 1 - model.p_hit
    return total + mixture_weight * normal(z, z_max, sigma)


def log_likelihood(
    readings: Readings,
    grid: Grid,
    occupied: np.ndarray,
    model: ModelParameters,
    normals: SurfaceNormals | None = None,
) -> float:
    total, model = 0.0, of_cells(model, grid)
    for t in range(len(readings)):
        met = obstacles(readings, t, grid, occupied, model, normals)
        total += math.log(sum(causes(readings.z[t], readings.z_max[t], sigma_of(readings, t, grid, model), met, model)))
    return total


def free_end(readings: Readings, t: int, grid: Grid, model: ModelParameters) -> float:
    """The distance where the free zone of reading t ends and its band begins, in metres."""
    return readings.z[t] - CUT * sigma_of(readings, t, grid, model)


def reach(readings: Readings, t: int, grid: Grid, model: ModelParameters) -> float:
    """The distance in metres beyond which cells do not affect reading t."""
    end = readings.z[t] + CUT * sigma_of(readings, t, grid, model)
    return end if end < readings.z_max[t] else readings.z_max[t]


def surface(grid: Grid, model: ModelParameters) -> float:
    """The distance in metres of the surface of an obstacle in front of the point to which distances are measured."""
    return model.surface_offset * grid.resolution


def cells_of(readings: Readings, t: int, grid: Grid, model: ModelParameters, slack: float = 0.0) -> dict[int, float]:
    """The cells that reading t sees, and the distances of their surfaces in metres."""
    pose = (readings.x[t], readings.y[t], readings.yaw[t])
    before = surface(grid, model)
    end = reach(readings, t, grid, model) + before
    cells = cone_cells(pose, readings.half_angle[t], end, grid, slack)
    return {c: d - before for c, d in cells.items()}


def strength(readings: Readings, t: int, grid: Grid, c: int) -> float:
    """The strength of the beam of reading t at cell c: 1 on the axis, 0 at the edge and beyond."""
    xs, ys = grid.centers()
    dx, dy = xs[c % grid.width] - readings.x[t], ys[c // grid.width] - readings.y[t]
    off_axis = math.sin(math.atan2(dy, dx) - readings.yaw[t])
    # half the cone is at least three quarters of a cell wide at the centre of the cell
    edge = max(math.sin(readings.half_angle[t]), 0.75 * grid.resolution / max(math.hypot(dx, dy), 1e-9))
    return max(0.0, 1 - (off_axis / edge) ** 2)


def live_log_odds(
    readings: Readings,
    grid: Grid,
    arc: tuple[float, float],
    logits: tuple[float, float, float],
    width: float = math.inf,
    directions: int = 1,
) -> np.ndarray:
    """The standard map; `logits` of occupied, free, and free without echo, `width` of the surface of an echo."""
    apart, touched = np.zeros((directions, grid.size)), np.zeros(grid.size, bool)
    before, behind = arc
    centres = np.arange(directions) * math.pi / directions
    for t in range(len(readings)):
        x, y, yaw, z = readings.x[t], readings.y[t], readings.yaw[t], readings.z[t]
        echo = z < readings.z_max[t]
        # angles between lines, not directed
        k = int(np.argmin([abs(math.remainder(yaw - centre, math.pi)) for centre in centres]))
        length = 2 * z * math.sin(readings.half_angle[t])
        for c, d in cone_cells((x, y, yaw), readings.half_angle[t], z + behind if echo else z, grid).items():
            touched[c] = True
            weight = strength(readings, t, grid, c)
            if d < z - before or not echo:
                apart[k, c] += weight * logits[1 if echo else 2]
            else:
                apart[k, c] += weight * logits[0] * (1.0 if length <= width else width / length)
    out = np.full(grid.size, np.nan)
    for c in np.flatnonzero(touched):
        together = sum(apart[:, c])
        by_direction = [
            apart[k, c] + (apart[k - 1, c] + apart[(k + 1) % directions, c]) / 16 for k in range(directions)
        ]
        out[c] = max(*by_direction, together) if directions > 1 and max(by_direction) > 0 else together
    return out.reshape(grid.shape)


def awkward_readings(rng: np.random.Generator, grid: Grid, count: int) -> Readings:
    """Edge cases of readings.

    Sensors on corners, edges and centres of cells, inside and outside the grid, that look along rows, columns and
    diagonals; cones from very thin to a half plane; ranges from zero to beyond the grid.
    """
    size, span = grid.resolution, max(grid.width, grid.height)
    places = rng.integers(-4, 2 * span + 4, (2, count)) / 2 + rng.choice([0.0, 0.0, 0.25, 1e-13], (2, count))
    z_max = rng.choice([0.5, 1.0, 1.5], count) * span * size
    z = np.minimum(rng.choice([1e-3, 0.5, 1.0, 2.5, 0.3 * span, span], count) * size + rng.choice([0, 0.01]), z_max)
    return Readings.from_columns(
        names=('sonar',),
        x=(grid.column + places[0]) * size,
        y=(grid.row + places[1]) * size,
        yaw=rng.integers(-9, 10, count) * math.pi / 4 + rng.choice([0.0, 0.0, 1e-9, 0.3], count),
        z=np.where(rng.random(count) < 0.2, z_max, z),
        z_max=z_max,
        half_angle=rng.choice([1e-6, 1e-3, 0.1, math.pi / 8, math.pi / 4, 1.2, 1.55, 1.5707], count),
        sigma=rng.choice([0.0, 0.2, 3.0], count) * size,
        stamp=np.arange(count),
    )


def pairs_of(state: State, t: int) -> tuple[list[int], list[int], list[float], list[int]]:
    """The stored pairs of reading t: the cells of its runs in order; cells, densities and logs of its band."""
    reading_state = state.reading_states[t]
    assert reading_state['stored']
    words = state.pairs.cell[reading_state['at'] :]
    free = [c for k in range(reading_state['runs']) for c in range(words[2 * k], words[2 * k + 1] + 1)]
    begin, m = reading_state['at'] + 2 * reading_state['runs'], reading_state['bands']
    return (
        free,
        state.pairs.cell[begin : begin + m].tolist(),
        state.pairs.density[begin + m : begin + 2 * m].tolist(),
        state.pairs.log[begin + 2 * m : begin + 3 * m].tolist(),
    )


def readings_of_tile(tiles: Tiles, tile: int) -> list[int]:
    """The readings in the list of a tile, the last one at the end."""
    chunk, fill, out = tiles.head[tile], tiles.fill[tile], []
    while chunk >= 0:
        out = tiles.chunks[chunk, :fill].tolist() + out
        chunk, fill = tiles.chunks[chunk, -1], tiles.chunks.shape[1] - 1
    return out


def neighbours_of(c: int, shape: tuple[int, int]) -> dict[int, int]:
    """The neighbours of a cell on the grid, by bearing in eighths of a turn from east."""
    row, column = divmod(c, shape[1])
    out = {}
    for y, x in itertools.product((-1, 0, 1), repeat=2):
        if (x or y) and 0 <= row + y < shape[0] and 0 <= column + x < shape[1]:
            out[round(math.atan2(y, x) / (math.pi / 4)) % 8] = c + y * shape[1] + x
    return out


def pattern_of(occupied: np.ndarray, c: int, shape: tuple[int, int]) -> int:
    return sum(1 << k for k, o in neighbours_of(c, shape).items() if occupied.ravel()[o])


def log_prior(prior: Prior, occupied: np.ndarray, shape: tuple[int, int]) -> float:
    """The log prior of a whole map, cell by cell."""
    cells = np.flatnonzero(occupied.ravel()).tolist()
    return math.fsum(prior.local[c] + prior.shape[pattern_of(occupied, c, shape)] for c in cells)


def prior_gain(prior: Prior, occupied: np.ndarray, c: int, shape: tuple[int, int]) -> float:
    """The change of the log prior by flipping cell c: the difference of two whole maps, without the unchanged rest."""
    # only the prices of the cell and its neighbours change
    nearby = {c, *neighbours_of(c, shape).values()}
    flipped = occupied.copy().ravel()
    flipped[c] ^= 1
    after, before = (
        math.fsum(prior.local[k] + prior.shape[pattern_of(cells, k, shape)] for k in nearby if cells[k])
        for cells in (flipped, occupied.ravel())
    )
    return after - before


def log_likelihoods(
    readings: Readings,
    grid: Grid,
    maps: np.ndarray,
    model: ModelParameters,
    normals: SurfaceNormals | None = None,
) -> np.ndarray:
    """Log likelihoods of many maps at once, shape (maps, cells)."""
    model = of_cells(model, grid)
    mixture_weight = 1 - model.p_rand - model.p_lost
    total = np.zeros(len(maps))
    for t in range(len(readings)):
        z, z_max, sigma = readings.z[t], readings.z_max[t], sigma_of(readings, t, grid, model)
        no_echo = normal(z, z_max, sigma)
        unmapped = model.p_rand / z_max + lost(z, z_max, sigma, model)
        likelihood, left = np.full(len(maps), unmapped), np.full(len(maps), mixture_weight)
        passed = left_out(readings, t, grid, model, normals)
        for c, d in sorted(cells_of(readings, t, grid, model).items(), key=lambda pair: pair[1]):
            if c in passed:
                continue
            answers = model.p_hit * maps[:, c]
            likelihood += left * answers * normal(z, d, sigma)
            left *= 1 - answers
        total += np.log(likelihood + left * no_echo)
    return total


def box_sum(values: np.ndarray) -> np.ndarray:
    """Sums over the 3 x 3 cells around each cell, within the grid."""
    out = np.zeros_like(values)
    for row, column in np.ndindex(values.shape):
        out[row, column] = values[max(row - 1, 0) : row + 2, max(column - 1, 0) : column + 2].sum()
    return out


def normals(readings: Readings, grid: Grid, model: ModelParameters) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """C, S and M of `normals`, before the sums over 3 x 3 cells."""
    sums = np.zeros((3, *grid.shape))
    xs, ys = grid.centers()
    for t in range(len(readings)):
        if readings.z[t] >= readings.z_max[t]:
            continue
        sigma = sigma_of(readings, t, grid, model)
        for c in cells_of(readings, t, grid, model):
            row, column = divmod(c, grid.width)
            dx, dy = xs[column] - readings.x[t], ys[row] - readings.y[t]
            d, bearing = math.hypot(dx, dy) - surface(grid, model), math.atan2(dy, dx)
            if d > readings.z[t] - 4 * sigma:
                w = math.exp(-0.5 * ((d - readings.z[t]) / sigma) ** 2)
                sums[:, row, column] += w * math.cos(2 * bearing), w * math.sin(2 * bearing), w
    return sums[0], sums[1], sums[2]


def met(
    readings: Readings, grid: Grid, model: ModelParameters, normals: SurfaceNormals, limits: tuple[float, ...]
) -> np.ndarray:
    """Echoes and passes of each cell with known normal, by the incidence at which it is met: twin of `incidence`.

    Shape (2, zones, cells).
    """
    out = np.zeros((2, len(limits), grid.size))
    xs, ys = grid.centers()
    for t in range(len(readings)):
        z, sigma = readings.z[t] + surface(grid, model), sigma_of(readings, t, grid, model)
        for c in cells_of(readings, t, grid, model):
            if not normals.known[c]:
                continue
            row, column = divmod(c, grid.width)
            dx, dy = xs[column] - readings.x[t], ys[row] - readings.y[t]
            d = math.hypot(dx, dy)
            off = math.acos(min(abs(dx * normals.x[c] + dy * normals.y[c]) / d, 1.0))
            zone = sum(off > limit for limit in limits)
            if zone == len(limits):
                continue
            if d <= z - THROUGH * sigma:
                out[1, zone, c] += strength(readings, t, grid, c)
            elif d < z + THROUGH * sigma and readings.z[t] < readings.z_max[t]:
                out[0, zone, c] += math.exp(-0.5 * ((d - z) / sigma) ** 2)
    return out


def incidence_limit(echoes: np.ndarray, passes: np.ndarray) -> int:
    """The last zone in which a surface returns echoes, from echoes and passes in each zone: twin of `incidence`."""

    def rate(e: float, p: float) -> float:
        return (e + FEW_ECHOES) / (e + p + FEW_READINGS)

    def log_likelihood(e: float, p: float) -> float:
        return e * math.log(rate(e, p)) + p * math.log(1 - rate(e, p))

    best, zone = GAIN, len(echoes) - 1
    for k in range(1, len(echoes)):
        within = sum(echoes[:k]), sum(passes[:k])
        beyond = sum(echoes[k:]), sum(passes[k:])
        gained = log_likelihood(*within) + log_likelihood(*beyond) - log_likelihood(sum(echoes), sum(passes))
        if gained > best and rate(*within) >= max(LEAST_RATE, CONTRAST * rate(*beyond)):
            best, zone = gained, k - 1
    return zone


def in_line_of_sight(grid: Grid, occupied: np.ndarray, apex: tuple[float, float], c: int, before: float) -> bool:
    """Whether no occupied cell is on the way from a sensor to `before` metres in front of cell c."""
    xs, ys = grid.centers()
    dx, dy = xs[c % grid.width] - apex[0], ys[c // grid.width] - apex[1]
    d = math.hypot(dx, dy)
    steps = np.arange(0.5, max((d - before) / grid.resolution, 0.0) - 1e-9, 0.5) * grid.resolution
    for at in steps:
        rows, columns = grid.cells_of(np.array([apex[0] + dx / d * at]), np.array([apex[1] + dy / d * at]))
        row, column = int(rows[0]), int(columns[0])
        if 0 <= row < grid.height and 0 <= column < grid.width and occupied.ravel()[row * grid.width + column]:
            return False
    return True


def explained_echoes(readings: Readings, grid: Grid, occupied: np.ndarray, model: ModelParameters) -> np.ndarray:
    """Echoes explained by occupied cells, in line of sight and all, shape (2, cells): the twin of `line_of_sight`."""
    out = np.zeros((2, grid.size))
    for t in np.flatnonzero(readings.z < readings.z_max):
        sigma = sigma_of(readings, t, grid, model)
        for c, d in cells_of(readings, t, grid, model).items():
            error = (d - readings.z[t]) / sigma
            if occupied.ravel()[c] and abs(error) < THROUGH:
                out[1, c] += math.exp(-0.5 * error**2)
                if in_line_of_sight(grid, occupied, (readings.x[t], readings.y[t]), c, SAME_WALL):
                    out[0, c] += math.exp(-0.5 * error**2)
    return out


def mirror_images(
    readings: Readings, grid: Grid, occupied: np.ndarray, model: ModelParameters, cells: np.ndarray
) -> np.ndarray:
    """The cells among `cells` that are mirror images, shape `grid.shape`: the twin of `line_of_sight`."""
    free, total = explained_echoes(readings, grid, occupied, model).reshape(2, *grid.shape)
    out, n = np.zeros(grid.shape, bool), round(IMAGE_AROUND / grid.resolution)
    for row, column in np.argwhere(cells):
        part = slice(max(row - n, 0), row + n + 1), slice(max(column - n, 0), column + n + 1)
        out[row, column] = free[part].sum() < LEAST_IN_SIGHT * total[part].sum()
    return out


def never_passed(
    readings: Readings, grid: Grid, occupied: np.ndarray, model: ModelParameters, cells: np.ndarray
) -> np.ndarray:
    """Those `cells` that no reading passed in line of sight, shape `grid.shape`: the twin of `line_of_sight`."""
    out = cells.copy()
    for t in range(len(readings)):
        sigma = sigma_of(readings, t, grid, model)
        for c, d in cells_of(readings, t, grid, model).items():
            here = d <= readings.z[t] - THROUGH * sigma and strength(readings, t, grid, c) >= LEAST_STRENGTH
            if here and in_line_of_sight(grid, occupied, (readings.x[t], readings.y[t]), c, grid.resolution):
                out.ravel()[c] = False
    return out


def passed(
    readings: Readings, grid: Grid, occupied: np.ndarray, model: ModelParameters, weight: np.ndarray | None = None
) -> np.ndarray:
    """Expected number of readings that passed each cell in each direction: the twin of `post_processing`.

    Shape (4, cells): beams nearest to 0°, 45°, 90° and 135°.
    """
    out, model = np.zeros((4, grid.size)), of_cells(model, grid)
    mixture_weight = 1 - model.p_rand - model.p_lost
    for t in range(len(readings)):
        z, z_max, sigma = readings.z[t], readings.z_max[t], sigma_of(readings, t, grid, model)
        away = cells_of(readings, t, grid, model)
        chance, no_echo = model.p_rand / z_max, normal(z, z_max, sigma)
        met = sorted((d, c) for c, d in away.items() if occupied.ravel()[c])
        free_end = z - CUT * sigma
        terms, left = [], mixture_weight
        for d, _ in met:
            terms.append((d, left * model.p_hit * normal(z, d, sigma)))
            left *= 1 - model.p_hit
        whole = sum(term for _, term in terms) + left * no_echo
        total = chance + model.p_lost * no_echo + whole
        for c, d in away.items():
            before = sum(term for at, term in terms if at <= d)
            p = (whole - before) / total
            if d <= free_end and z < z_max:
                # the probability that it passed the occupied cells in the free zone in front of the cell
                blocking = [at for at, _ in met if at <= free_end]
                behind = bool(blocking) and d > min(blocking)
                p += chance / total * ((1 - model.p_hit) ** len(blocking) if behind else 1.0)
            row, column = divmod(c, grid.width)
            x, y = (grid.column + column + 0.5) * grid.resolution, (grid.row + row + 0.5) * grid.resolution
            bearing = math.atan2(y - readings.y[t], x - readings.x[t])
            way = round(bearing / (math.pi / 4)) % 4
            out[way, c] += p * strength(readings, t, grid, c) * (1 if weight is None else weight[t])
    return out


def usual_limits(model: ModelParameters) -> list[float]:
    """Limits of the incidence angle of a surface of which nothing is known."""
    low, high = model.min_incidence_angle, model.max_incidence_angle
    return [high] if high >= 1.5707 or low >= high else [0.5 * (low + high), high]


def noticing(passes: np.ndarray, p_hit: float, limits: list[float]) -> np.ndarray:
    """Expected number of passes that any surface would have noticed, shape (4, cells), by trying all bearings."""
    bearings = (np.arange(18000) + 0.5) * math.pi / 18000
    nearest = np.round(bearings / (math.pi / 4)).astype(int) % 4
    out = np.zeros(passes.shape[1])
    for normal, limit in itertools.product(np.arange(4) * math.pi / 4, limits):
        off = np.abs((bearings - normal + math.pi / 2) % math.pi - math.pi / 2)
        share = [np.mean(off[nearest == way] < limit) for way in range(4)]
        out += (1 - p_hit) ** (np.array(share) @ passes) / (4 * len(limits))
    with np.errstate(divide='ignore'):
        return np.log(out) / math.log(1 - p_hit)


def evidence(
    readings: Readings, grid: Grid, occupied: np.ndarray, model: ModelParameters, normals: SurfaceNormals | None
) -> np.ndarray:
    """log p(Z | cell occupied, rest of the map) - log p(Z | cell free, rest of the map), shape (cells,)."""
    both = np.repeat(occupied.reshape(1, 1, -1), grid.size, axis=1).repeat(2, axis=0)
    for c in range(grid.size):
        both[:, c, c] = 0, 1
    free, full = (log_likelihoods(readings, grid, maps, model, normals) for maps in both)
    return full - free


def calibrated(evidence: np.ndarray, passed: np.ndarray, ml: np.ndarray, alpha: float = 1.0) -> np.ndarray:
    """Calibrated marginals of all cells, shape (height, width), cell by cell: see the docstring of `uncertainty`."""
    out = np.zeros(ml.shape)
    for row in range(ml.shape[0]):
        for column in range(ml.shape[1]):
            square = [(row + dy, column + dx) for dx in (-1, 0, 1) for dy in (-1, 0, 1)]
            inside = [(0 <= r < ml.shape[0]) and (0 <= k < ml.shape[1]) for r, k in square]
            near = [passed[at] if there else 0.0 for at, there in zip(square, inside, strict=True)]
            walls = [
                (k - column, r - row)
                for (r, k), there in zip(square, inside, strict=True)
                if there and ml[r, k] == 1 and (r, k) != (row, column)
            ]
            sides = [(dx, dy) for dx, dy in walls if not dx * dy]
            cosines = [
                (a[0] * b[0] + a[1] * b[1]) / math.hypot(*a) / math.hypot(*b) for a in walls for b in walls if a != b
            ]
            if any(cosine < -0.7 for cosine in cosines):
                kind = 1.10 if len(sides) >= 3 else 0.20
            elif len(sides) == 2:
                kind = -0.20
            elif not walls:
                kind = -1.95
            else:
                kind = -2.56 if sides and len(walls) >= 3 else -1.23
            nats = evidence[row, column]
            logit = alpha * math.copysign(math.log(1 + abs(nats)), nats) + kind + (1.31 if ml[row, column] == 1 else 0)
            logit += -1.30 * math.log(1 + min(near)) + 0.29 * math.log(1 + sum(near) / 9)
            out[row, column] = 1 / (1 + math.exp(-logit))
    return out


STEPS = [(1, 0), (1, 1), (0, 1), (-1, 1), (-1, 0), (-1, -1), (0, -1), (1, -1)]


def extended_walls(
    occupied: np.ndarray, nats: np.ndarray, seen: np.ndarray, steps: int, barred: np.ndarray
) -> np.ndarray:
    """Cells of 0.1 m by which straight walls are extended: see the docstring of `extend`. `nats`: (height, width)."""
    run, most = round(STRAIGHT_RUN / 0.1), MOST_AGAINST_EXTENSION * 0.1
    height, width = occupied.shape
    out = np.zeros(occupied.shape, np.uint8)

    def at(x: int, y: int) -> bool:
        return 0 <= x < width and 0 <= y < height and occupied[y, x] == 1

    for y, x in np.argwhere(occupied == 1):
        for k, (dx, dy) in enumerate(STEPS):
            ahead = [STEPS[k], STEPS[(k + 1) % 8], STEPS[k - 1]]
            straight = all(at(x - n * dx, y - n * dy) for n in range(run))
            if not straight or any(at(x + u, y + v) for u, v in ahead):
                continue
            for n in range(1, steps + 1):
                u, v = x + n * dx, y + n * dy
                if not (0 <= u < width and 0 <= v < height):
                    break
                if barred[v, u] or occupied[v, u] or not seen[v, u] or nats[v, u] < -most:
                    break
                out[v, u] = 1
    return out


def final_map(
    readings: Readings,
    grid: Grid,
    occupied: np.ndarray,
    model: ModelParameters,
    normals: SurfaceNormals | None,
    traversed: np.ndarray,
    steps: int,
    least: tuple[float, float],
) -> np.ndarray:
    """The final map, made from the map found by the search; `least`: passed, and noticed.

    Cells are of 0.1 m.
    """
    seen = np.zeros(grid.size, int)
    for t in range(len(readings)):
        seen[list(cells_of(readings, t, grid, model))] += 1
    seen = seen.reshape(grid.shape)
    ml = np.where(seen > 0, occupied.reshape(grid.shape).astype(int), -1)
    ml[traversed & (ml < 0)] = 0
    passes = passed(readings, grid, occupied, model)
    through = (ml == 0) & (traversed | (passes.sum(axis=0).reshape(grid.shape) >= least[0]))
    noticed = noticing(passes, model.p_hit, usual_limits(model)).reshape(grid.shape) >= least[1]
    known = (ml == 0) & (traversed | (noticed & through))
    for _ in range(round(FREE_GROWTH / 0.1)):
        known = through & (box_sum(known.astype(int)) > 0)
    nats = evidence(readings, grid, occupied, model, normals).reshape(grid.shape)
    nats = np.where(occupied.reshape(grid.shape) == 1, -nats, nats)
    ahead = extended_walls(occupied.reshape(grid.shape), nats, seen, steps, through)
    ml[ahead == 1] = 1
    ml[(ml == 0) & (box_sum(known.astype(int)) == 0)] = -1
    images = mirror_images(readings, grid, occupied, model, ml == 1)
    sure = (ml == 0) & ~never_passed(readings, grid, occupied, model, (ml == 0) & ~traversed)
    ml[(ml == 0) & (box_sum(sure.astype(int)) == 0)] = -1
    ml[images] = -1
    return ml
