"""The prior of a map: a Markov random field of occupied cells, given their neighbours and the traversed cells.

    log p(m) = Σ over occupied cells c of [ local(c) + shape(pattern of the occupied ones of its eight neighbours) ]

The search uses two priors, one after the other. In the first, cells are independent, as in the paper: an occupied cell
has the log odds of `prior`. In the second, walls are curves: a curve costs `wall_cost` for each metre and `end_cost`
for each of its two ends. A cell with two occupied neighbours on opposite sides is inside a curve; any other cell is an
end; a cell without neighbours is a curve with both ends in one cell. A corner of less than 135° costs as much as an
end. Both costs do not depend on the cell size.

No sensor moves through a wall, so traversed cells are never occupied.
"""

from __future__ import annotations

import math
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from ..common.constants import FORBIDDEN
from ..common.parameter_groups import SearchParameters
from ..common.readings import Floats
from ..evidence.neighbourhood import NEIGHBOURS, continues, offset, opposite, patterns
from ..runtime.jit import allocating_kernel, inlined_kernel


class Prior(NamedTuple):
    """Log prior odds.

    Attributes
    ----------
    local : float64, shape (cells,)
        Of each cell alone; at most 0, except for occupied cells that must not change.
    shape : float64, shape (256,)
        Of each pattern of occupied neighbours; bit k stands for the neighbour k eighths of a turn from the x axis.
    most : float
        An upper bound of `local` for free cells.
    """

    local: Floats
    shape: Floats
    most: float = 0.0


def has_walls(parameters: SearchParameters) -> bool:
    """Return whether there is a prior for walls; without one, cells are independent, as in the paper."""
    return parameters.end_cost > 0


def independent_prior(parameters: SearchParameters, traversed: NDArray[np.bool_]) -> Prior:
    """Return the prior of independent cells.

    Parameters
    ----------
    parameters : SearchParameters
        `prior` is used.
    traversed : bool, shape (cells,)
        Cells that the robot traversed.
    """
    odds = math.log(parameters.prior / (1 - parameters.prior))
    return Prior(_local(odds, traversed), np.zeros(256), odds)


def wall_prior(parameters: SearchParameters, traversed: NDArray[np.bool_], resolution: float) -> Prior:
    """Return the prior for walls, or that of independent cells if `has_walls` is false.

    Parameters
    ----------
    parameters : SearchParameters
        `wall_cost` and `end_cost` are used.
    traversed : bool, shape (cells,)
        Cells that the robot traversed.
    resolution : float
        Cell size, metres.
    """
    if not has_walls(parameters):
        return independent_prior(parameters, traversed)
    odds = -parameters.wall_cost * resolution
    return Prior(_local(odds, traversed), shapes(parameters.end_cost), odds)


def _ends() -> Floats:
    """Return the number of ends of a wall in a cell with each of the 256 patterns of neighbours."""
    out = np.ones(256)
    out[0] = 2.0
    for pattern in range(1, 256):
        if continues(pattern):
            out[pattern] = 0.0
    return out


_ENDS = _ends()


def shapes(end_cost: float) -> Floats:
    """Return `Prior.shape`, the log prior odds by each of the 256 patterns, nats."""
    # 0, not −0, if there is no end
    return 0.0 - end_cost * _ENDS


def _local(odds: float, traversed: NDArray[np.bool_]) -> Floats:
    out: Floats = np.where(traversed, -FORBIDDEN, odds)
    return out


@inlined_kernel
def prior_gain(prior: Prior, occupied: NDArray[np.uint8], pattern: NDArray[np.uint8], c: int, width: int) -> float:
    """Return the change of the log prior by flipping cell c."""
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
    """Return the log prior odds of each cell given the rest of a map, nats, shape (cells,).

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
    # numpy.flatnonzero is several times faster for bool
    cells = np.flatnonzero(occupied.view(np.bool_))
    return float(prior.local[cells].sum() + prior.shape[pattern[cells]].sum())
