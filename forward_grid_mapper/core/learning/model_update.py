"""Learning of p_hit, p_rand and σ from the expectations (Thrun's outer EM loop); an opt-in.

Given a map, the updates maximise the expected log-likelihood:

    p_rand = mean e_*     p_lost = mean e_lost, if it was not 0
    σ²     = Σ e_k (z − d_k)² / Σ e_k over readings with an echo
    p_hit  = Σ e_k / (Σ k·e_k + Σ K·e_0), of a cell, from which that of `density.HIT_LENGTH` follows

With the true map, they recover the true values. If map and values are learned together, p_hit is biased upward, since
the map has no more occupied cells than it needs.
"""

from __future__ import annotations

import dataclasses
import math
from typing import Any

import numpy as np
from numpy.typing import NDArray

from ..common.parameter_groups import ModelParameters
from ..common.parameters import find
from ..sensor.density import hit_parameter
from ..sensor.forward_model import ForwardModel

MOST_UNEXPLAINED = 0.9
"""Largest sum of p_rand and p_lost that is learned."""


def learn(forward: ForwardModel, occupied: NDArray[Any]) -> ModelParameters:
    """Return the model after one update of its probabilities and σ, given a map; values stay in their allowed ranges.

    A value without information is kept (σ without echoes, p_hit without any obstacle).

    Parameters
    ----------
    forward : ForwardModel
        The readings, and the present values.
    occupied : array of shape `forward.grid.shape`
        1 if occupied.
    """
    readings, model = forward.readings, forward.model
    e = forward.expectations(occupied)
    values = {'p_rand': float(e.random.mean())}
    if model.p_lost > 0:
        values['p_lost'] = float(e.lost.mean())
    # readings with a σ of their own have no information about that of the model
    unstated = readings.echo & (readings.sigma == 0)
    hits = float(e.hit[unstated].sum())
    if hits > 0:
        values['sigma'] = math.sqrt(float(e.squared_error[unstated].sum()) / hits)
    # lost echoes and random measurements have no information about the obstacles in their cones
    chances = float(e.rank.sum() + (e.obstacles * e.no_echo).sum())
    if chances > 0:
        values['p_hit'] = hit_parameter(float(e.hit.sum()) / chances, forward.grid.resolution)
    bounded: dict[str, Any] = {
        name: float(np.clip(value, find(name).low, find(name).high)) for name, value in values.items()
    }
    # with a map that explains nothing, the model must stay valid
    together = bounded['p_rand'] + bounded.get('p_lost', 0.0)
    if together > MOST_UNEXPLAINED:
        bounded['p_rand'] = max(bounded['p_rand'] * MOST_UNEXPLAINED / together, find('p_rand').low)
        if 'p_lost' in bounded:
            bounded['p_lost'] = MOST_UNEXPLAINED - bounded['p_rand']
    return dataclasses.replace(model, **bounded)
