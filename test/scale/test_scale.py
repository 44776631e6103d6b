"""Tiles on several workers: the maps equal those of one process, also after kills; errors; large maps in parts."""

from __future__ import annotations

import dataclasses
import errno
import json
import os
import shutil
import signal
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
from forward_grid_mapper.commands.simulate import write_bag
from forward_grid_mapper.core.common.errors import ClusterError, OutputError
from forward_grid_mapper.core.common.parameters import Parameters
from forward_grid_mapper.core.messages.message_types import OdometryMessage
from forward_grid_mapper.files import drawing
from forward_grid_mapper.files.map_archive import read_npz
from forward_grid_mapper.files.map_files import read_map
from forward_grid_mapper.recordings.drive import WHOLE
from forward_grid_mapper.scale import extra
from forward_grid_mapper.scale.job import DriveArguments, Job, check_versions, plan_of, versions
from forward_grid_mapper.scale.work_folder import WorkFolder, whole
from forward_grid_mapper.simulation.campus import campus_drive
from forward_grid_mapper.simulation.sonar import front_array

ROOT = Path(__file__).resolve().parents[2]
TILE = 8.0
MAPS = ('live', 'ml', 'uncertainty')
MISSING = [name for name in extra.PACKAGES if not extra.installed(name)]


scaled = pytest.mark.skipif(bool(MISSING), reason=f'the extra scale is not installed: {", ".join(MISSING)}')


def code_of(*arguments: object) -> int:
    return process_bag.main([str(word) for word in arguments])


