"""The result of mapping: three maps on one grid, and how they were made."""

from __future__ import annotations

from dataclasses import dataclass, field, replace
from typing import Any

import numpy as np
from numpy.typing import NDArray

from ..common.grid import UNKNOWN, Grid
from ..common.parameters import Parameters
from ..common.readings import Readings
from ..sensor.forward_model import ForwardModel
from ..sensor.surface_normals import SurfaceNormals, no_normals, on_larger_grid


@dataclass(frozen=True)
class MapSet:
    """The three maps of one set of readings. Arrays have shape `grid.shape`; row 0 has the smallest y.

    Attributes
    ----------
    grid : Grid
    live : float32
        Occupancy probability of the standard map, NaN for cells in no cone.
    ml : int8
        Maximum likelihood map: 0 free, 1 occupied, -1 not observed.
    uncertainty : float32
        Calibrated leave-one-cell-out marginals (module `uncertainty`); NaN where `ml` is unknown and the evidence is
        negligible.
    readings : Readings
        The readings that the maps were made from.
    unexplained : bool, shape (N,)
        Readings whose most likely cause, given `ml`, is a random measurement (e_* above one half).
    log_likelihood : float
        log p(Z | ml) of the final map, by `forward_model`, nats.
    objective : float
        The log-likelihood of `ml` plus its log prior, up to a constant.
    parameters : Parameters
    searched : int8
        The map that the search found, with the values of `ml`; another search may start from it. Post-processing makes
        `ml` of it.
    dynamic : float32
        Number of echoes that `ml` does not explain, by the free cells in which they end: people, for example (module
        `dynamic`).
    normals : SurfaceNormals
        The surface normals that the maps were made with.
    statistics : dict
        Numbers about the run: pairs, flips, shifts, iterations, converged, seconds of each stage. `searched_objective`
        and `searched_log_likelihood` are those of `searched`.
    """

    grid: Grid
    live: NDArray[np.float32]
    ml: NDArray[np.int8]
    uncertainty: NDArray[np.float32]
    readings: Readings
    unexplained: NDArray[np.bool_]
    log_likelihood: float
    objective: float
    parameters: Parameters
    searched: NDArray[np.int8] = field(default_factory=lambda: np.zeros((0, 0), np.int8))
    dynamic: NDArray[np.float32] = field(default_factory=lambda: np.zeros((0, 0), np.float32))
    normals: SurfaceNormals = field(default_factory=no_normals)
    statistics: dict[str, Any] = field(default_factory=dict)

    def forward_model(self) -> ForwardModel:
        """Return the forward model of the readings, which gives the likelihood of `ml` or of another map."""
        return ForwardModel(self.readings, self.grid, self.parameters.model, self.normals)

    def with_live(self, grid: Grid, live: NDArray[np.float32]) -> MapSet:
        """Return the maps with another live map, all on the smallest grid that contains both.

        Parameters
        ----------
        grid : Grid
            Of `live`; of the same resolution.
        live : float32, shape `grid.shape`
        """
        whole = self.grid.union(grid)
        ml, searched = (np.full(whole.shape, UNKNOWN, np.int8) for _ in range(2))
        ml[whole.window(self.grid)] = self.ml
        if self.searched.size:
            searched[whole.window(self.grid)] = self.searched
        uncertainty, shown = (np.full(whole.shape, np.nan, np.float32) for _ in range(2))
        uncertainty[whole.window(self.grid)] = self.uncertainty
        shown[whole.window(grid)] = live
        dynamic = np.zeros(whole.shape, np.float32)
        if self.dynamic.size:
            dynamic[whole.window(self.grid)] = self.dynamic
        normals = on_larger_grid(self.normals, self.grid, whole)
        own = replace(self, searched=searched, dynamic=dynamic, normals=normals)
        return replace(own, grid=whole, live=shown, ml=ml, uncertainty=uncertainty)
