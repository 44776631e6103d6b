"""The online map: the forward map, updated while the robot drives.

New readings change the evidence of the cells in their cones. Cells there, and around as far as flips have effects, are
flipped until nothing gains. From time to time the map is refined: surface normals are estimated again from all
readings, the affected pairs are made again, and the surroundings are searched with all moves of a batch. This begins
with independent cells, since the prior for walls would keep walls that rest on few readings.

Equal readings are only counted: those of the same sensor, with poses within a fraction of a cell and of the half angle,
and ranges within a fraction of σ. So a robot that stands still for hours adds evidence, but needs no more memory and
time.
"""

from __future__ import annotations

import math
from collections.abc import Iterator, MutableMapping
from itertools import chain
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from .common.constants import FARTHEST_RANDOM, FORBIDDEN
from .common.grid import Grid, Window, part_of, united
from .common.parameters import Parameters
from .common.readings import Readings, of_drives
from .evidence.evidence import Evidence
from .maps.final_maps import final_maps
from .maps.log_odds_map import map_grid
from .maps.traversed import LONGEST_STEP, STRIDES, longest_step, mark_traversed
from .runtime.memory import memory_for_pairs
from .runtime.threads import cores
from .search.flips import flip_in_order, promising
from .search.prior import wall_prior
from .search.search import LEAST, Search
from .sensor.cone_table import effective_sigma, grid_of, reach_of

SAME_PLACE = 0.5
"""Poses of equal readings differ by less than this many cells, and this fraction of the half angle."""

SAME_RANGE = 0.5
"""Ranges of equal readings differ by less than this fraction of σ."""

MARGIN = 64
"""Cells that are added to each side of the grid when it grows, besides a quarter of its size."""

MOST_UPDATES = 50
"""Most sequential updates in one call; the rest is done in the next."""

REFINE_EVERY = 1000
"""Most new readings before the map is refined."""

REFINE_SHARE = 0.05
"""The map is refined after new readings of this fraction of all: while there are few, each affects the surface normals
much, and refining is fast."""

REFINE_LEAST = 50
"""Fewest new readings for it."""

SEARCH_ALL_FROM = 5000
"""With more new readings, a search of the whole map is faster."""


PORTION = 2000
"""Readings that are looked up before other threads can get the GIL."""

PARTS = 512
"""Number of dictionaries for the indices of readings: a single large one would hold the GIL for long when it grows or
is deleted."""

Key = bytes
"""The discretised values of a reading; the garbage collector does not traverse bytes."""


class _IndexByKey(MutableMapping[Key, int]):
    """Indices of the stored readings, by key."""

    def __init__(self) -> None:
        self._parts: list[dict[Key, int]] = [{} for _ in range(PARTS)]
        self._count = 0

    def __getitem__(self, key: Key) -> int:
        return self._parts[hash(key) % len(self._parts)][key]

    def __setitem__(self, key: Key, number: int) -> None:
        part = self._parts[hash(key) % len(self._parts)]
        before = len(part)
        part[key] = number
        self._count += len(part) - before

    def __delitem__(self, key: Key) -> None:
        del self._parts[hash(key) % len(self._parts)][key]
        self._count -= 1

    def __iter__(self) -> Iterator[Key]:
        return chain.from_iterable(self._parts)

    def __len__(self) -> int:
        return self._count

    def clear(self) -> None:
        """Remove all keys in small steps."""
        self._count = 0
        for part in self._parts:
            part.clear()


MOST_SIZE_READINGS = 1000
"""Readings from which the distances of the sensors on the robot are estimated (`traversed.longest_step`)."""

NO_READINGS = Readings.from_columns(x=[], y=[], yaw=[], z=[], z_max=[], half_angle=[])


class _Traversed(NamedTuple):
    """Cells of a part of the grid that the robot traversed, after new readings, and data about the robot's size."""

    near: tuple[slice, slice]
    cells: NDArray[np.bool_]
    last: tuple[NDArray[np.float64], NDArray[np.float64], NDArray[np.int64]]
    begun: Readings
    longest: float


