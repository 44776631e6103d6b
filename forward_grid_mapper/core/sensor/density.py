"""The density of a range: the noise about an obstacle, and the causes that no map changes.

    p(z | m) =  p_rand / z_max                                                        random measurement (*)
             +  p_lost · N(z; z_max, σ) if there is no echo, z ≥ z_max                lost echo
             +  (1 − p_rand − p_lost) · Σ_k (1 − p_hit)^(k−1) p_hit N(z; d_k, σ)      k-th obstacle, k = 1 … K
             +  (1 − p_rand − p_lost) · (1 − p_hit)^K N(z; z_max, σ)                  nothing hit, max range (0)

p_hit is that of a cell (`hit_probability`), d_k the distance of the k-th nearest occupied cell of the cone. This is eq
22, 24 and 25 of the paper with the prior of the correspondences, eq 28, summed over them. With p_lost = 0 and cells of
0.1 m it is the paper's model.
"""

from __future__ import annotations

import math
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from ..common.constants import HIT_LENGTH, MOST_HIT
from ..common.parameters import ModelParameters
from ..common.readings import Floats, Readings
from ..runtime.jit import allocating_kernel, kernel

CUT = 4.0
"""σ beyond which the noise density is taken as nil, so that few cells of a cone need a distance of their own: there it
is 3e-4 of its peak, less than random measurements account for."""

_ROOT = math.sqrt(2.0 * math.pi)


class Causes(NamedTuple):
    """The model's terms that do not depend on the map.

    Attributes
    ----------
    p_hit, mixture_weight : float
        That of a cell, and 1 − p_rand − p_lost, the weight of the causes that the map explains.
    random, lost : float64, shape (N,)
        The densities p_rand / z_max and, where there is no echo, p_lost · N(z; z_max, σ) in 1/m.
    max_range : float64, shape (N,)
        N(z; z_max, σ) in 1/m.
    """

    p_hit: float
    mixture_weight: float
    random: Floats
    lost: Floats
    max_range: Floats


@kernel
def density(error: float, sigma: float) -> float:
    """Return N(z; d, σ) in 1/m, cut off at `CUT` σ: eq 22.

    Parameters
    ----------
    error
        (z − d) / σ.
    sigma
        σ in metres.
    """
    return 1.0 / (_ROOT * sigma) * math.exp(-0.5 * error * error) if abs(error) <= CUT else 0.0


@allocating_kernel
def _densities(error: NDArray[np.float64], sigma: NDArray[np.float64]) -> Any:
    out = np.empty(len(error))
    for t in range(len(error)):
        out[t] = density(error[t], sigma[t])
    return out


def hit_probability(model: ModelParameters, resolution: float) -> float:
    """Return the probability that an occupied cell in the cone returns the echo, if none before it did.

    A surface that misses the pulse with probability 1 − p_hit over `HIT_LENGTH` misses it with the product of the
    probabilities of its parts. So the same wall is heard alike in cells of any size.

    Parameters
    ----------
    model : ModelParameters
    resolution : float
        Edge length of a cell, metres.
    """
    return float(min(1.0 - (1.0 - model.p_hit) ** (resolution / HIT_LENGTH), MOST_HIT))


def hit_parameter(probability: float, resolution: float) -> float:
    """Return the `p_hit` with which `hit_probability` is `probability` in cells of edge `resolution`, metres."""
    return float(1.0 - (1.0 - min(probability, MOST_HIT)) ** (HIT_LENGTH / resolution))


def causes_of(readings: Readings, sigma: Floats, model: ModelParameters, resolution: float) -> Causes:
    """Return the map-independent terms of each reading.

    Parameters
    ----------
    readings : Readings
    sigma : float64, shape (N,)
        From `effective_sigma`, metres.
    model : ModelParameters
    resolution : float
        Edge length of a cell, metres.
    """
    max_range: Floats = _densities((readings.z_max - readings.z) / sigma, np.ascontiguousarray(sigma))
    lost = np.where(readings.echo, 0.0, model.p_lost * max_range)
    p_hit, weight = hit_probability(model, resolution), 1.0 - model.p_rand - model.p_lost
    return Causes(p_hit, weight, model.p_rand / readings.z_max, lost, max_range)
