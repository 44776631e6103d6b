"""Searching: where a scan fits best in a local map, anywhere around a pose, from coarse to fine.

Multi-resolution correlative scan matching (Olson, 2009), with the forward model in place of a table of echoes: on a
coarse grid of poses σ of the readings is larger, so that echoes hardly miss what lies between two places. Around the
best of them a finer grid is asked, and so on. Another place that fits about as well must be known too: it tells that
the best one may be chance. So the best poses away from the first one are followed as well.
"""

from __future__ import annotations

import itertools
import math
from typing import NamedTuple

import numpy as np

from .likelihood import Scan, blurred, scores
from .local_map import LocalMap
from .matching import grid_around
from .poses import Floats, compose, relative

STEPS = (0.15, 0.15, math.radians(2.5))
"""Steps of the finest grid: metres ahead and aside, radians."""

COARSER = (4, 2)
"""Times that the steps of the grids before are as large."""

BLUR = 0.4
"""σ that is added to that of readings on a coarse grid, steps."""

FOLLOWED = (40, 25)
"""Poses of each coarse grid that a finer one lies around: so many near the best, and as many elsewhere."""

NEAR = 0.65
"""Metres from the best pose within which poses are near it."""

EVALUATED = 60
"""Readings that are asked at each pose."""

LARGE = 300
"""Poses of the finest grid from which on coarse ones come first."""

_AROUND = np.array(list(itertools.product((-1, 0, 1), repeat=3)))


class Searched(NamedTuple):
    """Poses of the finest grid that were asked.

    Attributes
    ----------
    poses : float64, shape (P, 3)
    values : float64, shape (P,)
        Σ log ratio of the scan.
    prior : float64, shape (P,)
        ½ (off / σ)².
    """

    poses: Floats
    values: Floats
    prior: Floats

    @property
    def best(self) -> Floats:
        """The likeliest pose, shape (3,)."""
        out: Floats = self.poses[int((self.values - self.prior).argmax())]
        return out


def search(scan: Scan, around: LocalMap, guess: Floats, sigma: Floats, reach: Floats) -> Searched:
    """Return what fits around a pose.

    Parameters
    ----------
    scan : Scan
    around : LocalMap
    guess : float64, shape (3,)
        The pose that is expected.
    sigma, reach : float64, shape (3,)
        By how much it may be off, and how far is searched, either way: metres ahead and aside, radians.
    """

    def evaluate(poses: Floats, times: int) -> Searched:
        coarse = blurred(scan, BLUR * times * STEPS[0], around) if times > 1 else scan
        prior = 0.5 * ((relative(guess, poses) / sigma) ** 2).sum(1)
        return Searched(poses, scores(coarse, around, poses, max(len(scan.readings) // EVALUATED, 1)), prior)

    most = np.floor(reach / STEPS + 1e-9).astype(np.int64)
    if np.prod(2 * most + 1) <= LARGE:
        return evaluate(grid_around(guess, reach, STEPS), 1)
    axes = [np.arange(-(n // COARSER[0]) * COARSER[0], n + 1, COARSER[0]) for n in most.tolist()]
    steps = np.stack([axis.ravel() for axis in np.meshgrid(*axes, indexing='ij')], axis=1)
    for times, finer, count in zip(COARSER, (*COARSER[1:], 1), FOLLOWED, strict=True):
        found = evaluate(compose(guess, steps * STEPS), times)
        order = np.argsort(found.prior - found.values, kind='stable')
        apart = relative(found.best, found.poses[order])
        near = np.hypot(apart[:, 0], apart[:, 1]) <= NEAR
        kept = np.concatenate([order[near][:count], order[~near][:count]])
        steps = np.unique((steps[kept][:, None] + finer * _AROUND).reshape(-1, 3), axis=0)
        steps = steps[(np.abs(steps) <= most).all(1)]
    return evaluate(compose(guess, steps * STEPS), 1)
