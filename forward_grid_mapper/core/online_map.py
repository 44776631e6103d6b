"""The forward map kept up to date while the robot drives.

New readings change the evidence of the cells of their cones. Only there, and as far around as flips reach, cells are
flipped until nothing gains any more. From time to time the surroundings are searched in all ways that a batch has, at
first as if cells were independent: lines would hold on to what few readings seemed to say.

Readings that say the same, from the same place, are counted and not kept: the same sensor, its pose within a fraction
of a cell and of its half angle, and the range within a fraction of σ. So a robot that stands still for hours adds
weight to what is known, but no memory and no time.
"""

from __future__ import annotations

import dataclasses
import math

import numpy as np
from numpy.typing import NDArray

from .common.constants import EXTENSION, FORBIDDEN
from .common.grid import Grid, part_of
from .common.parameters import Parameters
from .common.readings import Readings
from .evidence.evidence import Evidence
from .maps.log_odds_map import map_grid
from .maps.post_processing import post_process
from .maps.traversed import STRIDES, mark_traversed
from .maps.uncertainty import uncertainty_map
from .runtime.memory import memory_for_pairs
from .runtime.threads import cores
from .search.flips import flip_in_order, promising
from .search.prior import has_walls, odds_given_neighbours, wall_prior
from .search.search import LEAST, Search, Window
from .sensor.cone_table import effective_sigma, grid_of

SAME_PLACE = 0.5
"""Cells, and share of the half angle, by which poses may differ."""

SAME_RANGE = 0.5
"""Share of σ by which ranges may differ."""

MARGIN = 64
"""Cells by which the grid outgrows what is needed, and a quarter of its size more."""

MOST_SWEEPS = 50
"""Bound on the sweeps after one call; what is left then is done after the next."""

REFINE_EVERY = 1000
"""Readings after which the surroundings of the robot are searched as a batch would."""

MANY = 5000
"""New readings for which a whole search is faster."""


