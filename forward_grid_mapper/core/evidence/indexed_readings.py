"""The lower half of `Evidence`: readings on a grid, indexed by its cells, and the memory for them.

This half knows nothing of a map: it counts and indexes the cells in the cones of readings. `evidence` makes their
pairs and evaluates them.
"""

from __future__ import annotations

from concurrent.futures import ThreadPoolExecutor
from functools import partial
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from ..common.grid import Grid
from ..common.parameter_groups import ModelParameters
from ..common.readings import Floats
from ..runtime.cancelling import check
from ..runtime.memory import THREAD_MEMORY
from ..runtime.threads import parts, run_each
from ..sensor.cone_table import CONE, Cones
from ..sensor.density import hit_probability
from ..sensor.surface_normals import SurfaceNormals
from .fixed_point import QUANTUM
from .indexing import ALLOCATED_WORDS, BAND_PAIRS, FREE_PAIRS, LARGEST_CONE, UNSTORED_READINGS, insert_readings
from .neighbourhood import set_patterns
from .pairs import WORD, Lattice, empty_pairs, workspace_for
from .state import BLOCK_SHIFT, READING_STATE, Maps, Model, State, Work
from .tile_index import more_chunks, no_tiles
from .updates import forget

BYTES_A_CONE_CELL = 64
"""Bytes of a workspace for each cell of the largest cone."""


class _IndexState(NamedTuple):
    """State that must be restored if adding readings fails: fields of `Tiles`, the totals, and the normals."""

    head: NDArray[np.int32]
    fill: NDArray[np.int32]
    latest: NDArray[np.int32]
    used: int
    totals: NDArray[np.int64]
    normals: SurfaceNormals


def empty_maps(grid: Grid, occupied: NDArray[np.uint8]) -> Maps:
    """Return the state of the cells of a grid without readings; `occupied` is the map, shape `grid.shape`."""
    seen, evidence = np.zeros(grid.size, np.int32), np.zeros(grid.size, np.int64)
    pattern = np.zeros(grid.size, np.uint8)
    set_patterns(occupied.ravel(), grid.shape, pattern)
    return Maps(occupied.ravel(), evidence, seen, pattern, np.ones((grid.size >> BLOCK_SHIFT) + 1, np.uint8))


