"""The uncertainty map: leave-one-cell-out marginals of the map found, mixed with the prior (eq 41-45)."""

from __future__ import annotations

import math

import numpy as np
from numpy.typing import NDArray

from .cones import Floats
from .parameters import SearchParameters


def marginals(evidence: Floats, parameters: SearchParameters) -> NDArray[np.float32]:
    """Return the occupancy probability of cells from their evidence.

    With Δ = log p(Z | cell occupied, rest of m) − log p(Z | cell free, rest of m), eq 43 is logit q = Δ + h_p, and
    eq 45 mixes it with the prior: logit q = α (Δ + h_p) + (1 − α) h_p = α Δ + h_p.

    Parameters
    ----------
    evidence : float64
        Δ in nats, any shape.
    parameters : SearchParameters
        Of which `alpha` and `uncertainty_prior` count.
    """
    prior = parameters.uncertainty_prior
    logit = np.clip(parameters.alpha * evidence + math.log(prior / (1 - prior)), -500.0, 500.0)
    return (1.0 / (1.0 + np.exp(-logit))).astype(np.float32)