class OnlineMap:
    """An ML map and its evidence that follow the readings."""

    def __init__(self, parameters: Parameters) -> None:
        self._parameters = parameters
        self.clear()

    def clear(self) -> None:
        """Forget everything."""
        self._evidence: Evidence | None = None
        self._kept: dict[tuple[float, ...], int] = {}
        self._traversed = np.zeros((0, 0), np.bool_)
        self._since: list[Window] = []
        self._count = 0
        self._prior = wall_prior(self._parameters.search, np.zeros(0, np.bool_), self._parameters.grid.resolution)
        self._last = np.zeros(0), np.zeros(0), np.zeros(0, np.int64)
        self.grid = Grid(self._parameters.grid.resolution, 0, 0, 0, 0)

    def __len__(self) -> int:
        """Return the number of readings kept."""
        return 0 if self._evidence is None else len(self._evidence)

    def add(self, readings: Readings) -> None:
        """Add placed readings and bring the map up to date.

        Raises
        ------
        InputError
            If the grid would exceed `max_cells`; nothing is changed.
        """
        if not len(readings):
            return
        p = self._parameters
        self.grid = map_grid(readings, p, within=self.grid)
        evidence = self._with_room()
        self._mark_traversed(readings, evidence.grid)
        new, known = self._sort_out(readings)
        evidence.extend(readings.select(new))
        # after the new ones, which may be what others of the same call say too
        if len(known):
            evidence.add_multiplicity(known)
        if len(new) > MANY:
            Search(evidence, p.search, self._traversed.ravel()).run()
        else:
            window = self._around(evidence.grid, readings)
            self._settle(evidence, window)
            self._since.append(window)
            self._count += len(readings)
            if self._count >= REFINE_EVERY:
                self._refine(evidence)

    def _refine(self, evidence: Evidence) -> None:
        """Search around all readings since this was done last, in all ways that a search has."""
        bottom, top, left, right = zip(*self._since, strict=True)
        window = min(bottom), max(top), min(left), max(right)
        Search(evidence, self._parameters.search, self._traversed.ravel(), window).refine()
        self._since.clear()
        self._count = 0

    def adopt(self, grid: Grid, ml: NDArray[np.int8]) -> None:
        """Go on from another map of the same readings, 1 where occupied; cells that it does not have are free."""
        if self._evidence is not None:
            self._evidence.state.maps.occupied[:] = (part_of(grid, ml, self._evidence.grid) == 1).ravel()
            self._evidence.rebuild()

    def _mark_traversed(self, readings: Readings, grid: Grid) -> None:
        """Note the cells that sensors were moved over, from the last reading on."""
        x, y, stamp = (
            np.r_[old, new] for old, new in zip(self._last, (readings.x, readings.y, readings.stamp), strict=True)
        )
        mark_traversed(x, y, stamp, grid, self._traversed)
        rows, columns = grid.cells_of(x, y)
        # the last reading may be one of before a jump, off this grid
        rows, columns = rows.clip(0, grid.height - 1), columns.clip(0, grid.width - 1)
        near = (slice(rows.min(), rows.max() + 1), slice(columns.min(), columns.max() + 1))
        self._prior.local.reshape(grid.shape)[near][self._traversed[near]] = -FORBIDDEN
        n = STRIDES[-1]
        self._last = x[-n:], y[-n:], stamp[-n:]

    def _sort_out(self, readings: Readings) -> tuple[NDArray[np.int64], NDArray[np.int64]]:
        """Return which readings are new, and for the others which kept reading says the same."""
        p = self._parameters
        sigma = effective_sigma(readings, p.model, p.grid.resolution)
        place = SAME_PLACE * p.grid.resolution
        turn = SAME_PLACE * readings.half_angle
        columns = (
            readings.sensor,
            np.floor(readings.x / place),
            np.floor(readings.y / place),
            np.floor(readings.yaw / turn),
            np.floor(readings.z / (SAME_RANGE * sigma)),
            readings.z_max,
            readings.half_angle,
            sigma,
        )
        new: list[int] = []
        known: list[int] = []
        for i, key in enumerate(zip(*(column.tolist() for column in columns), strict=True)):
            kept = self._kept.setdefault(key, len(self._kept))
            if kept == len(self) + len(new):
                new.append(i)
            else:
                known.append(kept)
        return np.array(new, np.int64), np.array(known, np.int64)

    def _with_room(self) -> Evidence:
        evidence, g = self._evidence, self.grid
        if evidence is not None and evidence.grid.union(g) == evidence.grid:
            return evidence
        margin = MARGIN + max(g.width, g.height) // 4
        larger = Grid(g.resolution, g.column - margin, g.row - margin, g.width + 2 * margin, g.height + 2 * margin)
        p = self._parameters
        if evidence is None:
            # surfaces would have to be faced anew as readings come
            model = dataclasses.replace(p.model, grazing_angle=math.pi / 2)
            threads = p.search.threads or cores()
            self._evidence = evidence = Evidence(larger, model, memory_for_pairs(p), threads)
            self._traversed = np.zeros(larger.shape, np.bool_)
        else:
            larger = larger.union(evidence.grid)
            inner = larger.window(evidence.grid)
            traversed = np.zeros(larger.shape, np.bool_)
            traversed[inner] = self._traversed
            self._traversed = traversed
            up, right = inner[0].start, inner[1].start
            self._since = [(a + up, b + up, c + right, d + right) for a, b, c, d in self._since]
            evidence.grow(larger)
        self._prior = wall_prior(p.search, self._traversed.ravel(), g.resolution)
        return evidence

    def _around(self, grid: Grid, readings: Readings) -> Window:
        """Return the window of all cells that flips near new readings may change."""
        p = self._parameters
        box = grid_of(readings, p.model, p.grid)
        # flips change the readings that see a cell, and these reach that far
        around = math.ceil(float(readings.z_max.max()) / grid.resolution)
        row, column = box.row - grid.row, box.column - grid.column
        return (
            max(row - around, 0),
            min(row + box.height + around, grid.height),
            max(column - around, 0),
            min(column + box.width + around, grid.width),
        )

    def _settle(self, evidence: Evidence, window: Window) -> None:
        """Flip cells around the new readings until none gains any more."""
        prior = self._prior
        room = (window[1] - window[0]) * (window[3] - window[2])
        cells, gains = np.empty(room, np.int64), np.empty(room)
        for _ in range(MOST_SWEEPS):
            n = promising(evidence.state, prior, LEAST, window, cells, gains)
            if not n:
                break
            order = np.argsort(-gains[:n], kind='stable')
            flip_in_order(evidence.state, prior, LEAST, cells[order], gains[order])

    def maps(self) -> tuple[Grid, NDArray[np.int8], NDArray[np.float32]]:
        """Return the grid, the ML map (1 occupied, 0 free, -1 not observed) and the uncertainty map, as in `MapSet`."""
        if self._evidence is None:
            return self.grid, np.zeros((0, 0), np.int8), np.zeros((0, 0), np.float32)
        evidence, search = self._evidence, self._parameters.search
        window = evidence.grid.window(self.grid)
        extension = EXTENSION if has_walls(search) else 0.0
        ml = post_process(evidence, extension, search.least_passed, self._traversed)
        neighbours = odds_given_neighbours(self._prior, ml == 1)
        uncertainty = uncertainty_map(evidence.of_occupancy(), neighbours, ml, search)
        return self.grid, ml[window], uncertainty[window]
