"""What is done with a tile by a worker, which holds it with its halo: tasks of a job and the number of a tile.

What a task makes is a file of the tile, and what it returns is small. If the file is there already, it only returns
what it did then: so a task may be run again whenever a worker died or the client was interrupted.

    readings.parquet    its readings and those near it, in canonical order
    ground.npz          which cells of the core were traversed
    normals.npz         surface normals of the core
    search_0007.npz     the window as a search left it; the number says which came first
    maps.npz            the maps of the core
    judged.npz          echoes from nothing, in the box
"""

from __future__ import annotations

import dataclasses
from collections.abc import Iterator, Mapping
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from ..core.common.grid import UNKNOWN, Grid
from ..core.common.readings import Readings, in_canonical_order
from ..core.evidence.neighbourhood import patterns
from ..core.learning.sensor_health import health_counts
from ..core.maps.log_odds_map import LogOddsMap
from ..core.search.prior import log_prior, wall_prior
from ..core.tiles import windows
from ..core.tiles.mosaic import FIRST_AROUND
from ..core.tiles.tiling import Tile, boxes_of, common_part
from ..core.tiles.windows import Given, Searched
from .job import Job, Plan, plan_of, task
from .tables import COLUMNS, columns_of, read_table, readings_of, write_table
from .work_folder import outcome_in, read_arrays, write_arrays

FIRST = 0
"""The number of the first search."""


class TileFiles:
    """A tile of a job, with the files of it and of its neighbours."""

    def __init__(self, job: Job, number: int) -> None:
        self.job, self.number = job, number
        self.plan: Plan = plan_of(job.folder, job.size)
        self.tiling = self.plan.tiling
        self.tile: Tile = self.tiling.tiles[number]

    def path(self, name: str, number: int | None = None) -> Path:
        """Return a file of this tile, or of another one."""
        tile = self.tile if number is None else self.tiling.tiles[number]
        return self.job.folder.tile(tile.row, tile.column, name)

    @property
    def readings(self) -> Readings:
        """All that is kept of the tile, in canonical order."""
        return readings_of(read_table(self.path('readings.parquet')), self.plan.sensor_names)

    def given(self, step: int | None = None, around: float = 0.0, ml: bool = False) -> Given:
        """Return what is known around the tile, as `Mosaic.given` does.

        Parameters
        ----------
        step : int, optional
            The map as it was before that search; by default as it is.
        around : float
            Metres around the core whose readings are given.
        ml : bool
            Whether the map that is handed out is needed.
        """
        kept, p = self.readings, self.job.parameters
        boxes = boxes_of(kept, p)
        readings = kept.select(self.tiling.touching(self.number, boxes, around)) if len(kept) else kept
        box = self.tiling.box(self.number, readings, p)
        own = self.tiling.owners(readings) == self.number
        traversed = self._cores('ground.npz', 'traversed', box, np.zeros(box.shape, np.bool_))
        # the first map is made without its neighbours
        occupied = np.zeros(box.shape, np.uint8) if step == FIRST else self._occupied(box, step)
        normals = self._cores('normals.npz', 'normals', box, np.zeros((2, *box.shape), np.float32))
        shown = np.full(box.shape, UNKNOWN, np.int8)
        if ml:
            self._cores('maps.npz', 'ml', box, shown)
        return Given(self.tile, box, readings, own, traversed, occupied, normals, shown)

    def _cores(self, file: str, name: str, box: Grid, out: NDArray[Any]) -> NDArray[Any]:
        """Fill an array of a box with what the tiles in it have."""
        for number in self.tiling.meeting(box):
            core = self.tiling.tiles[number].core
            part = common_part(core, box)
            try:
                (values,) = read_arrays(self.path(file, number), name)
            except FileNotFoundError:
                # a tile without readings has no normals
                continue
            out[(..., *box.window(part))] = values[(..., *core.window(part))]
        return out

    def _occupied(self, box: Grid, step: int | None) -> NDArray[np.uint8]:
        """Return the map in a box: the windows of all searches in their order, of which those of one step are apart."""
        out = np.zeros(box.shape, np.uint8)
        found = []
        for number in self.tiling.meeting(box, window=True):
            steps = [s for s in self._steps(number) if step is None or s < step]
            # what a first search says beyond its core is not kept, so the first one is always shown below
            found += [(s, number) for s in {min(steps), max(steps)}] if steps else []
        for s, number in sorted(found):
            of = self.tiling.tiles[number]
            region = of.core if s == FIRST else of.window
            part = common_part(region, box)
            if part.size:
                (values,) = read_arrays(self.path(searched(s), number), 'occupied')
                out[box.window(part)] = values[of.window.window(part)]
        return out

    def _steps(self, number: int) -> Iterator[int]:
        """Yield the numbers of the searches of a tile."""
        for path in self.path('', number).glob('search_*.npz'):
            yield int(path.stem.partition('_')[2])


def searched(step: int) -> str:
    """Return the name of the file of a search."""
    return f'search_{step:04d}.npz'


def prior_of_core(given: Given, occupied: NDArray[np.bool_], job: Job) -> float:
    """Return the part of a map's log prior, shape `box.shape`, that the cells of the core have."""
    prior = wall_prior(job.parameters.search, given.traversed.ravel(), given.box.resolution)
    mine = np.zeros(given.box.shape, np.uint8)
    core = given.box.window(given.tile.core)
    mine[core] = occupied[core]
    return log_prior(prior, mine.ravel(), patterns(occupied.astype(np.uint8), given.box.shape))


