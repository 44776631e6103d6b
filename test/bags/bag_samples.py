"""Small bags for the tests of this folder."""

from __future__ import annotations

import math
from pathlib import Path

from rosbags import rosbag1, rosbag2
from rosbags.typesys import Stores, get_typestore

from forward_grid_mapper.bags.writer import BagWriter
from forward_grid_mapper.core.messages.message_types import OdometryMessage, Pose2, RangeMessage

SECOND = 1_000_000_000
START = 1_700_000_000 * SECOND
COUNT = 200
SUFFIXES = {'mcap': '.mcap', 'sqlite3': '.db3', 'ros1': '.bag'}
EXTRINSICS = [('base_link', 'sonar_0', Pose2(0.1, 0.2, 0.5)), ('base_link', 'sonar_1', Pose2(-0.1, 0.0, math.pi / 2))]


def sample_messages(count: int = COUNT) -> list[RangeMessage | OdometryMessage]:
    """Ranges of two sensors and odometry in turn; all numbers are exact in single precision."""
    made: list[RangeMessage | OdometryMessage] = []
    for i in range(count):
        stamp = START + i * SECOND // 10
        made.append(OdometryMessage(stamp, 'odom', 'base_link', Pose2(i / 8, -i / 16, 0.0)))
        distance = math.inf if i % 5 == 0 else 1.0 + i / 64
        made.append(RangeMessage(stamp + 1000, f'sonar_{i % 2}', distance, 0.125, 5.0, 0.25, 0.0))
    return made


def write_sample(folder: Path, kind: str, *, shared_topic: bool = True, count: int = COUNT, name: str = 'bag') -> Path:
    """Write a bag of this format; return its path."""
    path = folder / (f'{name}.bag' if kind == 'ros1' else name)
    with BagWriter(path, kind) as writer:
        writer.write_static_transforms(EXTRINSICS, START)
        for message in sample_messages(count):
            if isinstance(message, RangeMessage):
                writer.write_range('/sonar' if shared_topic else f'/{message.frame_id}', message)
            else:
                writer.write_odometry('/odom', message)
    return path


def storage_file(bag: Path) -> Path:
    """The file in a bag folder that is not the metadata; for a ROS 1 bag, the bag itself."""
    return bag if bag.is_file() else next(p for p in bag.iterdir() if p.name != 'metadata.yaml')


def write_many_chunks(folder: Path, kind: str, compression: str | None = None) -> Path:
    """Write a bag with a few messages in each chunk."""
    name = f'chunks_{kind}_{compression}'
    if kind == 'ros1':
        store, path = get_typestore(Stores.ROS1_NOETIC), folder / f'{name}.bag'
        writer1 = rosbag1.Writer(path)
        if compression:
            writer1.set_compression(rosbag1.Writer.CompressionFormat[compression.upper()])
        writer1.chunk_threshold = 1000
        with writer1:
            connection = writer1.add_connection('/sonar', 'sensor_msgs/msg/Range', typestore=store)
            for message in sample_messages():
                if isinstance(message, RangeMessage):
                    raw = store.serialize_ros1(range_of(store, message, seq=0), connection.msgtype)
                    writer1.write(connection, message.stamp, raw)
        return path
    store, path = get_typestore(Stores.ROS2_JAZZY), folder / name
    writer = rosbag2.Writer(path, version=9, storage_plugin=rosbag2.StoragePlugin.MCAP)
    if compression:
        writer.set_compression(rosbag2.CompressionMode[compression.upper()], rosbag2.CompressionFormat.ZSTD)
    with writer:
        connection = writer.add_connection('/sonar', 'sensor_msgs/msg/Range', typestore=store)
        for i, message in enumerate(m for m in sample_messages() if isinstance(m, RangeMessage)):
            writer.write(connection, message.stamp, store.serialize_cdr(range_of(store, message), connection.msgtype))
            if i % 10 == 9 and i < COUNT - 1:
                writer.storage.close_chunk()
    return path


def range_of(store: object, message: RangeMessage, **header: int) -> object:
    """A `sensor_msgs/Range` of a rosbags type store."""
    types = store.types
    stamp = types['builtin_interfaces/msg/Time'](message.stamp // SECOND, message.stamp % SECOND)
    kind = types['sensor_msgs/msg/Range']
    variance = {'variance': message.variance} if 'variance' in kind.__dataclass_fields__ else {}
    return kind(
        header=types['std_msgs/msg/Header'](stamp=stamp, frame_id=message.frame_id, **header),
        radiation_type=0,
        field_of_view=message.field_of_view,
        min_range=message.min_range,
        max_range=message.max_range,
        range=message.range,
        **variance,
    )
