"""Maps by tasks for tiles equal those of one process, also after interruptions; large maps in parts; odd drives."""

from __future__ import annotations

import dataclasses
import json
import math
from pathlib import Path

import numpy as np
import pytest
from scaled_jobs import MAPS, Here, assert_same, copy_of, job_in, made_here, recordings, scaled

from forward_grid_mapper.commands.simulate import write_bag
from forward_grid_mapper.core.messages.message_types import OdometryMessage
from forward_grid_mapper.files.map_archive import read_npz
from forward_grid_mapper.files.map_files import read_map
from forward_grid_mapper.recordings.drive import WHOLE
from forward_grid_mapper.scale.job import DriveArguments
from forward_grid_mapper.scale.work_folder import outcome_in
from forward_grid_mapper.simulation.campus import campus_drive
from forward_grid_mapper.simulation.sonar import front_array


@scaled
def test_maps_equal_those_of_one_process(finished: Path, one_process: Path) -> None:
    assert_same(finished / 'maps', one_process)


@scaled
def test_maps_do_not_depend_on_the_order_of_drives_and_tasks(drives: Path, one_process: Path, tmp_path: Path) -> None:
    assert_same(made_here(drives, tmp_path, Here(turned=True), True), one_process)


@scaled
def test_other_results_equal_those_of_one_process(finished: Path, one_process: Path) -> None:
    folder = finished / 'maps'
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
def test_interrupted_job_continues(drives: Path, placed: Path, one_process: Path, tmp_path: Path) -> None:
    """The job is interrupted every few tasks; only the interrupted task is done twice."""
    work = copy_of(placed, tmp_path / 'work')
    # the job was interrupted when the last drive was almost placed
    (work / 'drives' / '0002.json').unlink()
    rounds = 0
    while True:
        rounds += 1
        done = len([path for path in work.rglob('*') if path.is_file()])
        try:
            # finished tasks only report that they are finished
            folder = made_here(drives, tmp_path, Here(12 * rounds))
            break
        except KeyboardInterrupt:
            assert len([path for path in work.rglob('*') if path.is_file()]) > done
    assert rounds > 3
    assert_same(folder, one_process)


@scaled
def test_repeated_task_changes_no_files(finished: Path) -> None:
    from forward_grid_mapper.scale import tile_work

    job = job_in(finished / 'work')
    before = {path: (path.read_bytes(), path.stat().st_mtime_ns) for path in job.folder.root.rglob('*.npz')}
    assert len(before) > 30
    for work in (tile_work.gather, tile_work.normals, tile_work.finish, tile_work.judge):
        assert work(job, 5) == {**work(job, 5), 'cpu': pytest.approx(0, abs=1), 'peak': pytest.approx(0, abs=1e12)}
    tile_work.search(job, 5, 0)
    after = {path: (path.read_bytes(), path.stat().st_mtime_ns) for path in job.folder.root.rglob('*.npz')}
    assert before == after


@scaled
def test_large_maps_are_written_in_parts(
    drives: Path, finished: Path, one_process: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    import zarr

    from forward_grid_mapper.scale import output

    for name, value in (('MOST_CELLS_OF_A_FILE', 0), ('REGION', 64), ('OVERVIEW', 60)):
        monkeypatch.setattr(output, name, value)
    read: list[Path] = []
    monkeypatch.setattr(output, 'outcome_in', lambda path: read.append(path) or outcome_in(path))
    copy_of(finished / 'work', tmp_path / 'work')
    folder = made_here(drives, tmp_path, Here())
    maps = read_npz(one_process / 'maps.npz')
    tiles, regions = len(set(read)), math.prod(-(-side // 64) for side in maps.grid.shape)
    assert len(read) < 0.75 * tiles * regions, 'each region reads all tiles'
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


@scaled
def test_region_that_was_only_traversed_is_written() -> None:
    from forward_grid_mapper.scale.output import is_empty

    unknown, known = np.full((2, 3), np.nan, np.float32), np.array([[np.nan, 0.0]], np.float32)
    assert is_empty('uncertainty_map', unknown) and not is_empty('uncertainty_map', known)
    assert is_empty('dynamic', np.zeros((2, 3), np.float32)) and not is_empty('dynamic', np.ones((2, 3), np.float32))
    assert is_empty('ml_map', np.full((2, 3), -1, np.int8)) and not is_empty('ml_map', np.zeros((2, 3), np.int8))


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
def test_drives_that_cannot_be_mapped_are_named(drives: Path, placed: Path, tmp_path: Path) -> None:
    from forward_grid_mapper.scale.mapping import ScaledMapper

    paths = (*recordings(drives).paths, str(tmp_path / 'nothing'))
    with pytest.raises(Exception, match=r'1 of 4 drives cannot be mapped.*\n.*nothing'):
        ScaledMapper(Here(), job_in(copy_of(placed, tmp_path / 'work'))).run(
            DriveArguments(paths, {}, None, None, WHOLE)
        )


@scaled
def test_bag_without_static_transforms_uses_those_of_another(drives: Path, tmp_path: Path) -> None:
    from forward_grid_mapper.scale.placing import place

    drive = dataclasses.replace(campus_drive(3, 1, 900, sonars=front_array()), extrinsics=())
    write_bag(tmp_path / 'without', drive, 'mcap', False)
    paths = (str(drives / 'drive_0'), str(tmp_path / 'without'))
    placed = place(job_in(tmp_path / 'work'), 1, DriveArguments(paths, {}, None, None, WHOLE))
    assert placed['source']['mounts_from'] == f'/tf_static of {paths[0]}'


@scaled
def test_copy_of_a_drive_is_left_out(drives: Path, placed: Path, one_process: Path, tmp_path: Path) -> None:
    copy_of(placed, tmp_path / 'work')
    of_three = recordings(drives)
    copy = copy_of(drives / 'drive_1', tmp_path / 'drive_9')
    folder = made_here(dataclasses.replace(of_three, paths=(*of_three.paths, str(copy))), tmp_path, Here())
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
