"""From drives to maps by workers: the same steps as `core.tiled_mapping`, with readings and maps on disk.

place      every drive separately
gather     the readings of the drives for every tile; its box
normals    of every core
search     every tile separately; then colour by colour the stale ones, until no tile changes
finish     the maps of every core
judge      the readings of every tile

The client knows drives, tiles and counts; workers read and write readings and maps. The maps depend only on the
contents of the boxes of tiles, so they are those of one process, cell for cell, for any number of workers.
"""

from __future__ import annotations

import time
from collections.abc import Callable, Iterable, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from ..core.common.errors import BagError, InputError, MapperError
from ..core.common.grid import Grid
from ..core.learning.sensor_health import BINS, SensorHealth, health_of_counts
from ..core.messages.message_types import Pose2
from ..core.sensor.cone_table import check_size
from ..core.tiles.schedule import Schedule
from ..core.tiles.tiling import Tiling
from ..files.panels import joined_paths
from ..files.quality_warning import NOT_CONVERGED
from ..recordings.contradictions import Described, check_frames, contradictions
from ..recordings.drives import same_drive, source_of_all, unreadable
from .cluster import Cluster, Work
from .job import DriveArguments, Job, plan_of
from .placing import place
from .tile_work import FIRST, finish, gather, judge, normals, search
from .work_folder import write_json

Say = Callable[[str], None]


@dataclass
class JobResult:
    """The client's results; readings and maps are in the work folder.

    Attributes
    ----------
    tiling : Tiling
    source : dict
        Data for the report.
    sensor_names : tuple of str
    path_xy : float64, shape (P, 2)
        Paths of the robots, metres; separated by rows of NaN.
    log_likelihood, objective : float
    counts : int64, shape (drives, sensors, 3)
        Readings, those without echo, and those that the map does not explain.
    health : dict of SensorHealth
        By sensor.
    cells : dict of int
        Unknown (-1), free (0) and occupied (1) cells of the ML map.
    statistics : dict
        As in `MapSet`.
    tasks : list of (str, int, float, int)
        Stage, number, CPU seconds, and memory of the worker in bytes, of every task, stage by stage.
    peak : int
        Memory of the largest worker, bytes.
    """

    tiling: Tiling
    source: dict[str, Any]
    sensor_names: tuple[str, ...]
    path_xy: NDArray[np.float64]
    log_likelihood: float = 0.0
    objective: float = 0.0
    counts: NDArray[np.int64] = field(default_factory=lambda: np.zeros((0, 0, 3), np.int64))
    health: dict[str, SensorHealth] = field(default_factory=dict)
    cells: dict[str, int] = field(default_factory=dict)
    statistics: dict[str, Any] = field(default_factory=dict)
    tasks: list[tuple[str, int, float, int]] = field(default_factory=list)
    peak: int = 0