@pytest.fixture(autouse=True)
def quick_picture(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(drawing, 'draw', lambda path, picture: path.write_bytes(b''))


@pytest.fixture(scope='module')
def drives(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Three short drives in one building."""
    folder = tmp_path_factory.mktemp('drives')
    for number in range(3):
        write_bag(folder / f'drive_{number}', campus_drive(number, 1, 900, sonars=front_array()), 'mcap', False)
    return folder


@pytest.fixture(scope='module')
def one_process(drives: Path, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The maps of one process, in tiles."""
    folder = tmp_path_factory.mktemp('one') / 'maps'
    assert code_of(drives, '-o', folder, '--tiles', TILE, '-q') == 0
    return folder


class Here:
    """A cluster in this process, which may be interrupted after this many tasks."""

    workers, memory, dashboard = 1, 0, ''

    def __init__(self, tasks: float = float('inf'), turned: bool = False) -> None:
        self.left, self.done, self.turned = tasks, 0, turned

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
    parameters = Parameters.from_flat({'max_readings': 0, 'threads': 1, **values})
    job = Job(WorkFolder(str(folder)), parameters, TILE, versions())
    job.folder.begin({'a': 'job'})
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


def made_here(drives: Path, tmp_path: Path, cluster: Here, turned: bool = False, **values: Any) -> Path:
    from forward_grid_mapper.scale.mapping import ScaledMapper
    from forward_grid_mapper.scale.output import write_output

    job, folder = job_in(tmp_path / 'work', **values), tmp_path / 'maps'
    found = ScaledMapper(cluster, job).run(recordings(drives, turned))
    folder.mkdir()
    write_output(folder, job, found, cluster, Parameters(), 'drives', lambda text: None)
    return folder


# ---- the maps


@scaled
@pytest.mark.parametrize('turned', [False, True])
def test_maps_equal_those_of_one_process_in_any_order(
    drives: Path, one_process: Path, tmp_path: Path, turned: bool
) -> None:
    assert_same(made_here(drives, tmp_path, Here(turned=turned), turned), one_process)


@scaled
def test_other_results_equal_those_of_one_process(drives: Path, one_process: Path, tmp_path: Path) -> None:
    folder = made_here(drives, tmp_path, Here())
    missing = {path.name for path in one_process.iterdir()} - {path.name for path in folder.iterdir()}
    assert missing == {'report.html', 'readings.npz'}
    for name in ('live_map.png', 'uncertainty_map.png'):
        assert (folder / name).read_bytes() == (one_process / name).read_bytes()
    one, other = (json.loads((f / 'report.json').read_text()) for f in (one_process, folder))
    assert one['changed_parameters'] == other['changed_parameters']
    for name, row in one['sensors'].items():
        mine = other['sensors'][name]
        assert {**mine, 'health': 0} == {**row, 'health': 0}
        for kind in ('readings', 'random', 'no_echo', 'missed', 'verdict'):
            assert mine['health'][kind] == row['health'][kind], (name, kind)
        # readings beyond the box of a tile are not seen, and ranges are counted in bins
        assert mine['health']['short'] == pytest.approx(row['health']['short'], abs=0.02)
        assert mine['health']['same'] == pytest.approx(row['health']['same'], abs=0.1)
        assert mine['health']['common'] == pytest.approx(row['health']['common'], abs=0.3)


@scaled
def test_interrupted_job_continues(drives: Path, one_process: Path, tmp_path: Path) -> None:
    """The job is interrupted every few tasks; only the interrupted task is done twice."""
    rounds = 0
    while True:
        rounds += 1
        done = len([path for path in (tmp_path / 'work').rglob('*') if path.is_file()])
        try:
            # finished tasks only report that they are finished
            folder = made_here(drives, tmp_path, Here(12 * rounds))
            break
        except KeyboardInterrupt:
            assert len([path for path in (tmp_path / 'work').rglob('*') if path.is_file()]) > done
    assert rounds > 3
    assert_same(folder, one_process)


@scaled
def test_repeated_task_changes_no_files(drives: Path, tmp_path: Path) -> None:
    from forward_grid_mapper.scale import tile_work
    from forward_grid_mapper.scale.mapping import ScaledMapper

    job = job_in(tmp_path / 'work')
    ScaledMapper(Here(), job).run(recordings(drives))
    before = {path: (path.read_bytes(), path.stat().st_mtime_ns) for path in (tmp_path / 'work').rglob('*.npz')}
    for work in (tile_work.gather, tile_work.normals, tile_work.finish, tile_work.judge):
        assert work(job, 5) == {**work(job, 5), 'cpu': pytest.approx(0, abs=1), 'peak': pytest.approx(0, abs=1e12)}
    tile_work.search(job, 5, 0)
    after = {path: (path.read_bytes(), path.stat().st_mtime_ns) for path in (tmp_path / 'work').rglob('*.npz')}
    assert before == after


@scaled
def test_large_maps_are_written_in_parts(
    drives: Path, one_process: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    import zarr

    from forward_grid_mapper.scale import output

    for name, value in (('MOST_CELLS_OF_A_FILE', 0), ('REGION', 64), ('OVERVIEW', 60)):
        monkeypatch.setattr(output, name, value)
    folder = made_here(drives, tmp_path, Here())
    maps = read_npz(one_process / 'maps.npz')
    assert {path.name for path in folder.iterdir()} == {
        'maps.zarr',
        'tiles',
        'maps.png',
        'report.json',
        'report.txt',
        'tasks.csv',
    }
    group = zarr.open_group(str(folder / 'maps.zarr'), mode='r')
    assert group.attrs['resolution'] == maps.grid.resolution and group.attrs['origin'] == list(maps.grid.origin)
    for name in MAPS:
        np.testing.assert_array_equal(group[f'0/{name}_map'][:], getattr(maps, name))
    with np.load(one_process / 'maps.npz') as whole_maps:
        np.testing.assert_array_equal(group['0/dynamic'][:], whole_maps['dynamic'])
    levels = len(group.attrs['levels'])
    assert levels > 2
    for level in range(levels):
        cells, edge = group[f'{level}/ml_map'][:], 2**level
        rows, columns = np.nonzero(maps.ml == 1)
        expected = np.zeros(cells.shape, bool)
        expected[rows // edge, columns // edge] = True
        np.testing.assert_array_equal(cells == 1, expected)
    assert max(cells.shape) <= 60
    index = json.loads((folder / 'tiles' / 'index.json').read_text())
    seen = np.full(maps.grid.shape, -1)
    for entry in index['tiles']:
        if entry['map'] == 'ml_map':
            grid, probability = read_map(folder / 'tiles' / entry['yaml'])
            assert grid.shape == tuple(entry['shape'])
            seen[maps.grid.window(grid)] = np.nan_to_num(probability, nan=-1)
    np.testing.assert_array_equal(seen, maps.ml)


# ---- workers of Dask


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


@scaled
def test_killed_worker_or_client_loses_only_its_current_tasks(drives: Path, one_process: Path, tmp_path: Path) -> None:
    import psutil

    work = tmp_path / 'work'
    arguments = (drives, '-o', tmp_path / 'maps', '--tiles', TILE, '--workers', 2, '--work', work, '-q')

    def count(name: str) -> int:
        return len(list(work.glob(f'tiles/*/{name}')))

    client = started(*arguments)
    wait_for(lambda: count('normals.npz') > 0, client)
    workers = [p for p in psutil.Process(client.pid).children(recursive=True) if 'spawn_main' in ' '.join(p.cmdline())]
    os.kill(workers[0].pid, signal.SIGKILL)
    wait_for(lambda: count('search_0000.npz') > 1, client)
    client.kill()
    # its workers have the same pipes, and end when they notice that it has ended
    client.communicate(timeout=PATIENCE)
    assert not (tmp_path / 'maps').exists()
    before = {path: path.stat().st_mtime_ns for path in work.glob('tiles/*/search_*.npz')}
    client = started(*arguments)
    wait_for(lambda: count('search_*.npz') > len(before), client)
    assert before.items() <= {path: path.stat().st_mtime_ns for path in work.glob('tiles/*/search_*.npz')}.items()
    _, error = client.communicate(timeout=2 * PATIENCE)
    assert client.returncode == 0, error
    assert_same(tmp_path / 'maps', one_process)
    assert not work.exists(), 'what is done needs no work folder'


@scaled
def test_ctrl_c_prints_one_message_about_kept_files(drives: Path, tmp_path: Path) -> None:
    """A terminal sends Ctrl-C to the workers as well."""
    work = tmp_path / 'work'
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
    drives: Path, one_process: Path, tmp_path: Path, small_disk: Path, full: str, capsys: pytest.CaptureFixture[str]
) -> None:
    where = {'work': tmp_path / 'work', 'maps': tmp_path / 'maps', full: small_disk / full}
    arguments = (drives, '-o', where['maps'], '--tiles', TILE, '--workers', 1, '--work', where['work'], '-q')
    assert code_of(*arguments) == 1
    error = capsys.readouterr().err
    assert f'{where[full]}' in error and 'the disk is full; free some space' in error
    assert 'the same command continues from there' in error and 'Traceback' not in error
    assert not where['maps'].exists() and not list(small_disk.rglob('.*partial'))
    # all existing files are complete
    for path in where['work'].rglob('*.npz'):
        np.load(path).close()
    subprocess.run(['mount', '-o', 'remount,size=100M', str(small_disk)], check=True)
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

    # a second try is sufficient
    monkeypatch.setitem(cluster.SETTINGS, 'distributed.scheduler.allowed-failures', 1)
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


@scaled
def test_warnings_equal_those_of_one_process(tmp_path: Path) -> None:
    drive = campus_drive(0, 1, 900, sonars=front_array())
    middle = drive.odometry[len(drive.odometry) // 2].stamp

    def jumped(message: OdometryMessage) -> OdometryMessage:
        assert message.pose is not None
        return message._replace(pose=message.pose._replace(x=message.pose.x + 5.0 * (message.stamp > middle)))

    jumping = dataclasses.replace(drive, odometry=[jumped(message) for message in drive.odometry])
    write_bag(tmp_path / 'drives' / 'drive', jumping, 'mcap', False)
    made_here(tmp_path / 'drives', tmp_path, Here(), max_iterations=1)
    warnings = json.loads((tmp_path / 'maps' / 'report.json').read_text())['warnings']
    assert any(text.startswith('odometry jumps once, by 5.0 m') for text in warnings)
    assert any('raise max_iterations' in text for text in warnings)


@scaled
def test_options_without_effect_are_reported_with_workers(drives: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    reported: list[str] = []

    def with_workers(options: Any, parameters: Any, extrinsics: Any, ignored: list[str], *_: Any) -> int:
        reported.extend(ignored)
        return 0

    monkeypatch.setattr(process_bag, 'with_workers', with_workers)
    assert code_of(drives, '--workers', 2, '--set', 'odometry_noise=2deg') == 0
    assert reported == ['odometry_noise has an effect only with --refine-poses, which is not given']


# ---- errors


def test_missing_extra_is_reported_with_a_remedy(
    drives: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.setitem(sys.modules, 'distributed', None)
    assert code_of(drives, '-o', tmp_path / 'maps', '--workers', 2) == 1
    assert "pip install 'forward_grid_mapper[scale]'" in capsys.readouterr().err
    assert list(tmp_path.iterdir()) == []


@scaled
@pytest.mark.parametrize(
    ('options', 'expected'),
    [
        (('--workers', 0), '--workers'),
        (('--workers', 100_000), 'cores; give at most'),
        (('--scheduler', 'nonsense'), 'is not the address of a scheduler'),
        (('--scheduler', 'http://localhost:8786'), 'is not the address of a scheduler'),
        (('--scheduler', ''), 'is not the address of a scheduler'),
        (('--workers', 2, '--scheduler', 'tcp://a:1'), 'leave out --workers'),
        (('--workers', 2, '--memory-per-worker', 0.1), '--memory-per-worker'),
        (('--workers', 2, '--refine-poses'), '--refine-poses'),
        (('--workers', 2, '--odometry-calibration', 'wheels.yaml'), '--odometry-calibration'),
        (('--workers', 2, '--learn', 1), '--learn'),
        (('--work', 'here'), '--work'),
    ],
)
def test_incompatible_options_are_rejected(
    drives: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str], options: tuple[object, ...], expected: str
) -> None:
    assert code_of(drives, '-o', tmp_path / 'maps', *options) == 1
    assert expected in capsys.readouterr().err
    assert list(tmp_path.iterdir()) == []


def test_other_version_is_rejected_by_name() -> None:
    check_versions(versions())
    with pytest.raises(ClusterError, match=r'numpy .*, not 0\.1.*install the same'):
        check_versions({**versions(), 'numpy': '0.1'})


def test_work_folder_belongs_to_one_job(tmp_path: Path) -> None:
    work = WorkFolder(str(tmp_path / 'work'))
    assert not work.begin({'tiles': 5.0, 'of': (1, 2)})
    assert work.begin({'tiles': 5.0, 'of': (1, 2)})
    with pytest.raises(OutputError, match=r'another job .*differ in tiles.*--work'):
        work.begin({'tiles': 6.0, 'of': (1, 2)})
    (tmp_path / 'other').mkdir()
    (tmp_path / 'other' / 'file').touch()
    with pytest.raises(OutputError, match='not empty'):
        WorkFolder(str(tmp_path / 'other')).begin({})
    assert [path.name for path in (tmp_path / 'other').iterdir()] == ['file']


def test_work_folder_is_used_by_one_command_at_a_time(tmp_path: Path) -> None:
    work, same = WorkFolder(str(tmp_path / 'work')), WorkFolder(str(tmp_path / 'work'))
    work.begin({'tiles': 5.0})
    with work.held():
        assert same.begin({'tiles': 5.0})
        with pytest.raises(OutputError, match=r'another process_bag works in .*work; wait .*--work'), same.held():
            pass
        assert same.manifest.exists()
    with same.held():
        shutil.rmtree(same.root)
    with pytest.raises(OutputError, match='another process_bag works in'), work.held():
        pass
    assert not work.root.exists()


@scaled
def test_second_command_leaves_the_work_of_the_first(
    drives: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    """Before a drive is placed, a command that ends without results removes its own work folder."""
    from forward_grid_mapper.scale import cluster

    work, codes = tmp_path / 'work', []

    def start_again(*_: object) -> None:
        codes.append(code_of(drives, '-o', tmp_path / 'second', '--workers', 1, '--work', work))
        assert (work / 'manifest.json').exists()
        raise ClusterError('no worker')

    monkeypatch.setattr(cluster, 'Cluster', start_again)
    assert code_of(drives, '-o', tmp_path / 'first', '--workers', 1, '--work', work) == 1
    assert codes == [1]
    assert 'another process_bag works in' in capsys.readouterr().err
    assert not list(tmp_path.iterdir())


def test_worker_uses_the_plan_of_the_next_job(tmp_path: Path) -> None:
    work = WorkFolder(str(tmp_path))
    for name, width in (('left', 30), ('right', 50)):
        plan = {
            'grid': [0.1, 0, 0, width, 20],
            'widest': 3.0,
            'sensor_names': [name],
            'drives': [0],
            'sensors': {0: [0]},
        }
        work.plan.unlink(missing_ok=True)
        work.plan.write_text(json.dumps(plan))
        found = plan_of(work, 5.0)
        assert (found.sensor_names, found.tiling.grid.width) == ((name,), width)
        assert plan_of(work, 5.0) is found


@pytest.mark.parametrize(('number', 'expected'), [(errno.ENOSPC, 'disk is full'), (errno.EACCES, 'permission')])
def test_file_is_complete_or_unchanged(tmp_path: Path, number: int, expected: str) -> None:
    (tmp_path / 'file').write_text('before')
    with pytest.raises(OutputError, match=expected), whole(tmp_path / 'file') as partial:
        partial.write_text('half of')
        raise OSError(number, os.strerror(number))
    assert (tmp_path / 'file').read_text() == 'before'
    assert [path.name for path in tmp_path.iterdir()] == ['file']


@scaled
def test_drives_that_cannot_be_mapped_are_named(drives: Path, tmp_path: Path) -> None:
    from forward_grid_mapper.scale.mapping import ScaledMapper

    paths = (*recordings(drives).paths, str(tmp_path / 'nothing'))
    with pytest.raises(Exception, match=r'1 of 4 drives cannot be mapped.*\n.*nothing'):
        ScaledMapper(Here(), job_in(tmp_path / 'work')).run(DriveArguments(paths, {}, None, None, WHOLE))


@scaled
def test_bag_without_static_transforms_uses_those_of_another(drives: Path, tmp_path: Path) -> None:
    from forward_grid_mapper.scale.placing import place

    drive = dataclasses.replace(campus_drive(3, 1, 900, sonars=front_array()), extrinsics=())
    write_bag(tmp_path / 'without', drive, 'mcap', False)
    paths = (str(drives / 'drive_0'), str(tmp_path / 'without'))
    placed = place(job_in(tmp_path / 'work'), 1, DriveArguments(paths, {}, None, None, WHOLE))
    assert placed['source']['mounts_from'] == f'/tf_static of {paths[0]}'


@scaled
def test_copy_of_a_drive_is_left_out(drives: Path, one_process: Path, tmp_path: Path) -> None:
    copies = tmp_path / 'copies'
    shutil.copytree(drives, copies)
    shutil.copytree(drives / 'drive_1', copies / 'drive_9')
    folder = made_here(copies, tmp_path, Here())
    report = json.loads((folder / 'report.json').read_text())
    assert [w for w in report['warnings'] if 'is the same drive as' in w and 'drive_9' in w]
    np.testing.assert_array_equal(read_npz(folder / 'maps.npz').ml, read_npz(one_process / 'maps.npz').ml)


@scaled
def test_drives_without_echoes_are_not_copies_of_each_other(tmp_path: Path) -> None:
    silent = tmp_path / 'silent'
    for number in range(2):
        drive = campus_drive(number, 1, 200, sonars=front_array())
        ranges = [message._replace(range=float('inf')) for message in drive.ranges]
        write_bag(silent / f'drive_{number}', dataclasses.replace(drive, ranges=ranges), 'mcap', False)
    report = json.loads((made_here(silent, tmp_path, Here()) / 'report.json').read_text())
    assert not [w for w in report['warnings'] if 'the same drive as' in w]
    assert report['counts']['accepted'] == 2 * len(drive.ranges)
