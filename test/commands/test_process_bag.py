"""From a recorded drive to maps, in all formats, and each option."""

from __future__ import annotations

import os
import re
import shutil
from pathlib import Path

import numpy as np
import pytest
import yaml
from drive_samples import (
    FILES,
    SECOND,
    Tape,
    arrays_in,
    assert_same_maps,
    backwards_sensors,
    code_of,
    in_turn,
    mapped,
    report_in,
    tape,
    write_tape,
)
from rosbags.highlevel import AnyReader

from forward_grid_mapper.commands import process_bag, simulate
from forward_grid_mapper.core.common.parameters import TABLE, Parameters
from forward_grid_mapper.core.mapping import Mapper
from forward_grid_mapper.core.messages.message_types import Pose2
from forward_grid_mapper.core.messages.pose_association import PoseAssociator
from forward_grid_mapper.files import drawing
from forward_grid_mapper.files.map_archive import read_npz
from forward_grid_mapper.files.map_files import occupancy_values, read_map
from forward_grid_mapper.simulation.drive import door_drive
from forward_grid_mapper.simulation.sonar import NOISY, front_array

FRAMES = [frame for frame, _ in tape().extrinsics]
DRIVE = ('door', '--seen', 1, '--sonars', 'front', '-q')


@pytest.fixture(autouse=True)
def quick_picture(monkeypatch: pytest.MonkeyPatch) -> None:
    """Do not draw: it takes most of the time of a run. `plain` and the tests of paths do draw."""
    monkeypatch.setattr(drawing, 'draw', lambda path, picture: path.write_bytes(b''))


