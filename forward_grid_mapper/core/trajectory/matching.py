"""Matching: where a scan fits in a local map, and how certain that is.

Near a pose the log-likelihood ratio is taken as a parabola through 27 poses around it:

    Σ log ratio(x + s q) ≈ a + gᵀ q − ½ qᵀ H q

whose top is the measured pose, with the information H. Directions in which the parabola is not curved, as along a bare
corridor, are not measured.
"""

from __future__ import annotations

import itertools
import math
from typing import NamedTuple

import numpy as np

from .likelihood import Scan, scores
from .local_map import LocalMap
from .poses import Floats, compose

CURVED = np.array([0.06, 0.06, math.radians(1.5)])
"""s: metres ahead and aside, and radians, between the poses of a parabola."""

LEAST_CURVATURE = 0.02
"""Nats from which on a direction is measured: less is the chance of where cells happen to lie."""

FARTHEST_TOP = 2.0
"""Steps that the top of a parabola may lie away."""

ENOUGH = 32
"""Readings that measure a pose: more of a short piece of the drive tell little more, and take time."""

COARSE = (0.1, 0.1, math.radians(2.5))
"""Steps of a search: metres ahead and aside, radians."""

NEIGHBOURS = np.array(list(itertools.product((-1.0, 0.0, 1.0), repeat=3)))
"""The 27 poses around one, in steps."""


def _parabola() -> Floats:
    """Return the matrix (10, 27) from values at `NEIGHBOURS` to 1, x, y, t, xx, yy, tt, xy, xt, yt."""
    x, y, t = NEIGHBOURS.T
    columns = [np.ones(27), x, y, t, x * x / 2, y * y / 2, t * t / 2, x * y, x * t, y * t]
    out: Floats = np.linalg.pinv(np.stack(columns, axis=1))
    return out


_PARABOLA = _parabola()


class Match(NamedTuple):
    """Where a scan fits.

    Attributes
    ----------
    pose : float64, shape (3,)
        Of the scan in the frame of the map.
    information : float64, shape (3, 3)
        Along the axes of the map; of rank 3 or less.
    score : float
        Σ log ratio at the pose that was asked for, in nats.
    """

    pose: Floats
    information: Floats
    score: float


def measure(scan: Scan, around: LocalMap, pose: Floats, most: int = ENOUGH) -> Match:
    """Return where a scan fits near a pose; of more readings than `most`, some are asked, evenly."""
    stride = max(math.ceil(len(scan.readings) / most), 1)
    values = scores(scan, around, pose + NEIGHBOURS * CURVED, stride)
    fit = _PARABOLA @ values
    xx, yy, tt, xy, xt, yt = -fit[4:]
    curvature, axes = np.linalg.eigh(np.array([[xx, xy, xt], [xy, yy, yt], [xt, yt, tt]]))
    kept = curvature > LEAST_CURVATURE
    curvature, axes = curvature[kept], axes[:, kept]
    top = np.clip(axes @ (axes.T @ fit[1:4] / curvature), -FARTHEST_TOP, FARTHEST_TOP)
    # those asked tell no more than they are, though they stand for all in the score
    information: Floats = (axes * curvature) @ axes.T / np.outer(CURVED, CURVED) / stride
    return Match(pose + top * CURVED, information, float(values[13]))


def grid_around(center: Floats, reach: Floats, steps: tuple[float, float, float] = COARSE) -> Floats:
    """Return poses on a grid in the frame of `center`, up to `reach` either way, shape (P, 3)."""
    axes = []
    for far, step in zip(reach, steps, strict=True):
        n = math.floor(far / step + 1e-9)
        axes.append(np.arange(-n, n + 1) * step)
    offsets = np.stack([axis.ravel() for axis in np.meshgrid(*axes, indexing='ij')], axis=1)
    return compose(center, offsets)
