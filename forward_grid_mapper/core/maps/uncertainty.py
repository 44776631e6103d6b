"""The uncertainty map: leave-one-cell-out marginals of the map found, mixed with the prior ((41)-(45) of the paper).

Of a cell that the map does not know, and of which the readings say less than a tenth of a nat, nothing is said at all:
the prior alone is no observation, and it would pass for rather free.
"""

from __future__ import annotations

import math

import numpy as np
from numpy.typing import NDArray

from ..common.constants import LEAST_EVIDENCE
from ..common.parameters import SearchParameters
from ..sensor.cone_table import Floats


def marginals(evidence: Floats, neighbours: Floats, parameters: SearchParameters) -> NDArray[np.float32]:
    """Return the occupancy probability of cells from their evidence.

    With Δ = log p(Z | cell occupied, rest of m) − log p(Z | cell free, rest of m), (43) is logit q = Δ + h_p, and
    (45) mixes it with the prior: logit q = α (Δ + h_p) + (1 − α) h_p = α Δ + h_p. What the prior says of the cell
    given its neighbours in m comes with a weight of its own, since it says too much: logit q = α Δ + β G + h_p.

    Parameters
    ----------
    evidence : float64
        Δ in nats, any shape.
    neighbours : float64, same shape
        G, the prior log odds of each cell given its neighbours, nats.
    parameters : SearchParameters
        Of which `alpha`, `neighbour_weight` and `uncertainty_prior` count.
    """
    p = parameters
    base = math.log(p.uncertainty_prior / (1 - p.uncertainty_prior))
    logit = np.clip(p.alpha * evidence + p.neighbour_weight * neighbours + base, -500.0, 500.0)
    return (1.0 / (1.0 + np.exp(-logit))).astype(np.float32)


def uncertainty_map(
    evidence: Floats, neighbours: Floats, ml: NDArray[np.int8], parameters: SearchParameters
) -> NDArray[np.float32]:
    """Return the occupancy probability of the cells of a map, NaN where it is not observed, shape `ml.shape`.

    Parameters
    ----------
    evidence, neighbours : float64, shape (cells,)
        As in `marginals`.
    ml : int8, shape (height, width)
        The maximum likelihood map: 1 occupied, 0 free, -1 not observed.
    parameters : SearchParameters
    """
    probability = marginals(evidence, neighbours, parameters).reshape(ml.shape)
    silent = np.abs(evidence.reshape(ml.shape)) < LEAST_EVIDENCE
    probability[(ml < 0) & silent] = np.nan
    return probability
