"""The evidence of every cell, given readings and a map: built once, extended by new readings, kept right by flips."""

from __future__ import annotations

import math
from collections.abc import Callable
from functools import partial
from typing import Any

import numpy as np
from numpy.typing import NDArray

from ..common.grid import UNKNOWN, Grid
from ..common.parameters import ModelParameters
from ..common.readings import Readings
from ..runtime.cancelling import check
from ..runtime.jit import kernel
from ..runtime.threads import parts, run_each
from ..sensor.cone import rows_of, runs_of
from ..sensor.cone_table import CONE, Cones, Floats, cone_of, cone_table
from ..sensor.density import causes_of, hit_probability
from ..sensor.surface_normals import gather, no_normals, normals_of
from .fixed_point import QUANTUM
from .neighbourhood import patterns
from .pairs import WORD, WORDS_PER_BAND_PAIR, WORDS_PER_RUN, Lattice, empty_pairs, workspace_for
from .state import READING_STATE, Maps, Model, State
from .tile_index import SHIFT, insert, more_chunks, no_tiles
from .updates import add_multiplicity, evaluate_all

NO_INCIDENCE_LIMIT = 1.5707
"""Radians off the normal from where on no reading exceeds_incidence_angle."""

FREE, BAND, LARGEST, WORDS, UNSTORED = range(5)
"""Of the totals: pairs in free zones and in bands, cells of the largest cone, words stored, readings not stored."""


@kernel
def _index(s: State, limits: tuple[int, int, int], totals: Any) -> int:
    """Count the pairs of readings, and insert these into the tiles; return the reading at which chunks ran out.

    Parameters
    ----------
    limits
        The first reading, the last one plus one, and the words that stored pairs may take.
    totals : int64, shape (5,)
        Added to.
    """
    begin, end, words = limits
    cones, lattice, tiles, seen, before = s.cones, s.lattice, s.tiles, s.maps.seen, s.normals.before
    for t in range(begin, end):
        reading = cones[t]
        cone = cone_of(reading)
        bottom, end_row = rows_of(cone, lattice.height)
        across = min(2 * int(cone.reach) + 3, lattice.width)
        most = (((end_row - bottom) >> SHIFT) + 2) * ((across >> SHIFT) + 2)
        if s.stop[0] or tiles.used[0] + most > len(tiles.chunks):
            return t
        count, free, band = 0, 0, 0
        for row in range(bottom, end_row):
            runs = runs_of(cone, row, lattice.width)
            for left, right in ((runs.first, runs.last), (runs.first2, runs.last2)):
                if left > right:
                    continue
                insert(tiles, row, left, right, t)
                inner, outer = max(left, runs.inner), min(right, runs.outer)
                inside = max(outer - inner + 1, 0)
                count += inside > 0
                if s.normals.cos2_limit > 0.0 and inside > 0:
                    # a cell that is left out may cut a run in two
                    count += before[row, outer + 1] - before[row, inner]
                for c in range(np.uint64(row * lattice.width + left), np.uint64(row * lattice.width + right + 1)):
                    seen[c] += 1
                free += inside
                band += right - left + 1 - inside
        reading_state = s.reading_states[t]
        size = WORDS_PER_RUN * count + WORDS_PER_BAND_PAIR * band
        reading_state.at = totals[WORDS]
        reading_state.stored = totals[WORDS] + size <= words
        if reading_state.stored:
            totals[WORDS] += size
        else:
            totals[UNSTORED] += 1
        totals[FREE] += free
        totals[BAND] += band
        totals[LARGEST] = max(totals[LARGEST], free + band)
    return end


def reading_state_table(
    readings: Readings, sigma: Floats, model: ModelParameters, resolution: float
) -> NDArray[np.void]:
    """Return records of `READING_STATE`, shape (N,), with what no map changes; arguments are those of `causes_of`."""
    reading_states = np.zeros(len(readings), READING_STATE)
    causes = causes_of(readings, sigma, model, resolution)
    reading_states['floor'] = causes.random + causes.lost
    reading_states['max_range'] = causes.max_range
    reading_states['multiplicity'] = 1
    return reading_states


def _maps(grid: Grid, occupied: NDArray[np.uint8]) -> Maps:
    """Return what is kept for the cells of a grid, without readings, on the map `occupied`, shape `grid.shape`."""
    seen, evidence = np.zeros(grid.size, np.int32), np.zeros(grid.size, np.int64)
    occupied = occupied.reshape(grid.shape)
    return Maps(occupied.ravel(), evidence, seen, patterns(occupied, grid.shape))


