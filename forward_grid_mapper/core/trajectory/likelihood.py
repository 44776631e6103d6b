"""How likely readings are from another pose of the robot, given a local map: the forward model over probabilities.

The density of a range is that of `sensor.density`. A cone is walked ring by ring, a cell deep; what a ring returns is
the largest of the probabilities that rays through the cone meet in it, h_d. With s_d = Π (1 − h) over the nearer rings

    p(z | map) = causes that no map changes + (1 − p_rand − p_lost) · (Σ_d s_d h_d N(z; d, σ) + s_end N(z; z_max, σ))

A surface that the reading meets beyond the incidence angle, and goes past, does not count (`surface_normals`). Divided
by the same of a map without any known cell, new territory counts nothing either way.
"""

from __future__ import annotations

import math
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from ..common.constants import THROUGH
from ..common.parameters import ModelParameters
from ..common.readings import Readings
from ..runtime.jit import kernel
from ..sensor.cone_table import effective_sigma, reach_of
from ..sensor.density import CUT, causes_of, density
from .local_map import LocalMap
from .poses import Floats

RAYS = (3, 5, 7, 11)
"""Rays through a cone, the middle one along its axis: as few as lie a cell apart or less, 11 at the most."""

SPREAD = 0.85
"""Part of the half angle that the rays span: beyond it a cone hears little."""

SCAN = np.dtype(
    [(name, np.float64) for name in ('x', 'y', 'yaw', 'half', 'z', 'sigma', 'reach', 'floor', 'silence', 'unknown')],
    align=True,
)
"""A reading of a scan: the pose of its sensor in the frame of the scan, half the spread of its rays in radians, the
range and σ in metres, how far rings matter, and p of the causes that no map changes, N(z; z_max, σ), and log p where
nothing is known."""


class Scan(NamedTuple):
    """Readings that move together.

    Attributes
    ----------
    readings : records of `SCAN`, shape (N,)
    weight : float
        1 − p_rand − p_lost.
    """

    readings: NDArray[np.void]
    weight: float


@kernel
def _log_unknown(reading: Any, weight: float, resolution: float, unknown: float) -> float:
    """Return log p(z) where no cell is known."""
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
        Those of the local maps to match with.
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


@kernel
def _log_ratio(reading: Any, weight: float, around: LocalMap, pose: tuple[float, float, float]) -> float:
    """Return log p(z | map) − log p(z | nothing known) of one reading from a pose of the scan's frame."""
    resolution, hits = around.resolution, around.hit
    height, width = hits.shape
    c, s = math.cos(pose[2]), math.sin(pose[2])
    x = (pose[0] + c * reading.x - s * reading.y) / resolution - around.column
    y = (pose[1] + s * reading.x + c * reading.y) / resolution - around.row
    begin = pose[2] + reading.yaw - reading.half
    axis_x, axis_y = math.cos(begin), math.sin(begin)
    through = (reading.z - THROUGH * reading.sigma) / resolution
    survival, hit = 1.0, 0.0
    rays, wide = 1, 0
    c1, s1 = 1.0, 0.0
    for k in range(int(math.ceil(reading.reach / resolution))):
        d = k + 0.5
        while wide < len(RAYS) and rays < 1.0 + 2.0 * reading.half * d:
            rays = RAYS[wide]
            wide += 1
            step = 2.0 * reading.half / (rays - 1)
            c1, s1 = math.cos(step), math.sin(step)
        best, off_x, off_y = 0.0, d, 0.0
        u, v = axis_x, axis_y
        for _ in range(rays):
            column, row = int(math.floor(x + d * u)), int(math.floor(y + d * v))
            here = around.unknown
            if 0 <= row < height and 0 <= column < width:
                here = hits[row, column]
                if here > best and d < through and around.cos2_limit > 0.0:
                    nx, ny = around.normal_x[row, column], around.normal_y[row, column]
                    along = u * nx + v * ny
                    if (nx != 0.0 or ny != 0.0) and along * along < around.cos2_limit:
                        here = 0.0
                if here > best:
                    off_x, off_y = column + 0.5 - x, row + 0.5 - y
            best = max(best, here)
            u, v = u * c1 - v * s1, u * s1 + v * c1
        distance = math.sqrt(off_x * off_x + off_y * off_y)
        error = (reading.z - distance * resolution) / reading.sigma
        if abs(error) <= CUT:
            hit += survival * best * density(error, reading.sigma)
        survival *= 1.0 - best
        if survival < 1e-4:
            break
    return float(math.log(reading.floor + weight * (hit + survival * reading.silence)) - reading.unknown)


@kernel
def score_poses(scan: Scan, around: LocalMap, poses: Any, stride: int, out: Any) -> None:
    """Write Σ log ratio of a scan from each pose, shape (P, 3), to `out`; of every `stride`-th reading, times that."""
    for k in range(len(poses)):
        total = 0.0
        pose = poses[k, 0], poses[k, 1], poses[k, 2]
        for t in range(0, len(scan.readings), stride):
            total += _log_ratio(scan.readings[t], scan.weight, around, pose)
        out[k] = total * stride


def scores(scan: Scan, around: LocalMap, poses: Floats, stride: int = 1) -> Floats:
    """Return Σ log p(z | map) − log p(z | nothing known) of a scan from each pose, shape (P, 3), in nats."""
    out = np.empty(len(poses))
    score_poses(scan, around, np.ascontiguousarray(poses), stride, out)
    return out