@pytest.fixture(scope='module')
def plain(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A bag of the drive, `bag`, and its results with all options at their defaults, `maps`."""
    folder = tmp_path_factory.mktemp('plain')
    write_tape(folder / 'bag', tape())
    mapped(folder / 'bag', folder / 'maps')
    return folder


def readings_placed(drive: Tape) -> PoseAssociator:
    """The messages of the drive as readings, without a bag."""
    extrinsics = dict(drive.extrinsics)
    associator = PoseAssociator(lambda base, frame, stamp: extrinsics[frame], patient=True)
    for message in drive.odometry:
        associator.add_odometry(message)
    for message in drive.ranges:
        associator.add_range(message)
    associator.finish()
    return associator


# ---- formats of a drive


@pytest.mark.parametrize('kind', ['mcap', 'sqlite3', 'ros1'])
@pytest.mark.parametrize('topics', ['one', 'each'])
def test_all_formats_give_the_same_maps(tmp_path: Path, plain: Path, kind: str, topics: str) -> None:
    recorded = tmp_path / 'recorded'
    assert code_of(simulate.main, *DRIVE, '-o', recorded, '--format', kind, '--topics', topics) == 0
    if kind == 'ros1':
        file = recorded / 'drive.bag'
        folder = tmp_path / 'folder'
        folder.mkdir()
        shutil.copy(file, folder)
    else:
        folder = recorded / 'bag'
        file = next(path for path in folder.iterdir() if path.name != 'metadata.yaml')
    for name, path in (('of_file', file), ('of_folder', folder)):
        report = mapped(path, tmp_path / name)
        assert_same_maps(tmp_path / name, plain / 'maps')
        assert report['input']['range_topics'] == (['/sonar'] if topics == 'one' else [f'/{f}' for f in FRAMES])
        assert report['counts']['received'] == report['counts']['accepted'] == len(tape().ranges)


def test_maps_equal_those_of_the_pipeline_without_a_bag(plain: Path) -> None:
    maps = Mapper(Parameters()).run(readings_placed(tape()).readings)
    archive = read_npz(plain / 'maps' / 'maps.npz')
    assert archive.grid == maps.grid
    np.testing.assert_array_equal(archive.ml, maps.ml)
    # quaternions round the last digits of the directions of the sensors
    np.testing.assert_allclose(archive.live, maps.live, atol=1e-6)
    np.testing.assert_allclose(archive.uncertainty, maps.uncertainty, atol=1e-6)
    assert archive.log_likelihood == pytest.approx(maps.log_likelihood)


def test_readings_have_the_poses_of_the_simulation() -> None:
    truth = door_drive(1, NOISY, 0, front_array()).readings
    found = readings_placed(tape()).readings
    for column in ('x', 'y', 'yaw', 'z', 'z_max', 'half_angle'):
        np.testing.assert_allclose(getattr(found, column), getattr(truth, column), atol=1e-6)
    np.testing.assert_array_equal(found.stamp, truth.stamp)


# ---- output


def test_all_output_files_are_written(plain: Path) -> None:
    folder = plain / 'maps'
    assert {path.name for path in folder.iterdir()} == FILES
    assert (folder / 'maps.png').read_bytes().startswith(b'\x89PNG')
    archive = read_npz(folder / 'maps.npz')
    arrays = arrays_in(folder)
    for name, mode, tolerance in (
        ('ml_map', 'trinary', 0.0),
        ('live_map', 'raw', 0.006),
        ('uncertainty_map', 'raw', 0.006),
    ):
        meta = yaml.safe_load((folder / f'{name}.yaml').read_text())
        assert (meta['mode'], meta['image'], meta['negate']) == (mode, f'{name}.pgm', 0)
        grid, values = read_map(folder / f'{name}.yaml')
        assert grid == archive.grid
        assert arrays[name].dtype == np.float32
        np.testing.assert_allclose(values, arrays[name], atol=tolerance)
    assert set(np.unique(archive.ml)) == {-1, 0, 1}
    assert {path.name for path in plain.iterdir()} == {'bag', 'maps'}, 'a temporary folder is left'


def test_report_has_topics_frames_and_counts(plain: Path, capsys: pytest.CaptureFixture[str]) -> None:
    report = report_in(plain / 'maps')
    assert report['input']['bag'] == str(plain / 'bag')
    assert report['input']['range_topics'] == ['/sonar']
    assert (report['input']['odom_topic'], report['input']['odom_frame']) == ('/odom', 'odom')
    assert report['input']['mounts_from'] == '/tf_static'
    assert report['input']['path_m'] == pytest.approx(10.1, abs=0.1)
    assert report['warnings'] == []
    assert report['changed_parameters'] == {}
    assert set(report['parameters']) == {row.name for row in TABLE}
    assert {'reading the bag', 'search'} <= set(report['seconds'])
    assert all(seconds >= 0.0 for seconds in report['seconds'].values())
    text = (plain / 'maps' / 'report.txt').read_text('utf-8')
    assert str(plain / 'bag') in text and '/odom' in text
    assert text.count('sonar_') == len(FRAMES)


def test_drive_with_negative_stamps_is_mapped(tmp_path: Path, plain: Path) -> None:
    """Stamps are signed; log times are not."""
    shift = -tape().odometry[0].stamp - 100 * SECOND
    early = tape()._replace(
        odometry=[m._replace(stamp=m.stamp + shift) for m in tape().odometry],
        ranges=[m._replace(stamp=m.stamp + shift) for m in tape().ranges],
    )
    logged = [(time + 200 * SECOND, message) for time, message in in_turn(early)]
    bag = write_tape(tmp_path / 'bag', early, logged=logged)
    mapped(bag, tmp_path / 'maps', '--bag')
    assert_same_maps(tmp_path / 'maps', plain / 'maps')
    with AnyReader([tmp_path / 'maps' / 'maps.mcap_bag']) as reader:
        for connection, time, raw in reader.messages():
            header = reader.deserialize(raw, connection.msgtype).header
            assert (time, header.stamp.sec) == (0, max(m.stamp for m in early.ranges) // SECOND)


def test_maps_are_written_to_a_bag(tmp_path: Path, plain: Path) -> None:
    mapped(plain / 'bag', tmp_path / 'maps', '--bag')
    assert_same_maps(tmp_path / 'maps', plain / 'maps')
    assert {path.name for path in (tmp_path / 'maps').iterdir()} == FILES | {'maps.mcap_bag'}
    archive = read_npz(tmp_path / 'maps' / 'maps.npz')
    with AnyReader([tmp_path / 'maps' / 'maps.mcap_bag']) as reader:
        grids = {c.topic: reader.deserialize(data, c.msgtype) for c, _, data in reader.messages()}
        times = {time for _, time, _ in reader.messages()}
    assert set(grids) == {f'/forward_grid_mapper/{name}' for name in ('live_map', 'ml_map', 'uncertainty_map')}
    for name, values in (('live_map', archive.live), ('ml_map', archive.ml), ('uncertainty_map', archive.uncertainty)):
        message = grids[f'/forward_grid_mapper/{name}']
        assert message.header.frame_id == 'odom'
        position = message.info.origin.position
        assert (position.x, position.y) == pytest.approx(archive.grid.origin)
        assert message.info.origin.orientation.w == 1.0
        assert message.info.resolution == pytest.approx(archive.grid.resolution)
        read = np.asarray(message.data, np.int8).reshape(message.info.height, message.info.width)
        np.testing.assert_array_equal(read, occupancy_values(values))
    assert times == {max(m.stamp for m in tape().ranges)}


def test_default_output_name_is_unused(tmp_path: Path, plain: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.chdir(tmp_path)
    for name in ('bag_maps', 'bag_maps_2', 'bag_maps_3'):
        before = {path: path.stat().st_mtime_ns for path in tmp_path.rglob('*') if path.is_file()}
        assert code_of(process_bag.main, plain / 'bag') == 0
        assert {path.name for path in (tmp_path / name).iterdir()} == FILES
        assert {path: path.stat().st_mtime_ns for path in before} == before


def test_output_name_of_the_current_folder(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.chdir(write_tape(tmp_path / 'drive', tape()))
    for name in ('drive_maps', 'drive_maps_2'):
        assert code_of(process_bag.main, '.') == 0
        assert FILES == {path.name for path in Path(name).iterdir()}


def test_existing_empty_output_folder_is_filled(tmp_path: Path, plain: Path) -> None:
    folder = tmp_path / 'mounted'
    folder.mkdir()
    inode = folder.stat().st_ino
    mapped(plain / 'bag', folder)
    assert folder.stat().st_ino == inode
    assert {path.name for path in folder.iterdir()} == FILES


def test_output_on_the_terminal(tmp_path: Path, plain: Path, capsys: pytest.CaptureFixture[str]) -> None:
    mapped(plain / 'bag', tmp_path / 'a', '-q')
    assert capsys.readouterr() == (f'maps are in {tmp_path / "a"}\n', '')
    mapped(plain / 'bag', tmp_path / 'b')
    report = (tmp_path / 'b' / 'report.txt').read_text('utf-8')
    assert capsys.readouterr().out == f'{report}maps are in {tmp_path / "b"}\n'


@pytest.mark.filterwarnings('ignore:Glyph')
@pytest.mark.parametrize('name', ['with space', 'Büro 日本 😀', r'$x^{\frac', '50% of #1?', '-dash'])
def test_paths_with_unusual_characters(
    tmp_path: Path, plain: Path, name: str, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.undo()
    bag = tmp_path / name / 'bag'
    shutil.copytree(plain / 'bag', bag)
    for which, path in (('folder', bag), ('file', bag / 'bag.mcap')):
        report = mapped(path, tmp_path / name / f'{name} {which}', '--bag')
        assert report['input']['bag'] == str(path)
        assert_same_maps(tmp_path / name / f'{name} {which}', plain / 'maps')
    assert f'maps are in {tmp_path / name / name} file' in capsys.readouterr().out


def test_path_that_is_not_utf_8(
    tmp_path: Path, plain: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.undo()
    folder = tmp_path / os.fsdecode(b'n\xfft')
    try:
        folder.mkdir()
    except OSError:
        pytest.skip('the file system takes only UTF-8')
    shutil.copytree(plain / 'bag', folder / 'bag')
    report = mapped(folder / 'bag', folder / 'maps')
    assert report['input']['bag'] == str(tmp_path / r'n\xfft' / 'bag')
    assert 'n\\' in capsys.readouterr().out


# ---- options


def test_listed_parameters_as_a_file_change_no_values(
    tmp_path: Path, plain: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    assert code_of(process_bag.main, '--list-parameters') == 0
    listed = capsys.readouterr().out
    for row in TABLE:
        assert re.search(rf'^ +{row.name}: ', listed, re.MULTILINE), row.name
    (tmp_path / 'all.yaml').write_text(listed)
    report = mapped(plain / 'bag', tmp_path / 'maps', '--params', tmp_path / 'all.yaml')
    assert report['changed_parameters'] == {}
    assert_same_maps(tmp_path / 'maps', plain / 'maps')


def test_setting_overrides_the_parameter_file(tmp_path: Path, plain: Path) -> None:
    file = tmp_path / 'p.yaml'
    file.write_text('forward_grid_mapper: {ros__parameters: {resolution: 0.2, alpha: 0.25, publish_rate: 5.0}}')
    of_file = mapped(plain / 'bag', tmp_path / 'a', '--params', file)
    options = ('--params', file, '--set', 'resolution=0.5', '--set', 'max_iterations=3', '--set', 'resolution=0.25')
    of_both = mapped(plain / 'bag', tmp_path / 'b', *options)
    assert {k: of_file['parameters'][k] for k in ('resolution', 'alpha')} == {'resolution': 0.2, 'alpha': 0.25}
    assert {k: of_both['parameters'][k] for k in ('resolution', 'alpha')} == {'resolution': 0.25, 'alpha': 0.25}
    assert of_both['parameters']['max_iterations'] == 3
    assert [read_npz(tmp_path / name / 'maps.npz').grid.resolution for name in 'ab'] == [0.2, 0.25]
    assert 'resolution' in of_both['changed_parameters']
    assert '0.25' in (tmp_path / 'b' / 'report.txt').read_text('utf-8')


def test_search_that_did_not_converge_gives_a_warning(
    tmp_path: Path, plain: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    report = mapped(plain / 'bag', tmp_path / 'maps', '--set', 'max_iterations=1', '-q')
    assert any('raise max_iterations' in warning for warning in report['warnings'])
    assert 'process_bag: warning: ' in capsys.readouterr().err


def test_sensor_option_overrides_file_and_transforms(tmp_path: Path, plain: Path) -> None:
    wrong = tuple((frame, Pose2(1.0, 2.0, 3.0)) for frame, _ in tape().extrinsics)
    bag = write_tape(tmp_path / 'bag', tape()._replace(extrinsics=wrong))
    given = {frame: list(pose) for frame, pose in tape().extrinsics}
    sensors = [f'--sensor={frame}={x!r},{y!r},{yaw!r}' for frame, (x, y, yaw) in tape().extrinsics]
    right, mixed = tmp_path / 'right.yaml', tmp_path / 'mixed.yaml'
    right.write_text(yaml.safe_dump({'sensors': {frame: {'pose': pose} for frame, pose in given.items()}}))
    mixed.write_text(yaml.safe_dump({f'sensors.{frame}.pose': [0.0, 0.0, 0.0] for frame in FRAMES}))
    alone = mapped(bag, tmp_path / 'sensor', *sensors)
    assert alone['input']['mounts_from'] == 'parameters'
    mapped(bag, tmp_path / 'file', '--params', right)
    mapped(bag, tmp_path / 'both', '--params', mixed, *sensors)
    assert_same_maps(tmp_path / 'sensor', tmp_path / 'file')
    assert_same_maps(tmp_path / 'sensor', tmp_path / 'both')
    np.testing.assert_array_equal(arrays_in(tmp_path / 'sensor')['ml_map'], arrays_in(plain / 'maps')['ml_map'])
    some = mapped(bag, tmp_path / 'some', *sensors[1:])
    assert some['input']['mounts_from'] == '/tf_static and parameters'
    assert some['result'] != alone['result']


def test_sensor_option_accepts_degrees_and_slashes(tmp_path: Path) -> None:
    bag = write_tape(tmp_path / 'bag', tape().of(FRAMES[0])._replace(extrinsics=()))
    mapped(bag, tmp_path / 'a', f'--sensor=/{FRAMES[0]}=0.1,-0.2,90deg')
    mapped(bag, tmp_path / 'b', '--sensor', f'{FRAMES[0]}=0.1,-0.2,{np.pi / 2!r}')
    assert_same_maps(tmp_path / 'a', tmp_path / 'b')


def test_one_of_two_odometry_topics_is_used(tmp_path: Path, plain: Path) -> None:
    moved = [m._replace(frame_id='map', pose=Pose2(m.pose.y, m.pose.x, 1.0)) for m in tape().odometry]
    drive = tape()._replace(odometry=[*tape().odometry, *moved])
    bag = write_tape(
        tmp_path / 'bag', drive, odometry_topic=lambda m: '/odom' if m.frame_id == 'odom' else '/laser/odom'
    )
    for name in ('/odom', 'odom'):
        report = mapped(bag, tmp_path / f'of {name.strip("/")} {len(name)}', '--odom-topic', name)
        assert (report['input']['odom_topic'], report['input']['odom_frame']) == ('/odom', 'odom')
        assert_same_maps(tmp_path / f'of odom {len(name)}', plain / 'maps')
    report = mapped(bag, tmp_path / 'of_laser', '--odom-topic', '/laser/odom')
    assert (report['input']['odom_topic'], report['input']['odom_frame']) == ('/laser/odom', 'map')
    assert arrays_in(tmp_path / 'of_laser')['ml_map'].shape != arrays_in(plain / 'maps')['ml_map'].shape


def test_only_chosen_range_topics_are_used(tmp_path: Path) -> None:
    chosen = [FRAMES[5], FRAMES[2]]
    bag = write_tape(tmp_path / 'bag', tape(), sonar_topic=lambda m: f'/sonars/{m.frame_id}')
    topics = [f'/sonars/{frame}' for frame in chosen]
    report = mapped(bag, tmp_path / 'chosen', '--range-topics', topics[0], topics[1].lstrip('/'), topics[0])
    assert report['input']['range_topics'] == topics
    assert set(report['sensors']) == set(chosen)
    only = write_tape(tmp_path / 'only', tape().of(*chosen))
    mapped(only, tmp_path / 'only_maps')
    assert_same_maps(tmp_path / 'chosen', tmp_path / 'only_maps')


def test_sensor_that_sends_zero_gives_a_warning(tmp_path: Path) -> None:
    dead = [m._replace(range=0.0) if m.frame_id == FRAMES[3] else m for m in tape().ranges]
    report = mapped(write_tape(tmp_path / 'bag', tape()._replace(ranges=dead)), tmp_path / 'maps')
    assert [w for w in report['warnings'] if w.startswith(f'nearly all readings of {FRAMES[3]} were rejected as')]


def test_learning_changes_the_parameters_of_the_model(tmp_path: Path, plain: Path) -> None:
    report = mapped(plain / 'bag', tmp_path / 'maps', '--learn', 1)
    before = report_in(plain / 'maps')['parameters']
    learned = {name for name, value in report['parameters'].items() if value != before[name]}
    assert learned and learned <= {'p_hit', 'p_rand', 'p_lost', 'sigma'}
    assert set(report['changed_parameters']) == learned
    (warning,) = (w for w in report['warnings'] if w.startswith('learned'))
    assert f'p_hit {report["parameters"]["p_hit"]:.3f}' in warning
    assert 'learning' in report['seconds']


def test_help_lists_all_options(capsys: pytest.CaptureFixture[str]) -> None:
    assert code_of(process_bag.main, '--help') == 0
    text = capsys.readouterr().out
    for option in ('--range-topics', '--odom-topic', '--params', '--set', '--sensor', '--bag', '-o', '--learn'):
        assert option in text


def test_sensor_poses_that_contradict_the_readings_give_a_warning(tmp_path: Path) -> None:
    """Sensors rotated by 180 degrees, in the transforms of the bag and in options."""
    right, wrong = backwards_sensors()
    bag = write_tape(tmp_path / 'bag', wrong)
    report = mapped(bag, tmp_path / 'maps')
    expected = 'the sensors seem to be rotated by 180 degrees; check the poses of the sensors on the robot'
    assert sum(w.startswith(expected) for w in report['warnings']) == 1
    assert expected in ' '.join((tmp_path / 'maps' / 'report.txt').read_text('utf-8').split())
    for frame, pose in wrong.extrinsics:
        assert report['input']['extrinsics'][frame][:2] == pytest.approx(list(pose[:2]))
    given = [f'--sensor={frame}={p.x},{p.y},{p.yaw}' for frame, p in right]
    assert mapped(bag, tmp_path / 'right', *given)['warnings'] == []
