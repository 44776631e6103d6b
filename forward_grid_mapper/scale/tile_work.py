"""Tasks for a tile, which a worker loads with its halo: functions of a job and the number of a tile.

A task writes a file of the tile, and returns little data. If the file exists already, the task only returns its
earlier result: so tasks can be repeated after a worker died or the client was interrupted.

readings.parquet    its readings and those near it, in canonical order
ground.npz          the traversed cells of the core
normals.npz         surface normals of the core
search_0007.npz     the window after a search; searches are numbered in their order
maps.npz            the maps of the core
judged.npz          echoes that no object explains, in the box
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
from ..core.tiles import tile_steps
from ..core.tiles.mosaic import FIRST_AROUND
from ..core.tiles.tile_steps import SearchedWindow, TileInput
from ..core.tiles.tiling import Tile, boxes_of, common_part
from .job import Job, Plan, plan_of, task
from .tables import COLUMNS, columns_of, read_table, readings_of, write_table
from .work_folder import outcome_in, read_arrays, write_arrays

FIRST = 0
"""The number of the first search."""


class TileFiles:
    """A tile of a job, with its files and those of its neighbours."""

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
        """All stored readings of the tile, in canonical order."""
        return readings_of(read_table(self.path('readings.parquet')), self.plan.sensor_names)

    def input(self, step: int | None = None, around: float = 0.0, ml: bool = False) -> TileInput:
        """Return readings and maps around the tile, as `Mosaic.input_of` does.

        Parameters
        ----------
        step : int, optional
            The map before that search; by default the current one.
        around : float
            Metres around the core within which readings are used.
        ml : bool
            Whether the final ML map is needed.
        """
        kept, p = self.readings, self.job.parameters
        boxes = boxes_of(kept, p)
        readings = kept.select(self.tiling.touching(self.number, boxes, around)) if len(kept) else kept
        box = self.tiling.box(self.number, readings, p)
        own = self.tiling.owners(readings) == self.number
        traversed = self._cores('ground.npz', 'traversed', box, np.zeros(box.shape, np.bool_))
        # the first map does not depend on the neighbours
        occupied = np.zeros(box.shape, np.uint8) if step == FIRST else self._occupied(box, step)
        normals = self._cores('normals.npz', 'normals', box, np.zeros((2, *box.shape), np.float32))
        shown = np.full(box.shape, UNKNOWN, np.int8)
        if ml:
            self._cores('maps.npz', 'ml', box, shown)
        return TileInput(self.tile, box, readings, own, traversed, occupied, normals, shown)

    def _cores(self, file: str, name: str, box: Grid, out: NDArray[Any]) -> NDArray[Any]:
        """Fill an array of a box with the data of the tiles in it."""
        for number in self.tiling.with_cores_in(box):
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
        """Return the map in a box: the windows of all searches in order; those of the same step do not overlap."""
        out = np.zeros(box.shape, np.uint8)
        found = []
        for number in self.tiling.with_windows_in(box):
            steps = [s for s in self._steps(number) if step is None or s < step]
            # the result of a first search outside of its core is not used, so the first one is always below the others
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


def prior_of_core(given: TileInput, occupied: NDArray[np.bool_], job: Job) -> float:
    """Return the sum of a map's log prior, shape `box.shape`, over the cells of the core."""
    prior = wall_prior(job.parameters.search, given.traversed.ravel(), given.box.resolution)
    mine = np.zeros(given.box.shape, np.uint8)
    core = given.box.window(given.tile.core)
    mine[core] = occupied[core]
    return log_prior(prior, mine.ravel(), patterns(occupied.astype(np.uint8), given.box.shape))


@task
def gather(job: Job, number: int) -> dict[str, Any]:
    """Combine the data of the drives for a tile; return its box and the number of readings that touch it."""
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
    # the files of the drives are kept, since an interrupted job may need them again
    given = files.input()
    box = given.box
    outcome = {
        'box': [box.resolution, box.column, box.row, box.width, box.height],
        'readings': len(given.readings),
        'own': int(given.own.sum()),
    }
    write_arrays(target, {'traversed': traversed}, outcome)
    return outcome


def _parts(job: Job, kind: str, tile: Tile, plan: Plan) -> Iterator[tuple[Path, int]]:
    """Yield the files of drives for a tile, with the numbers of the drives in the map."""
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
        write_arrays(target, {'normals': tile_steps.estimate_normals(files.input(), job.parameters)}, before := {})
    return before


@task
def search(job: Job, number: int, step: int) -> dict[str, Any]:
    """Search a tile: first separately, later with all others fixed; return where its map changed."""
    files = TileFiles(job, number)
    target = files.path(searched(step))
    if (before := outcome_in(target)) is not None:
        return before
    if step == FIRST:
        found: SearchedWindow = tile_steps.search_alone(files.input(FIRST, FIRST_AROUND), job.parameters)
    else:
        found = tile_steps.search_with_neighbours(files.input(step), job.parameters)
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
    given = files.input()
    found = tile_steps.finish_core(given, p)
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
    """Judge the readings whose sensors were in the core by the map; return counts by drive and sensor."""
    files = TileFiles(job, number)
    target = files.path('judged.npz')
    if (before := outcome_in(target)) is not None:
        return before
    given = files.input(ml=True)
    found = tile_steps.judge_readings(given, job.parameters)
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
    """Return the indices and values of counts that are not 0."""
    return {kind: [index.tolist() for index in (*np.nonzero(of), of[of != 0])] for kind, of in counts.items()}
