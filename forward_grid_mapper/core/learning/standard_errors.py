"""Standard errors and confidence intervals of learned parameters, given the map, from estimating functions.

The updates of `model_update` converge where the sum over all readings of

    ψ_rand  = e_* / p_rand − (e_hit + e_0) / (1 − p_rand − p_lost)
    ψ_lost  = e_lost / p_lost − (e_hit + e_0) / (1 − p_rand − p_lost)
    ψ_hit   = [e_hit / p − (Σ (k − 1)·e_k + K·e_0) / (1 − p)] ∂p/∂p_hit    (p is p_hit of a cell)
    ψ_sigma = Σ e_k (z − d_k)² / σ³ − e_hit / σ          (echoes without a σ of their own)

is zero. The first three are the derivatives of log p(z | m), by Fisher's identity; so is the last, except for readings
without echo, which are not used for σ. With A = −∂Σψ/∂θ, the observed information, and B the variance of Σψ, the
covariance is A⁻¹ B A⁻ᵀ (sandwich estimator). B is computed twice: for independent readings, and over blocks of time,
since a person or a smooth wall affects many successive readings. The larger standard error is used.

The results are conditional on the map: they do not include that it was made from the same readings.
"""

from __future__ import annotations

import dataclasses
import math
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from ..common.constants import HIT_LENGTH, MOST_HIT
from ..common.parameter_groups import ModelParameters
from ..common.parameters import find
from ..common.readings import Floats, Readings
from ..sensor.density import hit_probability
from ..sensor.forward_model import Expectations, ForwardModel

LEARNED = ('p_hit', 'p_rand', 'p_lost', 'sigma')
BLOCKS = 30
"""Most blocks of time; they have equal numbers of readings."""
LEAST_BLOCK = 10
"""Fewest readings in a block."""
_STEP = 1e-3
_NEAR = 1e-3
_NORMAL = 1.96


@dataclass(frozen=True)
class ParameterEstimate:
    """A learned value and its uncertainty.

    Attributes
    ----------
    value : float
    error : float
        Standard error; NaN if the value could not be learned or is at a bound.
    low, high : float
        Bounds of the 95 % interval: normal in the logit of a probability and in the logarithm of σ.
    readings : float
        Expected number of readings with information about the value: for p_hit those that met an obstacle, with or
        without an echo; for σ the echoes of obstacles; for p_lost those without echo; for p_rand all.
    bound : str
        Why it has no standard error, or ''.
    """

    value: float
    error: float
    low: float
    high: float
    readings: float
    bound: str = ''


def estimating_functions(forward: ForwardModel, occupied: NDArray[Any]) -> dict[str, Floats]:
    """Return ψ of each parameter, shape (N,); without p_lost if that is zero."""
    readings, model = forward.readings, forward.model
    e = forward.expectations(occupied)
    explained = (e.hit + e.no_echo) / (1.0 - model.p_rand - model.p_lost)
    missed = e.rank - e.hit + e.obstacles * e.no_echo
    unstated = readings.echo & (readings.sigma == 0)
    resolution = forward.grid.resolution
    p_hit = hit_probability(model, resolution)
    # derivative of p_hit of a cell with respect to that of the model
    slope = resolution / HIT_LENGTH * (1.0 - p_hit) / (1.0 - model.p_hit)
    made = {
        'p_hit': (e.hit / p_hit - missed / (1.0 - p_hit)) * slope,
        'p_rand': e.random / model.p_rand - explained,
        'sigma': np.where(unstated, e.squared_error / model.sigma**3 - e.hit / model.sigma, 0.0),
    }
    if model.p_lost > 0:
        made['p_lost'] = e.lost / model.p_lost - explained
    return made


