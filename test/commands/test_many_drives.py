"""One map of several drives: which drives are found, independence of their order, and contradictions between them."""

from __future__ import annotations

import itertools
import json
import math
import shutil
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from drive_samples import FILES, Tape, arrays_in, assert_same_maps, code_of, error_of, mapped, report_in, write_tape

from forward_grid_mapper.commands import learn, process_bag
from forward_grid_mapper.core.common.errors import InputError
from forward_grid_mapper.core.common.parameters import Parameters
from forward_grid_mapper.core.common.readings import Readings, in_canonical_order
from forward_grid_mapper.core.mapping import Mapper
from forward_grid_mapper.core.maps.log_odds_map import map_grid
from forward_grid_mapper.core.maps.traversed import traversed_cells
from forward_grid_mapper.core.messages.message_types import NANOSECONDS, Pose2
from forward_grid_mapper.files import drawing
from forward_grid_mapper.files.map_archive import read_npz
from forward_grid_mapper.files.panels import paths_of
from forward_grid_mapper.files.reading_archive import read_readings
from forward_grid_mapper.recordings.drive import Part
from forward_grid_mapper.recordings.drives import Drives, read_drives, unreadable
from forward_grid_mapper.simulation import drive as drives_of_robots
from forward_grid_mapper.simulation.drive import door_drive
from forward_grid_mapper.simulation.sonar import NOISY, front_array
from forward_grid_mapper.simulation.world import rooms_world

DAY = 86_400 * NANOSECONDS
KINDS = ('mcap', 'sqlite3', 'ros1')


@pytest.fixture(autouse=True)
def quick_picture(monkeypatch: pytest.MonkeyPatch) -> None:
    """Do not draw: it takes most of the time of a run."""
    monkeypatch.setattr(drawing, 'draw', lambda path, picture: path.write_bytes(b''))


def day(number: int, later: int = DAY) -> Tape:
    """The drive past the door on another day, with other noise."""
    made = door_drive(1, NOISY, number, front_array())
    shift = number * later
    return Tape(
        list(made.extrinsics),
        [m._replace(stamp=m.stamp + shift) for m in made.odometry],
        [m._replace(stamp=m.stamp + shift) for m in made.ranges],
    )


