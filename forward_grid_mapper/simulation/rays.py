"""Casts rays against the walls of a world."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from ..core.common.readings import Floats

NOTHING = -1
_CHUNK = 200_000  # ray-segment pairs at a time: temporaries stay within the cache
_SLACK = 1e-9  # so that no ray slips through where two walls meet


def cast(origins: Floats, angles: Floats, segments: Floats, reach: float) -> tuple[Floats, NDArray[np.int64]]:
    """Return the length of each ray, and the wall that it hits.

    Parameters
    ----------
    origins : float64, shape (N, 2)
        Origins of the rays, metres in the map frame.
    angles : float64, shape (N, R)
        Directions of the R rays from each origin, radians.
    segments : float64, shape (S, 4)
        Walls, x0, y0, x1, y1 in metres.
    reach : float
        Longest ray in metres.

    Returns
    -------
    distance : float64, shape (N, R)
        Metres; +inf if no wall is within `reach`.
    hit : int64, shape (N, R)
        Index of the segment that is hit, `NOTHING` if none.
    """
    distance = np.full(angles.shape, np.inf)
    hit = np.full(angles.shape, NOTHING, np.int64)
    low = np.minimum(segments[:, :2], segments[:, 2:]) - reach
    high = np.maximum(segments[:, :2], segments[:, 2:]) + reach
    step = max(1, _CHUNK // (angles.shape[1] * 16))
    for start in range(0, len(origins), step):
        part = slice(start, start + step)
        here = origins[part]
        # origins of a chunk are close together, so most walls are out of its reach
        near = np.flatnonzero(np.all((low <= here.max(0)) & (high >= here.min(0)), axis=1))
        if not len(near):
            continue
        t = _along_rays(here, angles[part], segments[near])
        nearest = t.argmin(axis=2)
        best = np.take_along_axis(t, nearest[:, :, None], axis=2)[:, :, 0]
        found = best <= reach
        distance[part] = np.where(found, best, np.inf)
        hit[part] = np.where(found, near[nearest], NOTHING)
    return distance, hit


def _along_rays(origins: Floats, angles: Floats, segments: Floats) -> Floats:
    """Return the distance along ray (n, r) to segment s, +inf if it does not meet it, shape (N, R, S)."""
    dx, dy = np.cos(angles)[:, :, None], np.sin(angles)[:, :, None]
    ax = segments[:, 0] - origins[:, :1]
    ay = segments[:, 1] - origins[:, 1:]
    ex, ey = segments[:, 2] - segments[:, 0], segments[:, 3] - segments[:, 1]
    with np.errstate(divide='ignore', invalid='ignore'):
        scale = 1.0 / (dx * ey - dy * ex)
        t = (ax * ey - ay * ex)[:, None, :] * scale
        u = (ax[:, None, :] * dy - ay[:, None, :] * dx) * scale
        met = (t > 0.0) & (u >= -_SLACK) & (u <= 1.0 + _SLACK)
    return np.where(met, t, np.inf)


def cast_discs(origins: Floats, angles: Floats, centers: Floats, radius: float) -> Floats:
    """Return the distance of each ray to the disc of its origin, +inf without intersection; NaN centres are no discs.

    Parameters
    ----------
    origins, centers : float64, shape (N, 2)
        Metres in the map frame; origin n can only hit disc n.
    angles : float64, shape (N, R)
        Radians.
    radius : float
        Metres.
    """
    x, y = (centers - origins).T[:, :, None]
    along = x * np.cos(angles) + y * np.sin(angles)
    depth = radius**2 - (x * x + y * y - along * along)
    with np.errstate(invalid='ignore'):
        distance = along - np.sqrt(depth)
        return np.where((depth >= 0.0) & (distance > 0.0), distance, np.inf)


def blocked(path: Floats, segments: Floats) -> bool:
    """Return whether a polyline, shape (P, 2) in metres, touches a wall."""
    steps = np.diff(path, axis=0)
    lengths = np.hypot(*steps.T)
    angles = np.arctan2(steps[:, 1], steps[:, 0])[:, None]
    distance, _ = cast(path[:-1], angles, segments, float(lengths.max(initial=0.0)))
    return bool(np.any(distance[:, 0] <= lengths))