class IndexedReadings:
    """Cones of readings on a grid, their pairs with cells as far as there is memory, and work on them by threads.

    `Evidence` adds readings in this order: `_allocate_readings` makes room for them, and their cones are written there;
    `_insert` indexes them, and makes room for their pairs; then the pairs are made. If `_insert` or a later step fails,
    `_restore_index` returns to what `_index_state` was before. In the end, `_size` grows.

    Attributes
    ----------
    grid : Grid
    model : ModelParameters
    state : State
        For the kernels. Arrays that grow are replaced, so callers must not store it.
    """

    def __init__(
        self,
        grid: Grid,
        model: ModelParameters,
        memory: float,
        threads: int,
        stop: NDArray[np.uint8],
        occupied: NDArray[np.uint8],
        normals: SurfaceNormals,
    ) -> None:
        """Begin without readings, on the map `occupied` (1 occupied, shape `grid.shape`)."""
        self.grid, self.model, self._threads = grid, model, threads
        # its threads begin when they are needed, and end with this object; starting them each time takes longer
        self._pool = ThreadPoolExecutor(threads)
        self._most_words = int(min(memory / WORD, 2.0**60))
        # by the indices of `indexing`, such as ALLOCATED_WORDS
        self._totals = np.zeros(6, np.int64)
        # numbers of readings that were added, and that are indexed; the latter is larger only within `Evidence.extend`
        self._size = self._indexed = 0
        self.state = State(
            normals=normals,
            lattice=Lattice(grid.height, grid.width, grid.resolution),
            model=Model(
                hit_probability(model, grid.resolution),
                1.0 - model.p_rand - model.p_lost,
                model.likelihood_exponent * QUANTUM,
            ),
            cones=np.empty(0, CONE),
            reading_states=np.empty(0, READING_STATE),
            pairs=empty_pairs(0),
            tiles=no_tiles(grid.height, grid.width),
            maps=empty_maps(grid, occupied),
            workspace=workspace_for(0),
            observing=np.empty((0, 2), np.int32),
            clock=np.zeros(1, np.int64),
            stop=stop,
        )

    def __len__(self) -> int:
        return self._size

    @property
    def pairs(self) -> int:
        """Number of pairs of a cell and a reading."""
        return int(self._totals[FREE_PAIRS] + self._totals[BAND_PAIRS])

    @property
    def unstored(self) -> int:
        """Number of readings whose pairs are not stored, for lack of memory."""
        return int(self._totals[UNSTORED_READINGS])

    @property
    def nbytes(self) -> int:
        """Memory of pairs, readings and cells, without surface normals, bytes."""
        s = self.state
        kept = (s.cones, s.reading_states, s.pairs.cell, s.tiles.chunks, s.observing, *s.maps)
        return sum(int(array.nbytes) for array in kept)

    @property
    def cones(self) -> Cones:
        """The cones of the readings, shape (N,); valid until readings are added or the grid grows."""
        return self.state.cones[: self._size]

    @property
    def z_max(self) -> Floats:
        """The largest range of each reading, metres, shape (N,)."""
        far = self.state.cones['z_max'][: self._size] - self.model.surface_offset
        out: Floats = far * self.grid.resolution
        return out

    @staticmethod
    def _check_indices(readings: NDArray[np.int64], size: int) -> None:
        if len(readings) and not 0 <= readings.min() <= readings.max() < size:
            raise ValueError(f'readings {readings.min()} to {readings.max()} are asked for, and there are {size}')

    def sum_over_readings(self, begin: int, end: int, work: Work, total: NDArray[np.int64], beside: int = 0) -> None:
        """Run work on several threads, each for a part of the readings `begin` to `end`, and sum the results.

        Each thread has its own workspace and array. Integer sums do not depend on the number of threads.

        Parameters
        ----------
        begin, end : int
        work : callable
        total : int64
            The results are added to it.
        beside : int
            Additional memory of each thread, bytes.

        Raises
        ------
        Cancelled
            If `stop` was set.
        """
        largest = int(self._totals[LARGEST_CONE])
        own = [(self.state, total)]
        each = total.nbytes + beside + BYTES_A_CONE_CELL * largest
        most = len(parts(begin, end, min(self._threads, 1 + THREAD_MEMORY // max(each, 1))))
        try:
            while len(own) < most:
                s = self.state._replace(workspace=workspace_for(largest))
                own.append((s, np.zeros_like(total)))
        except MemoryError:
            # with fewer threads, the result is the same
            pass
        portions = zip(own, parts(begin, end, len(own)), strict=True)
        run_each([partial(work, s, first, last, array) for (s, array), (first, last) in portions], self._pool)
        check(self.state.stop)
        for _, array in own[1:]:
            np.add(total, array, out=total)

    def _index_state(self) -> _IndexState:
        """Return a copy of the state for `_restore_index`."""
        s = self.state
        tiles = s.tiles
        lists = tiles.head.copy(), tiles.fill.copy(), tiles.latest.copy()
        return _IndexState(*lists, int(tiles.used[0]), self._totals.copy(), s.normals)

    def _insert(self, begin: int, end: int) -> None:
        """Index readings whose cones are set, and allocate memory for their pairs."""
        self._indexed = begin
        while self._indexed < end:
            s = self.state
            self._indexed = insert_readings(s, (self._indexed, end, self._most_words), self._totals)
            check(s.stop)
            if self._indexed < end:
                self.state = s._replace(tiles=more_chunks(s.tiles))
        self._allocate_pairs(int(self._totals[ALLOCATED_WORDS]))

    def _restore_index(self, begin: int, before: _IndexState) -> None:
        """Undo the indexing from reading `begin` on."""
        s = self.state
        forget(s, begin, self._indexed)
        s.tiles.head[:], s.tiles.fill[:], s.tiles.latest[:] = before.head, before.fill, before.latest
        s.tiles.used[0] = before.used
        self._indexed = begin
        self._totals[:] = before.totals
        self.state = s._replace(normals=before.normals)

    def _allocate_readings(self, size: int) -> None:
        """Allocate memory for `size` readings, and for half as many more if there are readings already."""
        s = self.state
        if size <= len(s.reading_states):
            return
        room = size if not self._size else max(size, self._size * 3 // 2)
        cones, reading_states = np.empty(room, CONE), np.zeros(room, READING_STATE)
        cones[: self._size], reading_states[: self._size] = s.cones[: self._size], s.reading_states[: self._size]
        self.state = s._replace(cones=cones, reading_states=reading_states, observing=np.empty((room, 2), np.int32))

    def _allocate_pairs(self, words: int) -> None:
        """Allocate this many words of pairs, and a workspace for the largest cone."""
        s = self.state
        largest, words = int(self._totals[LARGEST_CONE]), min(words, self._most_words)
        if words > len(s.pairs.cell):
            kept = len(s.pairs.cell)
            pairs = empty_pairs(words if not kept else max(words, min(words * 3 // 2, self._most_words)))
            pairs.cell[:kept] = s.pairs.cell
            s = s._replace(pairs=pairs)
        if largest + 3 > len(s.workspace.new):
            s = s._replace(workspace=workspace_for(largest))
        self.state = s