class OnlineMap:
    """A maximum likelihood map and its evidence, updated with each set of new readings."""

    def __init__(self, parameters: Parameters) -> None:
        self._parameters = parameters
        self._stop = np.zeros(1, np.uint8)
        self.clear()

    def clear(self) -> None:
        """Make the map empty."""
        self._evidence: Evidence | None = None
        self._index_by_key = _IndexByKey()
        self._traversed = np.zeros((0, 0), np.bool_)
        # the part that has changed since the last refinement
        self._not_refined: Window | None = None
        self._new_readings = 0
        self._prior = wall_prior(self._parameters.search, np.zeros(0, np.bool_), self._parameters.grid.resolution)
        self._last_poses = np.zeros(0), np.zeros(0), np.zeros(0, np.int64)
        # the first readings, from which the size of the robot follows
        self._size_readings, self._longest_step = NO_READINGS, LONGEST_STEP
        self.grid = Grid(self._parameters.grid.resolution, 0, 0, 0, 0)
        self.taken = 0
        """Number of readings added, including those merged with equal ones."""

    def cancel(self) -> None:
        """Make all calls raise `Cancelled` soon; the map is of no more use. May be called from any thread."""
        self._stop[0] = 1

    def dismantle(self) -> None:
        """Free the memory of a map that is not needed any more, in small steps: at once would hold the GIL for long."""
        self._evidence = None
        self._index_by_key.clear()

    def __len__(self) -> int:
        """Return the number of stored readings."""
        return 0 if self._evidence is None else len(self._evidence)

    @property
    def waiting(self) -> int:
        """Number of readings added since the last refinement."""
        return self._new_readings

    def add(self, readings: Readings) -> None:
        """Add readings and update the map.

        Either all readings are added or none; `taken` shows which. After an error the map stays usable: the rest of the
        search is done in the next call.

        Raises
        ------
        InputError
            If the grid would exceed `max_cells`; nothing is changed.
        Cancelled
            If `cancel` was called.
        MemoryError
        """
        if not len(readings):
            return
        grid = map_grid(readings, self._parameters, within=self.grid)
        evidence = self._with_room(grid)
        window = self._around(evidence, readings)
        traversed = self._newly_traversed(readings, evidence.grid)
        before = len(evidence)
        self._insert(evidence, readings)
        self.grid, self.taken, self._new_readings = grid, self.taken + len(readings), self._new_readings + len(readings)
        self._not_refined = united(self._not_refined, window)
        self._traversed[traversed.near] = traversed.cells
        self._prior.local.reshape(evidence.grid.shape)[traversed.near][traversed.cells] = -FORBIDDEN
        self._last_poses, self._size_readings, self._longest_step = traversed[2:]
        if len(evidence) - before > SEARCH_ALL_FROM:
            self._search(evidence)
        elif self._new_readings >= min(REFINE_EVERY, max(REFINE_LEAST, REFINE_SHARE * len(evidence))):
            self._settle(evidence, window)
            self._refine(evidence)
        else:
            self._settle(evidence, window)

    def _insert(self, evidence: Evidence, readings: Readings) -> None:
        """Add readings to the evidence; equal ones increase the multiplicity. Either all are added or none."""
        new: list[NDArray[np.int64]] = []
        known: list[NDArray[np.int64]] = []
        fresh: list[list[Key]] = []
        try:
            for begin in range(0, len(readings), PORTION):
                fresh.append([])
                numbers = []
                for key in self._keys(readings.select(slice(begin, begin + PORTION))):
                    numbers.append(self._index_by_key.get(key, -1))
                    if numbers[-1] < 0:
                        fresh[-1].append(key)
                        self._index_by_key[key] = len(self._index_by_key)
                number = np.array(numbers, np.int64)
                new.append(begin + np.flatnonzero(number < 0))
                known.append(number[number >= 0])
            evidence.extend(readings.select(np.concatenate(new)), np.concatenate(known))
        except BaseException:
            for keys in fresh:
                for key in keys:
                    self._index_by_key.pop(key, None)
            raise

    def _keys(self, readings: Readings) -> list[Key]:
        """Return a key for each reading; equal readings have the same one."""
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
        # + 0.0 maps −0 to 0, which has other bytes
        rows = np.column_stack(columns).astype(np.float64) + 0.0
        data, size = rows.tobytes(), rows.shape[1] * rows.itemsize
        return [data[i : i + size] for i in range(0, len(data), size)]

    def _search(self, evidence: Evidence) -> None:
        """Search the whole map like a batch."""
        evidence.renew_normals()
        Search(evidence, self._parameters.search, self._traversed.ravel()).run()
        self._not_refined, self._new_readings = None, 0

    def _refine(self, evidence: Evidence) -> None:
        """Renew the surface normals, and search around all changes since the last time, with all moves."""
        self._not_refined = united(self._not_refined, evidence.renew_normals())
        Search(evidence, self._parameters.search, self._traversed.ravel(), self._not_refined).refine()
        self._not_refined, self._new_readings = None, 0

    def adopt(self, grid: Grid, searched: NDArray[np.int8]) -> None:
        """Replace the map by another one of the same readings.

        Parameters
        ----------
        grid : Grid
        searched : int8, shape `grid.shape`
            1 if occupied, like `MapSet.searched`; cells outside of it are free.
        """
        if self._evidence is not None:
            self._evidence.state.maps.occupied[:] = (part_of(grid, searched, self._evidence.grid) == 1).ravel()
            self._evidence.rebuild()

    def searched(self) -> tuple[Grid, NDArray[np.int8]]:
        """Return the grid and the map as the start of another search, like `MapSet.searched`."""
        if self._evidence is None:
            return self.grid, np.zeros((0, 0), np.int8)
        return self.grid, self._evidence.observed()[self._evidence.grid.window(self.grid)]

    def _newly_traversed(self, readings: Readings, grid: Grid) -> _Traversed:
        """Return the cells that the robot traversed since the last reading; nothing is changed yet."""
        x, y, stamp = (
            np.r_[old, new] for old, new in zip(self._last_poses, (readings.x, readings.y, readings.stamp), strict=True)
        )
        rows, columns = grid.cells_of(x, y)
        # the last reading may be from before a jump, and outside of this grid
        rows, columns = rows.clip(0, grid.height - 1), columns.clip(0, grid.width - 1)
        bottom, left = int(rows.min()), int(columns.min())
        near = (slice(bottom, int(rows.max()) + 1), slice(left, int(columns.max()) + 1))
        cells = self._traversed[near].copy()
        part = Grid(grid.resolution, grid.column + left, grid.row + bottom, cells.shape[1], cells.shape[0])
        begun, longest = self._size_readings, self._longest_step
        if len(begun) < MOST_SIZE_READINGS:
            begun = of_drives([begun, readings])
            longest = longest_step(begun)
            # later only their number matters, and there may be half a million
            begun = begun.select(np.arange(min(len(begun), MOST_SIZE_READINGS)))
        mark_traversed(x, y, stamp, part, cells, longest)
        n = STRIDES[-1]
        return _Traversed(near, cells, (x[-n:], y[-n:], stamp[-n:]), begun, longest)

    def _with_room(self, g: Grid) -> Evidence:
        """Return the evidence on a grid that contains `g`."""
        evidence = self._evidence
        if evidence is not None and evidence.grid.union(g) == evidence.grid:
            return evidence
        p = self._parameters
        known = g if evidence is None else g.union(evidence.grid)
        wide, high = MARGIN + g.width // 4, MARGIN + g.height // 4
        larger = Grid(g.resolution, g.column - wide, g.row - high, g.width + 2 * wide, g.height + 2 * high).union(known)
        if larger.size > p.grid.max_cells:
            # the margin must not make the map exceed max_cells
            larger = known
        traversed = np.zeros(larger.shape, np.bool_)
        if evidence is not None:
            inner = larger.window(evidence.grid)
            traversed[inner] = self._traversed
        prior = wall_prior(p.search, traversed.ravel(), g.resolution)
        if evidence is None:
            threads = p.search.threads or cores()
            evidence = Evidence(larger, p.model, memory_for_pairs(p), threads, self._stop, renewable=True)
        else:
            evidence.grow(larger)
            if self._not_refined:
                up, right = inner[0].start, inner[1].start
                a, b, c, d = self._not_refined
                self._not_refined = a + up, b + up, c + right, d + right
        self._evidence, self._traversed, self._prior = evidence, traversed, prior
        return evidence

    def _around(self, evidence: Evidence, readings: Readings) -> Window:
        """Return the window of all cells that flips near new readings may change."""
        p, grid = self._parameters, evidence.grid
        box = grid_of(readings, p.model, p.grid)
        # flips affect the readings that observe a cell, and these reach that far
        farthest = float(readings.z_max.max())
        if farthest > FARTHEST_RANDOM:
            # the driver knows no largest range; without this, each sweep would examine the whole map
            new = reach_of(readings, effective_sigma(readings, p.model, grid.resolution)).max()
            farthest = max(float(new), float(evidence.cones['reach'].max(initial=0.0)) * grid.resolution)
        around = math.ceil(farthest / grid.resolution)
        row, column = box.row - grid.row, box.column - grid.column
        return (
            max(row - around, 0),
            min(row + box.height + around, grid.height),
            max(column - around, 0),
            min(column + box.width + around, grid.width),
        )

    def _settle(self, evidence: Evidence, window: Window) -> None:
        """Flip cells around the new readings until none gains."""
        prior = self._prior
        room = (window[1] - window[0]) * (window[3] - window[2])
        cells, gains = np.empty(room, np.int64), np.empty(room)
        for _ in range(MOST_UPDATES):
            n = promising(evidence.state, prior, LEAST, window, cells, gains)
            if not n:
                break
            order = np.argsort(-gains[:n], kind='stable')
            flip_in_order(evidence.state, prior, LEAST, cells[order], gains[order])

    def maps(self) -> tuple[Grid, NDArray[np.int8], NDArray[np.float32]]:
        """Return the grid, the maximum likelihood map and the uncertainty map, with values as in `MapSet`."""
        if self._evidence is None:
            return self.grid, np.zeros((0, 0), np.int8), np.zeros((0, 0), np.float32)
        evidence, search = self._evidence, self._parameters.search
        window = evidence.grid.window(self.grid)
        final = final_maps(evidence, search, self._traversed)
        return self.grid, final.ml[window], final.uncertainty[window]
