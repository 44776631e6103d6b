"""The likelihood of readings from any pose of the robot, given a local map: the forward model with probabilities.

The density of a range is that of `sensor.density`. The cone is divided into rings, each one cell deep. The probability
h_d that a ring returns the echo is the largest probability that rays through the cone meet in it. With
s_d = Π (1 − h) over the nearer rings

    p(z | map) = causes independent of the map
                 + (1 − p_rand − p_lost) · (Σ_d s_d h_d N(z; d, σ) + s_end N(z; z_max, σ))

A surface that the sound meets beyond the incidence angle does not count if the reading is longer (`surface_normals`). A
surface that was seen from the other side only is unknown from this one (`sides`).
The result is a likelihood ratio to a map without known cells, so that new territory counts nothing.
"""

from __future__ import annotations

import math
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from ..common.constants import THROUGH
from ..common.parameter_groups import ModelParameters
from ..common.readings import Floats, Readings
from ..runtime.jit import inlined_kernel, kernel
from ..sensor.cone_table import effective_sigma, reach_of
from ..sensor.density import CUT, causes_of, density
from .local_map import LocalMap

RAYS = (3, 5, 7, 11)
"""Numbers of rays through a cone, the middle one along its axis: as many as needed to be at most a cell apart, 11 at
most."""

SPREAD = 0.85
"""Fraction of the half angle that the rays span: near the edge of the cone, sensors detect little."""

LEAST_SURVIVAL = 1e-4
"""s_d below which the rings behind are ignored."""

OFF = 1.0
"""Cells; more than the centre of a cell that a ray meets can be away from the ring."""

LANES, SIDE_BY_SIDE = 64, 4
"""Most poses that are evaluated in parallel (SIMD), and the number that they are a multiple of."""

SCAN = np.dtype(
    [(name, np.float64) for name in ('x', 'y', 'yaw', 'half', 'z', 'sigma', 'reach', 'floor', 'silence', 'unknown')],
    align=True,
)
"""A reading of a scan: pose of its sensor in the frame of the scan; half the angle that its rays span, radians; range,
σ and the distance up to which rings matter, metres; density of the causes independent of the map (`floor`),
N(z; z_max, σ) (`silence`), and log p on an unknown map."""


class Scan(NamedTuple):
    """Readings in one frame, which are moved as a rigid body.

    Attributes
    ----------
    readings : records of `SCAN`, shape (N,)
    weight : float
        1 − p_rand − p_lost.
    """

    readings: NDArray[np.void]
    weight: float


@inlined_kernel
def _log_unknown(reading: Any, weight: float, resolution: float, unknown: float) -> float:
    """Return log p(z) on a map without known cells."""
    survival, hit = 1.0, 0.0
    for k in range(int(math.ceil(reading.reach / resolution))):
        error = (reading.z - (k + 0.5) * resolution) / reading.sigma
        if abs(error) <= CUT:
            hit += survival * unknown * density(error, reading.sigma)
        survival *= 1.0 - unknown
    return math.log(reading.floor + weight * (hit + survival * reading.silence))


@kernel
def _set_unknown(scan: Scan, resolution: float, unknown: float) -> None:
    for t in range(len(scan.readings)):
        scan.readings[t].unknown = _log_unknown(scan.readings[t], scan.weight, resolution, unknown)


def make_scan(readings: Readings, poses: Floats, model: ModelParameters, resolution: float, unknown: float) -> Scan:
    """Return readings as a scan.

    Parameters
    ----------
    readings : Readings
        N of them.
    poses : float64, shape (N, 3)
        Of the sensors in the frame of the scan.
    model : ModelParameters
    resolution, unknown : float
        Cell size, metres, and probability of unknown cells of the local maps.
    """
    sigma = effective_sigma(readings, model, resolution)
    causes = causes_of(readings, sigma, model, resolution)
    table = np.empty(len(readings), SCAN)
    table['x'], table['y'], table['yaw'] = poses.T
    table['half'] = SPREAD * readings.half_angle
    offset = model.surface_offset * resolution
    table['z'], table['sigma'] = readings.z + offset, sigma
    table['reach'] = reach_of(readings, sigma) + offset
    table['floor'], table['silence'] = causes.random + causes.lost, causes.max_range
    scan = Scan(table, causes.mixture_weight)
    _set_unknown(scan, resolution, unknown)
    return scan


def blurred(scan: Scan, by: float, around: LocalMap) -> Scan:
    """Return a scan with larger σ, for coarse grids of poses: the root of σ² + by², metres."""
    table = scan.readings.copy()
    table['sigma'] = np.hypot(table['sigma'], by)
    # readings without echo reach up to z_max, and nothing is detected beyond
    echo = table['reach'] > table['z']
    table['reach'] += np.where(echo, CUT * (table['sigma'] - scan.readings['sigma']), 0.0)
    blurry = Scan(table, scan.weight)
    _set_unknown(blurry, around.resolution, around.unknown)
    return blurry


