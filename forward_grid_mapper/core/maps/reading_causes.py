"""The likeliest cause of each reading, given the maximum likelihood map."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from .map_set import MapSet

CAUSES = ('hit', 'random', 'lost', 'no_echo')
"""Causes of a reading, by the names of the fields of `Expectations`."""

RANDOM = CAUSES.index('random')


def likeliest_causes(maps: MapSet) -> NDArray[np.uint8]:
    """Return the likeliest cause of each reading, an index into `CAUSES`, shape (N,).

    A reading is random only if that is likelier than all other causes together, as in the report.
    """
    expected = maps.forward_model().expectations(maps.ml)
    likely = np.stack([getattr(expected, name) for name in CAUSES])
    likely[RANDOM] = np.where(maps.unexplained, 2.0, 0.0)
    return np.asarray(likely.argmax(axis=0), np.uint8)