class ScaledMapper:
    """Runs a job on a cluster."""

    def __init__(self, cluster: Cluster, job: Job, say: Say = lambda text: None) -> None:
        self._cluster, self._job, self._say = cluster, job, say
        self._seconds: dict[str, float] = {}
        self._tasks: list[tuple[str, int, float, int]] = []
        self._peak = 0

    def run(self, recordings: DriveArguments, repeated: Sequence[str] = ()) -> JobResult:
        """Map drives; `repeated` are warnings about repeated ones.

        Raises
        ------
        BagError, InputError
            If drives cannot be mapped, or not together.
        ClusterError, OutputError
            If workers die repeatedly, or cannot write.
        """
        found = self._plan(self._place(recordings), list(repeated))
        tiles = range(len(found.tiling.tiles))
        gathered = self._each('gathering readings', gather, tiles)
        evaluated, own = (sum(result[name] for _, result in gathered) for name in ('readings', 'own'))
        # the largest first, so that no worker is left with a large one at the end of a stage
        gathered.sort(key=lambda one: -one[1]['readings'])
        boxes = {number: Grid(*result['box']) for number, result in gathered if result['readings']}
        self._each('normals', normals, boxes)
        searches = self._search(found.tiling, boxes)
        finished = self._each('maps of tiles', finish, [number for number, _ in gathered])
        judged = self._each('uncertainty', judge, boxes)
        exponent = self._job.parameters.model.likelihood_exponent
        searched = sum(result['log_likelihood'] for _, result in finished)
        found.log_likelihood = sum(result['log_likelihood'] for _, result in judged)
        found.objective = exponent * found.log_likelihood + sum(result['prior'] for _, result in judged)
        self._count(found, [result for _, result in judged])
        pairs = sum(result['pairs'] for _, result in finished)
        found.statistics = {
            'pairs': pairs,
            'bytes_per_pair': sum(result['bytes'] for _, result in finished) / max(pairs, 1),
            'readings_not_stored': sum(result['unstored'] for _, result in finished),
            'searched_log_likelihood': searched,
            'searched_objective': exponent * searched + sum(result['prior'] for _, result in finished),
            **searches,
            'tiles': len(boxes),
            'evaluations_of_a_reading': evaluated / max(own, 1),
            'workers': self._cluster.workers,
            'cpu_seconds': sum(seconds for _, _, seconds, _ in self._tasks),
            'peak_memory_of_a_worker': self._peak,
        }
        if not searches['converged']:
            found.source['warnings'].append(NOT_CONVERGED)
        found.tasks, found.peak = self._tasks, self._peak
        found.statistics['seconds'] = self._seconds
        return found

    def _each(self, stage: str, work: Work, numbers: Iterable[int], *more: Any, name: str = '') -> list[Any]:
        """Run a stage; return numbers and results, by number."""
        begun, numbers = time.perf_counter(), list(numbers)
        found = []
        for number, result in self._cluster.each(name or stage, work, self._job, numbers, *more):
            found.append((number, result))
            self._peak = max(self._peak, result['peak'])
            self._tasks.append((name or stage, number, result['cpu'], result['peak']))
            self._say(f'{name or stage}: {len(found):,} of {len(numbers):,}, {self._peak / 1e9:.1f} GB a worker')
        self._seconds[stage] = self._seconds.get(stage, 0.0) + time.perf_counter() - begun
        return sorted(found, key=lambda one: one[0])

    def _place(self, recordings: DriveArguments) -> dict[int, dict[str, Any]]:
        """Place all drives; return the data of each."""
        result = dict(self._each('placing drives', place, range(len(recordings.paths)), recordings))
        errors: list[tuple[Path, MapperError]] = []
        for number, known in result.items():
            if 'error' in known:
                kind = BagError if known['kind'] == 'BagError' else InputError
                errors.append((Path(recordings.paths[number]), kind(known['error'])))
        if len(result) == 1 and errors:
            raise errors[0][1]
        if errors:
            raise unreadable(errors, len(result))
        for known in result.values():
            poses = known['source'].get('extrinsics') or {}
            known['source']['extrinsics'] = {frame: Pose2(*pose) for frame, pose in poses.items()}
        return result

    def _plan(self, result: dict[int, dict[str, Any]], warnings: list[str]) -> JobResult:
        """Order the drives, leave out copies, and write the plan for the workers."""
        order = sorted(result, key=lambda k: (result[k]['first'], result[k]['digest'], result[k]['source']['bag']))
        described = {k: _described(result[k]) for k in order}
        check_frames(list(described.values()))
        by_echoes: dict[str | int, list[int]] = {}
        for k in order:
            by_echoes.setdefault(result[k]['echoes'] or k, []).append(k)
        kept = [same[0] for same in by_echoes.values()]
        for first, *others in by_echoes.values():
            if others:
                warnings.append(same_drive([described[k].name for k in others], described[first].name))
        warnings += contradictions([described[k] for k in kept])
        sources = [result[k]['source'] for k in kept]
        for source in sources if len(sources) > 1 else ():
            warnings += [f'{source["bag"]}: {text}' for text in source['warnings']]
        if len(sources) == 1:
            source = {**sources[0], 'warnings': [*sources[0]['warnings'], *warnings]}
        else:
            source = source_of_all(sources, warnings)
        grid = Grid(*result[kept[0]]['grid'])
        for k in kept[1:]:
            grid = grid.union(Grid(*result[k]['grid']))
        check_size(grid, self._job.parameters.grid)
        names = sorted({name for k in kept for name in result[k]['sensors']})
        plan = {
            'grid': [grid.resolution, grid.column, grid.row, grid.width, grid.height],
            'widest': max(result[k]['widest'] for k in kept),
            'sensor_names': names,
            'drives': kept,
            'sensors': {k: [names.index(name) for name in result[k]['sensors']] for k in kept},
        }
        write_json(self._job.folder.plan, plan)
        tiling = plan_of(self._job.folder, self._job.size).tiling
        paths = [np.array(result[k]['path'], np.float64).reshape(-1, 2) for k in kept]
        return JobResult(tiling, source, tuple(names), joined_paths(paths))

    def _search(self, tiling: Tiling, boxes: dict[int, Grid]) -> dict[str, Any]:
        """Search until no tile changes; return counts. `boxes` has the tiles in the order of the first searches."""
        result = self._each('search', search, boxes, FIRST, name='search, first maps')
        schedule, step, rounds = Schedule(boxes), FIRST, 0
        colours = [[number for number in boxes if number in members] for members in map(set, tiling.colours)]
        while schedule.stale:
            rounds += 1
            for k, colour in enumerate(colours, 1):
                step += 1
                if numbers := schedule.stale_of(colour):
                    name = f'search, round {rounds}, colour {k} of {len(tiling.colours)}'
                    now = self._each('search', search, numbers, step, name=name)
                    for number, outcome in now:
                        schedule.searched(number, Grid(*outcome['changed']) if outcome['changed'] else None)
                    result += now
        progress = [outcome['progress'] for _, outcome in result]
        iterations, flips, shifts = (int(sum(column)) for column in list(zip(*progress, strict=True))[:3])
        return {
            'flips': flips,
            'shifts': shifts,
            'iterations': iterations,
            'converged': all(outcome['converged'] for _, outcome in result),
            'searches_of_tiles': len(result),
        }

    def _count(self, found: JobResult, judged: Sequence[dict[str, Any]]) -> None:
        """Add up counts of readings by drive and sensor, and of cells."""
        drives = len(found.source.get('drives') or (0,))
        counts = np.zeros((drives, len(found.sensor_names), 3), np.int64)
        cells = dict.fromkeys(('-1', '0', '1'), 0)
        for result in judged:
            marks = zip(
                result['drive'],
                result['sensor'],
                result['accepted'],
                result['no_echo'],
                result['unexplained'],
                strict=True,
            )
            for drive, sensor, *three in marks:
                counts[drive, sensor] += three
            cells = {value: cells[value] + result['cells'][value] for value in cells}
        cells['-1'] += found.tiling.grid.size - sum(cells.values())
        found.counts, found.cells = counts, cells
        sums: dict[str, NDArray[np.int64]] = {}
        for result in judged:
            for kind, (*index, numbers) in result['health'].items():
                size = (len(found.sensor_names), BINS)[: len(index)]
                np.add.at(sums.setdefault(kind, np.zeros(size, np.int64)), tuple(index), numbers)
        found.health = health_of_counts(found.sensor_names, sums) if sums else {}


def _described(known: dict[str, Any]) -> Described:
    source = known['source']
    limits = {frame: (one, other) for frame, (one, other) in known['limits'].items()}
    return Described(source['bag'], source['map_frame'], source['base_frame'], source['extrinsics'], limits)
