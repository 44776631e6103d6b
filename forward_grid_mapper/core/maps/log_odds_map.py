"""The standard map: log odds ((3), (4) and (14)-(16) of the paper), updated reading by reading.

Inverse sensor model. A reading adds the following to the cells of its cone, times the strength of the beam at the cell
(`cone.strength`), so that cells at the edge get little. With d the distance of a cell, b and a the depths of the arc of
an echo before and behind its range z, and w the length of that arc from edge to edge of the cone:

    echo        d < z − b             logit(live_p_free)
                z − b ≤ d ≤ z + a     logit(live_p_occupied) · min(1, live_echo_width / w)
    no echo     d ≤ z                 logit(live_p_free_no_echo)

Only one point of the arc returned the echo, so each of its cells gets less if it is longer.

Directions. A smooth wall returns only sound that meets it nearly at right angles; at a slant, readings appear to pass
through it, however many there are. So readings are summed separately for each of `live_directions`, evenly spaced over
half a turn. The log-odds of a direction get a fraction of those of the two neighbouring ones. Those of a cell are the
sum of all readings, or those of the direction with the most, if these are positive and larger. With one direction this
is the map of the paper, (14).

Increments are rounded to 2⁻²⁰, so that float64 sums of them are exact. So the map does not depend on the order of the
readings, and that of the node equals that of the offline tool in each cell.
"""

from __future__ import annotations

import math

import numpy as np
from numpy.typing import NDArray

from ..common.constants import ARC, arc_depths
from ..common.grid import Grid
from ..common.parameters import Parameters
from ..common.readings import Floats, Readings
from ..sensor.cone_table import check_size, grid_of
from .log_odds_kernel import PADDING, UNTOUCHED, Beams, InverseModel, StoredGrid, add_readings, is_steep

MARGIN = 64
"""Cells by which the array is larger than needed on each side, so that it seldom grows while the robot drives."""

BESIDE = 1 / 16
"""Fraction of the log-odds of the two neighbouring directions that is added: walls may lie between directions."""


def map_grid(
    readings: Readings, parameters: Parameters, within: Grid | None = None, arc: tuple[float, float] = ARC
) -> Grid:
    """Return the grid of all maps of `readings`: it contains the cells of all cones, and `within`.

    `arc` is that of `LogOddsMap`.

    Raises
    ------
    InputError
        If there are no readings, or the grid would exceed `max_cells`.
    """
    p = parameters
    return grid_of(readings, p.model, p.grid, within=within, beyond=arc_depths(p.grid.resolution, arc)[1])