@pytest.fixture(scope='module')
def days(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A folder with bags of three days in three formats."""
    folder = tmp_path_factory.mktemp('days')
    for number, kind in enumerate(KINDS):
        name = f'day_{number}.bag' if kind == 'ros1' else f'day_{number}'
        write_tape(folder / name, day(number), kind)
    return folder


def read(*paths: Path, **options: Any) -> Drives:
    return read_drives(paths, Parameters(), {}, **options)


def names(drives: Drives) -> list[str]:
    return [Path(drive.source['bag']).name for drive in drives.drives]


# ---- which drives


def test_folder_pattern_and_paths_give_the_same_maps(days: Path, tmp_path: Path) -> None:
    paths = [days / 'day_0', days / 'day_1', days / 'day_2.bag']
    one = mapped(days, tmp_path / 'a')
    assert [Path(drive['bag']).name for drive in one['drives']] == ['day_0', 'day_1', 'day_2.bag']
    assert one['warnings'] == []
    for folder, words in (('b', [days / 'day_*']), ('c', paths), ('d', [paths[2], days / 'day_[01]'])):
        assert code_of(process_bag.main, *words, '-o', tmp_path / folder) == 0
        assert_same_maps(tmp_path / folder, tmp_path / 'a')
    assert {path.name for path in (tmp_path / 'a').iterdir()} == FILES


@pytest.mark.parametrize('order', list(itertools.permutations(range(3))))
def test_maps_do_not_depend_on_the_order_of_arguments(days: Path, tmp_path: Path, order: tuple[int, ...]) -> None:
    paths = sorted(days.iterdir())
    assert code_of(process_bag.main, *(paths[k] for k in order), '-o', tmp_path / 'maps', '-q') == 0
    report = report_in(tmp_path / 'maps')
    assert [Path(drive['bag']).name for drive in report['drives']] == ['day_0', 'day_1', 'day_2.bag']
    if order != (0, 1, 2):
        assert code_of(process_bag.main, *paths, '-o', tmp_path / 'other', '-q') == 0
        assert_same_maps(tmp_path / 'maps', tmp_path / 'other')
        columns = [
            read_readings(tmp_path / f / 'readings.npz', read_npz(tmp_path / f / 'maps.npz')).readings
            for f in ('maps', 'other')
        ]
        for name in ('stamp', 'z', 'drive'):
            np.testing.assert_array_equal(getattr(columns[0], name), getattr(columns[1], name))


def test_bag_without_static_transforms_uses_those_of_another(days: Path, tmp_path: Path) -> None:
    without = write_tape(tmp_path / 'without', day(1)._replace(extrinsics=()))
    expected = read(days / 'day_0', days / 'day_1').readings
    for order in ([days / 'day_0', without], [without, days / 'day_0'], [days / 'day_0', without, days / 'day_2.bag']):
        drives = read(*order)
        assert drives.source['mounts_from'] == f'/tf_static, /tf_static of {days / "day_0"}'
        (warning,) = (text for text in drives.source['warnings'] if 'tf_static' in text)
        assert warning.startswith(
            f'{without}: the bag has no /tf_static, so that of {days / "day_0"} gives the poses of'
        )
        if len(order) == 2:
            for column in ('x', 'y', 'yaw', 'z'):
                np.testing.assert_array_equal(getattr(drives.readings, column), getattr(expected, column))


def test_transforms_of_other_bags_that_differ_are_not_used(tmp_path: Path) -> None:
    with_it, frame = day(0), day(0).extrinsics[0][0]
    moved = [(name, pose._replace(x=pose.x + 0.1) if name == frame else pose) for name, pose in with_it.extrinsics]
    one = write_tape(tmp_path / 'one', with_it)
    other = write_tape(tmp_path / 'other', day(2)._replace(extrinsics=moved))
    without = write_tape(tmp_path / 'without', day(1)._replace(extrinsics=()))
    drives = read(one, without, other)
    (warning,) = (text for text in drives.source['warnings'] if 'no pose on the robot' in text)
    assert (
        f'The other bags have different poses of {frame}, {one} and {other}: are they of different robots?' in warning
    )
    assert f'--sensor {frame}=x,y,yaw' in warning
    # the other sensors of that bag have the same pose in both
    (mapped_drive,) = (drive for drive in drives.drives if drive.source['bag'] == str(without))
    assert frame not in mapped_drive.source['extrinsics'] and len(mapped_drive.source['extrinsics']) == len(moved) - 1


def test_transforms_of_a_robot_with_other_frames_are_not_used(days: Path, tmp_path: Path) -> None:
    renamed = day(1)
    renamed = renamed._replace(extrinsics=(), ranges=[m._replace(frame_id=f'r2/{m.frame_id}') for m in renamed.ranges])
    without = write_tape(tmp_path / 'without', renamed)
    with pytest.raises(InputError, match=r'1 of 2 drives cannot be mapped.*\n.*without: no pose on the robot'):
        read(days / 'day_0', without)


def test_simultaneous_drives_have_a_defined_order(tmp_path: Path) -> None:
    paths = [write_tape(tmp_path / f'robot_{number}', day(number, 0)) for number in range(3)]
    orders = [names(read(*order)) for order in itertools.permutations(paths)]
    assert all(order == orders[0] for order in orders)
    maps = [Mapper(Parameters()).run(read(*order).readings) for order in (paths, paths[::-1])]
    for name in ('live', 'ml', 'uncertainty'):
        np.testing.assert_array_equal(getattr(maps[0], name), getattr(maps[1], name))
    assert maps[0].log_likelihood == maps[1].log_likelihood


def test_map_of_several_drives_is_that_of_all_readings(days: Path, tmp_path: Path) -> None:
    mapped(days, tmp_path / 'maps')
    parts = [read(path).readings for path in sorted(days.iterdir())]
    whole = Readings.from_columns(
        parts[0].sensor_names,
        **{c: np.concatenate([getattr(p, c) for p in parts]) for c in ('x', 'y', 'yaw', 'z', 'z_max', 'half_angle')},
        **{c: np.concatenate([getattr(p, c) for p in parts]) for c in ('sigma', 'stamp', 'sensor')},
    )
    maps, found = Mapper(Parameters()).run(whole), read_npz(tmp_path / 'maps' / 'maps.npz')
    assert maps.grid == found.grid
    np.testing.assert_array_equal(maps.ml, found.ml)
    np.testing.assert_allclose(maps.live, found.live, atol=1e-6)
    assert maps.log_likelihood == pytest.approx(found.log_likelihood)


def test_cells_between_two_robots_are_not_traversed(tmp_path: Path) -> None:
    """Two robots on both sides of a door, at the same times: no line between them is free."""
    still = day(0)._replace(odometry=[m._replace(pose=Pose2(1.0, 1.0, 0.0)) for m in day(0).odometry])
    apart = day(1, 0)._replace(odometry=[m._replace(pose=Pose2(1.0, 1.6, 0.0)) for m in day(1, 0).odometry])
    paths = [write_tape(tmp_path / 'one', still), write_tape(tmp_path / 'other', apart)]
    both, each = read(*paths), [read(path) for path in paths]
    grid = map_grid(both.readings, Parameters())
    either = traversed_cells(each[0].readings, grid) | traversed_cells(each[1].readings, grid)
    np.testing.assert_array_equal(traversed_cells(both.readings, grid), either)
    mixed = Readings.from_columns(
        both.readings.sensor_names,
        **{
            name: getattr(both.readings, name)
            for name in ('x', 'y', 'yaw', 'z', 'z_max', 'half_angle', 'sigma', 'stamp', 'sensor')
        },
    )
    assert traversed_cells(mixed, grid).sum() > either.sum(), 'the test shows nothing'


@pytest.mark.parametrize('bound', [100, 700])
def test_max_readings_is_the_sum_over_all_drives(days: Path, tmp_path: Path, bound: int) -> None:
    report = mapped_thinned(days, tmp_path / 'maps', bound)
    assert report['result']['readings'] == bound < report['counts']['accepted']
    (note,) = report['warnings']
    assert note.startswith(f'EM used {bound} of {report["counts"]["accepted"]} readings')
    whole = mapped(days, tmp_path / 'whole')
    assert report['counts'] == whole['counts']
    np.testing.assert_array_equal(arrays_in(tmp_path / 'maps')['live_map'], arrays_in(tmp_path / 'whole')['live_map'])


def mapped_thinned(days: Path, folder: Path, bound: int) -> dict[str, Any]:
    assert code_of(process_bag.main, days, '-o', folder, '--set', f'max_readings={bound}', '-q') == 0
    return dict(json.loads((folder / 'report.json').read_text('utf-8')))


# ---- the report


def test_report_has_counts_of_each_drive(days: Path, tmp_path: Path) -> None:
    report = mapped(days, tmp_path / 'maps')
    assert report['counts']['received'] == sum(drive['counts']['received'] for drive in report['drives'])
    for drive in report['drives']:
        sensors = drive['sensors']
        assert sum(row['accepted'] for row in sensors.values()) == drive['counts']['accepted'] > 0
        assert drive['unexplained'] == sum(row['unexplained'] for row in sensors.values())
    for name, row in report['sensors'].items():
        assert row['accepted'] == sum(drive['sensors'][name]['accepted'] for drive in report['drives'])
    assert report['input']['path_m'] == pytest.approx(sum(drive['path_m'] for drive in report['drives']))
    text = (tmp_path / 'maps' / 'report.txt').read_text('utf-8')
    for drive in report['drives']:
        assert drive['bag'] in text and f'{drive["counts"]["accepted"]:,}' in text


def test_picture_has_a_path_for_each_drive(days: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    pictures = []
    monkeypatch.setattr(drawing, 'draw', lambda path, picture: (pictures.append(picture), path.write_bytes(b'')))
    mapped(days, tmp_path / 'maps')
    paths = paths_of(pictures[0].path_xy)
    assert len(paths) == 3
    for path, bag in zip(paths, sorted(days.iterdir()), strict=True):
        np.testing.assert_array_equal(path, read(bag).path_xy)
    assert pictures[0].title.endswith('day_0 and 2 more')


def test_bag_of_the_maps_of_several_drives(days: Path, tmp_path: Path) -> None:
    mapped(days, tmp_path / 'maps', '--bag')
    assert (tmp_path / 'maps' / 'maps.mcap_bag').is_dir()


def test_default_output_names(days: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.undo()
    monkeypatch.chdir(tmp_path)
    assert code_of(process_bag.main, days, '-q') == 0
    assert code_of(process_bag.main, days / 'day_1', days / 'day_0', '-q') == 0
    assert {path.name for path in tmp_path.iterdir()} == {f'{days.name}_maps', 'day_1_and_1_more_maps'}
    assert all(path.read_bytes().startswith(b'\x89PNG') for path in tmp_path.glob('*/maps.png'))


# ---- the same drive twice


def test_bag_under_several_names_is_read_once(days: Path, tmp_path: Path) -> None:
    link = tmp_path / 'link'
    link.symlink_to(days / 'day_0')
    file = next((days / 'day_0').glob('*.mcap'))
    for again in (days / 'day_0', link, file, days / 'day_0' / 'metadata.yaml'):
        drives = read(days / 'day_0', again)
        (warning,) = drives.source['warnings']
        assert names(drives) == ['day_0'] and 'it is read once' in warning
        assert len(drives.readings) == len(day(0).ranges)


@pytest.mark.parametrize('kind', KINDS)
def test_copy_in_another_format_is_left_out(days: Path, tmp_path: Path, kind: str) -> None:
    copy = write_tape(tmp_path / ('copy.bag' if kind == 'ros1' else 'copy'), day(0), kind)
    for words in ((days / 'day_0', copy, days / 'day_1'), (copy, days / 'day_1', days / 'day_0')):
        drives = read(*words)
        assert len(drives.drives) == 2
        (warning,) = (text for text in drives.source['warnings'])
        assert 'is the same drive as' in warning and 'left out' in warning
        assert str(copy) in warning and str(days / 'day_0') in warning
        np.testing.assert_array_equal(
            np.sort(drives.readings.z), np.sort(read(days / 'day_0', days / 'day_1').readings.z)
        )
    alone = read(days / 'day_0', copy)
    assert len(alone.drives) == 1 and 'is the same drive' in alone.source['warnings'][0]


def test_copies_give_one_warning(days: Path, tmp_path: Path) -> None:
    copies = [write_tape(tmp_path / f'copy_{k}', day(0), 'sqlite3') for k in range(3)]
    part = write_tape(tmp_path / 'part', day(0)._replace(ranges=day(0).ranges[:200]))
    drives = read(days / 'day_0', days / 'day_1', *copies)
    (warning,) = drives.source['warnings']
    assert warning.count(' the same drive as ') == 1 and 'they are left out' in warning
    assert len(drives.drives) == 2
    both = read(days / 'day_0', days / 'day_1', *copies, part).source['warnings']
    assert len(both) == 2 and f'leave out {part}' in both[1]


def test_part_of_another_drive_gives_a_warning(days: Path, tmp_path: Path) -> None:
    whole = day(0)
    half = whole._replace(ranges=whole.ranges[: len(whole.ranges) // 2])
    part = write_tape(tmp_path / 'half', half)
    warnings = read(part, days / 'day_0', days / 'day_1').source['warnings']
    assert len(warnings) == 1 and f'leave out {part}' in warnings[0]
    echoes = sum(math.isfinite(m.range) for m in half.ranges)
    assert warnings[0].startswith(f'{echoes} of {echoes} echoes of {part} are in {days / "day_0"} as well')


# ---- contradictions between drives


def framed(number: int, frame: str) -> Tape:
    drive = day(number)
    return drive._replace(odometry=[m._replace(frame_id=frame) for m in drive.odometry])


def test_drives_in_different_map_frames_are_rejected(
    days: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    other = write_tape(tmp_path / 'other', framed(2, 'warehouse'))
    error = error_of(capsys, tmp_path, days / 'day_0', days / 'day_1', other, '-o', tmp_path / 'maps')
    assert 'not in the same map frame' in error and f'warehouse: {other}' in error and f'leave out {other}' in error


def test_leading_slash_is_no_different_frame(days: Path, tmp_path: Path) -> None:
    other = write_tape(tmp_path / 'other.bag', framed(2, '/odom'), 'ros1')
    assert len(read(days / 'day_0', other).drives) == 2


def test_different_pose_of_a_sensor_gives_a_warning(days: Path, tmp_path: Path) -> None:
    drive = day(2)
    (frame, pose), *rest = drive.extrinsics
    moved = [(frame, pose._replace(x=pose.x + 0.05)), *rest]
    other = write_tape(tmp_path / 'other', drive._replace(extrinsics=moved))
    (warning,) = read(days / 'day_0', days / 'day_1', other).source['warnings']
    assert f'{frame} is mounted on the robot at x = {pose.x + 0.05:.2f} m' in warning
    assert f'in {other}, and at x = {pose.x:.2f} m' in warning and f'--sensor {frame}=x,y,yaw' in warning


def test_robots_with_different_base_frames_may_differ(days: Path, tmp_path: Path) -> None:
    drive = day(2)
    (frame, pose), *rest = drive.extrinsics
    moved = [(frame, pose._replace(x=pose.x + 0.05)), *rest]
    odometry = [m._replace(child_frame_id='other_robot') for m in drive.odometry]
    drive = drive._replace(extrinsics=moved, odometry=odometry)
    sensors = dict(moved)
    drives = read_drives([days / 'day_0', write_tape(tmp_path / 'other', drive)], Parameters(), sensors)
    assert not any('is mounted on the robot' in warning for warning in drives.source['warnings'])


def test_different_limits_of_a_sensor_give_a_warning(days: Path, tmp_path: Path) -> None:
    drive = day(2)
    frame = drive.extrinsics[1][0]
    ranges = [m._replace(field_of_view=2 * m.field_of_view) if m.frame_id == frame else m for m in drive.ranges]
    other = write_tape(tmp_path / 'other', drive._replace(ranges=ranges))
    (warning,) = read(days / 'day_0', days / 'day_1', other).source['warnings']
    assert warning.startswith(f'{frame} has a range of') and str(other) in warning and 'field_of_view' in warning


def test_missing_sensor_gives_a_warning(days: Path, tmp_path: Path) -> None:
    drive = day(2)
    frame = drive.extrinsics[3][0]
    other = write_tape(tmp_path / 'other', drive._replace(ranges=[m for m in drive.ranges if m.frame_id != frame]))
    (warning,) = read(days / 'day_0', days / 'day_1', other).source['warnings']
    assert warning.startswith(f'{other} has no reading of {frame},')


@pytest.mark.slow
def test_drive_that_does_not_fit_the_map_gives_a_warning(tmp_path: Path) -> None:
    way = np.array([[1.5, 1.5], [3.0, 3.45], [9.0, 3.45], [9.0, 2.0], [10.5, 6.5]])
    paths = []
    for number in range(3):
        made = drives_of_robots.drive(rooms_world(), way, 0.1, front_array(), NOISY, seed=number)
        odometry = [m._replace(stamp=m.stamp + number * DAY) for m in made.odometry]
        if number == 2:
            odometry = [m._replace(pose=m.pose._replace(x=m.pose.x + 0.5)) for m in odometry if m.pose]
        ranges = [m._replace(stamp=m.stamp + number * DAY) for m in made.ranges]
        paths.append(write_tape(tmp_path / f'day_{number}', Tape(made.extrinsics, odometry, ranges)))
    assert code_of(process_bag.main, *paths, '-o', tmp_path / 'maps', '-q') == 0
    (warning,) = report_in(tmp_path / 'maps')['warnings']
    assert warning.startswith(f'{paths[2]} (') and 'Localise all drives' in warning


def test_warning_names_its_drive(days: Path, tmp_path: Path) -> None:
    drive = day(2)
    frame = drive.extrinsics[0][0]
    other = write_tape(tmp_path / 'other', drive._replace(extrinsics=drive.extrinsics[1:]))
    (warning,) = read(days / 'day_0', other).source['warnings']
    assert warning.startswith(f'{other}: no pose on the robot') and frame in warning


# ---- errors


def test_all_drives_that_cannot_be_mapped_are_named(
    days: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    absent = tmp_path / 'absent'
    silent = write_tape(tmp_path / 'silent', day(2)._replace(ranges=[]))
    error = error_of(capsys, tmp_path, days / 'day_0', absent, silent, '-o', tmp_path / 'maps')
    assert error.startswith('2 of 3 drives cannot be mapped; leave them out')
    assert f'{absent} does not exist' in error and f'{silent}: The bag has no sensor_msgs/Range' in error


def test_error_lines_of_one_drive_are_indented() -> None:
    errors = [(Path('a'), InputError('choose one:\n  /odom\n  /odom_2')), (Path('b'), InputError('b is empty'))]
    assert str(unreadable(errors, 3)).splitlines()[1:] == [
        '  a: choose one:',
        '      /odom',
        '      /odom_2',
        '  b is empty',
    ]


def test_pattern_without_match_is_rejected(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    error = error_of(capsys, tmp_path, f'{tmp_path}/monday_*', '-o', tmp_path / 'maps')
    assert f'no file or folder matches {tmp_path}/monday_*' in error


def test_files_of_a_split_bag_without_metadata_are_rejected(
    days: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    folder = tmp_path / 'split'
    folder.mkdir()
    for number in range(2):
        shutil.copy(next((days / 'day_0').glob('*.mcap')), folder / f'split_{number}.mcap')
    error = error_of(capsys, tmp_path, folder, '-o', tmp_path / 'maps')
    assert 'ros2 bag reindex' in error


def test_bag_without_metadata_in_a_folder_is_a_drive(days: Path, tmp_path: Path) -> None:
    for name in ('day_0', 'day_1'):
        shutil.copytree(days / name, tmp_path / 'days' / name)
    (tmp_path / 'days' / 'day_1' / 'metadata.yaml').unlink()
    (tmp_path / 'days' / 'day_2.bag.active').touch()
    drives = read(tmp_path / 'days')
    assert names(drives) == ['day_0', 'day_1']
    assert any('left out: day_2.bag.active' in warning for warning in drives.source['warnings'])


# ---- parts


def test_parts_of_a_drive_add_up_to_the_whole(days: Path) -> None:
    path = days / 'day_0'
    whole = in_canonical_order(read(path).readings)
    first = int(min(m.stamp for m in (*day(0).ranges, *day(0).odometry)))
    found = []
    for start, duration in ((0.0, 4.0), (4.0, 5.0), (9.0, math.inf)):
        part = in_canonical_order(read(path, part=Part(start, duration)).readings)
        begin = first + start * NANOSECONDS
        assert (begin <= part.stamp).all() and (part.stamp < begin + duration * NANOSECONDS).all()
        found.append(part)
    for name in ('stamp', 'x', 'y', 'yaw', 'z'):
        np.testing.assert_array_equal(np.concatenate([getattr(p, name) for p in found]), getattr(whole, name))


def test_part_is_taken_of_each_drive(days: Path, tmp_path: Path) -> None:
    report = mapped(days, tmp_path / 'maps', '--start', 2, '--duration', 3)
    for drive in report['drives']:
        assert 2.0 < drive['duration_s'] <= 3.0
    one = mapped(days / 'day_1', tmp_path / 'one', '--start', 2, '--duration', 3)
    assert one['counts']['accepted'] == report['drives'][1]['counts']['accepted'] < len(day(1).ranges)


def test_part_after_the_end_of_the_drive_is_rejected(
    days: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    error = error_of(capsys, tmp_path, days / 'day_0', '-o', tmp_path / 'maps', '--start', 900)
    assert 'has no reading in the part --start 900; its messages span' in error


def test_learn_accepts_several_drives(days: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    assert code_of(learn.main, days, '-o', tmp_path / 'a.yaml', '--rounds', 1, '--keep-going', '-q') == 0
    paths = sorted(days.iterdir(), reverse=True)
    assert code_of(learn.main, *paths, '-o', tmp_path / 'b.yaml', '--rounds', 1, '--keep-going', '-q') == 0

    def values(name: str) -> list[str]:
        return [line for line in (tmp_path / name).read_text().splitlines() if not line.lstrip().startswith('#')]

    assert values('a.yaml') == values('b.yaml') != []
