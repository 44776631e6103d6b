"""Messages decoded in batches are bit-identical to those of rosbags, in all formats and mixtures."""

from __future__ import annotations

import math
import random
import struct
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from bag_samples import COUNT, START, range_of, sample_messages, write_many_chunks, write_sample
from rosbags import rosbag2
from rosbags.typesys import Stores, get_typestore

from forward_grid_mapper.bags import columns
from forward_grid_mapper.bags.choice import RANGE
from forward_grid_mapper.bags.columns import Columns
from forward_grid_mapper.bags.decoder import Decoder, default_stores
from forward_grid_mapper.bags.layouts import Layout
from forward_grid_mapper.bags.mcap_chunks import indexed_messages
from forward_grid_mapper.bags.poses import ODOMETRY, POSE, POSE_WITH_COVARIANCE, POSES
from forward_grid_mapper.bags.reader import _CONVERSIONS, Bag
from forward_grid_mapper.core.messages.message_batch import MessageBatch, batch_of, joined
from forward_grid_mapper.core.messages.message_types import RangeMessage

NAMES = ('a', 'sonar_1', 'sonar_2', 'sonar_12', 'ü', '')
TF = 'tf2_msgs/msg/TFMessage'


class RandomMessages:
    """Random serialized messages in one of the encodings."""

    def __init__(self, encoding: str, seed: int = 0) -> None:
        self.rng = random.Random(seed)
        self.encoding = encoding
        self.store = default_stores(ros1=encoding == 'ros1')[0]

    def type(self, name: str) -> Any:
        return self.store.types[name]

    def header(self, name: str) -> Any:
        seq = {'seq': 7} if self.encoding == 'ros1' else {}
        stamp = self.type('builtin_interfaces/msg/Time')(self.rng.randrange(2**31), self.rng.randrange(10**9))
        return self.type('std_msgs/msg/Header')(stamp=stamp, frame_id=name, **seq)

    def number(self) -> float:
        return self.rng.choice([self.rng.gauss(0, 3), self.rng.gauss(0, 3), math.inf, -math.inf, math.nan, 1e300])

    def single(self) -> float:
        return float(np.float32(self.rng.gauss(0, 3)))

    def range(self) -> Any:
        seq = {'seq': 7} if self.encoding == 'ros1' else {}
        message = range_of(self.store, sample_messages(1)[1], **seq)
        message.header = self.header(self.rng.choice(NAMES))
        for name in ('range', 'min_range', 'max_range', 'field_of_view', 'variance'):
            if hasattr(message, name):
                setattr(message, name, self.rng.choice([self.single(), math.nan, math.inf]))
        return message

    def pose(self) -> Any:
        x, y, z, w = np.array([self.rng.gauss(0, 1) for _ in range(4)])
        length = math.sqrt(x * x + y * y + z * z + w * w) * self.rng.choice([1.0, 1.0, 1.0, 1.5])
        turn = self.type('geometry_msgs/msg/Quaternion')(x / length, y / length, z / length, w / length)
        return self.type('geometry_msgs/msg/Pose')(
            position=self.type('geometry_msgs/msg/Point')(self.number(), self.number(), 0.0), orientation=turn
        )

    def random_message(self, kind: str) -> Any:
        if kind == RANGE:
            return self.range()
        header, pose, square = self.header(self.rng.choice(NAMES)), self.pose(), np.zeros(36)
        if kind == POSE:
            return self.type(POSE)(header=header, pose=pose)
        covered = self.type('geometry_msgs/msg/PoseWithCovariance')(pose=pose, covariance=square)
        if kind == POSE_WITH_COVARIANCE:
            return self.type(POSE_WITH_COVARIANCE)(header=header, pose=covered)
        vector = self.type('geometry_msgs/msg/Vector3')
        if kind == ODOMETRY:
            twist = self.type('geometry_msgs/msg/Twist')(vector(1.0, 2.0, 3.0), vector(4.0, 5.0, 6.0))
            moving = self.type('geometry_msgs/msg/TwistWithCovariance')(twist=twist, covariance=square)
            child = self.rng.choice(NAMES)
            return self.type(ODOMETRY)(header=header, child_frame_id=child, pose=covered, twist=moving)
        items = []
        for child in self.rng.sample(['base_link', '/base_footprint', 'wheel', 'arm'], self.rng.randrange(0, 4)):
            pose = self.pose()
            where = self.type('geometry_msgs/msg/Transform')(vector(*vars(pose.position).values()), pose.orientation)
            stamped = self.type('geometry_msgs/msg/TransformStamped')
            items.append(stamped(header=self.header('odom'), child_frame_id=child, transform=where))
        return self.type(TF)(transforms=items)

    def raw(self, kind: str) -> bytes:
        message = self.random_message(kind)
        if self.encoding == 'ros1':
            return bytes(self.store.serialize_ros1(message, kind))
        return bytes(self.store.serialize_cdr(message, kind, little_endian=self.encoding == 'cdr'))


