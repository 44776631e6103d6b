"""Workers of Dask: kills, Ctrl-C, full disks, too little memory; existing schedulers."""

from __future__ import annotations

import errno
import os
import shutil
import signal
import subprocess
import time
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from patience import PATIENCE
from scaled_jobs import TILE, Here, assert_same, code_of, copy_of, scaled, started, wait_for

from forward_grid_mapper.core.common.errors import ClusterError, OutputError
from forward_grid_mapper.core.common.parameters import Parameters
from forward_grid_mapper.scale.job import Job, versions
from forward_grid_mapper.scale.work_folder import WorkFolder


@scaled
def test_killed_worker_or_client_loses_only_its_current_tasks(drives: Path, one_process: Path, tmp_path: Path) -> None:
    """All work, from the drives on, is done by workers."""
    import psutil

    work = tmp_path / 'work'
    arguments = (drives, '-o', tmp_path / 'maps', '--tiles', TILE, '--work', work, '-q', '--workers')

    def count(name: str) -> int:
        return len(list(work.glob(f'tiles/*/{name}')))

    client = started(*arguments, 2)
    wait_for(lambda: count('normals.npz') > 0, client)
    workers = [p for p in psutil.Process(client.pid).children(recursive=True) if 'spawn_main' in ' '.join(p.cmdline())]
    os.kill(workers[0].pid, signal.SIGKILL)
    wait_for(lambda: count('search_0000.npz') > 1, client)
    client.kill()
    # its workers have the same pipes, and end when they notice that it has ended
    client.communicate(timeout=PATIENCE)
    assert not (tmp_path / 'maps').exists()
    before = {path: path.stat().st_mtime_ns for path in work.glob('tiles/*/search_*.npz')}
    # the number of workers may change
    client = started(*arguments, 1)
    wait_for(lambda: count('search_*.npz') > len(before), client)
    assert before.items() <= {path: path.stat().st_mtime_ns for path in work.glob('tiles/*/search_*.npz')}.items()
    _, error = client.communicate(timeout=2 * PATIENCE)
    assert client.returncode == 0, error
    assert_same(tmp_path / 'maps', one_process)
    assert not work.exists(), 'what is done needs no work folder'


@scaled
def test_ctrl_c_prints_one_message_about_kept_files(drives: Path, placed: Path, tmp_path: Path) -> None:
    """A terminal sends Ctrl-C to the workers as well."""
    work = copy_of(placed, tmp_path / 'work')
    client = started(drives, '-o', tmp_path / 'maps', '--tiles', TILE, '--workers', 2, '--work', work, '-q', group=True)
    wait_for(lambda: any(work.glob('tiles/*/normals.npz')), client)
    os.killpg(client.pid, signal.SIGINT)
    output, error = client.communicate(timeout=PATIENCE)
    lines = [line for line in error.decode().splitlines() if 'compiling' not in line]
    assert lines == [
        f'process_bag: cancelled; no results were written, finished work is kept in {work}; the same command continues '
        'from there'
    ]
    assert client.returncode == 130 and not output
    assert not (tmp_path / 'maps').exists() and any(work.glob('tiles/*/normals.npz'))


@scaled
def test_ctrl_c_while_workers_start_prints_one_message(drives: Path, tmp_path: Path) -> None:
    import psutil

    client = started(drives, '-o', tmp_path / 'maps', '--tiles', TILE, '--workers', 2, '-q', group=True)

    def importing(process: Any) -> bool:
        return 'spawn_main' in ' '.join(process.cmdline()) and process.cpu_times().user > 0.3

    wait_for(lambda: any(map(importing, psutil.Process(client.pid).children())), client)
    os.killpg(client.pid, signal.SIGINT)
    output, error = client.communicate(timeout=PATIENCE)
    lines = [line for line in error.decode().splitlines() if 'compiling' not in line]
    assert lines == ['process_bag: cancelled; nothing was written']
    assert client.returncode == 130 and not output
    assert list(tmp_path.iterdir()) == []


SIZES = {'work': '200k', 'maps': '60k'}


@pytest.fixture
def small_disk(tmp_path: Path, full: str) -> Iterator[Path]:
    """A file system that is too small."""
    folder = tmp_path / 'disk'
    folder.mkdir()
    command = ['mount', '-t', 'tmpfs', '-o', f'size={SIZES[full]}', 'tmpfs', str(folder)]
    if shutil.which('mount') is None or subprocess.run(command, check=False, capture_output=True).returncode:
        pytest.skip('only root can mount a small disk')
    yield folder
    subprocess.run(['umount', '-l', str(folder)], check=True)