@task
def gather(job: Job, number: int) -> dict[str, Any]:
    """Put together what the drives have for a tile; return its box and how many readings touch it."""
    files = TileFiles(job, number)
    target = files.path('ground.npz')
    if (before := outcome_in(target)) is not None:
        return before
    tile, plan = files.tile, files.plan
    drives = []
    for path, k in _parts(job, 'readings', tile, plan):
        table = read_table(path)
        table['sensor'] = np.array(plan.sensors[_number(path)], np.int32)[table['sensor']]
        table['drive'] = np.full(len(table['z']), k, np.int32)
        drives.append(table)
    together = {name: np.concatenate([d[name] for d in drives]) if drives else np.zeros(0) for name in COLUMNS}
    write_table(
        files.path('readings.parquet'), columns_of(in_canonical_order(readings_of(together, plan.sensor_names)))
    )
    traversed = np.zeros(tile.core.shape, np.bool_)
    for path, _ in _parts(job, 'ground', tile, plan):
        cells = read_table(path)
        inside = cells['row'] - tile.core.row, cells['column'] - tile.core.column
        traversed[inside] = True
    # the drives' parts are kept: an interrupted job may be asked for them again
    given = files.given()
    box = given.box
    outcome = {
        'box': [box.resolution, box.column, box.row, box.width, box.height],
        'readings': len(given.readings),
        'own': int(given.own.sum()),
    }
    write_arrays(target, {'traversed': traversed}, outcome)
    return outcome


def _parts(job: Job, kind: str, tile: Tile, plan: Plan) -> Iterator[tuple[Path, int]]:
    """Yield the files that drives of the map have for a tile, with the numbers of the drives."""
    for path in sorted(job.folder.parts(kind, tile.row, tile.column).glob('drive_*.parquet')):
        if _number(path) in plan.order:
            yield path, plan.order[_number(path)]


def _number(path: Path) -> int:
    return int(path.stem.partition('_')[2])


@task
def normals(job: Job, number: int) -> dict[str, Any]:
    """Find the surface normals of a core."""
    files = TileFiles(job, number)
    target = files.path('normals.npz')
    if (before := outcome_in(target)) is None:
        write_arrays(target, {'normals': windows.found_normals(files.given(), job.parameters)}, before := {})
    return before


@task
def search(job: Job, number: int, step: int) -> dict[str, Any]:
    """Search a tile: at first by itself, later with all others held; return where its map changed."""
    files = TileFiles(job, number)
    target = files.path(searched(step))
    if (before := outcome_in(target)) is not None:
        return before
    if step == FIRST:
        found: Searched = windows.first_map(files.given(FIRST, FIRST_AROUND), job.parameters)
    else:
        found = windows.improved(files.given(step), job.parameters)
    c = found.changed
    outcome = {
        'changed': None if c is None else [c.resolution, c.column, c.row, c.width, c.height],
        'progress': list(dataclasses.astuple(found.progress)),
        'converged': bool(found.converged),
    }
    write_arrays(target, {'occupied': found.occupied}, outcome)
    return outcome


@task
def finish(job: Job, number: int) -> dict[str, Any]:
    """Make the maps of a core."""
    files, p = TileFiles(job, number), job.parameters
    target = files.path('maps.npz')
    if (before := outcome_in(target)) is not None:
        return before
    given = files.given()
    found = windows.finished(given, p)
    live = LogOddsMap(p)
    live.add(files.readings)
    outcome = {
        'pairs': found.pairs,
        'bytes': found.nbytes,
        'unstored': found.unstored,
        'log_likelihood': found.log_likelihood,
        'prior': prior_of_core(given, given.occupied == 1, job),
    }
    maps: dict[str, NDArray[Any]] = {
        'ml': found.ml,
        'uncertainty': found.uncertainty,
        'searched': found.searched,
        'live': live.probability(given.tile.core),
    }
    write_arrays(target, maps, outcome)
    return outcome


@task
def judge(job: Job, number: int) -> dict[str, Any]:
    """Ask what the map says of the readings whose sensors were in the core; return counts by drive and sensor."""
    files = TileFiles(job, number)
    target = files.path('judged.npz')
    if (before := outcome_in(target)) is not None:
        return before
    given = files.given(ml=True)
    found = windows.judged(given, job.parameters)
    own = given.readings.select(given.own)
    kinds, of = np.unique(np.stack([own.drive, own.sensor]), axis=1, return_inverse=True)
    marks = {'accepted': np.ones(len(own), np.bool_), 'no_echo': ~own.echo, 'unexplained': found.unexplained}
    counts = {name: np.bincount(of.ravel()[mask], minlength=kinds.shape[1]) for name, mask in marks.items()}
    core = given.core(given.ml)
    outcome = {
        'log_likelihood': float(found.log_likelihood.sum()),
        'prior': prior_of_core(given, given.ml == 1, job),
        'drive': kinds[0],
        'sensor': kinds[1],
        **counts,
        'health': _sparse(health_counts(own, found.forward, given.ml, found.unexplained)),
        'cells': {str(value): int((core == value).sum()) for value in (-1, 0, 1)},
    }
    write_arrays(target, {'dynamic': found.dynamic}, outcome)
    return outcome_in(target) or {}


def _sparse(counts: Mapping[str, NDArray[np.int64]]) -> dict[str, list[list[int]]]:
    """Return where counts are not 0, and what they are."""
    return {kind: [index.tolist() for index in (*np.nonzero(of), of[of != 0])] for kind, of in counts.items()}
