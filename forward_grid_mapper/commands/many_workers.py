"""`process_bag --workers`: the same maps by processes on this machine, or by those of a cluster."""

from __future__ import annotations

import argparse
import contextlib
import dataclasses
import math
import os
import re
import shutil
import sys
import time
from collections.abc import Callable, Mapping, Sequence
from pathlib import Path
from typing import Any

from ..core.common.errors import ParameterError
from ..core.common.parameters import Parameters
from ..core.messages.message_types import Pose2
from ..core.runtime.threads import cores
from ..files.output_folder import free_name, output_folder, readable
from ..recordings.drive import Part
from ..recordings.drives import without_repetition
from ..recordings.finding import find_recordings
from .console import Ticker
from .options import output_name
from .signals import Interrupted

TILE = 30.0
"""Edge of a tile without `--tiles`, metres."""

MEMORY = 2.0
"""Most memory of a worker without `--memory-per-worker`, gigabytes."""

LEAST_MEMORY = 0.5
"""Memory of an idle worker, gigabytes; it needs as much again for work."""

WORKERS_A_CORE = 4
"""Most workers for each core: more only compete for time and memory."""

RESERVED = 0.6e9
"""Memory of a worker that is not for pairs of cells and readings, bytes: Python, kernels and a tile's readings."""


def add_worker_options(parser: argparse.ArgumentParser) -> None:
    """Add `--workers`, `--scheduler`, `--memory-per-worker` and `--work`."""
    group = parser.add_argument_group('many processes (extra "scale")')
    group.add_argument(
        '--workers',
        type=int,
        metavar='N',
        help=f'map in tiles ({TILE:g} m, or --tiles) by N processes of this machine, with readings and maps on disk',
    )
    group.add_argument(
        '--scheduler', metavar='ADDRESS', help='use the workers of this Dask scheduler (tcp://HOST:8786)'
    )
    group.add_argument(
        '--memory-per-worker',
        type=float,
        metavar='GB',
        help=(
            f'memory of a worker; a worker that exceeds it is ended, and its tile is started again (default {MEMORY:g})'
        ),
    )
    group.add_argument(
        '--work',
        type=output_name,
        metavar='DIR',
        help=(
            'folder of readings and tiles until the job is done, on a disk that all workers share; an interrupted job '
            'continues from there (default: next to the results)'
        ),
    )


def with_workers(
    options: argparse.Namespace,
    parameters: Parameters,
    extrinsics: Mapping[str, Pose2],
    ignored: Sequence[str],
    part: Part,
    default: str,
    tell: Callable[[argparse.Namespace, Mapping[str, Any], Path], None],
) -> int:
    """Run the command with its options; `default` is the name of the folder, and `tell` prints the result."""
    from ..scale.extra import need
    from ..scale.work_folder import WorkFolder

    need()
    _check(options)
    output = Path(options.output) if options.output else free_name(Path.cwd(), default)
    work = WorkFolder(str(Path(options.work or beside(output)).resolve()))
    check_apart(output, work.root)
    # imported late: they need the extra
    from ..scale.cluster import Cluster
    from ..scale.job import DriveArguments, Job, versions
    from ..scale.mapping import ScaledMapper
    from ..scale.output import write_output

    memory = int((options.memory_per_worker or MEMORY) * 1e9)
    size = TILE if options.tiles is None else options.tiles
    meant = find_recordings(options.bags)
    paths, repeated = without_repetition(meant.paths)
    of_all = dataclasses.replace(parameters, association=dataclasses.replace(parameters.association, max_readings=0))
    recordings = DriveArguments(
        tuple(str(path.resolve()) for path in paths),
        extrinsics,
        tuple(options.range_topics) if options.range_topics else None,
        options.odom_topic,
        part,
    )
    begun = time.perf_counter()
    with contextlib.ExitStack() as lock:
        with Ticker(options.quiet) as ticker, output_folder(output) as folder:
            again = work.begin(_described(recordings, of_all, size, versions()))
            lock.enter_context(work.held())
            ticker.say('starting workers')
            try:
                with Cluster(options.workers or 1, options.scheduler, memory) as cluster:
                    if not options.quiet:
                        told = f', the dashboard is at {cluster.dashboard}' if cluster.dashboard else ''
                        going_on = ', continuing the previous work' if again else ''
                        where = f'{readable(work.path)}{going_on}{told}'
                        print(f'mapping in tiles of {size:g} m in {where}', file=sys.stderr)
                    job = Job(work, _for_worker(of_all, cluster.memory or memory), size, versions())
                    notes = [*repeated, *meant.skipped, *ignored]
                    found = ScaledMapper(cluster, job, ticker.say).run(recordings, notes)
                    title = f'{readable(Path(*paths[0].resolve().parts[-2:]))}'
                    title += f' and {len(paths) - 1} more' if len(paths) > 1 else ''
                    report = write_output(folder, job, found, cluster, parameters, title, ticker.say)
            except BaseException as error:
                if not work.placed:
                    shutil.rmtree(work.root, ignore_errors=True)
                    raise
                kept = f'finished work is kept in {readable(work.path)}; the same command continues from there'
                if isinstance(error, Interrupted):
                    error.left = f'no results were written, {kept}'
                else:
                    print(kept, file=sys.stderr)
                raise
        shutil.rmtree(work.root, ignore_errors=True)
    tell(options, report, output)
    if not options.quiet and not options.json:
        seconds = time.perf_counter() - begun
        print(f'{seconds:.0f} s; the largest worker took {found.peak / 1e9:.2f} GB')
    return 0


