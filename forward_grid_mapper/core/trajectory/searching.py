"""Searching: the best pose of a scan on a local map within a large area, from coarse to fine.

Multi-resolution correlative scan matching (Olson, 2009) with the forward model in place of a lookup table. On a coarse
grid of poses, σ of the readings is larger, so that peaks between grid points are not missed. Finer grids are evaluated
only around the best poses. Whether the best pose is unique must be known as well, so the best poses away from it are
refined too.
"""

from __future__ import annotations

import itertools
import math
from typing import NamedTuple

import numpy as np

from ..common.readings import Floats
from .likelihood import Scan, blurred, scores
from .local_map import LocalMap
from .matching import grid_around
from .poses import compose, relative

STEPS = (0.15, 0.15, math.radians(2.5))
"""Steps of the finest grid: metres ahead and aside, radians."""

COARSER = (4, 2)
"""Factors of the steps of the coarser grids."""

BLUR = 0.4
"""σ added to that of the readings on a coarse grid, in steps of that grid."""

FOLLOWED = (40, 25)
"""Poses of each coarse grid that are refined: this many near the best one, and as many away from it."""

NEAR = 0.65
"""Metres within which a pose is near the best one."""

EVALUATED = 60
"""Readings that are evaluated at each pose."""

LARGE = 300
"""Largest number of poses of the finest grid that is evaluated without coarse grids."""

_AROUND = np.array(list(itertools.product((-1, 0, 1), repeat=3)))


class Searched(NamedTuple):
    """The evaluated poses of a grid.

    Attributes
    ----------
    poses : float64, shape (P, 3)
    values : float64, shape (P,)
        Log-likelihood ratio of the scan, nats.
    prior : float64, shape (P,)
        Negative log of the prior, ½ ‖(pose − guess) / σ‖², nats.
    """

    poses: Floats
    values: Floats
    prior: Floats

    @property
    def best(self) -> Floats:
        """The pose of the largest posterior, shape (3,)."""
        out: Floats = self.poses[int((self.values - self.prior).argmax())]
        return out


def search(scan: Scan, around: LocalMap, guess: Floats, sigma: Floats, reach: Floats) -> Searched:
    """Return the evaluated poses of the finest grid around a pose.

    Parameters
    ----------
    scan : Scan
    around : LocalMap
    guess : float64, shape (3,)
        The expected pose.
    sigma, reach : float64, shape (3,)
        σ of the prior, and half the size of the searched area: metres ahead and aside, radians.
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
