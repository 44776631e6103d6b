"""Wrong drives and options: an error that names the problem and the remedy, or a map with a warning."""

from __future__ import annotations

import math
import os
import random
import re
from pathlib import Path
from typing import Any

import pytest
from drive_samples import (
    SECOND,
    Message,
    Tape,
    assert_same_maps,
    code_of,
    error_of,
    in_turn,
    mapped,
    report_in,
    tape,
    write_tape,
)
from rosbags.highlevel import AnyReader

from forward_grid_mapper.bags.reader import Bag
from forward_grid_mapper.bags.writer import BagWriter
from forward_grid_mapper.commands import process_bag
from forward_grid_mapper.core.common.errors import BagError
from forward_grid_mapper.core.common.parameters import Parameters
from forward_grid_mapper.core.common.readings import in_canonical_order
from forward_grid_mapper.core.messages.message_types import NANOSECONDS, Pose2
from forward_grid_mapper.files import drawing
from forward_grid_mapper.recordings.read_drive import read_drive

FRAMES = [frame for frame, _ in tape().extrinsics]
COUNT = len(tape().ranges)


@pytest.fixture(autouse=True)
def no_picture(monkeypatch: pytest.MonkeyPatch) -> None:
    """Do not draw: it takes most of the time of a run and is not needed here."""
    monkeypatch.setattr(drawing, 'draw', lambda path, picture: None)