def beside(output: Path) -> Path:
    """Return the work folder of a job that writes to `output`: beside it, also if that is `.`."""
    return Path(f'{os.path.abspath(output)}.work')  # noqa: PTH100 (as in `output_folder`)


def check_apart(output: Path, work: Path) -> None:
    """Check that neither the results nor the work folder would be inside the other.

    Results need an empty folder at the end of the job, and the work folder is deleted then with all that it contains.

    Raises
    ------
    ParameterError
        If one is the other, or inside it; links are followed.
    """
    results = Path(os.path.realpath(os.path.abspath(output)))  # noqa: PTH100 (as in `output_folder`)
    inner = work.resolve()
    if inner == results:
        where = 'is the folder of the results'
    elif results in inner.parents:
        where = f'is inside the folder of the results, {readable(results)}'
    elif inner in results.parents:
        where = f'contains the folder of the results, {readable(results)}'
    else:
        return
    raise ParameterError(
        f'--work {readable(work)} {where}, and the work folder is deleted at the end: choose one outside the results, '
        'or leave out --work'
    )


def _check(options: argparse.Namespace) -> None:
    """Check combinations of options."""
    if options.workers is not None and options.workers < 1:
        raise ParameterError('--workers must be a positive number')
    if options.workers is not None and options.workers > (most := max(WORKERS_A_CORE * cores(), 8)):
        raise ParameterError(f'--workers {options.workers}: there are {cores()} cores; give at most {most}')
    if options.workers is not None and options.scheduler is not None:
        raise ParameterError('--scheduler has its own workers; leave out --workers')
    if options.scheduler is not None and not re.fullmatch(r'(tcp|tls|ws|wss|ucx)://[^\s/]+:\d+', options.scheduler):
        raise ParameterError(
            f'--scheduler {options.scheduler!r} is not the address of a scheduler: give tcp://HOST:8786'
        )
    memory = options.memory_per_worker
    if memory is not None and not (math.isfinite(memory) and memory >= LEAST_MEMORY):
        raise ParameterError(f'--memory-per-worker {memory:g}: give gigabytes, {LEAST_MEMORY:g} or more')
    given = (
        ('--learn', options.learn),
        ('--refine-poses', options.refine_poses),
        ('--odometry-calibration', options.odometry_calibration),
        ('--bag', options.write_bag),
        ('--show', options.show),
        ('--rerun', options.rerun),
        ('--poses', options.poses),
    )
    for name, value in given:
        if value:
            raise ParameterError(f'{name} is for one process; leave it out, or --workers and --scheduler')


def _for_worker(parameters: Parameters, memory: int) -> Parameters:
    """Return parameters with one thread, and memory for pairs that leaves enough for the rest of a tile."""
    pairs = int(max(memory - RESERVED, 0.1e9) / 2e6)
    of_search = dataclasses.replace(parameters.search, threads=1, max_memory=min(parameters.search.max_memory, pairs))
    return dataclasses.replace(parameters, search=of_search)


def _described(recordings: Any, parameters: Parameters, size: float, made_by: Mapping[str, str]) -> dict[str, Any]:
    """Return the data that distinguish a job from others."""
    files = []
    for name in recordings.paths:
        path = Path(name)
        inside = sorted(p for p in path.iterdir() if p.is_file()) if path.is_dir() else [path]
        files.append([name, *([p.name, p.stat().st_size, p.stat().st_mtime_ns] for p in inside if p.exists())])
    return {
        'recordings': files,
        'tiles': size,
        'parameters': parameters.flat(),
        'sensors': {frame: list(pose) for frame, pose in recordings.extrinsics.items()},
        'topics': [recordings.range_topics, recordings.odom_topic],
        'part': str(recordings.part),
        'versions': made_by,
    }
