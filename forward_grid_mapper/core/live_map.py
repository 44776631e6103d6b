"""The standard log-odds map (eq 1-4 of the paper), updated reading by reading.

Inverse sensor model. Let φ be a cell's angle off the axis, β the half angle and d its distance. A reading adds to the
cells of its cone, weighted by 1 − (φ / β)² so that the edge of the cone says little (Moravec and Elfes 1985); β is
taken as large enough for the cone to be one and a half cells wide there, since a thin beam fills the cells it crosses:

    d < z − depth                  logit(live_p_free), or logit(live_p_free_no_echo) for a reading without echo
    z − depth ≤ d ≤ z + depth      logit(live_p_occupied); nothing for a reading without echo

Increments are rounded to 2⁻²⁰, so that float64 sums of them are exact: the map does not depend on the order of the
readings, and the node's is the offline tool's cell for cell.
"""

from __future__ import annotations

import math
from typing import Any

import numpy as np
from numpy.typing import NDArray

from .cone_index import ConeTable, Floats, cone_table, grid_of, walk_with_room
from .grid import Grid
from .jit import kernel
from .parameters import Parameters
from .readings import Readings

QUANTUM = 2.0**-20
HALF_WIDTH = 0.75
"""Least half width of a cone in cells."""

MARGIN = 64
"""Cells by which the array outgrows what is needed, so that a driving robot rarely makes it grow again."""


@kernel
def _add(table: ConeTable, gains: Any, log_odds: Any, nearest: bool) -> None:
    """Add every reading's increments; `gains` are those of occupied, free, and free without echo."""
    height, width = log_odds.shape
    flat = log_odds.ravel()
    cells, distances = np.empty(1024, np.int32), np.empty(1024, np.float64)
    for t in range(len(table.x)):
        n, cells, distances = walk_with_room(table, t, (height, width), nearest, cells, distances)
        echo = table.z[t] < table.z_max[t]
        free = gains[1] if echo else gains[2]
        cosine, sine = math.cos(table.yaw[t]), math.sin(table.yaw[t])
        for k in range(n):
            du = cells[k] % width + 0.5 - table.x[t]
            dv = cells[k] // width + 0.5 - table.y[t]
            half_angle = max(table.half_angle[t], HALF_WIDTH / max(distances[k], HALF_WIDTH))
            angle = math.atan2(cosine * dv - sine * du, cosine * du + sine * dv) / half_angle
            weight = max(1.0 - angle * angle, 0.0)
            if distances[k] < table.free[t]:
                gain = free
            elif echo:
                gain = gains[0]
            else:
                continue
            step = math.floor(weight * gain / QUANTUM + 0.5) * QUANTUM
            known = flat[cells[k]]
            flat[cells[k]] = step if math.isnan(known) else known + step


def arc_depth(parameters: Parameters) -> float:
    """Return half the depth of the arc that an echo marks, in metres: the parameter's, or half a cell."""
    return max(parameters.live.live_depth, parameters.grid.resolution / 2)


class LiveMap:
    """The log-odds of every cell, NaN where not observed, on a grid that grows as readings come; 8 bytes a cell."""

    def __init__(self, parameters: Parameters) -> None:
        self._parameters = parameters
        self.clear()

    def clear(self) -> None:
        """Forget everything."""
        resolution = self._parameters.grid.resolution
        self.grid = Grid(resolution, 0, 0, 0, 0)
        self._stored = self.grid
        self._log_odds: Floats = np.zeros((0, 0))

    def add(self, readings: Readings) -> None:
        """Add placed readings; `grid` grows to hold every cell that they touch.

        Raises
        ------
        InputError
            If the grid would exceed `max_cells`; the map is unchanged.
        """
        if not len(readings):
            return
        p = self._parameters
        depth = arc_depth(p)
        self.grid = grid_of(readings, p.model, p.grid, within=self.grid, beyond=depth)
        self._grow()
        table = cone_table(readings, self._stored, p.model)
        depth /= p.grid.resolution
        table = table._replace(free=np.where(readings.echo, table.z - depth, table.z), reach=table.z + depth)
        gains = tuple(
            math.log(q / (1 - q)) for q in (p.live.live_p_occupied, p.live.live_p_free, p.live.live_p_free_no_echo)
        )
        _add(table, gains, self._log_odds, p.model.cell_distance == 'nearest')

    def log_odds(self, grid: Grid | None = None) -> Floats:
        """Return a copy of the log-odds on `grid` (by default the map's own); NaN is not observed.

        `grid` may be larger than the map; it must be of the same resolution.
        """
        grid = grid or self.grid
        whole = self._stored.union(grid)
        out = np.full(whole.shape, np.nan)
        if self._stored.size:
            out[whole.window(self._stored)] = self._log_odds
        return np.array(out[whole.window(grid)])

    def probability(self, grid: Grid | None = None) -> NDArray[np.float32]:
        """Return the occupancy probabilities, p = 1 − 1 / (1 + e^l), NaN where not observed."""
        log_odds = self.log_odds(grid)
        with np.errstate(over='ignore'):
            return (1.0 - 1.0 / (1.0 + np.exp(log_odds))).astype(np.float32)

    def _grow(self) -> None:
        inside = self._stored.union(self.grid)
        if inside == self._stored:
            return
        g = self.grid
        stored = Grid(g.resolution, g.column - MARGIN, g.row - MARGIN, g.width + 2 * MARGIN, g.height + 2 * MARGIN)
        stored = stored.union(self._stored)
        grown = np.full(stored.shape, np.nan)
        if self._stored.size:
            grown[stored.window(self._stored)] = self._log_odds
        self._stored, self._log_odds = stored, grown
