"""The prior of a map: how likely cells are occupied, given what is traversed over and given their neighbours.

    log p(m) = Σ over occupied cells c of [ local(c) + shape(the occupied ones of its eight neighbours) ]

Walls are curves. A cell through which a curve passes, with two occupied neighbours on opposite sides of it, costs next
to nothing; the end of a curve costs something, and a cell on its own more. With all three 0 this is the paper's
prior, where cells are independent.
"""

from __future__ import annotations

import math
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from ..common.parameters import SearchParameters
from ..evidence.neighbourhood import NEIGHBOURS, offset, opposite, patterns
from ..runtime.jit import allocating_kernel, kernel
from ..sensor.cone_table import Floats

OPPOSITE_ENOUGH = 3
"""Eighths of a turn between two neighbours that a curve can pass through."""


class Prior(NamedTuple):
    """Log prior odds.

    Attributes
    ----------
    local : float64, shape (cells,)
        Of each cell by itself.
    shape : float64, shape (256,)
        What the pattern of occupied neighbours adds; bit k stands for the neighbour k eighths of a turn from east.
    """

    local: Floats
    shape: Floats


LEAST_COST = 0.05
"""Nats that a cell of a wall must cost, all in all; if walls were likelier than none, they would grow out of sight."""


def shapes(parameters: SearchParameters) -> Floats:
    """Return what each of the 256 patterns adds to the log prior odds of an occupied cell."""
    cost = math.log((1 - parameters.prior) / parameters.prior)
    line = min(parameters.line_bonus, max(cost - LEAST_COST, 0.0))
    out = np.full(256, -parameters.end_cost)
    out[0] = -parameters.isolated_cost
    for pattern in range(1, 256):
        bits = [k for k in range(8) if pattern >> k & 1]
        if any(min((a - b) % 8, (b - a) % 8) >= OPPOSITE_ENOUGH for a in bits for b in bits):
            out[pattern] = line
    return out


def local_prior(parameters: SearchParameters, traversed: NDArray[np.bool_]) -> Floats:
    """Return the log prior odds of each cell by itself, given which are `traversed` over; the same shape."""
    odds = math.log(parameters.prior / (1 - parameters.prior))
    out: Floats = np.where(traversed, odds - parameters.driven_cost, odds)
    return out


@kernel
def prior_gain(prior: Prior, occupied: NDArray[np.uint8], pattern: NDArray[np.uint8], c: int, width: int) -> float:
    """Return what flipping cell c adds to the log prior."""
    own = pattern[c]
    gain = prior.local[c] + prior.shape[own]
    if own:
        for k in range(NEIGHBOURS):
            if own >> k & 1:
                o = c + offset(k, width)
                bit = 1 << opposite(k)
                gain += prior.shape[pattern[o] | bit] - prior.shape[pattern[o] & ~bit & 255]
    return float(-gain if occupied[c] else gain)


@allocating_kernel
def prior_gains(prior: Prior, occupied: NDArray[np.uint8], pattern: NDArray[np.uint8], width: int) -> Floats:
    """Return `prior_gain` of all cells, shape (cells,)."""
    out = np.zeros(len(occupied))
    for c in range(len(out)):
        out[c] = prior_gain(prior, occupied, pattern, c, width)
    return out


def odds_given_neighbours(prior: Prior, occupied: NDArray[np.bool_]) -> Floats:
    """Return the log prior odds of each cell given the rest of a map, in nats, shape (cells,).

    Parameters
    ----------
    prior : Prior
    occupied : bool, shape (height, width)
    """
    filled = occupied.ravel().astype(np.uint8)
    gains = prior_gains(prior, filled, patterns(filled, occupied.shape), occupied.shape[1])
    out: Floats = np.where(occupied.ravel(), -gains, gains)
    return out


def log_prior(prior: Prior, occupied: NDArray[np.uint8], pattern: NDArray[np.uint8]) -> float:
    """Return the log prior of a map, up to a constant."""
    cells = np.flatnonzero(occupied)
    return float(prior.local[cells].sum() + prior.shape[pattern[cells]].sum())
