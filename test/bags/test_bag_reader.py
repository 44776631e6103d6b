"""Reading intact bags of all formats: messages, order, transforms, and paths."""

from __future__ import annotations

import math
import os
import shutil
import sqlite3
from pathlib import Path

import pytest
from bag_samples import (
    COUNT,
    EXTRINSICS,
    SECOND,
    START,
    SUFFIXES,
    range_of,
    sample_messages,
    storage_file,
    write_many_chunks,
    write_sample,
)
from rosbags import rosbag2
from rosbags.typesys import Stores, get_typestore

from forward_grid_mapper.bags.choice import Topics
from forward_grid_mapper.bags.reader import Bag
from forward_grid_mapper.bags.writer import BagWriter
from forward_grid_mapper.core.common.errors import BagError
from forward_grid_mapper.core.messages.message_types import OdometryMessage, Pose2, RangeMessage

ODOMETRY = OdometryMessage(START, 'odom', 'base_link', Pose2(0.0, 0.0, 0.0))
RANGE = RangeMessage(START, 'sonar_0', 1.0, 0.125, 5.0, 0.25)
KINDS = sorted(SUFFIXES)


def read_all(path: Path) -> tuple[list[object], Bag]:
    with Bag(path) as bag:
        messages = list(bag.messages(bag.choose_topics()))
        assert not bag.undecodable
    return messages, bag


@pytest.mark.parametrize('kind', KINDS)
def test_bag_is_read_back_in_order(tmp_path: Path, kind: str) -> None:
    path = write_sample(tmp_path, kind)
    messages, bag = read_all(path)
    assert messages == sample_messages()
    assert bag.truncated is None