class Lanes(NamedTuple):
    """The state of L poses that are evaluated in parallel (SIMD).

    Attributes
    ----------
    x, y : float64, shape (L,)
        Position of the sensor, in cells of the map.
    fan : float64, shape (1 + len(RAYS), RAYS[-1], 2, L)
        Unit vectors along the rays: first for a single ray, then for each number in `RAYS`.
    best, ray : float64, shape (L,)
        The largest probability that rays have met in the current ring, and the first ray that met it inside of the map,
        or −1.
    survival, hit : float64, shape (L,)
        s_d, and Σ s_d h_d N(z; d, σ).
    cell : int32, shape (RAYS[-1], L)
        The cell that each ray meets in the current ring: index of a row of `LocalMap.cells`.
    met : float32, shape (RAYS[-1], 4, L)
        The values of that row.
    """

    x: Floats
    y: Floats
    fan: Floats
    best: Floats
    ray: Floats
    survival: Floats
    hit: Floats
    cell: NDArray[np.int32]
    met: NDArray[np.float32]


def _lanes(count: int) -> Lanes:
    x, y, best, ray, survival, hit = np.zeros((6, count))
    fan = np.zeros((1 + len(RAYS), RAYS[-1], 2, count))
    cell, met = np.zeros((RAYS[-1], count), np.int32), np.zeros((RAYS[-1], 4, count), np.float32)
    return Lanes(x, y, fan, best, ray, survival, hit, cell, met)


@inlined_kernel
def _fan_out(reading: Any, yaw: float, resolution: float, lanes: Lanes, part: tuple[int, int]) -> None:
    """Set the rays of a reading in the lanes `part[0]` to `part[1]`, which have the same yaw."""
    fan, begin = lanes.fan, yaw + reading.yaw - reading.half
    axis_x, axis_y = math.cos(begin), math.sin(begin)
    fan[0, 0, 0, part[0] : part[1]], fan[0, 0, 1, part[0] : part[1]] = axis_x, axis_y
    rays, last = 1, math.ceil(reading.reach / resolution) - 0.5
    for wide in range(len(RAYS)):
        if rays >= 1.0 + 2.0 * reading.half * last:
            break
        rays = RAYS[wide]
        step = 2.0 * reading.half / (rays - 1)
        c, s = math.cos(step), math.sin(step)
        u, v = axis_x, axis_y
        for k in range(rays):
            fan[wide + 1, k, 0, part[0] : part[1]], fan[wide + 1, k, 1, part[0] : part[1]] = u, v
            u, v = u * c - v * s, u * s + v * c


@inlined_kernel
def _meet(around: LocalMap, lanes: Lanes, wide: int, rays: int, d: float) -> None:
    """Look up the cells that the rays of each lane meet at distance d, cells."""
    x, y, fan, cell, met, cells = lanes.x, lanes.y, lanes.fan, lanes.cell, lanes.met, around.cells
    height, width = float(around.shape[0]), float(around.shape[1])
    for k in range(rays):
        for p in range(len(x)):
            column, row = np.floor(x[p] + d * fan[wide, k, 0, p]), np.floor(y[p] + d * fan[wide, k, 1, p])
            inside = (row >= 0.0) & (row < height) & (column >= 0.0) & (column < width)
            cell[k, p] = np.int32(row * width + column if inside else height * width)
        for p in range(len(x)):
            at = np.uint32(cell[k, p])
            met[k, 0, p], met[k, 1, p], met[k, 2, p] = cells[at, 0], cells[at, 1], cells[at, 2]
            met[k, 3, p] = cells[at, 3]


@inlined_kernel
def _raise(around: LocalMap, lanes: Lanes, wide: int, rays: int, limit: float) -> None:
    """Find the largest probability that the rays of each lane meet."""
    best, ray, fan, cell, met = lanes.best, lanes.ray, lanes.fan, lanes.cell, lanes.met
    outside, unknown = len(around.cells) - 1, around.unknown
    best[:], ray[:] = 0.0, -1.0
    for k in range(rays):
        this = float(k)
        for p in range(len(best)):
            # without a vector `along` is NaN, and the comparisons are false
            along = fan[wide, k, 0, p] * met[k, 1, p] + fan[wide, k, 1, p] * met[k, 2, p]
            here = unknown if along < met[k, 3, p] else np.float64(met[k, 0, p])
            here = 0.0 if along * along < limit else here
            beyond = cell[k, p] == outside
            here = unknown if beyond else here
            more = here > best[p]
            best[p] = here if more else best[p]
            ray[p] = this if more & (not beyond) else ray[p]


