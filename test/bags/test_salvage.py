"""Reading of damaged files: no messages with a wrong checksum, none twice, and none missing."""

from __future__ import annotations

import struct
from binascii import crc32
from collections.abc import Iterator
from pathlib import Path
from types import SimpleNamespace

import pytest
from bag_samples import START, range_of, sample_messages
from rosbags.interfaces import MessageDefinition, MessageDefinitionFormat
from rosbags.typesys import Stores, get_typestore

from forward_grid_mapper.bags.choice import Topics
from forward_grid_mapper.bags.reader import Bag
from forward_grid_mapper.bags.scan_mcap import McapScan
from forward_grid_mapper.bags.source import RawMessage, RosbagsSource
from forward_grid_mapper.core.common.errors import BagError
from forward_grid_mapper.core.messages.message_types import RangeMessage

# ---- checksums


def text(value: str) -> bytes:
    return struct.pack('<I', len(value)) + value.encode()


def record(opcode: int, content: bytes) -> bytes:
    return struct.pack('<BQ', opcode, len(content)) + content


def mcap(path: Path, chunks: list[tuple[bytes, int]]) -> Path:
    """An MCAP file without index, with chunks that have the given checksums."""
    with path.open('wb') as file:
        file.write(b'\x89MCAP0\r\n' + record(1, text('ros2') + text('')))
        file.write(record(3, struct.pack('<H', 1) + text('sensor_msgs/msg/Range') + text('ros2msg') + text('')))
        file.write(record(4, struct.pack('<HH', 1, 1) + text('/sonar') + text('cdr') + struct.pack('<I', 0)))
        for content, checksum in chunks:
            head = struct.pack('<QQQI', 0, 1, len(content), checksum)
            file.write(record(6, head + text('') + struct.pack('<Q', len(content)) + content))
        file.write(record(2, struct.pack('<QQI', 0, 0, 0)) + b'\x89MCAP0\r\n')
    return path


def chunk_of(message: RangeMessage) -> bytes:
    store = get_typestore(Stores.ROS2_JAZZY)
    data = bytes(store.serialize_cdr(range_of(store, message), 'sensor_msgs/msg/Range'))
    return record(5, struct.pack('<HIQQ', 1, 0, message.stamp, 0) + data)


def test_chunk_with_a_wrong_checksum_is_skipped(tmp_path: Path) -> None:
    messages = [m for m in sample_messages(3) if isinstance(m, RangeMessage)]
    chunks = [chunk_of(message) for message in messages]
    wrong = bytearray(chunks[1])
    # one flipped bit in the range, which is still a valid number
    at = wrong.index(struct.pack('<f', messages[1].range))
    wrong[at + 1] ^= 1
    sound = mcap(tmp_path / 'sound.mcap', [(chunk, crc32(chunk)) for chunk in chunks])
    without = mcap(tmp_path / 'without.mcap', [(chunks[0], 0), (bytes(wrong), 0), (chunks[2], 0)])
    refuted = mcap(
        tmp_path / 'refuted.mcap', [(c, crc32(chunks[n])) for n, c in enumerate([chunks[0], bytes(wrong), chunks[2]])]
    )
    for path, count, damaged in ((sound, 3, False), (without, 3, False), (refuted, 2, True)):
        scan = McapScan(path)
        assert len(list(scan.messages({1}))) == count
        assert (scan.damage is not None and 'checksum' in scan.damage) == damaged
    with Bag(refuted) as bag:
        assert list(bag.messages(Topics(('/sonar',), ''))) == [messages[0], messages[2]]
        assert bag.truncated is not None and 'checksum' in bag.truncated
    with pytest.raises(BagError, match='checksum'), Bag(mcap(tmp_path / 'all.mcap', [(bytes(wrong), 1)])) as bag:
        list(bag.messages(Topics(('/sonar',), '')))


# ---- where a scanner continues


class Reader:
    """A reader of rosbags that fails at damage."""

    start_time, end_time = 0, 10

    def __init__(self, given: list[RawMessage]) -> None:
        self._given = given
        definition = MessageDefinition(MessageDefinitionFormat.NONE, '')
        self.connections = [
            SimpleNamespace(id=key, topic=f'/{key}', msgtype='sensor_msgs/msg/Range', msgdef=definition, msgcount=9)
            for key in (1, 2)
        ]

    def messages(self, connections: object) -> Iterator[tuple[object, int, bytes]]:
        for key, time, data in self._given:
            yield self.connections[key - 1], time, data
        raise ValueError('damage')

    def close(self) -> None:
        """Nothing is open."""


class Everything:
    """A scanner that finds all messages."""

    damage = None
    channels: tuple[()] = ()

    def __init__(self, found: list[RawMessage]) -> None:
        self._found = found

    def messages(self, keys: object) -> Iterator[RawMessage]:
        yield from self._found

    def close(self) -> None:
        """Nothing is open."""


WHOLE = [
    (1, START, b'a'),
    (1, START + 1, b'b'),
    (2, START + 1, b'c'),
    (1, START + 1, b'b'),
    (2, START + 1, b'd'),
    (1, START + 2, b'e'),
]


@pytest.mark.parametrize('intact', range(len(WHOLE) + 1))
def test_scanner_continues_where_the_reader_stopped(intact: int) -> None:
    source = RosbagsSource(Reader(WHOLE[:intact]), 'cdr', lambda: Everything(WHOLE))
    found = list(source.messages({1, 2}))
    assert sorted(found) == sorted(WHOLE), 'messages of one time are neither lost nor doubled'
    assert [time for _, time, _ in found] == [time for _, time, _ in WHOLE]
    assert source.damage == 'damage'