@pytest.fixture(scope='module')
def plain(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A correct bag of the drive, `bag`, and its results, `maps`."""
    folder = tmp_path_factory.mktemp('plain')
    write_tape(folder / 'bag', tape())
    mapped(folder / 'bag', folder / 'maps')
    return folder


def every(step: int, **changes: Any) -> Tape:
    """The drive with every `step`-th Range changed."""
    return tape()._replace(ranges=[m._replace(**changes) if k % step == 0 else m for k, m in enumerate(tape().ranges)])


def error_of_drive(capsys: pytest.CaptureFixture[str], folder: Path, drive: Tape, *options: object) -> str:
    """The error message for a bag of this drive."""
    bag = write_tape(folder / 'bag', drive)
    return error_of(capsys, folder, bag, '-o', folder / 'maps', *options)


# ---- units


def in_units(ranges: float, limits: float) -> Tape:
    """The drive with ranges and max_range that are this many times as large."""
    return tape()._replace(
        ranges=[m._replace(range=m.range * ranges, max_range=m.max_range * limits) for m in tape().ranges]
    )


@pytest.mark.parametrize(
    ('by', 'expected'),
    [((100, 100), 'are ranges and limits in centimetres'), ((1, 100), 'is it in centimetres')],
    ids=['all in centimetres', 'limits in centimetres'],
)
def test_ranges_that_no_sonar_measures_are_an_error_and_not_a_huge_map(
    tmp_path: Path, capsys: pytest.CaptureFixture[str], by: tuple[float, float], expected: str
) -> None:
    error = error_of_drive(capsys, tmp_path, in_units(*by))
    assert expected in error and 'set the parameter max_range' in error


def test_drive_with_limits_in_centimetres_is_mapped_once_max_range_is_set(tmp_path: Path) -> None:
    bag = write_tape(tmp_path / 'bag', in_units(1, 100))
    report = mapped(bag, tmp_path / 'maps', '-q', '--set', 'max_range=5.0')
    assert report['counts']['accepted'] == COUNT


def test_no_limit_is_a_warning(tmp_path: Path) -> None:
    drive = tape()._replace(ranges=[m._replace(max_range=3.4e38) for m in tape().ranges])
    (warning,) = mapped(write_tape(tmp_path / 'bag', drive), tmp_path / 'maps', '-q')['warnings']
    assert 'does the driver state no limit' in warning


# ---- bags


def test_folder_that_contains_a_bag_is_rejected_with_its_path(plain: Path) -> None:
    with pytest.raises(BagError, match=r'is not a bag.* There is one in it: ') as caught, Bag(plain):
        pass
    assert str(plain / 'bag') in str(caught.value)


def test_folder_with_a_folder_of_bags_is_rejected_with_its_path(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    write_tape(tmp_path / 'campus' / 'drives' / 'first', tape())
    error = error_of(capsys, tmp_path, tmp_path / 'campus', '-o', tmp_path / 'maps')
    assert f'There are bags in {tmp_path / "campus" / "drives"}' in error


def test_absent_bag_is_rejected(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    error = error_of(capsys, tmp_path, tmp_path / 'absent', '-o', tmp_path / 'maps')
    assert str(tmp_path / 'absent') in error and 'does not exist' in error and 'Give a bag' in error


def test_file_that_is_no_bag_is_rejected(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    (tmp_path / 'text.bag').write_text('no bag')
    (tmp_path / 'empty.mcap').write_text('')
    (tmp_path / 'folder').mkdir()
    for name, expected in (('text.bag', 'neither an MCAP'), ('empty.mcap', '0 bytes'), ('folder', 'is not a bag')):
        error = error_of(capsys, tmp_path, tmp_path / name, '-o', tmp_path / 'maps')
        assert str(tmp_path / name) in error and expected in error


@pytest.mark.parametrize('kind', ['mcap', 'sqlite3', 'ros1'])
def test_intact_part_of_a_truncated_bag_is_mapped(
    tmp_path: Path, kind: str, capsys: pytest.CaptureFixture[str]
) -> None:
    bag = write_tape(tmp_path / 'cut.bag', tape(), kind)
    file = bag if bag.is_file() else next(p for p in bag.iterdir() if p.name != 'metadata.yaml')
    content = file.read_bytes()
    file.write_bytes(content[: len(content) * 6 // 10])
    report = mapped(bag, tmp_path / 'maps', '-q')
    assert 0.2 * COUNT < report['counts']['accepted'] < 0.8 * COUNT
    (warning,) = (w for w in report['warnings'] if 'cut off' in w)
    assert 'the intact part was read' in warning and 'repair it with' in warning
    assert f'process_bag: warning: {warning}' in capsys.readouterr().err
    assert 'WARNINGS' in (tmp_path / 'maps' / 'report.txt').read_text('utf-8')


@pytest.mark.parametrize('inside', [False, True])
def test_pipe_is_rejected_at_once(tmp_path: Path, capsys: pytest.CaptureFixture[str], inside: bool) -> None:
    pipe = tmp_path / 'drive.mcap'
    if inside:
        pipe = next(write_tape(tmp_path / 'bag', tape()).glob('*.mcap'))
        pipe.unlink()
    os.mkfifo(pipe)
    error = error_of(capsys, tmp_path, pipe.parent if inside else pipe, '-o', tmp_path / 'maps')
    assert str(pipe) in error and 'ive a bag folder' in error


def test_bag_without_any_intact_message_is_rejected(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    file = next(write_tape(tmp_path / 'bag', tape()).glob('*.mcap'))
    file.write_bytes(file.read_bytes()[:100])
    error = error_of(capsys, tmp_path, file, '-o', tmp_path / 'maps')
    assert 'cut off' in error and 'mcap recover' in error


def test_bag_without_ranges_is_rejected(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    error = error_of_drive(capsys, tmp_path, tape()._replace(ranges=[]))
    assert 'no sensor_msgs/Range' in error and 'LaserScan, PointCloud and other types are not read' in error
    assert '/odom: ' in error and '/tf_static: ' in error


def test_static_transforms_are_not_offered_as_odometry(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    bag = write_tape(tmp_path / 'bag', tape())
    error = error_of(capsys, tmp_path, bag, '-o', tmp_path / 'maps', '--odom-topic', '/nowhere')
    assert "no topic '/nowhere'" in error and '/odom' in error and '/tf_static' not in error


def test_bag_without_odometry_is_rejected(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    error = error_of_drive(capsys, tmp_path, tape()._replace(odometry=[]))
    assert 'no nav_msgs/Odometry' in error
    assert f'/sonar: {COUNT} sensor_msgs/msg/Range' in error


def test_several_odometry_topics_require_a_choice(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    odometry = [m._replace(frame_id=frame) for m in tape().odometry for frame in ('map', 'odom')]
    bag = write_tape(
        tmp_path / 'bag', tape()._replace(odometry=odometry), odometry_topic=lambda m: f'/{m.frame_id}/pose'
    )
    error = error_of(capsys, tmp_path, bag, '-o', tmp_path / 'maps')
    assert '--odom-topic' in error
    for frame in ('map', 'odom'):
        assert f'/{frame}/pose: {len(odometry) // 2} messages, {frame} → base_link' in error


@pytest.mark.parametrize(
    ('options', 'expected'),
    [
        (['--odom-topic', '/odum'], "no topic '/odum'.*--odom-topic.*: /odom"),
        (['--odom-topic', '/sonar'], '/sonar.*has the type sensor_msgs/msg/Range.*: /odom'),
        (['--range-topics', '/sonar', '/sonor'], "no topic '/sonor'.*--range-topics.*: /sonar"),
        (['--range-topics', '/odom'], '/odom.*has the type nav_msgs/msg/Odometry.*: /sonar'),
    ],
)
def test_unknown_topic_is_rejected_with_those_that_exist(
    tmp_path: Path, plain: Path, capsys: pytest.CaptureFixture[str], options: list[str], expected: str
) -> None:
    error = error_of(capsys, tmp_path, plain / 'bag', '-o', tmp_path / 'maps', *options)
    assert re.search(expected, error), error


# ---- poses


def test_drive_without_any_sensor_pose_is_rejected(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    error = error_of_drive(capsys, tmp_path, tape()._replace(extrinsics=()))
    assert all(frame in error for frame in FRAMES)
    assert (
        'no /tf_static' in error and f'--sensor {FRAMES[0]}=x,y,yaw' in error and f'sensors.{FRAMES[0]}.pose' in error
    )
    assert 'of a split bag the first file has it, so give the whole folder' in error


def test_drive_whose_sensor_poses_are_in_a_missing_file_names_that_file(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    bag = tmp_path / 'bag'
    write_tape(bag, tape()._replace(extrinsics=()))
    metadata = bag / 'metadata.yaml'
    metadata.write_text(metadata.read_text().replace('- bag.mcap', '- bag_0.mcap\n  - bag.mcap', 1))
    error = error_of(capsys, tmp_path, bag, '-o', tmp_path / 'maps')
    assert 'no /tf_static' in error and 'bag_0.mcap is missing' in error


def test_drive_without_sensor_poses_that_ends_with_ranges_is_rejected(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    newest = max(message.stamp for message in tape().ranges)
    odometry = [message for message in tape().odometry if message.stamp < newest - 10**8]
    error = error_of_drive(capsys, tmp_path, tape()._replace(extrinsics=(), odometry=odometry))
    assert error.startswith('no pose on the robot (frame ') and f'--sensor {FRAMES[0]}=x,y,yaw' in error


def test_drive_without_sensor_poses_and_with_bad_ranges_is_rejected(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    drive = tape()._replace(extrinsics=())
    first = drive.ranges[0]._replace(range=math.nan)
    error = error_of_drive(capsys, tmp_path, drive._replace(ranges=[first, *drive.ranges[1:]]))
    assert 'nan_range' in error and all(frame in error for frame in FRAMES)
    assert 'no /tf_static' in error and f'--sensor {FRAMES[0]}=x,y,yaw' in error


def test_frame_with_control_characters_is_rejected_and_escaped(tmp_path: Path) -> None:
    drive = tape()
    bad = drive.ranges[0]._replace(frame_id='a\n\x1b[31mX')
    mapped(write_tape(tmp_path / 'bag', drive._replace(ranges=[bad, *drive.ranges[1:]])), tmp_path / 'maps')
    text = (tmp_path / 'maps' / 'report.txt').read_text()
    assert 'unprintable_frame_id (a\\n\\x1b[31mX 1)' in text
    assert '\x1b' not in text


def test_transforms_not_connected_to_the_base_are_rejected(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    error = error_of_drive(capsys, tmp_path, tape().with_odometry(child_frame_id='base_footprint'))
    assert 'base_footprint' in error and 'base_link' in error and '--sensor' in error
    assert 'do not join it to base_link: publish that transform, or have odometry name base_link' in error


def test_frames_with_another_prefix_are_named_in_the_error(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    drive = tape().with_odometry(child_frame_id='robot1/base_link')
    error = error_of_drive(capsys, tmp_path, drive)
    assert 'The transforms have base_link, not robot1/base_link: set the same prefix' in error
    ranges = [m._replace(frame_id=f'robot1/{m.frame_id}') for m in drive.ranges]
    (tmp_path / 'all').mkdir()
    error = error_of_drive(capsys, tmp_path / 'all', drive._replace(ranges=ranges))
    assert (
        f'base_link, not robot1/base_link; {FRAMES[0]}, not robot1/{FRAMES[0]}' in error and 'and 6 more: set' in error
    )


def test_odometry_without_child_frame_is_rejected(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    error = error_of_drive(capsys, tmp_path, tape().with_odometry(child_frame_id=''))
    assert 'odometry has no child_frame_id' in error and '--sensor' in error


def test_stamps_of_zero_are_rejected_with_a_remedy(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    error = error_of_drive(capsys, tmp_path, tape().with_ranges(stamp=0))
    assert f'{COUNT} zero_stamp (header.stamp is 0: set it in the driver)' in error
    # also if a part is mapped
    drive = tape()
    error = error_of_drive(capsys, tmp_path / 'part', drive.with_ranges(stamp=0), '--duration', 1)
    assert 'in the part --start 0 --duration 1: header.stamp of all readings is 0: set it in the driver' in error
    span = (drive.odometry[-1].stamp - drive.odometry[0].stamp) / NANOSECONDS
    assert error.strip().endswith(f'its messages span {span:.1f} s')


def test_only_readings_of_a_sensor_without_pose_are_rejected(tmp_path: Path) -> None:
    bag = write_tape(tmp_path / 'bag', tape()._replace(extrinsics=tape().extrinsics[1:]))
    report = mapped(bag, tmp_path / 'maps')
    assert report['counts']['rejected'] == {'unknown_extrinsics': COUNT // len(FRAMES)}
    assert report['input']['rejected_by_frame'] == {FRAMES[0]: {'unknown_extrinsics': COUNT // len(FRAMES)}}
    assert f'unknown_extrinsics ({FRAMES[0]} {COUNT // len(FRAMES)})' in (tmp_path / 'maps' / 'report.txt').read_text()
    (warning,) = report['warnings']
    assert f'--sensor {FRAMES[0]}=x,y,yaw' in warning and FRAMES[1] not in warning.partition(':')[0]
    write_tape(tmp_path / 'rest', tape().of(*FRAMES[1:]))
    mapped(tmp_path / 'rest', tmp_path / 'rest_maps')
    assert_same_maps(tmp_path / 'maps', tmp_path / 'rest_maps')


class Unnormalised(BagWriter):
    """Writes odometry with quaternions of length 2."""

    def write_odometry(self, *arguments: Any, **options: Any) -> None:
        """Write a pose with a quaternion that is too long."""
        self._longer = 2.0
        super().write_odometry(*arguments, **options)
        self._longer = 1.0

    def _pose(self, pose: Pose2) -> Any:
        made = super()._pose(pose)
        made.orientation.z *= getattr(self, '_longer', 1.0)
        made.orientation.w *= getattr(self, '_longer', 1.0)
        return made


def test_quaternions_of_wrong_length_are_rejected(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    bag = write_tape(tmp_path / 'bag', tape(), writer=Unnormalised)
    error = error_of(capsys, tmp_path, bag, '-o', tmp_path / 'maps')
    assert f'all {COUNT} readings were rejected' in error
    assert f'{len(tape().odometry)} odometry messages' in error and 'quaternion is not normalised' in error
    assert 'cos(yaw/2)' in error and 'clocks' not in error


def test_odometry_without_pose_gives_a_warning(tmp_path: Path) -> None:
    odometry = [m._replace(pose=None) if k % 4 == 0 else m for k, m in enumerate(tape().odometry)]
    report = mapped(write_tape(tmp_path / 'bag', tape()._replace(odometry=odometry)), tmp_path / 'maps')
    assert report['counts']['accepted'] > 0.9 * COUNT
    bad = sum(m.pose is None for m in odometry)
    assert report['counts']['odometry_rejected'] == {'bad_pose': bad}
    assert any(f'{bad} of {len(odometry)} odometry' in w and 'quaternion' in w for w in report['warnings'])


def test_odometry_of_two_robots_on_one_topic_gives_a_warning(tmp_path: Path) -> None:
    odometry = [m._replace(child_frame_id=child) for m in tape().odometry for child in ('base_link', 'other')]
    report = mapped(write_tape(tmp_path / 'bag', tape()._replace(odometry=odometry)), tmp_path / 'maps')
    assert report['counts']['rejected'] == {}
    assert any('child_frame_id' in w for w in report['warnings'])


def test_leading_slash_of_frames_is_ignored(tmp_path: Path, plain: Path) -> None:
    drive = tape().with_odometry(frame_id='/odom', child_frame_id='/base_link')
    drive = drive._replace(ranges=[m._replace(frame_id=f'/{m.frame_id}') for m in drive.ranges])
    bag = write_tape(tmp_path / 'ros1.bag', drive, 'ros1')
    report = mapped(bag, tmp_path / 'maps', '--bag')
    assert report['counts']['accepted'] == COUNT
    assert_same_maps(tmp_path / 'maps', plain / 'maps')
    with AnyReader([tmp_path / 'maps' / 'maps.mcap_bag']) as reader:
        frames = {reader.deserialize(data, c.msgtype).header.frame_id for c, _, data in reader.messages()}
    assert frames == {'odom'}, 'tf2 refuses a leading slash'


# ---- stamps


def test_ranges_and_odometry_that_do_not_overlap_are_rejected(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    hour = 3600 * SECOND
    for name, shift in (('early', -hour), ('late', hour)):
        odometry = [m._replace(stamp=m.stamp + shift) for m in tape().odometry]
        bag = write_tape(tmp_path / name, tape()._replace(odometry=odometry))
        error = error_of(capsys, tmp_path, bag, '-o', tmp_path / 'maps')
        assert 'do not overlap' in error and 'clock' in error
        assert f'{tape().ranges[0].stamp / 1e9:.3f}' in error and f'{odometry[0].stamp / 1e9:.3f}' in error


def test_odometry_that_ends_early_and_has_a_gap_gives_warnings(tmp_path: Path) -> None:
    start = tape().odometry[0].stamp
    odometry = [m for m in tape().odometry if m.stamp < start + 10 * SECOND]
    odometry = [m for m in odometry if not start + 3 * SECOND < m.stamp < start + 6 * SECOND]
    report = mapped(write_tape(tmp_path / 'bag', tape()._replace(odometry=odometry)), tmp_path / 'maps')
    assert set(report['counts']['rejected']) == {'after_odometry', 'pose_gap'}
    assert any('after_odometry' in w and 'odometry reached' in w for w in report['warnings'])


def shuffled(of: type[Message] | tuple[type[Message], ...]) -> list[tuple[int, Message]]:
    """The messages; each of these types is logged up to a second late, at random."""
    generator = random.Random(1)
    late = [(time + (generator.randrange(SECOND) if isinstance(m, of) else 0), m) for time, m in in_turn(turning())]
    return sorted(late, key=lambda item: item[0])


def turning() -> Tape:
    """The drive with a robot that turns to and fro, so that a pose from wrong messages is detected."""
    start = tape().odometry[0].stamp
    return tape()._replace(
        odometry=[
            m._replace(pose=m.pose._replace(yaw=math.sin(5e-9 * (m.stamp - start)))) for m in tape().odometry if m.pose
        ]
    )


RANGE, ODOMETRY = type(tape().ranges[0]), type(tape().odometry[0])


@pytest.mark.parametrize(
    'late',
    [
        RANGE,
        ODOMETRY,
    ],
)
def test_readings_do_not_depend_on_the_order_of_logging(tmp_path: Path, late: type[Message]) -> None:
    readings = []
    for name, logged in (('in_turn', in_turn(turning())), ('shuffled', shuffled(late))):
        bag = write_tape(tmp_path / name, turning(), logged=logged)
        drive = read_drive(bag, Parameters(), {})
        assert not drive.source['warnings']
        readings.append(in_canonical_order(drive.associator.readings))
    assert len(readings[0]) == len(readings[1]) == COUNT
    for column in ('stamp', 'x', 'y', 'yaw', 'z'):
        assert getattr(readings[0], column).tolist() == getattr(readings[1], column).tolist(), column


# ---- ranges


@pytest.mark.parametrize('angle', [0.0, -0.25, math.nan, 4.0])
def test_impossible_field_of_view_is_rejected_with_a_remedy(
    tmp_path: Path, capsys: pytest.CaptureFixture[str], angle: float
) -> None:
    drive = tape().with_ranges(field_of_view=angle)
    error = error_of_drive(capsys, tmp_path, drive)
    assert f'{COUNT} bad_field_of_view' in error and 'set the parameter field_of_view to the full angle' in error
    right = tape().ranges[0].field_of_view
    report = mapped(tmp_path / 'bag', tmp_path / 'maps', '--set', f'field_of_view={right!r}')
    assert report['counts']['accepted'] == COUNT


@pytest.mark.parametrize(
    ('changes', 'reason', 'words'),
    [
        ({'range': math.nan}, 'nan_range', 'not a number; a driver should send +inf if there is no echo'),
        ({'range': -math.inf}, 'too_near', '-inf'),
        ({'range': 0.0}, 'below_min_range', 'set the parameter invalid_range to no_echo'),
        ({'range': 0.0, 'min_range': 0.0}, 'too_near', 'a driver should send +inf if there is no echo'),
        ({'max_range': math.inf}, 'bad_limits', 'not finite'),
        ({'max_range': 0.0}, 'bad_limits', 'max_range'),
        ({'min_range': -1.0}, 'bad_limits', 'negative'),
        ({'min_range': 6.0}, 'bad_limits', 'max_range is not above min_range'),
        ({'frame_id': ''}, 'empty_frame_id', 'no frame_id'),
    ],
)
def test_impossible_ranges_are_rejected_with_reason(
    tmp_path: Path, capsys: pytest.CaptureFixture[str], changes: dict[str, Any], reason: str, words: str
) -> None:
    error = error_of_drive(capsys, tmp_path, tape().with_ranges(**changes))
    assert f'all {COUNT} readings were rejected' in error and reason in error and words in error
    some = every(3, **changes)
    bad = sum(all(getattr(m, k) is v or getattr(m, k) == v for k, v in changes.items()) for m in some.ranges)
    report = mapped(write_tape(tmp_path / 'some', some), tmp_path / 'maps')
    assert report['counts']['rejected'] == {reason: bad}
    (warning,) = report['warnings']
    assert reason in warning and words in warning


def test_drive_without_echoes_gives_a_map_without_walls(tmp_path: Path) -> None:
    bag = write_tape(tmp_path / 'bag', tape().with_ranges(range=math.inf))
    report = mapped(bag, tmp_path / 'maps')
    assert report['counts']['accepted'] == COUNT
    assert report['map']['occupied_cells'] == 0 < report['map']['free_cells']
    assert sum(s['no_echo'] for s in report['sensors'].values()) == COUNT
    assert all(0 < k for k in (report['map']['width'], report['map']['height']))


def test_drive_without_echoes_that_are_discarded_is_rejected(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    error = error_of_drive(capsys, tmp_path, tape().with_ranges(range=math.inf), '--set', 'over_range=discard')
    assert 'over_range' in error and 'discard' in error


def test_most_frequent_reason_comes_first(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    drive = tape().with_ranges(range=math.nan)
    drive = drive._replace(ranges=[m._replace(frame_id='') if k % 4 else m for k, m in enumerate(drive.ranges)])
    error = error_of_drive(capsys, tmp_path, drive)
    assert error.index('empty_frame_id') < error.index('nan_range'), 'the most frequent comes first'


def test_pose_at_ten_million_metres_is_rejected(tmp_path: Path) -> None:
    odometry = [m._replace(pose=Pose2(1e7, 0.0, 0.0)) if k > 900 else m for k, m in enumerate(tape().odometry)]
    report = mapped(write_tape(tmp_path / 'bag', tape()._replace(odometry=odometry)), tmp_path / 'maps')
    # a reading with the stamp of the jump has no reliable pose
    assert set(report['counts']['rejected']) == {'far_from_map', 'pose_jump'}
    assert report['counts']['rejected']['pose_jump'] <= len(FRAMES)
    assert report['map']['width'] < 1000


# ---- parameters and options


@pytest.mark.parametrize(
    ('options', 'expected'),
    [
        (['--set', 'p_hit=2'], ['p_hit', '2.0', 'out of range', '…']),
        (['--set', 'p_hit=nan'], ['p_hit', 'out of range']),
        (['--set', 'phit=0.5'], ["'phit'", 'did you mean p_hit']),
        (['--set', 'p_hit=high'], ['p_hit', "'high' is not a number"]),
        (['--set', 'max_iterations=2.5'], ['max_iterations', 'whole number']),
        (['--set', 'online=maybe'], ['online', 'true or false']),
        (['--set', 'over_range=ignore'], ['over_range', 'no_echo, discard']),
        (['--set', 'p_hit'], ["'p_hit'", 'name=value']),
        (['--set', 'sensors.sonar_00.pose=[0.1, 0.0, 0.0]'], ['pose of a sensor', '--sensor sonar_00=x,y,yaw']),
        (['--sensor', 'sonar_00=1,2'], ["'sonar_00=1,2'", 'frame=x,y,yaw']),
        (['--sensor', 'sonar_00=1,2,nan'], ['sonar_00=1,2,nan', 'frame=x,y,yaw']),
        (['--learn', '-1'], ['--learn', 'negative']),
    ],
)
def test_impossible_option_is_rejected_with_reason(
    tmp_path: Path, plain: Path, capsys: pytest.CaptureFixture[str], options: list[str], expected: list[str]
) -> None:
    error = error_of(capsys, tmp_path, plain / 'bag', '-o', tmp_path / 'maps', *options)
    assert all(word in error for word in expected), error
    assert '\n' not in error


@pytest.mark.parametrize(
    ('options', 'expected'),
    [
        (['--learn', 'much'], '--learn'),
        (['--sett', 'p_hit=0.5', '--unknown'], 'unrecognized arguments'),
        (['--refine_poses'], 'unrecognized arguments: --refine_poses; did you mean --refine-poses?'),
        (['--params'], '--params'),
        (['--range-topics', ''], 'argument --range-topics: the name of a topic is expected'),
        (['--range-topics', ','], 'argument --range-topics: the name of a topic is expected'),
    ],
)
def test_wrong_command_line_is_rejected_with_exit_code_2(
    tmp_path: Path, plain: Path, capsys: pytest.CaptureFixture[str], options: list[str], expected: str
) -> None:
    assert expected in error_of(capsys, tmp_path, plain / 'bag', *options, code=2)


def test_missing_bag_is_rejected_with_exit_code_2(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    assert 'bag' in error_of(capsys, tmp_path, code=2)


@pytest.mark.parametrize(
    ('text', 'expected'),
    [
        ('p_hit: 2', ['p_hit', 'out of range']),
        ('p_hit: high', ['p_hit', "'high' is not a number"]),
        ('online: 1', ['online', 'true or false']),
        ('phit: 0.5', ['phit', 'did you mean p_hit']),
        ('p_hit: 0.5\np_hit: 0.6', ['p_hit', 'twice']),
        ('sensors: {front: {pose: [1, 2]}}', ['sensors.front.pose', '[x, y, yaw]']),
        ('other: {ros__parameters: {}}\nanother: {ros__parameters: {}}', ['forward_grid_mapper', 'other, another']),
        ('- p_hit', ['names with values']),
        ('{p_hit: [', ['not valid YAML']),
        ('p_hit: \x00', ['not valid YAML']),
    ],
)
def test_bad_parameter_file_is_rejected_with_reason(
    tmp_path: Path, plain: Path, capsys: pytest.CaptureFixture[str], text: str, expected: list[str]
) -> None:
    file = tmp_path / 'p.yaml'
    file.write_text(text)
    error = error_of(capsys, tmp_path, plain / 'bag', '-o', tmp_path / 'maps', '--params', file)
    assert str(file) in error
    assert all(word in error for word in expected), error


def test_path_that_is_no_parameter_file_is_rejected(
    tmp_path: Path, plain: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    picture = plain / 'maps' / 'maps.png'
    for path, expected in (
        (tmp_path / 'absent.yaml', 'cannot be read: No such file'),
        (tmp_path, 'cannot be read: Is a directory'),
        (picture, 'not text in UTF-8'),
    ):
        error = error_of(capsys, tmp_path, plain / 'bag', '-o', tmp_path / 'maps', '--params', path)
        assert str(path) in error and expected in error


def test_bad_setting_is_rejected_with_a_good_parameter_file(
    tmp_path: Path, plain: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    (tmp_path / 'p.yaml').write_text('')
    options = ('--params', tmp_path / 'p.yaml', '--set', 'p_rand=-1')
    assert 'p_rand' in error_of(capsys, tmp_path, plain / 'bag', '-o', tmp_path / 'maps', *options)
    assert code_of(process_bag.main, plain / 'bag', '-q', '-o', tmp_path / 'maps', *options[:2]) == 0
    assert report_in(tmp_path / 'maps')['changed_parameters'] == {}
