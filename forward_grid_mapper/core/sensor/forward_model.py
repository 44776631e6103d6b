"""The forward sensor model: how likely a reading is, given a whole map, and which cause explains it.

    p(z | m) =  p_rand / z_max                                                        chance (*)
             +  p_lost · N(z; z_max, σ) if there is no echo, z ≥ z_max                a lost echo
             +  (1 − p_rand − p_lost) · Σ_k (1 − p_hit)^(k−1) p_hit N(z; d_k, σ)      the k-th obstacle, k = 1 … K
             +  (1 − p_rand − p_lost) · (1 − p_hit)^K N(z; z_max, σ)                  nothing hit, max range (0)

d_k is the distance to the k-th nearest occupied cell of the cone. With p_lost = 0 this is the model of the paper
(eq 20-24 summed over its correspondences, eq 26 with eq 28); N is cut off at `cut` σ.

This file evaluates it exactly, in float64 and straight from the cones. The search (`flips`) has it in a form in which
a flip costs O(1) a reading, and is tested against this one.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from ..common.grid import Grid
from ..common.parameters import ModelParameters
from ..common.readings import Readings
from ..runtime.jit import allocating_kernel
from .cone_table import Cones, Floats, cone_table, walk_resized
from .density import Causes, causes_of, density


@dataclass(frozen=True)
class Expectations:
    """The E-step: the probability of each cause of each reading, given the map. All float64, shape (N,).

    `random` + `lost` + `no_echo` + `hit` is 1 (eq 33-36). `rank` is Σ k·e_k, `squared_error` Σ e_k·(z − d_k)² in m²,
    `obstacles` K, the number of occupied cells in the cone up to its reach; `log_likelihood` is log p(z | m) in nats.
    """

    random: Floats
    lost: Floats
    no_echo: Floats
    hit: Floats
    rank: Floats
    squared_error: Floats
    obstacles: Floats
    log_likelihood: Floats


@allocating_kernel
def _expect(table: Cones, causes: Causes, occupied: Any, resolution: float, out: Any) -> None:
    """Fill `out` (8, N) with the rows of `Expectations`, in its order."""
    height, width = occupied.shape
    flat = occupied.ravel()
    cells, distances = np.empty(1024, np.int32), np.empty(1024, np.float64)
    for t in range(len(table)):
        n, cells, distances = walk_resized(table, t, (height, width), cells, distances)
        m = 0
        for k in range(n):
            if flat[cells[k]] == 1:
                distances[m] = distances[k]
                m += 1
        hits = np.sort(distances[:m])
        sigma = table[t].sigma
        weight = causes.mixture_weight
        hit, rank, squared = 0.0, 0.0, 0.0
        for k in range(m):
            error = (table[t].z - hits[k]) / sigma
            term = weight * causes.p_hit * density(error, sigma * resolution)
            hit += term
            rank += (k + 1) * term
            squared += term * (error * sigma * resolution) ** 2
            weight *= 1.0 - causes.p_hit
        total = causes.random[t] + causes.lost[t] + hit + weight * causes.max_range[t]
        out[0, t] = causes.random[t] / total
        out[1, t] = causes.lost[t] / total
        out[2, t] = weight * causes.max_range[t] / total
        out[3, t] = hit / total
        out[4, t] = rank / total
        out[5, t] = squared / total
        out[6, t] = m
        out[7, t] = math.log(total)


def expectations(readings: Readings, grid: Grid, occupied: NDArray[Any], model: ModelParameters) -> Expectations:
    """Return the E-step and the log-likelihood of every reading, given a map.

    Parameters
    ----------
    readings : Readings
    grid : Grid
    occupied : array of shape `grid.shape`
        Occupied cells are 1; anything else counts as free.
    model : ModelParameters
    """
    table = cone_table(readings, grid, model)
    causes = causes_of(readings, table['sigma'] * grid.resolution, model)
    out = np.empty((8, len(readings)))
    filled = np.ascontiguousarray(np.asarray(occupied) == 1).view(np.uint8)
    _expect(table, causes, filled, grid.resolution, out)
    return Expectations(*out)


def log_likelihood(readings: Readings, grid: Grid, occupied: NDArray[Any], model: ModelParameters) -> float:
    """Return log p(Z | m) in nats (eq 16: the sum is over logs)."""
    return float(expectations(readings, grid, occupied, model).log_likelihood.sum())
