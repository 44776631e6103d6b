"""The standard map: log odds ((3), (4) and (14)-(16) of the paper), updated reading by reading.

Inverse sensor model. A reading adds to the cells of its cone, weighted by the strength of the beam there
(`cone.strength`), so that the edge of the cone says little. With d the distance of a cell:

    d < z − depth                  logit(live_p_free), or logit(live_p_free_no_echo) for a reading without echo
    z − depth ≤ d ≤ z + depth      logit(live_p_occupied); nothing for a reading without echo

Increments are rounded to 2⁻²⁰, so that float64 sums of them are exact: the map does not depend on the order of the
readings, and the node's is the offline tool's cell for cell.
"""

from __future__ import annotations

import dataclasses
import math
from typing import Any

import numpy as np
from numpy.typing import NDArray

from ..common.constants import ARC_DEPTH, arc_depth
from ..common.grid import Grid
from ..common.parameters import Parameters
from ..common.readings import Readings
from ..runtime.jit import kernel
from ..sensor.cone import rows_of, runs_of, strength
from ..sensor.cone_table import Cones, Floats, check_size, cone_of, cone_table, grid_of

QUANTUM = 2.0**-20
MARGIN = 64
"""Cells by which the array outgrows what is needed, so that a driving robot rarely makes it grow again."""


@kernel
def _add_run(
    row: Any, first: int, last: int, offset: tuple[float, float], beam: tuple[float, float, float], gain: float
) -> None:
    """Add the increments of a run of cells in one row.

    Parameters
    ----------
    row : float64
        Log-odds.
    offset
        From the sensor to the centre of column 0 of the row, cells.
    beam
        Unit vector of the axis, squared sine of the half angle.
    """
    if first > last:
        return
    u, v = offset
    axis_x, axis_y, sine2 = beam
    scale = gain / QUANTUM
    for column in range(np.uint64(first), np.uint64(last + 1)):
        du = u + column
        step = math.floor(strength(axis_x, axis_y, sine2, du, v) * scale + 0.5) * QUANTUM
        known = row[column]
        row[column] = (0.0 if math.isnan(known) else known) + step


@kernel
def _add(cones: Cones, gains: Any, log_odds: Any) -> None:
    """Add every reading's increments; `gains` are those of occupied, free, and free for a max-range reading."""
    height, width = log_odds.shape
    for t in range(len(cones)):
        reading = cones[t]
        cone = cone_of(reading)
        echo = reading.z < reading.z_max
        free = gains[1] if echo else gains[2]
        beam = (reading.axis_x, reading.axis_y, reading.sine**2)
        for y in range(*rows_of(cone, height)):
            runs = runs_of(cone, y, width)
            row, offset = log_odds[y], (0.5 - reading.x, y + 0.5 - reading.y)
            inner, outer = runs.inner, runs.outer
            if outer < inner:
                inner, outer = width, width - 1
            for first, last in ((runs.first, runs.last), (runs.first2, runs.last2)):
                if first > last:
                    continue
                _add_run(row, max(first, inner), min(last, outer), offset, beam, free)
                if echo:
                    _add_run(row, first, min(last, inner - 1), offset, beam, gains[0])
                    _add_run(row, max(first, outer + 1), last, offset, beam, gains[0])


def map_grid(
    readings: Readings, parameters: Parameters, within: Grid | None = None, least_depth: float = ARC_DEPTH
) -> Grid:
    """Return the grid on which all maps of `readings` lie: every cell that a reading touches, and all of `within`.

    `least_depth` is that of `LogOddsMap`.

    Raises
    ------
    InputError
        If there are no readings, or the grid would exceed `max_cells`.
    """
    p = parameters
    return grid_of(readings, p.model, p.grid, within=within, beyond=arc_depth(p.grid.resolution, least_depth))


class LogOddsMap:
    """The log-odds of every cell, NaN where not observed, on a grid that grows as readings come; 8 bytes a cell."""

    def __init__(self, parameters: Parameters, least_depth: float = ARC_DEPTH) -> None:
        """Start empty; `least_depth` is half the depth of the arcs that echoes mark, metres, if half a cell is less."""
        self._parameters, self._least_depth = parameters, least_depth
        self.clear()

    def change(self, parameters: Parameters) -> None:
        """Use other parameters for the readings that come, of the same resolution."""
        self._parameters = parameters

    def clear(self) -> None:
        """Forget everything."""
        resolution = self._parameters.grid.resolution
        self.grid = Grid(resolution, 0, 0, 0, 0)
        self._stored = self.grid
        self._log_odds: Floats = np.zeros((0, 0))

    def add(self, readings: Readings) -> None:
        """Add readings; `grid` grows to hold every cell that they touch.

        Raises
        ------
        InputError
            If the grid would exceed `max_cells`; the map is unchanged.
        """
        if not len(readings):
            return
        p = self._parameters
        depth = arc_depth(p.grid.resolution, self._least_depth)
        self.grid = map_grid(readings, p, self.grid, self._least_depth)
        self._grow()
        table = cone_table(readings, self._stored, dataclasses.replace(p.model, surface_offset=0.0))
        depth /= p.grid.resolution
        table['free'] = np.where(readings.echo, table['z'] - depth, table['z'])
        table['reach'] = table['z'] + depth
        gains = tuple(
            math.log(q / (1 - q)) for q in (p.live.live_p_occupied, p.live.live_p_free, p.live.live_p_free_no_echo)
        )
        _add(table, gains, self._log_odds)

    def add_map(self, other: LogOddsMap) -> None:
        """Add all that another map of the same lattice says; it comes to the same as adding its readings.

        Raises
        ------
        InputError
            If the grid would exceed `max_cells`; the map is unchanged.
        """
        if not other.grid.size:
            return
        grid = self.grid.union(other.grid)
        check_size(grid, self._parameters.grid)
        self.grid = grid
        self._grow()
        mine, theirs = self._log_odds[self._stored.window(other.grid)], other.log_odds()
        known = ~np.isnan(theirs)
        mine[known] = np.where(np.isnan(mine[known]), 0.0, mine[known]) + theirs[known]

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
