"""Jobs that map drives in tiles: by workers, or in the process of a test."""

from __future__ import annotations

import json
import shutil
import subprocess
import sys
import time
from collections.abc import Callable, Iterable, Iterator
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from patience import PATIENCE

from forward_grid_mapper.commands import process_bag
from forward_grid_mapper.core.common.parameters import Parameters
from forward_grid_mapper.files.map_archive import read_npz
from forward_grid_mapper.recordings.drive import WHOLE
from forward_grid_mapper.scale import extra
from forward_grid_mapper.scale.job import DriveArguments, Job, versions
from forward_grid_mapper.scale.work_folder import WorkFolder

ROOT = Path(__file__).resolve().parents[2]
TILE = 8.0
MAPS = ('live', 'ml', 'uncertainty')
MISSING = [name for name in extra.PACKAGES if not extra.installed(name)]


scaled = pytest.mark.skipif(bool(MISSING), reason=f'the extra scale is not installed: {", ".join(MISSING)}')


def code_of(*arguments: object) -> int:
    return process_bag.main([str(word) for word in arguments])


class Here:
    """A cluster in this process, which may be interrupted after this many tasks."""

    workers, memory, dashboard = 1, 0, ''

    def __init__(self, tasks: float = float('inf'), turned: bool = False) -> None:
        self.left, self.done, self.turned = tasks, 0, turned

    def __enter__(self) -> Here:
        return self

    def __exit__(self, *unused: object) -> None:
        pass

    def each(
        self, name: str, work: Callable[..., dict[str, Any]], job: Job, numbers: Iterable[int], *more: Any
    ) -> Iterator[tuple[int, Any]]:
        order = list(numbers)
        for number in reversed(order) if self.turned else order:
            if not self.left:
                raise KeyboardInterrupt
            self.left -= 1
            self.done += 1
            yield number, work(job, number, *more)


def job_in(folder: Path, **values: Any) -> Job:
    """Return a job in a folder, in which drives may be placed already."""
    parameters = Parameters.from_flat({'max_readings': 0, 'threads': 1, **values})
    job = Job(WorkFolder(str(folder)), parameters, TILE, versions())
    job.folder.manifest.unlink(missing_ok=True)
    with_drives = folder.exists()
    if with_drives:
        job.folder.manifest.write_text('{"a": "job"}')
    assert job.folder.begin({'a': 'job'}) == with_drives
    return job


def recordings(drives: Path, turned: bool = False) -> DriveArguments:
    paths = sorted(map(str, drives.iterdir()), reverse=turned)
    return DriveArguments(tuple(paths), {}, None, None, WHOLE)


def assert_same(folder: Path, other: Path) -> None:
    one, two = read_npz(folder / 'maps.npz'), read_npz(other / 'maps.npz')
    assert one.grid == two.grid
    for name in MAPS:
        np.testing.assert_array_equal(getattr(one, name), getattr(two, name))
    assert one.log_likelihood == pytest.approx(two.log_likelihood, abs=1e-6)
    assert one.objective == pytest.approx(two.objective, abs=1e-6)
    with np.load(folder / 'maps.npz') as a, np.load(other / 'maps.npz') as b:
        np.testing.assert_array_equal(a['dynamic'], b['dynamic'])
    reports = [json.loads((f / 'report.json').read_text()) for f in (folder, other)]
    for key in ('counts', 'map', 'drives'):
        assert [r for r in reports[:1] if r[key]] and reports[0][key] == reports[1][key]
    for key in ('readings', 'unexplained'):
        assert reports[0]['result'][key] == reports[1]['result'][key]
    for key in ('pairs', 'flips', 'iterations', 'tiles', 'searches_of_tiles', 'evaluations_of_a_reading', 'converged'):
        assert reports[0]['statistics'][key] == reports[1]['statistics'][key]
    assert reports[0]['warnings'] == reports[1]['warnings']


def made_here(drives: Path | DriveArguments, folder: Path, cluster: Here, turned: bool = False, **values: Any) -> Path:
    """Map drives in this process, with the work in `folder / 'work'`; return the folder of the maps."""
    from forward_grid_mapper.scale.mapping import ScaledMapper
    from forward_grid_mapper.scale.output import write_output

    job, maps = job_in(folder / 'work', **values), folder / 'maps'
    given = recordings(drives, turned) if isinstance(drives, Path) else drives
    found = ScaledMapper(cluster, job).run(given)
    maps.mkdir()
    write_output(maps, job, found, cluster, Parameters(), 'drives', lambda text: None)
    return maps


def copy_of(folder: Path, copy: Path) -> Path:
    """Return a copy of a folder, with the times of its files."""
    return Path(shutil.copytree(folder, copy))


def started(*arguments: object, group: bool = False) -> subprocess.Popen[bytes]:
    command = [sys.executable, '-m', 'forward_grid_mapper', 'process_bag', *map(str, arguments)]
    pipes = {'stdout': subprocess.PIPE, 'stderr': subprocess.PIPE}
    return subprocess.Popen(command, cwd=ROOT, start_new_session=group, **pipes)


def wait_for(condition: Callable[[], bool], process: subprocess.Popen[bytes]) -> None:
    end = time.monotonic() + 2 * PATIENCE
    while not condition():
        assert process.poll() is None, process.communicate(timeout=PATIENCE)
        assert time.monotonic() < end, 'it did not happen'
        time.sleep(0.02)