class LogOddsMap:
    """The log-odds of every cell, NaN if not observed, on a grid that grows with the readings.

    It needs 8 bytes for each cell and direction.
    """

    def __init__(self, parameters: Parameters, arc: tuple[float, float] = ARC) -> None:
        """Start empty; `arc` has the depths of the arc before and behind the range, metres, at least half a cell."""
        self._parameters, self._arc = parameters, arc
        self.clear()

    def change(self, parameters: Parameters) -> None:
        """Use other parameters for later readings; resolution and number of directions must be the same."""
        self._parameters = parameters

    def clear(self) -> None:
        """Remove all readings."""
        self.grid = self._stored = Grid(self._parameters.grid.resolution, 0, 0, 0, 0)
        self._planes: Floats = np.zeros((self._parameters.live.live_directions, 0))

    def add(self, readings: Readings) -> None:
        """Add readings; `grid` grows to contain their cones.

        Raises
        ------
        InputError
            If the grid would exceed `max_cells`; the map is unchanged.
        MemoryError
            If there is no memory to grow; the map is unchanged.
        """
        if not len(readings):
            return
        r = readings
        self._grow(map_grid(r, self._parameters, self.grid, self._arc))
        g = self._stored
        beams = Beams(*(np.ascontiguousarray(v) for v in (r.x, r.y, r.yaw, r.half_angle, r.z, r.z_max)))
        lattice = StoredGrid(float(g.resolution), g.column, g.row, g.width, g.height)
        add_readings(beams, self._model(), lattice, self._planes)

    def add_map(self, other: LogOddsMap) -> None:
        """Add another map with the same parameters; the result is the same as if its readings were added.

        Raises
        ------
        InputError
            If the grid would exceed `max_cells`; the map is unchanged.
        """
        if not other.grid.size:
            return
        grid = self.grid.union(other.grid)
        check_size(grid, self._parameters.grid)
        self._grow(grid)
        for k in range(len(self._planes)):
            mine = self._plane(self._planes, k, self._stored)[self._stored.window(other.grid)]
            mine += other._plane(other._planes, k, other._stored)[other._stored.window(other.grid)]

    def log_odds(self, grid: Grid | None = None) -> Floats:
        """Return the log-odds on `grid` (by default that of the map); NaN if not observed.

        `grid` may be larger than the map; it must be of the same resolution.
        """
        grid = grid or self.grid
        whole = self._stored.union(grid)
        out = np.full(whole.shape, np.nan)
        if self._stored.size:
            out[whole.window(self._stored)] = self._summed()
        return np.array(out[whole.window(grid)])

    def probability(self, grid: Grid | None = None) -> NDArray[np.float32]:
        """Return the occupancy probabilities, p = 1 − 1 / (1 + e^l), NaN if not observed."""
        log_odds = self.log_odds(grid)
        with np.errstate(over='ignore'):
            return (1.0 - 1.0 / (1.0 + np.exp(log_odds))).astype(np.float32)

    def _model(self) -> InverseModel:
        p, cell = self._parameters.live, self._parameters.grid.resolution
        occupied, free, silent = (
            math.log(q / (1 - q)) for q in (p.live_p_occupied, p.live_p_free, p.live_p_free_no_echo)
        )
        before, behind = (depth / cell for depth in arc_depths(cell, self._arc))
        return InverseModel(occupied, free, silent, before, behind, p.live_echo_width / cell)

    def _plane(self, planes: Floats, k: int, grid: Grid) -> Floats:
        """Return a view of plane k, shape `grid.shape`."""
        if is_steep(k, len(planes)):
            return planes[k, : grid.size].reshape(grid.width, grid.height).T
        return planes[k, : grid.size].reshape(grid.shape)

    def _summed(self) -> Floats:
        """Return the log-odds of all directions combined, NaN if untouched, shape of the stored grid."""
        count = len(self._planes)
        apart = [self._plane(self._planes, k, self._stored) for k in range(count)]
        together = apart[0].copy()
        for one in apart[1:]:
            together += one
        untouched = (together == 0.0) & np.signbit(together)
        if count > 1:
            most = np.zeros_like(together)
            for k in range(count):
                log_odds = apart[k - 1] + apart[(k + 1) % count]
                log_odds *= BESIDE
                log_odds += apart[k]
                np.maximum(most, log_odds, out=most)
            np.maximum(most, together, out=together, where=most > 0.0)
        together[untouched] = np.nan
        return together

    def _grow(self, g: Grid) -> None:
        """Make the array large enough for a grid; if there is no memory, nothing changes."""
        if self._stored.union(g) == self._stored:
            self.grid = g
            return
        stored = g
        if self._stored.size:
            # only on later calls, with a robot that drives on: the readings of a single call are often all there are
            wide, high = g.width + 2 * MARGIN, g.height + 2 * MARGIN
            stored = Grid(g.resolution, g.column - MARGIN, g.row - MARGIN, wide, high).union(self._stored)
        grown = np.full((len(self._planes), stored.size + PADDING), UNTOUCHED)
        if self._stored.size:
            for k in range(len(grown)):
                self._plane(grown, k, stored)[stored.window(self._stored)] = self._plane(self._planes, k, self._stored)
        self.grid, self._stored, self._planes = g, stored, grown
