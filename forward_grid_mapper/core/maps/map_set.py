"""What mapping returns: three maps on one grid, and how they came about."""

from __future__ import annotations

from dataclasses import dataclass, field, replace
from typing import Any

import numpy as np
from numpy.typing import NDArray

from ..common.grid import UNKNOWN, Grid
from ..common.parameters import Parameters
from ..common.readings import Readings


@dataclass(frozen=True)
class MapSet:
    """The three maps of one set of readings. Arrays have shape `grid.shape`; row 0 has the smallest y.

    Attributes
    ----------
    grid : Grid
    live : float32
        Occupancy probability of the standard log-odds map, NaN where no reading says anything.
    ml : int8
        Maximum likelihood map: 0 free, 1 occupied, -1 not observed.
    uncertainty : float32
        The α-mixed marginals of eq 45; NaN where `ml` is unknown and the readings say next to nothing.
    readings : Readings
        The readings that the maps evaluate.
    unexplained : bool, shape (N,)
        Readings whose most likely cause, given the ML map, is chance (e_* above one half).
    log_likelihood : float
        log p(Z | ml) in nats.
    objective : float
        The log-likelihood plus the log prior odds of the occupied cells.
    parameters : Parameters
    dynamic : float32
        Echoes that the map does not evaluate and that end in free space: people, say (`dynamic`).
    statistics : dict
        Plain numbers about the run: pairs, flips, shifts, sweeps, converged, seconds by stage.
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
    dynamic: NDArray[np.float32] = field(default_factory=lambda: np.zeros((0, 0), np.float32))
    statistics: dict[str, Any] = field(default_factory=dict)

    def with_live(self, grid: Grid, live: NDArray[np.float32]) -> MapSet:
        """Return the same maps beside another live map, all on the smallest grid that holds both.

        Parameters
        ----------
        grid : Grid
            Of `live`; of the same resolution.
        live : float32, shape `grid.shape`
        """
        whole = self.grid.union(grid)
        ml = np.full(whole.shape, UNKNOWN, np.int8)
        ml[whole.window(self.grid)] = self.ml
        uncertainty, shown = (np.full(whole.shape, np.nan, np.float32) for _ in range(2))
        uncertainty[whole.window(self.grid)] = self.uncertainty
        shown[whole.window(grid)] = live
        dynamic = np.zeros(whole.shape, np.float32)
        if self.dynamic.size:
            dynamic[whole.window(self.grid)] = self.dynamic
        return replace(self, grid=whole, live=shown, ml=ml, uncertainty=uncertainty, dynamic=dynamic)
