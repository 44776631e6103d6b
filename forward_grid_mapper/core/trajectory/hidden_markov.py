"""A hidden Markov model whose state is on a circle: forward filtering and backward smoothing.

The state has one of S values on a circle, and is of one of D kinds. Each motion has its own density, and the kind may
change with it. The belief over all states is kept (histogram filter), so contradicting votes are not fatal.
"""

from __future__ import annotations

from typing import Any

import numpy as np

from ..common.readings import Floats
from ..runtime.jit import inlined_kernel, kernel

TINY = 1e-300
"""Smallest probability of a state, so that later votes can still raise it."""


@inlined_kernel
def move(belief: Any, density: Any, other: float, out: Any) -> None:
    """Write the belief after a motion to `out`: the prediction step of the Bayes filter.

    Parameters
    ----------
    belief : float64, shape (D, S)
    density : float64, shape (S,)
        Probabilities of moving by 0, 1, … S − 1 steps.
    other : float
        Probability that the kind is drawn again, uniformly from all D.
    out : float64, shape (D, S)
    """
    kinds, size = np.uint64(belief.shape[0]), np.uint64(belief.shape[1])
    out[:] = 0.0
    for d in range(kinds):
        for i in range(size):
            here = belief[d, i]
            # unsigned, so that numba does not test for negative indices
            for k in range(size - i):
                out[d, i + k] += here * density[k]
            for k in range(size - i, size):
                out[d, i + k - size] += here * density[k]
    if other > 0.0:
        for i in range(size):
            mean = 0.0
            for d in range(kinds):
                mean += out[d, i]
            mean /= belief.shape[0]
            for d in range(kinds):
                out[d, i] = (1.0 - other) * out[d, i] + other * mean


@kernel
def _weigh(belief: Any, weights: Any, out: Any) -> float:
    """Write belief × weights, normalised, to `out`, and return the sum before; `out` may be `belief`."""
    total = 0.0
    for d in range(belief.shape[0]):
        for i in range(belief.shape[1]):
            out[d, i] = max(belief[d, i], TINY) * weights[d, i]
            total += out[d, i]
    for d in range(belief.shape[0]):
        for i in range(belief.shape[1]):
            out[d, i] /= total
    return total


@kernel
def _forward(likelihood: Any, densities: Any, others: Any, beliefs: Any, sums: Any) -> None:
    rows = len(beliefs)
    for k in range(len(likelihood)):
        now = beliefs[k % rows]
        if k:
            move(beliefs[(k - 1) % rows], densities[k - 1], others[k - 1], now)
        sums[k] = _weigh(now, likelihood[k], now)


@kernel
def _backward(likelihood: Any, densities: Any, others: Any, later: Any, weighed: Any) -> None:
    last = len(likelihood) - 1
    later[last] = 1.0
    for k in range(last - 1, -1, -1):
        _weigh(later[k + 1], likelihood[k + 1], weighed)
        move(weighed, densities[k], others[k], later[k])


def forward(
    likelihood: Floats, densities: Floats, others: Floats, start: Floats, keep: bool = False
) -> tuple[float, Floats]:
    """Return the log-likelihood of all votes, and the belief at each place given the votes up to it.

    Parameters
    ----------
    likelihood : float64, shape (B, D, S)
        Of the votes of each place.
    densities : float64, shape (B - 1, S)
        Of the motion from each place to the next.
    others : float64, shape (B - 1,)
        Probability that the kind is drawn again during each motion.
    start : float64, shape (S,)
        Prior of the values; all kinds are equally likely.
    keep : bool
        Whether all beliefs are returned, shape (B, D, S); otherwise only the last two.
    """
    beliefs = np.empty((len(likelihood) if keep else 2, *likelihood.shape[1:]))
    beliefs[0] = start / likelihood.shape[1]
    sums = np.empty(len(likelihood))
    _forward(likelihood, densities, others, beliefs, sums)
    return float(np.log(sums).sum()), beliefs


def smooth(likelihood: Floats, densities: Floats, others: Floats, start: Floats) -> Floats:
    """Return the belief at each place given all votes, shape (B, D, S); the parameters are those of `forward`."""
    _, out = forward(likelihood, densities, others, start, keep=True)
    later = np.empty_like(out)
    # backward in time the steps are reversed; drawing the kind again is symmetric
    _backward(likelihood, np.roll(densities[:, ::-1], 1, axis=1), others, later, np.empty_like(later[0]))
    out *= np.maximum(later, TINY)
    out /= out.sum(axis=(1, 2), keepdims=True)
    return out
