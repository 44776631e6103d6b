"""A job's description for workers, and the checks before they begin."""

from __future__ import annotations

import functools
import platform
import resource
import sys
import time
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any, NamedTuple

import numba
import numpy as np

from .. import __version__
from ..core.common.errors import ClusterError
from ..core.common.grid import Grid
from ..core.common.parameters import Parameters
from ..core.messages.message_types import Pose2
from ..core.runtime import jit
from ..core.tiles.tiling import Tiling
from ..recordings.drive import Part
from .work_folder import WorkFolder, read_json


@dataclass(frozen=True)
class DriveArguments:
    """Arguments of `read_drive` for all drives."""

    paths: tuple[str, ...]
    extrinsics: Mapping[str, Pose2]
    range_topics: tuple[str, ...] | None
    odom_topic: str | None
    part: Part


@dataclass(frozen=True)
class Job:
    """A job's description for workers.

    Attributes
    ----------
    folder : WorkFolder
        On a file system that all workers share.
    parameters : Parameters
        With one thread, and a worker's memory for pairs.
    size : float
        Edge of a tile, metres.
    versions : dict of str
        Versions of the packages of the client that began the job.
    """

    folder: WorkFolder
    parameters: Parameters
    size: float
    versions: Mapping[str, str]


class Plan(NamedTuple):
    """The order of drives and the tiles, once all drives are placed.

    Attributes
    ----------
    tiling : Tiling
    sensor_names : tuple of str
    order : dict of int
        Number of a drive in the map, by its number among the arguments.
    sensors : dict of list of int
        For the same numbers, the sensors of a drive as indices into `sensor_names`.
    """

    tiling: Tiling
    sensor_names: tuple[str, ...]
    order: dict[int, int]
    sensors: dict[int, list[int]]


def plan_of(job_folder: WorkFolder, size: float) -> Plan:
    """Return the plan of a job."""
    # workers may outlive a job, and another job may use its folder
    written = job_folder.plan.stat()
    return _plan_of(job_folder, size, (written.st_mtime_ns, written.st_size, written.st_ino))


@functools.lru_cache(maxsize=2)
def _plan_of(job_folder: WorkFolder, size: float, written: tuple[int, int, int]) -> Plan:
    data = read_json(job_folder.plan)
    return Plan(
        Tiling(Grid(*data['grid']), size, data['widest']),
        tuple(data['sensor_names']),
        {int(number): k for k, number in enumerate(data['drives'])},
        {int(number): sensors for number, sensors in data['sensors'].items()},
    )


def versions() -> dict[str, str]:
    """Return the versions that must be equal on all machines for equal maps."""
    return {
        'forward_grid_mapper': f'{__version__} ({Path(jit.CACHE).name.removeprefix(jit.PREFIX)})',
        'Python': '.'.join(map(str, sys.version_info[:2])),
        'numpy': np.__version__,
        'numba': numba.__version__,
    }


def check_versions(wanted: Mapping[str, str]) -> None:
    """Check that this process has the versions of the client that began the job.

    Raises
    ------
    ClusterError
        Otherwise; names the machine and the differences.
    """
    mine = versions()
    wrong = [f'{name} {mine.get(name)}, not {value}' for name, value in wanted.items() if mine.get(name) != value]
    if wrong:
        raise ClusterError(
            f'a worker on {platform.node()} has {"; ".join(wrong)}: install the same versions there, so that all '
            'tiles are computed in the same way'
        )


def task(work: Callable[..., dict[str, Any]]) -> Callable[..., dict[str, Any]]:
    """Make a function of a job and a number a task: it checks versions, and returns CPU seconds and peak memory too."""

    def run(job: Job, number: int, *arguments: Any) -> dict[str, Any]:
        check_versions(job.versions)
        if not job.folder.manifest.is_file():
            raise ClusterError(
                f'a worker on {platform.node()} does not see {job.folder.manifest}: choose a work folder (--work) on a '
                f'file system that all workers share'
            )
        begun = time.process_time()
        found = work(job, number, *arguments)
        peak = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss * 1024
        return {**found, 'cpu': time.process_time() - begun, 'peak': peak, 'host': platform.node()}

    return functools.update_wrapper(run, work)