class Evidence:
    """Readings, a map, and what flipping each of its cells would gain.

    Attributes
    ----------
    grid : Grid
    model : ModelParameters
    state : State
        What the kernels work on; arrays that grow are replaced, so it must not be kept.
    """

    def __init__(
        self,
        grid: Grid,
        model: ModelParameters,
        memory: float = math.inf,
        threads: int = 1,
        stop: NDArray[np.uint8] | None = None,
        start: NDArray[np.uint8] | None = None,
    ) -> None:
        """Begin without readings, on an empty map or on the map `start` (1 occupied, shape `grid.shape`).

        Parameters
        ----------
        grid : Grid
            Cells outside of it are left out.
        model : ModelParameters
        memory : float
            Bytes that the stored pairs may take.
        threads : int
            Threads to use where it pays; the result does not depend on it.
        stop : uint8, shape (1,), optional
            Set to 1 from any thread to cancel.
        """
        self.grid, self.model, self._threads = grid, model, threads
        self._words = int(min(memory / WORD, 2.0**60))
        self._totals = np.zeros(5, np.int64)
        self._size = 0
        self.state = State(
            normals=no_normals(),
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
            maps=_maps(grid, np.zeros(grid.shape, np.uint8) if start is None else np.array(start, np.uint8)),
            workspace=workspace_for(0),
            observing=np.empty((0, 2), np.int32),
            clock=np.zeros(1, np.int64),
            stop=np.zeros(1, np.uint8) if stop is None else stop,
        )

    def __len__(self) -> int:
        return self._size

    @property
    def pairs(self) -> int:
        """Number of pairs of a cell and a reading."""
        return int(self._totals[FREE] + self._totals[BAND])

    @property
    def unstored(self) -> int:
        """Number of readings whose pairs found no memory."""
        return int(self._totals[UNSTORED])

    @property
    def nbytes(self) -> int:
        """Memory of the pairs and of what is kept for readings and cells, bytes."""
        s = self.state
        kept = (s.cones, s.reading_states, s.pairs.cell, s.tiles.chunks, s.observing, *s.maps)
        return sum(int(array.nbytes) for array in kept)

    @property
    def tempered_log_likelihood(self) -> float:
        """What the readings count in the objective: the likelihood exponent times log p(Z | m), in nats."""
        return self.model.likelihood_exponent * self.log_likelihood

    @property
    def log_likelihood(self) -> float:
        """Log p(Z | m) in nats."""
        reading_states = self.state.reading_states[: self._size]
        return float((reading_states['likelihood'].astype(np.int64) * reading_states['multiplicity']).sum() * QUANTUM)

    @property
    def cones(self) -> Cones:
        """The cones of the readings, shape (N,); until readings are added or the grid grows."""
        return self.state.cones[: self._size]

    def of_occupancy(self) -> Floats:
        """Return γ [log p(Z | cell occupied, rest of the map) − log p(Z | cell free, rest of the map)] in nats.

        Shape (cells,); 0 where no reading sees the cell. γ is the likelihood exponent.
        """
        maps, nats = self.state.maps, self.state.model.nats
        out: Floats = np.where(maps.occupied == 1, -nats, nats) * maps.evidence
        return out

    @property
    def z_max(self) -> Floats:
        """The largest range of every reading in metres, shape (N,)."""
        far = self.state.cones['z_max'][: self._size] - self.model.surface_offset
        out: Floats = far * self.grid.resolution
        return out

    @property
    def likelihoods(self) -> Floats:
        """p(z | m) of every reading in 1/m, shape (N,)."""
        out: Floats = np.exp(self.state.reading_states['likelihood'][: self._size] * QUANTUM)
        return out

    def observed(self) -> NDArray[np.int8]:
        """Return a copy of the map, shape `grid.shape`: 1 occupied, 0 free, -1 where no reading sees the cell."""
        maps = self.state.maps
        return np.where(maps.seen > 0, maps.occupied.astype(np.int8), np.int8(UNKNOWN)).reshape(self.grid.shape)

    def extend(self, readings: Readings) -> None:
        """Add readings.

        Raises
        ------
        Cancelled
            If `stop` was set.
        """
        begin, end = self._size, self._size + len(readings)
        cones = cone_table(readings, self.grid, self.model)
        sigma = cones['sigma'] * self.grid.resolution
        reading_states = reading_state_table(readings, sigma, self.model, self.grid.resolution)
        self._reserve(end)
        s = self.state
        s.cones[begin:end], s.reading_states[begin:end] = cones, reading_states
        self._take_in(begin, end)

    def add_multiplicity(self, readings: NDArray[np.int64]) -> None:
        """Let each of `readings` (indices, shape (N,)) stand for one more reading that says the same."""
        add_multiplicity(self.state, readings)

    def grow(self, grid: Grid) -> None:
        """Go on with a larger grid, whose new cells are free; all readings are taken in anew.

        Parameters
        ----------
        grid : Grid
            Holds the old one.
        """
        old, maps, size = self.grid, self.state.maps, self._size
        window = grid.window(old)
        occupied = np.zeros(grid.shape, np.uint8)
        occupied[window] = maps.occupied.reshape(old.shape)
        self.state.cones['x'][:size] += window[1].start
        self.state.cones['y'][:size] += window[0].start
        self.grid = grid
        self.state = self.state._replace(
            lattice=self.state.lattice._replace(height=grid.height, width=grid.width),
            tiles=no_tiles(grid.height, grid.width),
            maps=_maps(grid, occupied),
        )
        self._totals[:] = 0
        self._take_in(0, size)

    def rebuild(self) -> None:
        """Explain all readings anew, after the map was changed in many places."""
        maps = self.state.maps
        maps.evidence[:] = 0
        maps.pattern[:] = patterns(maps.occupied, self.grid.shape)
        self._evaluate_and_add(0, self._size, new=False)

    def each(self, begin: int, end: int, work: Callable[[State, int, int], None]) -> None:
        """Have several threads work on parts of the readings `begin` to `end`, each with room of its own."""
        largest = int(self._totals[LARGEST])
        jobs: list[Callable[[], None]] = []
        for k, (first, last) in enumerate(parts(begin, end, self._threads)):
            s = self.state
            if k:
                s = s._replace(workspace=workspace_for(largest))
            jobs.append(partial(work, s, first, last))
        run_each(jobs)
        check(self.state.stop)

    def _evaluate_and_add(self, begin: int, end: int, new: bool) -> None:
        maps = self.state.maps
        own: list[Maps] = []

        def work(s: State, first: int, last: int) -> None:
            if first > begin:
                s = s._replace(maps=maps._replace(evidence=np.zeros_like(maps.evidence)))
                own.append(s.maps)
            evaluate_all(s, first, last, new)

        self.each(begin, end, work)
        for other in own:
            np.add(maps.evidence, other.evidence, out=maps.evidence)

    def _take_in(self, begin: int, end: int) -> None:
        """Index readings whose cones are in place, and add what they say to the evidence."""
        if not begin and self.model.grazing_angle < NO_INCIDENCE_LIMIT:
            self._face(end)
        done = begin
        while done < end:
            s = self.state
            done = _index(s, (done, end, self._words), self._totals)
            check(s.stop)
            if done < end:
                self.state = s._replace(tiles=more_chunks(s.tiles))
        self._size = end
        self._make_room()
        self._evaluate_and_add(begin, end, new=True)

    def _face(self, end: int) -> None:
        """Learn from the first readings which way surfaces face."""
        sums: list[NDArray[np.int64]] = []

        def work(s: State, first: int, last: int) -> None:
            sums.append(np.zeros((3, self.grid.size), np.int64))
            gather(s.cones, self.grid.shape, (first, last), sums[-1], s.stop)

        self.each(0, end, work)
        normals = normals_of(np.sum(sums, axis=0), self.grid, self.model.grazing_angle)
        self.state = self.state._replace(normals=normals)

    def _reserve(self, size: int) -> None:
        """Make room for `size` readings; more than that where they come in small numbers."""
        s = self.state
        if size <= len(s.reading_states):
            return
        room = size if not self._size else max(size, self._size * 3 // 2)
        cones, reading_states = np.empty(room, CONE), np.zeros(room, READING_STATE)
        cones[: self._size], reading_states[: self._size] = s.cones[: self._size], s.reading_states[: self._size]
        self.state = s._replace(cones=cones, reading_states=reading_states, observing=np.empty((room, 2), np.int32))

    def _make_room(self) -> None:
        """Make room for the pairs that were counted."""
        s = self.state
        words, largest = int(self._totals[WORDS]), int(self._totals[LARGEST])
        if words > len(s.pairs.cell):
            kept = len(s.pairs.cell)
            pairs = empty_pairs(words if not kept else max(words, min(words * 3 // 2, self._words)))
            pairs.cell[:kept] = s.pairs.cell
            s = s._replace(pairs=pairs)
        if largest + 3 > len(s.workspace.new):
            s = s._replace(workspace=workspace_for(largest))
        self.state = s