def one_by_one(decoder: Decoder, kind: str, data: list[bytes]) -> tuple[MessageBatch, list[int]]:
    good, bad = [], []
    for place, raw in enumerate(data):
        try:
            message = _CONVERSIONS[kind](decoder(raw))
        except Exception:
            bad.append(place)
            continue
        if message is not None:
            good.append((place, message))
    return batch_of(good), bad


def same(one: MessageBatch, other: MessageBatch) -> None:
    for kind, expected in zip(one, other, strict=True):
        names = [kind.frames[k] for k in kind.frame.tolist()]
        assert names == [expected.frames[k] for k in expected.frame.tolist()]
        for number, column in enumerate(expected[:-1]):
            if number != 2:
                np.testing.assert_array_equal(kind[number], column)


@pytest.mark.parametrize('encoding', ['cdr', 'cdr_big', 'ros1'])
@pytest.mark.parametrize('kind', [RANGE, *POSES])
def test_batches_equal_the_messages_of_rosbags(kind: str, encoding: str) -> None:
    made = RandomMessages(encoding)
    data = [made.raw(kind) for _ in range(400)]
    for k in range(0, 400, 23):
        data[k] = data[k][: made.rng.randrange(len(data[k]))]
    for k in range(5, 400, 31):
        # a length or a letter that is now invalid
        data[k] = data[k][:12] + b'\xff' + data[k][13:]
    decoder = Decoder(kind, 'ros1' if encoding == 'ros1' else 'cdr', 'none', '')
    decode = Columns(decoder, _CONVERSIONS[kind])
    found, bad = decode.decode(np.arange(400), data)
    expected, wrong = one_by_one(decoder, kind, data)
    assert sorted(bad) == wrong
    assert wrong
    same(joined([*found, batch_of([])]), expected)


def test_messages_of_a_batch_are_not_decoded_one_by_one(monkeypatch: pytest.MonkeyPatch) -> None:
    made, calls = RandomMessages('cdr'), []
    monkeypatch.setattr(Columns, '_one_by_one', lambda self, messages: (calls.extend(messages), ([], []))[1])
    decode = Columns(Decoder(RANGE, 'cdr', 'none', ''), _CONVERSIONS[RANGE])
    found, _ = decode.decode(np.arange(300), [made.raw(RANGE) for _ in range(300)])
    assert not calls
    assert sum(len(batch.ranges.place) for batch in found) == 300


def test_messages_of_humble_and_jazzy_in_one_topic_are_decoded() -> None:
    stores = [get_typestore(store) for store in (Stores.ROS2_HUMBLE, Stores.ROS2_JAZZY)]
    sample = RangeMessage(START, 'sonar', 1.5, 0.25, 4.0, 0.5, 0.0)
    data = [bytes(stores[k % 2].serialize_cdr(range_of(stores[k % 2], sample), RANGE)) for k in range(10)]
    decode = Columns(Decoder(RANGE, 'cdr', 'none', ''), _CONVERSIONS[RANGE])
    found, bad = decode.decode(np.arange(10), data)
    assert not bad
    assert [m for _, m in joined(found).ranges.one_by_one()] == [sample] * 10


def test_layout_that_disagrees_with_rosbags_is_not_used(monkeypatch: pytest.MonkeyPatch) -> None:
    made = RandomMessages('cdr')
    data = [made.raw(RANGE) for _ in range(50)]
    decoder = Decoder(RANGE, 'cdr', 'none', '')
    expected, _ = one_by_one(decoder, RANGE, data)
    start = Layout.__init__

    def shifted(self: Layout, *arguments: Any) -> None:
        start(self, *arguments)
        at, kind = self.fields['max_range',]
        self.fields['max_range',] = at - 4, kind

    monkeypatch.setattr(Layout, '__init__', shifted)
    decode = Columns(decoder, _CONVERSIONS[RANGE])
    found, _ = decode.decode(np.arange(50), data)
    assert decode._count == 0
    same(joined(found), expected)


