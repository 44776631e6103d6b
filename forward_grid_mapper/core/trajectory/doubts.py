"""Places at which a right angle of the heading may have been lost.

The probability that none was lost, from the start of the drive to each place, should never increase. Where its running
minimum decreases clearly, the place is doubtful.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from ..common.readings import Floats

DOUBTFUL, PAUSE = 0.02, 5
"""Least probability that a right angle was lost at a doubtful place, and fewest votes between two such places."""

NEGLIGIBLE = 1e-4
"""Places with a smaller probability are ignored."""


def doubts(at: NDArray[np.int64], certain: Floats) -> tuple[tuple[int, float], ...]:
    """Return the nodes at which the probability that no right angle was lost decreases, and by how much.

    Parameters
    ----------
    at : int64, shape (B,)
    certain : float64, shape (B,)
        This probability from the start of the drive to each node.
    """
    falls = _falls(certain)
    out = []
    for part in _doubtful(falls):
        sums = np.cumsum(falls[part])
        out.append((int(at[part[np.searchsorted(sums, sums[-1] / 2)]]), float(sums[-1])))
    return tuple(out)


def slight(at: NDArray[np.int64], certain: Floats) -> tuple[tuple[int, float], ...]:
    """Return the nodes at which it decreases less than for a doubt, and by how much; the parameters of `doubts`."""
    falls = _falls(certain)
    for part in _doubtful(falls):
        falls[part] = 0.0
    return tuple((int(at[k]), float(falls[k])) for k in np.flatnonzero(falls > NEGLIGIBLE))


def _falls(certain: Floats) -> Floats:
    """Return the decrease of the running minimum at each place, shape (B,)."""
    out: Floats = -np.diff(np.minimum.accumulate(certain), prepend=certain[0])
    return out


def _doubtful(falls: Floats) -> list[NDArray[np.int64]]:
    """Return the runs of consecutive places that are doubtful."""
    falling = np.flatnonzero(falls > DOUBTFUL / 10)
    runs = np.split(falling, np.flatnonzero(np.diff(falling) > PAUSE) + 1)
    return [run for run in runs if falls[run].sum() >= DOUBTFUL]