def parameter_estimates(forward: ForwardModel, occupied: NDArray[Any]) -> dict[str, ParameterEstimate]:
    """Return each learned value of the model with its standard error, given the map.

    Parameters
    ----------
    forward : ForwardModel
        The readings, and the values to which the updates converged.
    occupied : array of shape `forward.grid.shape`
        The map that they were learned from; 1 if occupied.
    """
    model = forward.model
    informed = _informed(forward.readings, forward.expectations(occupied))
    held = {name: _held(name, model, forward.grid.resolution, informed[name]) for name in LEARNED}
    free = [name for name in LEARNED if not held[name]]
    errors = dict(zip(free, _errors(forward, occupied, free), strict=True))
    made = {}
    for name in LEARNED:
        value, error = float(getattr(model, name)), errors.get(name, math.nan)
        why = held[name]
        if not why and not math.isfinite(error):
            why = 'the readings do not determine it'
        made[name] = ParameterEstimate(value, error, *_interval(name, value, error), informed[name], why)
    return made


def _informed(readings: Readings, e: Expectations) -> dict[str, float]:
    unstated = readings.echo & (readings.sigma == 0)
    return {
        'p_hit': float((e.hit + e.no_echo * (e.obstacles > 0)).sum()),
        'p_rand': float(len(readings)),
        'p_lost': float(np.count_nonzero(~readings.echo)),
        'sigma': float(e.hit[unstated].sum()),
    }


def _held(name: str, model: ModelParameters, resolution: float, informed: float) -> str:
    """Return why a parameter cannot be learned, or ''."""
    value, row = getattr(model, name), find(name)
    if name == 'p_lost' and value == 0:
        return '0 is the model without lost echoes, which learning keeps'
    if informed < 1:
        return 'no reading informs it'
    if name == 'sigma' and value <= resolution / 2:
        return 'it lies below half a cell, which is used instead'
    if value < row.low + _NEAR or value > row.high - _NEAR:
        return f'it lies at a bound of the admitted range, {row.range}'
    if name == 'p_hit' and hit_probability(model, resolution) > MOST_HIT - _NEAR:
        return f'that of a cell lies at its largest value, {MOST_HIT:g}'
    return ''


def _errors(forward: ForwardModel, occupied: NDArray[Any], free: list[str]) -> list[float]:
    """Return the standard errors of the parameters `free`, in their order; NaN if they are not determined."""
    if not free:
        return []

    readings, model = forward.readings, forward.model

    def psi(at: ModelParameters) -> Floats:
        made = estimating_functions(forward.at(at), occupied)
        return np.stack([made[name] for name in free])

    information = np.empty((len(free), len(free)))
    for column, name in enumerate(free):
        value = getattr(model, name)
        room = value if name == 'sigma' else min(value, 1.0 - value)
        step = _STEP * room
        above, below = (psi(dataclasses.replace(model, **{name: value + d})).sum(1) for d in (step, -step))
        information[:, column] = (below - above) / (2.0 * step)
    try:
        inverse = np.linalg.inv(information)
    except np.linalg.LinAlgError:
        return [math.nan] * len(free)
    functions = psi(model)
    variances = [functions @ functions.T]
    # sort by time
    ordered = functions[:, np.argsort(readings.stamp, kind='stable')]
    count = min(BLOCKS, len(readings) // LEAST_BLOCK)
    if count > len(free):
        sums = np.stack([part.sum(1) for part in np.array_split(ordered, count, axis=1)], axis=1)
        spread = sums - sums.mean(1, keepdims=True)
        variances.append(count / (count - 1) * (spread @ spread.T))
    squares = np.max([np.diag(inverse @ variance @ inverse.T) for variance in variances], axis=0)
    # if the covariance has no positive diagonal, the values are not at a maximum
    sound = (np.diag(inverse) > 0) & (squares > 0)
    return [math.sqrt(square) if good else math.nan for square, good in zip(squares, sound, strict=True)]


def _interval(name: str, value: float, error: float) -> tuple[float, float]:
    if not math.isfinite(error):
        return math.nan, math.nan
    if name == 'sigma':
        factor = math.exp(_NORMAL * error / value)
        return value / factor, value * factor
    odds = value / (1.0 - value)
    factor = math.exp(min(_NORMAL * error / (value * (1.0 - value)), 700.0))
    return odds / factor / (1.0 + odds / factor), 1.0 / (1.0 + 1.0 / (odds * factor))
