"""Reads an MCAP file record by record (https://mcap.dev/spec), for files without a usable index."""

from __future__ import annotations

import struct
from binascii import crc32
from collections.abc import Iterator
from io import BytesIO
from typing import BinaryIO

from .salvage import Scan
from .source import Channel, RawMessage, full_type_name, one_line

MAGIC = b'\x89MCAP0\r\n'
_HEADER, _FOOTER, _SCHEMA, _CHANNEL, _MESSAGE, _CHUNK, _DATA_END = 1, 2, 3, 4, 5, 6, 0x0F
_LAST_OPCODE = 0x0F
_FORMATS = {'ros2msg': 'msg', 'ros1msg': 'msg', 'ros2idl': 'idl', 'omgidl': 'idl'}


class McapScan(Scan):
    """Messages of an MCAP file; damaged chunks are skipped, a truncated chunk gives its beginning."""

    def _walk(self) -> Iterator[RawMessage]:
        self._schemas: dict[int, tuple[str, str, str]] = {}
        size = self._path.stat().st_size
        with self._path.open('rb') as file:
            file.seek(len(MAGIC))
            yield from self._records(file, size, in_chunk=False)
            file.seek(max(0, size - len(MAGIC)))
            if file.read() != MAGIC:
                self._note('the file is cut off')

    def _records(self, file: BinaryIO, end: int, *, in_chunk: bool) -> Iterator[RawMessage]:
        while end - file.tell() >= 9:
            opcode, length = struct.unpack('<BQ', file.read(9))
            if opcode in (_DATA_END, _FOOTER):
                return
            left = end - file.tell()
            if not _HEADER <= opcode <= _LAST_OPCODE and opcode < 0x80:
                return self._note(f'no record begins at byte {file.tell() - 9}')
            if length > left and opcode != _CHUNK:
                return self._note('the file is cut off')
            if opcode in (_SCHEMA, _CHANNEL, _MESSAGE, _CHUNK):
                content = file.read(min(length, left))
                try:
                    if opcode == _CHUNK and not in_chunk:
                        yield from self._chunk(content, whole=length <= left)
                    elif opcode == _MESSAGE:
                        key, _, time, _ = struct.unpack_from('<HIQQ', content)
                        yield key, time, content[22:]
                    elif opcode == _SCHEMA:
                        self._schema(content)
                    elif opcode == _CHANNEL:
                        self._channel(content)
                except Exception as error:  # errors of decompressors or decoders for damaged bytes
                    self._note(one_line(error))
            else:
                file.seek(length, 1)
        if not in_chunk or file.tell() < end:
            self._note('the file is cut off')
        return None

    def _chunk(self, content: bytes, *, whole: bool) -> Iterator[RawMessage]:
        _, _, size, crc, name_length = struct.unpack_from('<QQQII', content)
        compression = content[32 : 32 + name_length].decode()
        raw = self._budget.unpack(compression, content[40 + name_length :], size)
        if not whole:
            self._note('the file is cut off')
        elif len(raw) != size or (crc and crc32(raw) != crc):
            # The boundaries of its records are not reliable either.
            return self._note('a chunk does not match its checksum')
        yield from self._records(BytesIO(raw), len(raw), in_chunk=True)
        return None

    def _schema(self, content: bytes) -> None:
        (key,) = struct.unpack_from('<H', content)
        name, encoding, definition = _strings(content, 2, 3)
        self._schemas[key] = name, encoding, definition

    def _channel(self, content: bytes) -> None:
        key, schema = struct.unpack_from('<HH', content)
        topic, encoding = _strings(content, 4, 2)
        name, schema_encoding, definition = self._schemas.get(schema, ('unknown', '', ''))
        kind = _FORMATS.get(schema_encoding, 'none')
        self._found.setdefault(key, Channel(key, topic, full_type_name(name), encoding, kind, definition, 0))


def _strings(content: bytes, offset: int, number: int) -> list[str]:
    found = []
    for _ in range(number):
        (length,) = struct.unpack_from('<I', content, offset)
        (text,) = struct.unpack_from(f'<{length}s', content, offset + 4)
        found.append(text.decode())
        offset += 4 + length
    return found
