"""The forward sensor model: the likelihood of readings, given a whole map, and the probabilities of their causes.

The density p(z | m) and its causes are those of `density`. d_k is the distance to the k-th nearest occupied cell of the
cone, without the surfaces at which the reading exceeds the incidence angle (`surface_normals`).

The whole package uses this likelihood. Here it is evaluated exactly, in float64 and directly from the cones: for the
final map, for learning, for sensor health and for lost walls. The search (`evidence.updates`) uses a form in which a
flip costs O(1) for each reading; it is tested against this one.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from ..common.grid import Grid
from ..common.parameter_groups import ModelParameters
from ..common.readings import Floats, Readings
from ..runtime.jit import allocating_kernel, inlined_kernel
from .cone import rows_of, runs_of
from .cone_table import Cones, cone_of, cone_table
from .density import Causes, causes_of, density
from .surface_normals import SurfaceNormals, exceeds_incidence_angle, no_normals


@dataclass(frozen=True)
class Expectations:
    """The E-step: the probability of each cause of each reading, given the map. All float64, shape (N,).

    `random` + `lost` + `no_echo` + `hit` is 1 (34)-(38). `rank` is Σ k·e_k, `squared_error` Σ e_k·(z − d_k)² in m²,
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


class _KernelInput(NamedTuple):
    """What the kernel needs besides the map; `pairing` and `normals` decide which surfaces a reading passes."""

    cones: Cones
    pairing: Cones
    normals: SurfaceNormals
    causes: Causes
    resolution: float


@inlined_kernel
def _sort(values: Any, n: int) -> None:
    """Sort the first n values in place by Shell sort: they are few, and partly sorted."""
    stride = 1
    while stride < n // 3:
        stride = 3 * stride + 1
    while stride > 0:
        for k in range(stride, n):
            value, at = values[k], k
            while at >= stride and values[at - stride] > value:
                values[at] = values[at - stride]
                at -= stride
            values[at] = value
        stride //= 3


@inlined_kernel
def _distances(given: _KernelInput, t: int, occupied: Any, out: Any) -> int:
    """Write the distances of the occupied cells of cone t, without surfaces beyond the limit of the incidence angle.

    Returns their number, even if `out` is too short.
    """
    normals, cone = given.normals, cone_of(given.cones[t])
    height, width = occupied.shape
    m = 0
    for row in range(*rows_of(cone, height)):
        v = row + 0.5 - cone.y
        runs = runs_of(cone, row, width)
        for first, last in ((runs.first, runs.last), (runs.first2, runs.last2)):
            for column in range(first, last + 1):
                if not occupied[row, column]:
                    continue
                u, c = column + 0.5 - cone.x, row * width + column
                if normals.cos2_limit > 0.0 and exceeds_incidence_angle(normals, given.pairing[t], c, u, v):
                    continue
                if m < len(out):
                    out[m] = math.sqrt(u * u + v * v)
                m += 1
    return m


@allocating_kernel
def _expect(given: _KernelInput, occupied: Any, out: Any) -> None:
    """Fill `out` (8, N) with the rows of `Expectations`, in its order."""
    cones, causes = given.cones, given.causes
    distances = np.empty(1024)
    for t in range(len(cones)):
        m = _distances(given, t, occupied, distances)
        if m > len(distances):
            distances = np.empty(2 * m)
            m = _distances(given, t, occupied, distances)
        _sort(distances, m)
        sigma = cones[t].sigma
        weight = causes.mixture_weight
        hit, rank, squared = 0.0, 0.0, 0.0
        for k in range(m):
            error = (cones[t].z - distances[k]) / sigma
            term = weight * causes.p_hit * density(error, sigma * given.resolution)
            hit += term
            rank += (k + 1) * term
            squared += term * (error * sigma * given.resolution) ** 2
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


class ForwardModel:
    """Readings on a grid, and their likelihood given any map of this grid.

    Attributes
    ----------
    readings : Readings
    grid : Grid
    model : ModelParameters
    normals : SurfaceNormals
        Of the cells of `grid`.
    cones : records of `CONE`, shape (N,)
        From `cone_table`.
    """

    def __init__(
        self,
        readings: Readings,
        grid: Grid,
        model: ModelParameters,
        normals: SurfaceNormals | None = None,
        cones: Cones | None = None,
    ) -> None:
        """Use `cones` if already computed; without `normals`, no reading exceeds the incidence angle."""
        self.readings, self.grid, self.model = readings, grid, model
        self.normals = no_normals() if normals is None else normals
        self.cones = cone_table(readings, grid, model) if cones is None else cones
        self._pairing = self.cones

    def at(self, model: ModelParameters) -> ForwardModel:
        """Return the forward model with other values of the model.

        Normals stay the same, and so do the surfaces that each reading passes, although they depend on σ: so the
        likelihood is a smooth function of the values.
        """
        other = ForwardModel(self.readings, self.grid, model, self.normals)
        other._pairing = self._pairing
        return other

    def expectations(self, occupied: NDArray[Any]) -> Expectations:
        """Return the E-step and the log-likelihood of each reading, given a map.

        Parameters
        ----------
        occupied : array of shape `grid.shape`
            1 if occupied; anything else counts as free.
        """
        resolution, model = self.grid.resolution, self.model
        causes = causes_of(self.readings, self.cones['sigma'] * resolution, model, resolution)
        given = _KernelInput(self.cones, self._pairing, self.normals, causes, resolution)
        out = np.empty((8, len(self.readings)))
        _expect(given, np.ascontiguousarray(np.asarray(occupied) == 1).view(np.uint8), out)
        return Expectations(*out)

    def log_likelihood(self, occupied: NDArray[Any]) -> float:
        """Return log p(Z | m) in nats: over all readings, the sum of the log of (26) × (28), summed over the causes."""
        return float(self.expectations(occupied).log_likelihood.sum())


def expectations(
    readings: Readings,
    grid: Grid,
    occupied: NDArray[Any],
    model: ModelParameters,
    normals: SurfaceNormals | None = None,
) -> Expectations:
    """Return `ForwardModel.expectations` of one map."""
    return ForwardModel(readings, grid, model, normals).expectations(occupied)


def log_likelihood(
    readings: Readings,
    grid: Grid,
    occupied: NDArray[Any],
    model: ModelParameters,
    normals: SurfaceNormals | None = None,
) -> float:
    """Return `ForwardModel.log_likelihood` of one map."""
    return ForwardModel(readings, grid, model, normals).log_likelihood(occupied)
