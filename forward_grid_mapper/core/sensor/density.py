"""The density of a range: the noise of obstacles, and the causes that are independent of the map.

    p(z | m) =  p_rand / z_max                                                        random measurement (*)
             +  p_lost · N(z; z_max, σ) if there is no echo, z ≥ z_max                lost echo
             +  (1 − p_rand − p_lost) · Σ_k (1 − p_hit)^(k−1) p_hit N(z; d_k, σ)      k-th obstacle, k = 1 … K
             +  (1 − p_rand − p_lost) · (1 − p_hit)^K N(z; z_max, σ)                  nothing hit, max range (0)

p_hit is that of a cell (`hit_probability`), d_k the distance of the k-th nearest occupied cell of the cone. These are
(22), (24) and (25) of the paper with the prior of the correspondences, (28), summed over them. With p_lost = 0 and
cells of 0.1 m it is the model of the paper. (*) is p_rand / `FARTHEST_RANDOM` if z_max is larger.
"""

from __future__ import annotations

import math
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from ..common.constants import FARTHEST_RANDOM, HIT_LENGTH, MOST_HIT
from ..common.parameter_groups import ModelParameters
from ..common.readings import Floats, Readings
from ..runtime.jit import allocating_kernel, inlined_kernel

CUT = 4.0
"""σ beyond which the noise density is set to 0, so that distances of few cells are needed: there it is 3e-4 of its
peak, less than the density of random measurements."""

_ROOT = math.sqrt(2.0 * math.pi)


class Causes(NamedTuple):
    """The terms of the model that do not depend on the map.

    Attributes
    ----------
    p_hit, mixture_weight : float
        p_hit of a cell, and 1 − p_rand − p_lost, the weight of the causes that depend on the map.
    random, lost : float64, shape (N,)
        The densities of `random_density` and, without echo, p_lost · N(z; z_max, σ), 1/m.
    max_range : float64, shape (N,)
        N(z; z_max, σ), 1/m.
    """

    p_hit: float
    mixture_weight: float
    random: Floats
    lost: Floats
    max_range: Floats


@inlined_kernel
def density(error: float, sigma: float) -> float:
    """Return N(z; d, σ), 1/m, cut off at `CUT` σ: (22) of the paper.

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
    """Return the probability that an occupied cell in the cone returns the echo, if no nearer one did.

    A surface of `HIT_LENGTH` returns no echo with probability 1 − p_hit, which is the product of those of its parts. So
    the probability of an echo of a wall does not depend on the cell size.

    Parameters
    ----------
    model : ModelParameters
    resolution : float
        Edge length of a cell, metres.
    """
    return float(min(1.0 - (1.0 - model.p_hit) ** (resolution / HIT_LENGTH), MOST_HIT))


def hit_parameter(probability: float, resolution: float) -> float:
    """Return the `p_hit` with which `hit_probability` is `probability`; `resolution` is the cell size, metres."""
    return float(1.0 - (1.0 - min(probability, MOST_HIT)) ** (HIT_LENGTH / resolution))


def random_density(model: ModelParameters, z_max: Floats) -> Floats:
    """Return the density of a random measurement, p_rand / z_max, 1/m, for largest ranges in metres."""
    out: Floats = model.p_rand / np.minimum(z_max, FARTHEST_RANDOM)
    return out


def causes_of(readings: Readings, sigma: Floats, model: ModelParameters, resolution: float) -> Causes:
    """Return the terms of each reading that do not depend on the map.

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
    return Causes(p_hit, weight, random_density(model, readings.z_max), lost, max_range)
