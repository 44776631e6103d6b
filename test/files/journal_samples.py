"""Helpers of the tests of journals: readings, journals of both formats, and waiting for a condition."""

from __future__ import annotations

import json
import sqlite3
import struct
import time
import zlib
from collections.abc import Callable, Iterable
from pathlib import Path

import numpy as np

from forward_grid_mapper.core.common.readings import Readings
from forward_grid_mapper.files.journal import Journal
from forward_grid_mapper.files.journal_format import APPLICATION, ROW, TABLES, VERSION, Contents, rows_of
from forward_grid_mapper.files.journal_reader import read

FRAMES = ('odom', 'base_link')


def made(first: int, count: int, names: tuple[str, ...] = ('left', 'right')) -> Readings:
    """Readings whose x is their number."""
    numbers = np.arange(first, first + count)
    return Readings.from_columns(
        names=names,
        x=numbers,
        y=-0.5 * numbers,
        yaw=0.1 * numbers,
        z=1.0 + 0.001 * (numbers % 1000),
        z_max=9.0,
        half_angle=0.2,
        sigma=0.01,
        stamp=numbers * 10**8,
        sensor=numbers % len(names),
    )


def opened(folder: Path, warnings: list[str] | None = None) -> tuple[Journal, list[Readings]]:
    journal = Journal(folder, (warnings if warnings is not None else []).append)
    return journal, list(journal.restore())


def written(journal: Journal, readings: Readings) -> None:
    journal.put(readings, FRAMES, [(float(readings.x[0]), 0.0)])
    until(lambda: not journal.unwritten)


def until(condition: Callable[[], object], seconds: float = 120.0) -> None:
    end = time.monotonic() + seconds
    while not condition():
        assert time.monotonic() < end
        time.sleep(0.005)


def numbers(path: Path) -> tuple[list[int], Contents]:
    contents = Contents()
    return [int(x) for readings in read(path, contents) for x in readings.x], contents


def database(
    path: Path, rows: Iterable[bytes] = (), names: Iterable[bytes] = (b'left', b'right')
) -> sqlite3.Connection:
    """Make the file of a journal by hand, which tests then change; its blocks are consecutive."""
    made = sqlite3.connect(path, isolation_level=None)
    for sql in TABLES.values():
        made.execute(sql)
    made.execute(f'PRAGMA application_id={APPLICATION}')
    made.execute(f'PRAGMA user_version={VERSION}')
    made.execute("INSERT INTO drive VALUES (0, x'6d6170', x'62617365', x'7b7d')")
    for number, name in enumerate(names):
        made.execute('INSERT INTO sensors VALUES (?, ?)', (number, name))
    number = 0
    for block in rows:
        made.execute('INSERT INTO readings VALUES (?, ?)', (number, block))
        number += max(1, len(block) // ROW.itemsize)
    return made


def rows(readings: Readings) -> np.ndarray:
    return rows_of(readings, {name: number for number, name in enumerate(readings.sensor_names)})


class Previous:
    """Writes a file of the previous format."""

    MAGIC = b'FGMAPJ1\n'

    @staticmethod
    def block(kind: int, payload: bytes) -> bytes:
        checksum = zlib.crc32(payload, zlib.crc32(struct.pack('<BI', kind, len(payload))))
        return struct.pack('<4sBxxxII', b'\xf5FGM', kind, len(payload), checksum) + payload

    @classmethod
    def frames(cls, content: object = None) -> bytes:
        content = {'map_frame': FRAMES[0], 'base_frame': FRAMES[1]} if content is None else content
        return cls.block(1, json.dumps(content).encode())

    @classmethod
    def name(cls, number: int, name: str) -> bytes:
        return cls.block(2, struct.pack('<I', number) + name.encode('utf-8', 'surrogatepass'))

    @classmethod
    def readings(cls, content: np.ndarray) -> bytes:
        return cls.block(3, content.tobytes())

    @classmethod
    def path(cls, points: Iterable[tuple[float, float]]) -> bytes:
        return cls.block(4, np.array(list(points), '<f8').tobytes())

    @classmethod
    def file(cls, count: int, size: int = 10) -> bytes:
        """A valid file with blocks of `size` readings."""
        blocks = [cls.MAGIC, cls.frames(), cls.name(0, 'left'), cls.name(1, 'right')]
        for first in range(0, count, size):
            blocks += [cls.path([(float(first), 0.0)]), cls.readings(rows(made(first, size)))]
        return b''.join(blocks)
