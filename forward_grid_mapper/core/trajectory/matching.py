"""Scan matching on a local map: the pose of a scan, and its information matrix.

A parabola is fitted to the log-likelihood ratio at 27 poses around a pose:

    Σ log ratio(x + s q) ≈ a + gᵀ q − ½ qᵀ H q

Its top is the measured pose, and H, in units of the steps s, the information. Directions in which the parabola has no
curvature, as along a bare corridor, are not measured.
"""

from __future__ import annotations

import itertools
import math
from typing import NamedTuple

import numpy as np

from ..common.readings import Floats
from .likelihood import Scan, scores
from .local_map import LocalMap
from .poses import compose

CURVED = np.array([0.06, 0.06, math.radians(1.5)])
"""s: steps between the 27 poses; metres along x and y of the map, and radians."""

LEAST_CURVATURE = 0.02
"""Least curvature of a direction that is measured, nats a step²: smaller ones come from the discrete cells."""

FARTHEST_TOP = 2.0
"""Largest distance of the top of a parabola from the middle, steps; it is clipped to this."""

ENOUGH = 32
"""Readings that are evaluated to measure a pose: more of a short piece of the drive add little, and take time."""

CLIMBS = 3
"""Times that the best pose of a search is moved to the top of a parabola."""

COARSE = (0.1, 0.1, math.radians(2.5))
"""Steps of a search: metres ahead and aside, radians."""

NEIGHBOURS = np.array(list(itertools.product((-1.0, 0.0, 1.0), repeat=3)))
"""The 27 poses around one, in steps."""


def _parabola() -> Floats:
    """Return the matrix (10, 27) that fits 1, x, y, t, x²/2, y²/2, t²/2, xy, xt, yt to values at `NEIGHBOURS`."""
    x, y, t = NEIGHBOURS.T
    columns = [np.ones(27), x, y, t, x * x / 2, y * y / 2, t * t / 2, x * y, x * t, y * t]
    out: Floats = np.linalg.pinv(np.stack(columns, axis=1))
    return out


_PARABOLA = _parabola()


class Match(NamedTuple):
    """The measured pose of a scan on a local map.

    Attributes
    ----------
    pose : float64, shape (3,)
        Of the scan in the frame of the map.
    information : float64, shape (3, 3)
        In the axes of the map; its rank is less than 3 if a direction is not measured.
    score : float
        Sum of the log-likelihood ratios of the readings at the given pose, not at the measured one; nats.
    """

    pose: Floats
    information: Floats
    score: float


def measure(scan: Scan, around: LocalMap, pose: Floats, most: int = ENOUGH) -> Match:
    """Return the measured pose of a scan near a pose; if it has more than `most` readings, every n-th is evaluated."""
    stride = max(math.ceil(len(scan.readings) / most), 1)
    values = scores(scan, around, pose + NEIGHBOURS * CURVED, stride)
    fit = _PARABOLA @ values
    xx, yy, tt, xy, xt, yt = -fit[4:]
    curvature, axes = np.linalg.eigh(np.array([[xx, xy, xt], [xy, yy, yt], [xt, yt, tt]]))
    kept = curvature > LEAST_CURVATURE
    curvature, axes = curvature[kept], axes[:, kept]
    top = np.clip(axes @ (axes.T @ fit[1:4] / curvature), -FARTHEST_TOP, FARTHEST_TOP)
    # scores are scaled up to all readings, but only those evaluated give information
    information: Floats = (axes * curvature) @ axes.T / np.outer(CURVED, CURVED) / stride
    return Match(pose + top * CURVED, information, float(values[13]))


def climbed(scan: Scan, around: LocalMap, pose: Floats, most: int) -> Floats:
    """Return the best pose of a search, moved to the top of the parabola around it `CLIMBS` times; shape (3,)."""
    for _ in range(CLIMBS):
        pose = measure(scan, around, pose, most).pose
    return pose


def grid_around(center: Floats, reach: Floats, steps: tuple[float, float, float] = COARSE) -> Floats:
    """Return the poses of a grid along the axes of `center`, within ± `reach` of it, shape (P, 3)."""
    axes = []
    for far, step in zip(reach, steps, strict=True):
        n = math.floor(far / step + 1e-9)
        axes.append(np.arange(-n, n + 1) * step)
    offsets = np.stack([axis.ravel() for axis in np.meshgrid(*axes, indexing='ij')], axis=1)
    return compose(center, offsets)
