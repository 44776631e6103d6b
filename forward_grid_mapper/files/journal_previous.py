"""Reads journals of the previous format: blocks with a checksum, one after the other. This version only reads them.

A file begins with `MAGIC`. A block is `SYNC`, its kind, the length of its payload, and the CRC-32 of kind, length and
payload; little endian. A correct checksum means that a block is unchanged, not that its contents are meaningful, so
they pass the same checks as those of the present format.
"""

from __future__ import annotations

import json
import struct
import zlib
from collections.abc import Iterator
from pathlib import Path
from typing import BinaryIO

import numpy as np
from numpy.typing import NDArray

from ..core.common.readings import Readings
from .journal_format import ROW, Contents, encoded, in_chunks

MAGIC = b'FGMAPJ1\n'
SYNC = b'\xf5FGM'
HEAD = struct.Struct('<4sBxxxII')
FRAMES, NAME, READINGS, PATH = 1, 2, 3, 4
LONGEST = 1 << 26
"""Most bytes of a payload. A larger length is damage; after as many bytes without a block, reading ends."""

WINDOW = 4096
"""Bytes that are searched at once for the next block."""

NOTE = 'it has the format of the previous version, which the next version will not read'


def read(path: Path, contents: Contents) -> Iterator[Readings]:
    """Yield the readings of a journal file of the previous format, as `journal_reader.read` does, and fill `contents`.

    Raises
    ------
    OSError
        If the file cannot be read.
    """
    contents.note = NOTE
    with path.open('rb') as file:
        yield from in_chunks(_rows(file, contents), contents)


def _rows(file: BinaryIO, contents: Contents) -> Iterator[NDArray[np.void]]:
    for kind, payload in _blocks(file, contents):
        if kind == READINGS and payload and len(payload) % ROW.itemsize == 0:
            rows = np.frombuffer(payload, ROW)
            contents.next += len(rows)
            for number in np.unique(rows['sensor']).tolist():
                if number not in contents.sensors:
                    # the block with its name was damaged
                    contents.add_sensor(number, encoded(f'sensor number {number}'))
            yield rows
        elif kind == NAME and len(payload) >= 4:
            contents.add_sensor(struct.unpack_from('<I', payload)[0], payload[4:])
        elif kind == FRAMES:
            _take_frames(payload, contents)
        elif kind == PATH:
            contents.add_path(payload)
        else:
            contents.fault('it has blocks that are not part of a journal')


def _take_frames(payload: bytes, contents: Contents) -> None:
    try:
        frames = json.loads(payload)
        contents.set_frames(encoded(frames['map_frame']), encoded(frames['base_frame']))
    except (ValueError, LookupError, TypeError, AttributeError, RecursionError):
        contents.fault('the frames of the drive are damaged')


def _blocks(file: BinaryIO, contents: Contents) -> Iterator[tuple[int, bytes]]:
    """Yield kind and payload of every valid block; bytes between them are damage."""
    at = end = len(MAGIC)
    damaged = tried = 0
    while tried <= LONGEST:
        file.seek(at)
        head = file.read(HEAD.size)
        if len(head) < HEAD.size:
            break
        sync, kind, length, checksum = HEAD.unpack(head)
        payload = file.read(length) if sync == SYNC and length <= LONGEST else b''
        if sync == SYNC and len(payload) == length and _checksum(kind, payload) == checksum:
            damaged += at - end
            at = end = at + HEAD.size + length
            tried = 0
            yield kind, payload
        else:
            found = _find(file, at + 1)
            # headers with long payloads may be close together
            tried += max(found - at, WINDOW) + len(payload)
            at = found
    torn = file.seek(0, 2) - end
    if torn:
        contents.fault(f'its last {torn} bytes are cut off or damaged')
    if damaged:
        contents.fault(f'{damaged} bytes inside it are damaged, and their readings lost')


def _find(file: BinaryIO, at: int) -> int:
    """Return the position of the next `SYNC`, or of the end of the search."""
    stop = at + LONGEST
    while at < stop:
        file.seek(at)
        window = file.read(WINDOW)
        found = window.find(SYNC)
        if found >= 0:
            return at + found
        if len(window) < WINDOW:
            return at + len(window)
        at += len(window) - len(SYNC) + 1
    return at


def _checksum(kind: int, payload: bytes) -> int:
    return zlib.crc32(payload, zlib.crc32(struct.pack('<BI', kind, len(payload))))
