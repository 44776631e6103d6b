"""The uncertainty map: calibrated leave-one-cell-out marginals of the map that was found ((41)-(45) of the paper).

With Δ = log p(Z | cell occupied, rest of m) − log p(Z | cell free, rest of m), (43) is logit q = Δ + h_p, and (45)
mixes it with the prior: logit q = α (Δ + h_p) + (1 − α) h_p = α Δ + h_p. This is `marginals`. It assumes that readings
are independent and the rest of the map is certain, and is overconfident. With the prior for walls, `calibrated` has

    logit q = α T(Δ) + neighbours + [occupied] + passes around

**T(Δ) = ± log (1 + |Δ|).** Readings are correlated, by an unknown amount. So their log-likelihood ratio is multiplied
by a factor γ with an exponential distribution of mean one. The expectation of exp(−γ |Δ|) is 1 / (1 + |Δ|), the odds of
the less likely state.

**Neighbours.** Log odds of a cell given which of its neighbours are occupied, by six kinds of patterns, since walls
continue; and whether it is occupied itself.

**Passes around.** Walls are where free space ends: a cell that many readings passed on one side and none on the other
is likelier a wall than a cell in the open.

The weights were fitted by logistic regression on simulated worlds.

A cell that is unknown on the map stays unknown if the readings give less than a tenth of a nat: the prior alone is no
observation, and would look rather free. It stays unknown as well if readings are against an obstacle, but hardly any of
them would have detected a surface of any normal (`free_space`).
"""

from __future__ import annotations

import math

import numpy as np
from numpy.typing import NDArray

from ..common.constants import LEAST_EVIDENCE, LEAST_NOTICING
from ..common.parameter_groups import SearchParameters
from ..common.readings import Floats
from ..evidence.neighbourhood import continues, occupied_of, patterns
from .free_space import Passes

HOLE, INSIDE, STEP, END, BESIDE, ALONE = 1.10, 0.20, -0.20, -1.23, -2.56, -1.95
"""Log odds by the occupied neighbours of a cell, nats. `HOLE`, `INSIDE`: on opposite sides, 135° or more apart, with at
least three of the four that share an edge, or with fewer. `STEP`: two at a right angle that share an edge, as at a
corner, or at a step of a slanted wall. `BESIDE`: three in a row, as beside a wall. `ALONE`: none. `END`: others."""

OCCUPIED = 1.31
"""Log odds in addition for a cell that is occupied, nats."""

LEAST_AROUND, MEAN_AROUND = -1.30, 0.29
"""Coefficients of log(1 + passes), nats: of the smallest number of passes among a cell and its neighbours, and of their
mean."""


def kind_of(pattern: int) -> float:
    """Return the log odds of a cell by the pattern of its occupied neighbours, nats."""
    bits = occupied_of(pattern)
    sides = sum(k % 2 == 0 for k in bits)
    if continues(pattern):
        return HOLE if sides >= 3 else INSIDE
    if any(k % 2 == 0 and (k + 2) % 8 in bits for k in bits):
        return STEP
    if not bits:
        return ALONE
    return BESIDE if sides and len(bits) >= 3 else END


BLOCK = 50_000
"""Cells that are calibrated at once, to bound the memory."""

KINDS = np.array([kind_of(pattern) for pattern in range(256)])


def marginals(evidence: Floats, parameters: SearchParameters) -> Floats:
    """Return the occupancy probability of cells from their evidence by (45).

    Parameters
    ----------
    evidence : float64
        Δ in nats, any shape.
    parameters : SearchParameters
        `alpha` and `prior` are used.
    """
    base = math.log(parameters.prior / (1 - parameters.prior))
    return _probability(parameters.alpha * evidence + base)


def _probability(logit: Floats) -> Floats:
    out: Floats = 1.0 / (1.0 + np.exp(-np.clip(logit, -500.0, 500.0)))
    return out


def discounted(evidence: Floats) -> Floats:
    """Return T(Δ) of the module docstring: evidence discounted for unknown correlations of readings, nats."""
    out: Floats = np.copysign(np.log1p(np.abs(evidence)), evidence)
    return out


def around(passed: Floats) -> tuple[Floats, Floats]:
    """Return minimum and mean over each cell and its eight neighbours, shape (height, width); 0 outside of the grid."""
    wide = np.pad(passed, 1)
    below, here, above = wide[:-2], wide[1:-1], wide[2:]
    least, total = np.minimum(np.minimum(below, here), above), below + here + above
    least = np.minimum(np.minimum(least[:, :-2], least[:, 1:-1]), least[:, 2:])
    return least, (total[:, :-2] + total[:, 1:-1] + total[:, 2:]) / 9.0


def calibrated(
    evidence: Floats, passed: Floats, ml: NDArray[np.int8], parameters: SearchParameters
) -> NDArray[np.float32]:
    """Return the occupancy probability of cells, shape `ml.shape`.

    Parameters
    ----------
    evidence : float64, shape `ml.shape`
        Δ in nats.
    passed : float64, shape `ml.shape`
        Readings that passed each cell, `Passes.all`.
    ml : int8, shape (height, width)
        The map: 1 where occupied.
    parameters : SearchParameters
        `alpha` is used.
    """
    occupied = (ml == 1).astype(np.uint8)
    kinds = patterns(occupied.ravel(), ml.shape).reshape(ml.shape)
    out = np.empty(ml.shape, np.float32)
    height, width = ml.shape
    step = max(BLOCK // max(width, 1), 1)
    for begin in range(0, height, step):
        rows, first = slice(begin, begin + step), max(begin - 1, 0)
        # with one more row on each side, whose own results are dropped
        least, mean = (of[begin - first :][:step] for of in around(passed[first : begin + step + 1]))
        logit = parameters.alpha * discounted(evidence[rows]) + KINDS[kinds[rows]] + OCCUPIED * occupied[rows]
        out[rows] = _probability(logit + LEAST_AROUND * np.log1p(least) + MEAN_AROUND * np.log1p(mean))
    return out


def uncertainty_map(
    evidence: Floats,
    passes: Passes | None,
    ml: NDArray[np.int8],
    traversed: NDArray[np.bool_],
    parameters: SearchParameters,
) -> NDArray[np.float32]:
    """Return the occupancy probability of the cells of a map, NaN if not observed, shape `ml.shape`.

    Parameters
    ----------
    evidence : float64, shape (cells,)
        Δ in nats.
    passes : Passes, optional
        Of each cell. Without them, the result is that of (45), and only the evidence decides which cells are observed.
    ml : int8, shape (height, width)
        The maximum likelihood map: 1 occupied, 0 free, -1 not observed.
    traversed : bool, shape `ml.shape`
        Cells that the robot traversed, in which no obstacle can be.
    parameters : SearchParameters
    """
    evidence_of_cells = evidence.reshape(ml.shape)
    silent = np.abs(evidence_of_cells) < LEAST_EVIDENCE
    if passes is None:
        probability = marginals(evidence_of_cells, parameters).astype(np.float32)
    else:
        probability = calibrated(evidence_of_cells, passes.all.reshape(ml.shape), ml, parameters)
        silent |= (evidence_of_cells < 0) & (passes.noticing.reshape(ml.shape) < LEAST_NOTICING)
        probability[traversed] = 0.0
    probability[(ml < 0) & silent] = np.nan
    return probability