@inlined_kernel
def _hear(reading: Any, resolution: float, lanes: Lanes, wide: int, d: float) -> None:
    """Add s_d h_d N(z; d, σ) of a ring."""
    x, y, fan = lanes.x, lanes.y, lanes.fan
    for p in range(len(x)):
        off_x, off_y = d, 0.0
        if lanes.ray[p] >= 0.0:
            k = np.uint32(lanes.ray[p])
            off_x = np.floor(x[p] + d * fan[wide, k, 0, p]) + 0.5 - x[p]
            off_y = np.floor(y[p] + d * fan[wide, k, 1, p]) + 0.5 - y[p]
        distance = math.sqrt(off_x * off_x + off_y * off_y)
        error = (reading.z - distance * resolution) / reading.sigma
        if abs(error) <= CUT and lanes.survival[p] >= LEAST_SURVIVAL:
            lanes.hit[p] += lanes.survival[p] * lanes.best[p] * density(error, reading.sigma)


@inlined_kernel
def _walk(reading: Any, around: LocalMap, lanes: Lanes) -> None:
    """Go through the rings of the cone of a reading, in all lanes."""
    resolution, best, survival = around.resolution, lanes.best, lanes.survival
    through = (reading.z - THROUGH * reading.sigma) / resolution
    heard = (reading.z - CUT * reading.sigma) / resolution - OFF
    rays, wide = 1, 0
    lanes.hit[:], survival[:] = 0.0, 1.0
    for ring in range(int(math.ceil(reading.reach / resolution))):
        d = ring + 0.5
        while wide < len(RAYS) and rays < 1.0 + 2.0 * reading.half * d:
            rays = RAYS[wide]
            wide += 1
        _meet(around, lanes, wide, rays, d)
        _raise(around, lanes, wide, rays, around.cos2_limit if d < through else 0.0)
        if d > heard:
            _hear(reading, resolution, lanes, wide, d)
        for p in range(len(best)):
            s = survival[p]
            survival[p] = s * (1.0 - best[p]) if s >= LEAST_SURVIVAL else s


@kernel
def score_poses(scan: Scan, around: LocalMap, poses: Any, stride: int, lanes: Lanes, out: Any) -> None:
    """Write the log-likelihood ratio of a scan at each pose, shape (P, 3), to `out`.

    Only every `stride`-th reading is evaluated, and the sum is multiplied by `stride`. P must be a multiple of the
    number of lanes. It is fastest if poses are sorted by yaw.
    """
    resolution, count = around.resolution, len(lanes.x)
    out[:] = 0.0
    for first in range(0, len(poses), count):
        for t in range(0, len(scan.readings), stride):
            reading = scan.readings[t]
            # always of the same type, so that callees are compiled once
            begin: Any = np.int64(0)
            while begin < count:
                end, yaw = begin, poses[first + begin, 2]
                c, s = math.cos(yaw), math.sin(yaw)
                while end == begin or (end < count and poses[first + end, 2] == yaw):
                    x, y = poses[first + end, 0], poses[first + end, 1]
                    lanes.x[end] = (x + c * reading.x - s * reading.y) / resolution - around.column
                    lanes.y[end] = (y + s * reading.x + c * reading.y) / resolution - around.row
                    end += 1
                _fan_out(reading, yaw, resolution, lanes, (begin, end))
                begin = end
            _walk(reading, around, lanes)
            for p in range(count):
                heard = lanes.hit[p] + lanes.survival[p] * reading.silence
                out[first + p] += math.log(reading.floor + scan.weight * heard) - reading.unknown
    for k in range(len(poses)):
        out[k] *= stride


def scores(scan: Scan, around: LocalMap, poses: Floats, stride: int = 1) -> Floats:
    """Return the log-likelihood ratio Σ log p(z | map) − log p(z | unknown map) of a scan at poses (P, 3), nats.

    Only every `stride`-th reading is evaluated, and the sum is multiplied by `stride`.
    """
    count = len(poses)
    if not count:
        return np.empty(0)
    rounds = max(-(-count // LANES), 1)
    wide = max(-(-count // (rounds * SIDE_BY_SIDE)), 1) * SIDE_BY_SIDE
    order = np.argsort(poses[:, 2], kind='stable')
    # spare lanes repeat the last pose
    padded = np.concatenate([order, np.full(rounds * wide - count, order[-1])])
    found, out = np.empty(len(padded)), np.empty(count)
    score_poses(scan, around, poses[padded], stride, _lanes(wide), found)
    out[order] = found[:count]
    return out
