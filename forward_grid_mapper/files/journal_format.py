"""The bytes of a journal: blocks that are appended, each with a checksum, so that any damage costs only itself.

A file begins with `MAGIC`. A block is `SYNC`, its kind, the length of its payload, and the CRC-32 of kind, length and
payload; little endian. Kinds:

    FRAMES    JSON: map_frame and base_frame
    NAME      number of a sensor (uint32), and its frame_id in UTF-8
    READINGS  rows of `ROW`
    PATH      points of the robot's path: x, y (float64)
"""

from __future__ import annotations

import json
import mmap
import struct
import zlib
from collections.abc import Iterable, Iterator
from dataclasses import dataclass, field
from pathlib import Path

import numpy as np

from ..core.common.errors import BagError
from ..core.common.readings import Readings

MAGIC = b'FGMAPJ1\n'
SYNC = b'\xf5FGM'
_HEAD = struct.Struct('<4sBxxxII')
FRAMES, NAME, READINGS, PATH = 1, 2, 3, 4
LONGEST = 1 << 26
"""Bytes of a payload; a length beyond it is damage."""

COLUMNS = ('x', 'y', 'yaw', 'z', 'z_max', 'half_angle', 'sigma')
ROW = np.dtype([('stamp', '<i8'), *((name, '<f8') for name in COLUMNS), ('sensor', '<u4')])
"""A reading; 68 bytes."""

CHUNK = 50_000
"""Readings that are handed on at once when a journal is read."""


def block(kind: int, payload: bytes) -> bytes:
    """Return the bytes of a block."""
    return _HEAD.pack(SYNC, kind, len(payload), _checksum(kind, payload)) + payload


def frames_block(map_frame: str, base_frame: str) -> bytes:
    """Return the block with the frames of the drive."""
    return block(FRAMES, json.dumps({'map_frame': map_frame, 'base_frame': base_frame}).encode())


def name_block(number: int, name: str) -> bytes:
    """Return the block that names a sensor."""
    return block(NAME, struct.pack('<I', number) + name.encode('utf-8', 'surrogatepass'))


def readings_block(readings: Readings, numbers: dict[str, int]) -> bytes:
    """Return the block that holds readings of sensors with these numbers."""
    rows = np.empty(len(readings), ROW)
    for name in ('stamp', *COLUMNS):
        rows[name] = getattr(readings, name)
    rows['sensor'] = np.array([numbers.get(name, 0) for name in readings.sensor_names] or [0])[readings.sensor]
    return block(READINGS, rows.tobytes())


def path_block(points: Iterable[tuple[float, float]]) -> bytes:
    """Return the block that holds points of the path."""
    return block(PATH, np.array(list(points), '<f8').tobytes())


@dataclass
class Contents:
    """What a journal file holds besides its readings, complete once they were read.

    Attributes
    ----------
    names : dict of int → str
        Sensors by number.
    map_frame, base_frame : str
    path : list of (x, y)
    end : int
        Bytes up to the end of the last sound block.
    torn : int
        Bytes after it: a block that was being written when the writer died.
    damaged : int
        Bytes before it that are no sound block.
    """

    names: dict[int, str] = field(default_factory=dict)
    map_frame: str = ''
    base_frame: str = ''
    path: list[tuple[float, float]] = field(default_factory=list)
    end: int = 0
    torn: int = 0
    damaged: int = 0

    @property
    def harm(self) -> str:
        """What is wrong with the file, in words; empty if nothing is."""
        parts = []
        if self.torn:
            parts.append(f'its last {self.torn} bytes are a block that was cut off')
        if self.damaged:
            parts.append(f'{self.damaged} bytes inside it are damaged, and their readings lost')
        return ' and '.join(parts)


def read(path: Path, contents: Contents) -> Iterator[Readings]:
    """Yield the readings of a journal file, some ten thousand at a time; fills `contents` on the way.

    Raises
    ------
    BagError
        If the file cannot be read, or is no journal.
    """
    try:
        with path.open('rb') as file:
            size = path.stat().st_size
            begin = file.read(len(MAGIC))
            if size < len(MAGIC) and MAGIC.startswith(begin):
                # died before its first block
                contents.torn = size
                return
            if begin != MAGIC:
                raise BagError(f'{path} is not a journal')
            with mmap.mmap(file.fileno(), 0, access=mmap.ACCESS_READ) as data:
                yield from _chunks(data, contents)
    except OSError as error:
        raise BagError(f'{path} cannot be read: {error.strerror or error}') from error


def _chunks(data: mmap.mmap, contents: Contents) -> Iterator[Readings]:
    rows: list[bytes] = []
    left = CHUNK * ROW.itemsize
    for kind, payload in _blocks(data, contents):
        if kind == READINGS and len(payload) % ROW.itemsize == 0:
            rows.append(payload)
            left -= len(payload)
        elif kind == NAME and len(payload) >= 4:
            number = struct.unpack_from('<I', payload)[0]
            contents.names[number] = payload[4:].decode('utf-8', 'surrogatepass')
        elif kind == FRAMES:
            frames = json.loads(payload)
            contents.map_frame, contents.base_frame = str(frames['map_frame']), str(frames['base_frame'])
        elif kind == PATH:
            contents.path += [(x, y) for x, y in np.frombuffer(payload, '<f8').reshape(-1, 2).tolist()]
        if left <= 0:
            yield _readings(rows, contents)
            rows, left = [], CHUNK * ROW.itemsize
    if rows:
        yield _readings(rows, contents)


def _readings(payloads: list[bytes], contents: Contents) -> Readings:
    rows = np.frombuffer(b''.join(payloads), ROW)
    known, sensor = np.unique(rows['sensor'], return_inverse=True)
    columns = {name: rows[name] for name in ('stamp', *COLUMNS)}
    # a name that was damaged
    names = tuple(contents.names.get(int(number), f'sensor number {number}') for number in known)
    return Readings.from_columns(names=names, sensor=sensor, **columns)


def _blocks(data: mmap.mmap, contents: Contents) -> Iterator[tuple[int, bytes]]:
    """Yield kind and payload of every sound block; what lies between them is damage."""
    at = contents.end = len(MAGIC)
    while 0 <= at <= len(data) - _HEAD.size:
        found = _block_at(data, at)
        if found is None:
            at = data.find(SYNC, at + 1)
            continue
        contents.damaged += at - contents.end
        at += _HEAD.size + len(found[1])
        contents.end = at
        yield found
    contents.torn = len(data) - contents.end


def _block_at(data: mmap.mmap, at: int) -> tuple[int, bytes] | None:
    sync, kind, length, checksum = _HEAD.unpack_from(data, at)
    begin = at + _HEAD.size
    if sync != SYNC or length > LONGEST or begin + length > len(data):
        return None
    payload = bytes(data[begin : begin + length])
    return (kind, payload) if _checksum(kind, payload) == checksum else None


def _checksum(kind: int, payload: bytes) -> int:
    return zlib.crc32(payload, zlib.crc32(struct.pack('<BI', kind, len(payload))))