def test_number_of_kept_layouts_is_bounded(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(columns, 'MOST_LAYOUTS', 3)
    made = RandomMessages('cdr')
    data = [made.raw(RANGE) for _ in range(100)]
    decoder = Decoder(RANGE, 'cdr', 'none', '')
    decode = Columns(decoder, _CONVERSIONS[RANGE])
    found, _ = decode.decode(np.arange(100), data)
    assert decode._count == 3
    same(joined(found), one_by_one(decoder, RANGE, data)[0])


# ---- chunks


def test_chunks_are_read_as_by_rosbags(tmp_path: Path) -> None:
    paths = [write_sample(tmp_path, 'mcap'), *(write_many_chunks(tmp_path, 'mcap', c) for c in (None, 'storage'))]
    for path in paths:
        with rosbag2.Reader(path) as reader:
            single = rosbag2.Reader(next(path.glob('*.mcap')))
            single.open()
            connections = [c for c in single.connections if c.topic == '/sonar']
            by_rosbags = [(c.id, t, bytes(data)) for c, t, data in single.messages(connections)]
            assert list(indexed_messages(single, {c.id for c in connections})) == by_rosbags
            assert len(by_rosbags) == COUNT
            single.close()
            assert reader.message_count >= COUNT


def test_chunks_that_overlap_are_merged_as_by_rosbags(tmp_path: Path) -> None:
    store, path = get_typestore(Stores.ROS2_JAZZY), tmp_path / 'mixed'
    rng = random.Random(4)
    with rosbag2.Writer(path, version=9, storage_plugin=rosbag2.StoragePlugin.MCAP) as writer:
        topics = [writer.add_connection(f'/s{k}', RANGE, typestore=store) for k in range(3)]
        for k in range(300):
            sample = RangeMessage(START, f's{k}', 1.0, 0.25, 4.0, 0.5)
            # many messages with the same time, and whole chunks out of order
            time = START + rng.randrange(40) + 10 * (k // 50) * rng.choice([0, 1, 1])
            writer.write(rng.choice(topics), time, store.serialize_cdr(range_of(store, sample), RANGE))
            if rng.random() < 0.1:
                writer.storage.close_chunk()
    single = rosbag2.Reader(next(path.glob('*.mcap')))
    single.open()
    for chosen in (single.connections, single.connections[:1]):
        by_rosbags = [(c.id, t, bytes(data)) for c, t, data in single.messages(chosen)]
        assert list(indexed_messages(single, {c.id for c in chosen})) == by_rosbags
    single.close()


def test_damaged_chunks_are_read_as_by_rosbags(tmp_path: Path) -> None:
    path = write_many_chunks(tmp_path, 'mcap')
    file = next(path.glob('*.mcap'))
    whole = file.read_bytes()
    rng = random.Random(2)
    compared = 0
    for _ in range(60):
        raw = bytearray(whole)
        at = rng.randrange(100, len(raw) * 2 // 3)
        raw[at : at + 8] = rng.choice([struct.pack('<Q', rng.randrange(2**64)), b'\5' * 8, bytes(8)])
        file.write_bytes(raw)
        single = rosbag2.Reader(file)
        try:
            single.open()
        except Exception:
            continue
        connections = [c for c in single.connections if c.topic == '/sonar']
        found = []
        for messages in (
            ((c.id, t, bytes(data)) for c, t, data in single.messages(connections)),
            indexed_messages(single, {c.id for c in connections}),
        ):
            given: list[Any] = []
            try:
                for message in messages:
                    given.append(message)
                error = ''
            except Exception as problem:
                error = f'{type(problem).__name__}: {problem}'
            found.append((given, error))
        single.close()
        assert found[0] == found[1]
        compared += 1
    assert compared > 20


def test_batches_contain_all_messages_in_order(tmp_path: Path) -> None:
    for kind in ('mcap', 'sqlite3', 'ros1'):
        with Bag(write_sample(tmp_path, kind, name=kind, count=COUNT)) as bag:
            batches = list(bag.batches(bag.choose_topics()))
        assert [m for batch in batches for m in batch.one_by_one()] == sample_messages()