@pytest.mark.parametrize('kind', KINDS)
def test_topics_and_static_transforms_are_read(tmp_path: Path, kind: str) -> None:
    with Bag(write_sample(tmp_path, kind, shared_topic=False)) as bag:
        assert bag.topics() == {
            '/odom': ('nav_msgs/msg/Odometry', COUNT),
            '/sonar_0': ('sensor_msgs/msg/Range', COUNT // 2),
            '/sonar_1': ('sensor_msgs/msg/Range', COUNT // 2),
            '/tf_static': ('tf2_msgs/msg/TFMessage', 1),
        }
        assert bag.choose_topics() == Topics(('/sonar_0', '/sonar_1'), '/odom')
        assert list(bag.messages(bag.choose_topics())) == sample_messages()
        transforms = bag.static_transforms()
        for parent, child, pose in EXTRINSICS:
            assert transforms.lookup(parent, child) == pytest.approx(pose)


@pytest.mark.parametrize('kind', ['mcap', 'sqlite3'])
@pytest.mark.parametrize('where', ['in its folder', 'alone', 'other suffix', 'odd name', 'folder without metadata'])
def test_file_of_a_bag_without_its_folder_is_read(tmp_path: Path, kind: str, where: str) -> None:
    bag = write_sample(tmp_path, kind)
    file = storage_file(bag)
    if where == 'alone':
        file = file.rename(tmp_path / file.name)
    elif where == 'other suffix':
        file = file.rename(tmp_path / 'recording.data')
    elif where == 'odd name':
        file = file.rename(tmp_path / f'50% of #1?{file.suffix}')
    elif where == 'folder without metadata':
        (bag / 'metadata.yaml').unlink()
        file = bag
    messages, read = read_all(file)
    assert messages == sample_messages()
    assert read.truncated is None


def test_path_of_the_metadata_reads_its_folder(tmp_path: Path) -> None:
    assert len(read_all(write_sample(tmp_path, 'mcap') / 'metadata.yaml')[0]) == 2 * COUNT


@pytest.mark.parametrize('kind', ['mcap', 'sqlite3'])
def test_split_bag_is_read_as_a_whole_or_by_file(tmp_path: Path, kind: str) -> None:
    first, second = (write_sample(tmp_path, kind, name=f'part_{i}') for i in (9, 10))
    whole = tmp_path / 'whole'
    whole.mkdir()
    names = [Path(shutil.copy(storage_file(p), whole)).name for p in (first, second)]
    with pytest.raises(BagError, match=r'several bag files.*part_9.*ros2 bag reindex'), Bag(whole):
        pass
    metadata = (first / 'metadata.yaml').read_text().replace(f'- {names[0]}\n', f'- {names[0]}\n  - {names[1]}\n', 1)
    (whole / 'metadata.yaml').write_text(metadata)
    # both files have the same times
    assert read_all(whole)[0] == [message for message in sample_messages() for _ in range(2)]
    assert read_all(whole / names[1])[0] == sample_messages()
    (whole / names[0]).unlink()
    messages, bag = read_all(whole)
    assert messages == sample_messages()
    assert 'part_9' in bag.truncated and 'is missing' in bag.truncated


@pytest.mark.parametrize('compression', ['file', 'message', 'storage'])
def test_compressed_mcap_is_read(tmp_path: Path, compression: str) -> None:
    bag = write_many_chunks(tmp_path, 'mcap', compression)
    expected = [m for m in sample_messages() if isinstance(m, RangeMessage)]
    for path in (bag, storage_file(bag)):
        with Bag(path) as opened:
            assert list(opened.messages(Topics(('/sonar',), ''))) == expected
    alone = storage_file(bag).rename(tmp_path / storage_file(bag).name)
    if compression == 'file':
        with pytest.raises(BagError, match='zstd -d'), Bag(alone):
            pass
        return
    # without metadata.yaml, nothing but the messages shows that they are compressed
    folder = tmp_path / 'without_metadata'
    folder.mkdir()
    shutil.copy(alone, folder)
    for path in (alone, folder):
        with Bag(path) as opened:
            assert list(opened.messages(Topics(('/sonar',), ''))) == expected
            assert not opened.undecodable


def test_messages_are_in_order_of_log_time(tmp_path: Path) -> None:
    for kind, path in (('mcap', tmp_path / 'a'), ('sqlite3', tmp_path / 'b'), ('ros1', tmp_path / 'c.bag')):
        with BagWriter(path, kind) as writer:
            for i in range(3):
                writer.write_range('sonar', RANGE._replace(stamp=START + i * SECOND))
            for i in range(3):
                writer.write_odometry('odom', ODOMETRY._replace(stamp=START + i * SECOND + 1))
        messages, _ = read_all(path)
        assert [type(m) for m in messages] == [RangeMessage, OdometryMessage] * 3


@pytest.mark.parametrize('distribution', ['HUMBLE', 'JAZZY'])
def test_sqlite3_without_definitions_is_read(tmp_path: Path, distribution: str) -> None:
    """Range got `variance` after Humble, and bags of Humble contain no message definitions."""
    store = get_typestore(getattr(Stores, f'ROS2_{distribution}'))
    message = RANGE._replace(variance=0.25 if distribution == 'JAZZY' else 0.0)
    with rosbag2.Writer(tmp_path / 'old', version=8, storage_plugin=rosbag2.StoragePlugin.SQLITE3) as writer:
        connection = writer.add_connection('/sonar', 'sensor_msgs/msg/Range', typestore=store)
        writer.write(connection, START, store.serialize_cdr(range_of(store, message), connection.msgtype))
    database = sqlite3.connect(tmp_path / 'old' / 'old.db3')
    database.executescript('DROP TABLE schema; DROP TABLE message_definitions; DROP TABLE metadata')
    database.close()
    with Bag(tmp_path / 'old') as bag:
        assert list(bag.messages(Topics(('/sonar',), ''))) == [message]
        assert not bag.undecodable


def test_messages_that_cannot_be_decoded_are_counted(tmp_path: Path) -> None:
    store = get_typestore(Stores.ROS2_JAZZY)
    good = store.serialize_cdr(range_of(store, RANGE), 'sensor_msgs/msg/Range')
    with rosbag2.Writer(tmp_path / 'bag', version=9, storage_plugin=rosbag2.StoragePlugin.MCAP) as writer:
        connection = writer.add_connection('/sonar', 'sensor_msgs/msg/Range', typestore=store)
        for i, data in enumerate((good, bytes(good)[:-3], b'', good, b'rubbish' * 9)):
            writer.write(connection, START + i, data)
    with Bag(tmp_path / 'bag') as bag:
        for _ in range(2):
            assert list(bag.messages(Topics(('/sonar',), ''))) == [RANGE, RANGE]
            assert bag.undecodable == {'/sonar': 3}
        assert bag.truncated is None


def test_closed_bag_raises(tmp_path: Path) -> None:
    bag = Bag(write_sample(tmp_path, 'mcap'))
    with bag:
        pass
    with pytest.raises(ValueError, match='not open'):
        bag.topics()


def test_progress_is_reported(tmp_path: Path) -> None:
    calls = []
    with Bag(write_sample(tmp_path, 'mcap', count=1100)) as bag:
        list(bag.messages(bag.choose_topics(), lambda *call: calls.append(call)))
    assert calls == [(1000, 2200), (2000, 2200), (2200, 2200)]


def test_progress_continues_in_all_files_of_a_split_bag(tmp_path: Path) -> None:
    whole = tmp_path / 'whole'
    whole.mkdir()
    names = []
    for number in range(2):
        with BagWriter(tmp_path / f'part_{number}') as writer:
            for message in sample_messages(1100):
                if isinstance(message, RangeMessage):
                    writer.write_range('/sonar', message._replace(stamp=message.stamp + number * 1000 * SECOND))
        names.append(Path(shutil.copy(storage_file(tmp_path / f'part_{number}'), whole)).name)
    listed = ''.join(f'    - {name}\n' for name in names)
    (whole / 'metadata.yaml').write_text(f'rosbag2_bagfile_information:\n  relative_file_paths:\n{listed}')
    calls = []
    with Bag(whole) as bag:
        list(bag.messages(Topics(('/sonar',), ''), lambda *call: calls.append(call)))
    assert calls == [(1000, 2200), (1100, 2200), (2100, 2200), (2200, 2200)]


def test_path_without_a_bag_is_rejected_with_reason(tmp_path: Path) -> None:
    (tmp_path / 'text.mcap').write_text('not a bag\n')
    (tmp_path / 'empty.db3').touch()
    (tmp_path / 'folder').mkdir()
    (tmp_path / 'maps').mkdir()
    (tmp_path / 'maps' / 'maps.npz').touch()
    os.mkfifo(tmp_path / 'pipe')
    for name, words in {
        'absent': 'does not exist',
        'text.mcap': 'is not a bag',
        'empty.db3': 'is empty',
        'folder': 'neither metadata.yaml nor',
        'maps': 'contains maps of process_bag',
        'pipe': 'neither a file nor a folder',
    }.items():
        with pytest.raises(BagError, match=words), Bag(tmp_path / name):
            pass


@pytest.mark.parametrize('kind', KINDS)
def test_bag_without_read_permission_is_rejected(tmp_path: Path, kind: str, monkeypatch: pytest.MonkeyPatch) -> None:
    file = storage_file(write_sample(tmp_path, kind))
    file.chmod(0)
    if os.access(file, os.R_OK):  # root reads everything

        def refuse(path: Path, *args: object, **options: object) -> None:
            raise PermissionError(13, 'Permission denied', str(path))

        monkeypatch.setattr(Path, 'open', refuse)
    with pytest.raises(BagError, match=r'No permission to read .*Change its mode'), Bag(file):
        pass


def test_messages_in_the_write_ahead_log_are_read(tmp_path: Path) -> None:
    """A recorder that is killed leaves messages there."""
    bag = write_sample(tmp_path, 'sqlite3')
    file, killed = storage_file(bag), tmp_path / 'killed.db3'
    database = sqlite3.connect(file)
    database.execute('PRAGMA journal_mode=WAL')
    database.execute('PRAGMA wal_autocheckpoint=0')
    database.execute("INSERT INTO topics SELECT 99, '/late', type, serialization_format, '', '' FROM topics WHERE id=2")
    database.execute('INSERT INTO messages SELECT NULL, 99, timestamp, data FROM messages WHERE topic_id=2')
    database.commit()
    shutil.copy(file, killed)
    shutil.copy(f'{file}-wal', f'{killed}-wal')
    database.close()
    with Bag(killed) as opened:
        assert opened.topics()['/late'][1] == COUNT


def test_bag_in_the_working_directory_is_reported_by_name(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    bag = write_sample(tmp_path, 'mcap', name='here')
    (bag / 'metadata.yaml').write_text('relative_file_paths:\n  - absent.mcap\n')
    monkeypatch.chdir(bag)
    with Bag(Path()) as read:
        assert read.truncated is not None and read.truncated.startswith('here is damaged or cut off (absent.mcap is')


def test_log_of_a_bag_in_a_read_only_folder_is_rejected(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """SQLite makes a file next to the log, which is not possible on a read-only disk."""
    bag = write_sample(tmp_path, 'sqlite3')
    file = storage_file(bag)
    file.with_name(f'{file.name}-wal').write_bytes(b'7' * 100)
    monkeypatch.setattr(os, 'access', lambda path, mode: mode != os.W_OK)
    with pytest.raises(BagError, match=r'messages in a log next to it, .*-wal, .* copy the bag to one, with all its'):
        read_all(bag)


@pytest.mark.parametrize('kind', KINDS)
def test_bag_is_read_from_a_path_with_any_bytes(tmp_path: Path, kind: str) -> None:
    folder = tmp_path / os.fsdecode(b'n\xff?# %')
    folder.mkdir()
    path = write_sample(tmp_path, kind)
    messages, _ = read_all(path.rename(folder / path.name))
    assert messages == sample_messages()


def test_slashes_of_frames_are_removed_and_bad_transforms_rejected(tmp_path: Path) -> None:
    store = get_typestore(Stores.ROS2_JAZZY)
    types = store.types
    stamp = types['builtin_interfaces/msg/Time'](0, 0)

    def message(parent: str, child: str, quaternion: tuple[float, ...]) -> object:
        vector = types['geometry_msgs/msg/Vector3'](1.0, 2.0, 3.0)
        transform = types['geometry_msgs/msg/Transform'](vector, types['geometry_msgs/msg/Quaternion'](*quaternion))
        header = types['std_msgs/msg/Header'](stamp, parent)
        stamped = types['geometry_msgs/msg/TransformStamped'](header, child, transform)
        return store.serialize_cdr(types['tf2_msgs/msg/TFMessage']([stamped]), 'tf2_msgs/msg/TFMessage')

    with rosbag2.Writer(tmp_path / 'bag', version=9) as writer:
        for topic, child in (('/tf_static', 'left'), ('/robot1/tf_static', '/right'), ('/tf', 'moving')):
            connection = writer.add_connection(topic, 'tf2_msgs/msg/TFMessage', typestore=store)
            writer.write(connection, START, message('base', child, (0.0, 0.0, 0.0, 1.0)))
            writer.write(connection, START, message('base', 'broken', (0.0, 0.0, 0.0, 0.0)))
    with Bag(tmp_path / 'bag') as bag:
        transforms = bag.static_transforms()
    assert transforms.frames == ['base', 'left', 'right']
    assert transforms.lookup('/base', 'right') == Pose2(1.0, 2.0, 0.0)
    assert 'broken' in transforms.rejected


def test_missing_pose_is_read_back_as_missing(tmp_path: Path) -> None:
    with BagWriter(tmp_path / 'bag') as writer:
        writer.write_odometry('/odom', ODOMETRY._replace(pose=None))
        writer.write_range('/sonar', RANGE._replace(range=math.inf, variance=0.5))
    messages, _ = read_all(tmp_path / 'bag')
    assert messages == [ODOMETRY._replace(pose=None), RANGE._replace(range=math.inf, variance=0.5)]


@pytest.mark.parametrize(('run', 'count', 'suffix'), [('office_a', 1591, '.mcap'), ('office_b', 815, '.db3')])
def test_real_recordings_are_read(shared: Path, run: str, count: int, suffix: str) -> None:
    folder = shared / 'data' / run / 'bag'
    for path in (folder, folder / f'bag{suffix}'):
        with Bag(path) as bag:
            with pytest.raises(BagError, match=r'/odom_corrected: \d+ messages, map → base_link'):
                bag.choose_topics()
            messages = list(bag.messages(bag.choose_topics(odom_topic='odom')))
            assert sum(isinstance(m, RangeMessage) for m in messages) == count
            assert all(m.pose for m in messages if isinstance(m, OdometryMessage))
            transforms = bag.static_transforms()
            assert bag.truncated is None and not bag.undecodable
        assert transforms.lookup('base_link', 'sonar_0') == pytest.approx((0.1, -0.195, -math.pi / 2))
        assert all(transforms.lookup('base_link', m.frame_id) for m in messages if isinstance(m, RangeMessage))
        assert transforms.lookup('base_link', 'laser') is None