@scaled
@pytest.mark.parametrize('full', [*SIZES])
def test_full_disk_is_reported_and_the_job_continues_later(
    drives: Path,
    placed: Path,
    one_process: Path,
    tmp_path: Path,
    small_disk: Path,
    full: str,
    monkeypatch: pytest.MonkeyPatch,
    capsys: pytest.CaptureFixture[str],
) -> None:
    from forward_grid_mapper.scale import cluster

    where = {'work': tmp_path / 'work', 'maps': tmp_path / 'maps', full: small_disk / full}
    arguments = (drives, '-o', where['maps'], '--tiles', TILE, '--workers', 1, '--work', where['work'], '-q')
    with monkeypatch.context() as patched:
        if full == 'maps':
            # maps are written by the client
            copy_of(placed, where['work'])
            patched.setattr(cluster, 'Cluster', lambda *_: Here())
        assert code_of(*arguments) == 1
    error = capsys.readouterr().err
    assert f'{where[full]}' in error and 'the disk is full; free some space' in error
    assert 'the same command continues from there' in error and 'Traceback' not in error
    assert not where['maps'].exists() and not list(small_disk.rglob('.*partial'))
    # all existing files are complete
    for path in where['work'].rglob('*.npz'):
        np.load(path).close()
    subprocess.run(['mount', '-o', 'remount,size=100M', str(small_disk)], check=True)
    monkeypatch.setattr(cluster, 'Cluster', lambda *_: Here())
    assert code_of(*arguments) == 0
    assert_same(where['maps'], one_process)


def hungry(job: Job, number: int) -> dict[str, Any]:
    held = []
    while True:
        held.append(np.ones(4_000_000))
        time.sleep(0.01)


@scaled
def test_worker_above_its_memory_limit_is_reported(monkeypatch: pytest.MonkeyPatch) -> None:
    from forward_grid_mapper.scale import cluster

    # without another try
    monkeypatch.setitem(cluster.SETTINGS, 'distributed.scheduler.allowed-failures', 0)
    job = Job(WorkFolder('nowhere'), Parameters(), TILE, versions())
    with (
        cluster.Cluster(1, None, 500_000_000) as given,
        pytest.raises(ClusterError, match=r'hungry 7 ended its worker .* --memory-per-worker|hungry 7.*memory'),
    ):
        list(given.each('hungry', hungry, job, [7]))


@scaled
def test_scheduler_that_does_not_respond_is_reported(
    drives: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    from forward_grid_mapper.scale import cluster

    monkeypatch.setattr(cluster, 'PATIENCE', 0.5)
    assert code_of(drives, '-o', tmp_path / 'maps', '--scheduler', 'tcp://127.0.0.1:9') == 1
    assert 'no scheduler answers at tcp://127.0.0.1:9' in capsys.readouterr().err
    assert list(tmp_path.iterdir()) == []


def doubled(job: Job, number: int, more: int) -> dict[str, Any]:
    return {'twice': 2 * number + more}


def refused(job: Job, number: int) -> dict[str, Any]:
    raise (OutputError('the disk is full') if number else OSError(errno.EIO, 'the disk is broken'))


@scaled
def test_existing_scheduler_is_used(monkeypatch: pytest.MonkeyPatch) -> None:
    from distributed import LocalCluster

    from forward_grid_mapper.scale import cluster

    job = Job(WorkFolder('nowhere'), Parameters(), TILE, versions())
    # in separate processes, as for users; in this process it would share its event loop with the client
    with LocalCluster(
        n_workers=2, threads_per_worker=1, processes=True, memory_limit='1GB', dashboard_address=None
    ) as there:
        address = there.scheduler_address
        with cluster.Cluster(1, address, 10) as given:
            assert (given.workers, given.memory) == (2, 10**9)
            assert sorted(given.each('twice', doubled, job, range(5), 1)) == [
                (k, {'twice': 2 * k + 1}) for k in range(5)
            ]
            for number, expected in ((0, 'the disk is broken'), (1, 'the disk is full')):
                with pytest.raises(OutputError, match=expected):
                    list(given.each('refused', refused, job, [number]))
        monkeypatch.setattr(cluster, 'versions', lambda: {**versions(), 'numba': '0.1'})
        with pytest.raises(ClusterError, match=r'numba .*, not 0\.1'), cluster.Cluster(1, address, 10):
            pass
