"""Bounds of the evidence of a single reading for or against an obstacle.

A reading multiplies the odds of an obstacle by [(c + T') / (c + T)]^γ, where c is the density of the causes independent
of the map, T and T' that of the others without and with the obstacle, and γ the likelihood exponent. Since c is never
zero, the ratio is bounded: for an echo by the random measurement, for a reading without echo by the lost echo. So no
wall depends on a single reading.
"""

from __future__ import annotations

import math
from typing import NamedTuple

from ..common.constants import FARTHEST_RANDOM
from ..common.parameter_groups import ModelParameters
from .density import density, hit_probability


class ReadingBounds(NamedTuple):
    """Bounds of the log-likelihood ratio, tempered, nats: positive for an obstacle, negative against it.

    Attributes
    ----------
    echo_for : float
        Of an echo for the cell at its range, if nothing else on the map explains it.
    echo_against_cell, echo_against_wall : float
        Of an echo from far beyond against one cell on its way, and against any number of cells.
    silence_against_cell, silence_against_wall : float
        The same of a reading without echo, which is never evidence for a cell.
    """

    echo_for: float
    echo_against_cell: float
    echo_against_wall: float
    silence_against_cell: float
    silence_against_wall: float


def reading_bounds(model: ModelParameters, resolution: float, z_max: float) -> ReadingBounds:
    """Return the bounds for a reading.

    Parameters
    ----------
    model : ModelParameters
    resolution : float
        Edge length of a cell, metres.
    z_max : float
        Largest range of the sensor, metres.
    """
    gamma, p_hit = model.likelihood_exponent, hit_probability(model, resolution)
    peak = density(0.0, max(model.sigma, resolution / 2))
    explained = (1.0 - model.p_rand - model.p_lost) * peak
    random = model.p_rand / min(z_max, FARTHEST_RANDOM)
    silent = random + model.p_lost * peak

    def against(floor: float, left: float) -> float:
        return gamma * math.log((floor + left * explained) / (floor + explained))

    return ReadingBounds(
        echo_for=gamma * math.log1p(p_hit * explained / random),
        echo_against_cell=against(random, 1.0 - p_hit),
        echo_against_wall=against(random, 0.0),
        silence_against_cell=against(silent, 1.0 - p_hit),
        silence_against_wall=against(silent, 0.0),
    )
