"""Reads a ROS 1 bag record by record (http://wiki.ros.org/Bags/Format/2.0), for bags without a usable index."""

from __future__ import annotations

import struct
from collections.abc import Iterator
from io import BytesIO
from typing import BinaryIO

from .salvage import Scan
from .source import Channel, Damage, RawMessage, full_type_name, one_line

MAGIC = b'#ROSBAG V2.0\n'
_MESSAGE, _CHUNK, _CHUNK_INFO, _CONNECTION = 2, 5, 6, 7


class Rosbag1Scan(Scan):
    """Messages of a ROS 1 bag; damaged chunks are skipped, a truncated chunk gives its beginning."""

    def _walk(self) -> Iterator[RawMessage]:
        size = self._path.stat().st_size
        self._indexed = False
        with self._path.open('rb') as file:
            file.seek(len(MAGIC))
            yield from self._records(file, size, in_chunk=False)
        if not self._indexed:
            self._note('the bag was not closed: it has no index')

    def _records(self, file: BinaryIO, end: int, *, in_chunk: bool) -> Iterator[RawMessage]:
        while file.tell() < end:
            head, _ = _block(file, end)
            data, whole = _block(file, end)
            if not whole:
                self._note('the file is cut off')
            try:
                fields = _fields(head)
                opcode = fields['op'][0]
            except (struct.error, KeyError, IndexError, UnicodeDecodeError):
                # The boundary of the next record is unknown as well.
                return self._note(f'no record begins at byte {file.tell() - len(data) - len(head) - 8}')
            try:
                if opcode == _CHUNK and not in_chunk:
                    yield from self._chunk(fields, data, whole=whole)
                elif not whole:
                    return None
                elif opcode == _MESSAGE:
                    key, seconds, nanoseconds = struct.unpack('<III', fields['conn'] + fields['time'])
                    yield key, seconds * 1_000_000_000 + nanoseconds, data
                elif opcode == _CONNECTION:
                    self._connection(fields, _fields(data))
                elif opcode == _CHUNK_INFO:
                    self._indexed = True
            except Exception as error:  # errors of decompressors or decoders for damaged bytes
                self._note(one_line(error))
        return None

    def _chunk(self, fields: dict[str, bytes], data: bytes, *, whole: bool) -> Iterator[RawMessage]:
        (size,) = struct.unpack('<I', fields['size'])
        raw = self._budget.unpack(fields['compression'].decode(), data, size)
        if whole and len(raw) != size:
            raise Damage('a chunk does not have the size it states')
        yield from self._records(BytesIO(raw), len(raw), in_chunk=True)

    def _connection(self, fields: dict[str, bytes], stated: dict[str, bytes]) -> None:
        (key,) = struct.unpack('<I', fields['conn'])
        topic, msgtype = fields['topic'].decode(), full_type_name(stated['type'].decode())
        definition = stated['message_definition'].decode()
        self._found.setdefault(key, Channel(key, topic, msgtype, 'ros1', 'msg', definition, 0))


def _block(file: BinaryIO, end: int) -> tuple[bytes, bool]:
    """Return a block that is preceded by its length, and whether it is complete."""
    prefix = file.read(4)
    if len(prefix) < 4:
        return b'', False
    (length,) = struct.unpack('<I', prefix)
    left = end - file.tell()
    return file.read(min(length, left)), length <= left


def _fields(head: bytes) -> dict[str, bytes]:
    found: dict[str, bytes] = {}
    offset = 0
    while offset < len(head):
        (length,) = struct.unpack_from('<I', head, offset)
        name, _, value = head[offset + 4 : offset + 4 + length].partition(b'=')
        found[name.decode()] = value
        offset += 4 + length
    return found
