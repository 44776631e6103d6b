"""Journals of the previous format: damage affects only its block, and blocks with valid checksums are validated too."""

from __future__ import annotations

import random
import struct
import time
from pathlib import Path

import numpy as np
import pytest
from journal_samples import FRAMES, Previous, made, numbers, rows


@pytest.fixture
def path(tmp_path: Path) -> Path:
    return tmp_path / 'drive_0001.journal'


def test_journal_of_the_previous_version_is_read(path: Path) -> None:
    path.write_bytes(Previous.file(200))
    found, contents = numbers(path)
    assert found == list(range(200))
    assert (contents.map_frame, contents.base_frame) == FRAMES
    assert contents.path == [(10.0 * k, 0.0) for k in range(20)]
    assert contents.harm == ''
    assert 'the previous version' in contents.note


def test_truncated_journal_gives_all_complete_blocks(path: Path) -> None:
    whole = Previous.file(30)
    last = 0
    for length in (*range(8, len(whole), 29), len(whole)):
        path.write_bytes(whole[:length])
        found, contents = numbers(path)
        assert found == list(range(len(found)))
        assert len(found) % 10 == 0
        assert len(found) >= last
        assert bool(contents.harm) == ('cut off' in contents.harm)
        last = len(found)
    assert last == 30
    assert contents.harm == ''


def test_flipped_bit_loses_one_block(path: Path) -> None:
    whole = Previous.file(200)
    rng = random.Random(1)
    for _ in range(200):
        damaged = bytearray(whole)
        damaged[rng.randrange(8, len(damaged))] ^= 1 << rng.randrange(8)
        path.write_bytes(damaged)
        found, contents = numbers(path)
        assert len(found) >= 190
        assert set(found) <= set(range(200))
        assert contents.harm


@pytest.mark.parametrize(
    ('block', 'reason'),
    [
        (Previous.block(1, b'{'), 'frames of the drive'),
        (Previous.block(1, b'\xff'), 'frames of the drive'),
        (Previous.block(1, b'[' * 100_000), 'frames of the drive'),
        (Previous.frames([]), 'frames of the drive'),
        (Previous.frames({}), 'frames of the drive'),
        (Previous.frames({'map_frame': 1, 'base_frame': None}), 'frames of the drive'),
        (Previous.frames({'map_frame': 'm' * 2000, 'base_frame': 'b'}), 'frames of the drive'),
        (Previous.block(2, b'abc'), 'not part of a journal'),
        (Previous.block(2, struct.pack('<I', 5) + b'\xff\xff'), 'name of a sensor'),
        (Previous.name(5, 'n' * 2000), 'name of a sensor'),
        (Previous.block(3, b'abc'), 'not part of a journal'),
        (Previous.block(4, b'abc'), 'points of the path'),
        (Previous.path([(float('nan'), 0.0)]), 'points of the path'),
        (Previous.path([(1e300, 0.0)]), 'points of the path'),
        (Previous.block(9, b''), 'not part of a journal'),
        (Previous.block(0, bytes(68)), 'not part of a journal'),
    ],
)
def test_bad_content_with_valid_checksum_is_reported(path: Path, block: bytes, reason: str) -> None:
    whole = Previous.file(20)
    path.write_bytes(whole + block + Previous.readings(rows(made(20, 10))))
    found, contents = numbers(path)
    assert found == list(range(30))
    assert reason in contents.harm
    assert (contents.map_frame, contents.base_frame) == FRAMES
    assert np.isfinite(contents.path).all()


def test_reading_of_a_slow_file_is_stopped(path: Path) -> None:
    """Many headers that each claim 64 MB, and a hole of a terabyte."""
    heads = struct.pack('<4sBxxxII', b'\xf5FGM', 3, 1 << 26, 0) * 100_000
    for tail in (heads, bytes(1 << 20)):
        path.write_bytes(Previous.file(20) + tail)
        with path.open('r+b') as file:
            file.truncate(path.stat().st_size if tail is heads else 1 << 40)
        begin = time.monotonic()
        found, contents = numbers(path)
        assert time.monotonic() - begin < 30.0
        assert found == list(range(20))
        assert 'cut off or damaged' in contents.harm
