"""Readings that are mapped: each once, and only those in the requested part of the drive."""

from __future__ import annotations

import math
from pathlib import Path
from typing import Any

import pytest
from drive_samples import in_turn, tape, write_tape

from forward_grid_mapper.core.common.errors import InputError
from forward_grid_mapper.core.common.parameters import Parameters
from forward_grid_mapper.core.common.readings import in_canonical_order
from forward_grid_mapper.core.messages.message_types import NANOSECONDS
from forward_grid_mapper.recordings.drive import Part
from forward_grid_mapper.recordings.drives import Drives, read_drives


def read(*paths: Path, **options: Any) -> Drives:
    return read_drives(paths, Parameters(), {}, **options)


def test_bag_and_one_of_its_files_are_read_as_the_bag(tmp_path: Path) -> None:
    """The file may have only half of the drive."""
    whole = tape()
    halves = in_turn(whole)[::2], in_turn(whole)[1::2]
    bag = write_tape(tmp_path / 'bag', whole, logged=halves[0])
    other = write_tape(tmp_path / 'other', whole._replace(extrinsics=()), logged=halves[1])
    next(other.glob('*.mcap')).rename(bag / 'bag_1.mcap')
    (bag / 'metadata.yaml').write_text('relative_file_paths:\n  - bag.mcap\n  - bag_1.mcap\n')
    for words in ((bag, bag / 'bag.mcap'), (bag / 'bag.mcap', bag), (bag / 'bag_1.mcap', bag, bag / 'bag.mcap')):
        drives = read(*words)
        assert [drive.source['bag'] for drive in drives.drives] == [str(bag)]
        assert len(drives.drives[0].associator.buffer) == len(whole.ranges)
        assert sum('it is read once' in warning for warning in drives.source['warnings']) == len(words) - 1


def test_topic_and_its_filtered_copy_are_named_with_an_option(tmp_path: Path) -> None:
    drive = tape()
    filtered = [m._replace(range=m.range + 0.01) if math.isfinite(m.range) else m._replace() for m in drive.ranges]
    copies = {id(message) for message in filtered}
    both = drive._replace(ranges=[*drive.ranges, *filtered])
    path = write_tape(tmp_path / 'bag', both, sonar_topic=lambda m: '/sonar_filtered' if id(m) in copies else '/sonar')
    (warning,) = (text for text in read(path).source['warnings'] if 'counts twice' in text)
    assert warning.startswith('/sonar and /sonar_filtered contain the same readings (frame ')
    assert warning.endswith('is /sonar_filtered a filtered copy? To use one of them, add `--range-topics /sonar`')
    drives = read(path, range_topics=['/sonar'])
    assert len(drives.readings) == len(drive.ranges) and not drives.source['warnings']


@pytest.mark.parametrize('first', [1_700_000_000_123_456_789, 1_700_000_000_123_456_790 + 100])
def test_bounds_of_a_part_are_exact_to_the_nanosecond(first: int) -> None:
    assert Part(0.0, 60.0).bounds(first) == (first, first + 60 * NANOSECONDS)
    assert Part(1.5).bounds(first) == (first + 3 * NANOSECONDS // 2, math.inf)
    assert Part(1e300, 1e308).bounds(first)[1] == math.inf


def test_part_of_a_drive_whose_first_message_has_no_stamp(tmp_path: Path) -> None:
    drive = tape()
    unstamped = drive._replace(odometry=[drive.odometry[0]._replace(stamp=0), *drive.odometry[1:]])
    logged = [(drive.odometry[0].stamp, unstamped.odometry[0]), *in_turn(unstamped)[1:]]
    path = write_tape(tmp_path / 'bag', unstamped, logged=logged)
    begin = drive.odometry[1].stamp + 2 * NANOSECONDS
    found = in_canonical_order(read(path, part=Part(2.0, 3.0)).readings)
    assert len(found) and begin <= found.stamp[0] and found.stamp[-1] < begin + 3 * NANOSECONDS
    with pytest.raises(InputError, match=r'its messages span \d\d\.\d s'):
        read(path, part=Part(900.0))


def test_part_of_a_drive_without_stamps_is_rejected(tmp_path: Path) -> None:
    drive = tape().with_ranges(stamp=0).with_odometry(stamp=0)
    path = write_tape(tmp_path / 'bag', drive, logged=[(k + 1, m) for k, (_, m) in enumerate(in_turn(drive))])
    with pytest.raises(InputError, match='no reading in the part'):
        read(path, part=Part(2.0))


def test_duration_and_begin_are_those_of_the_drive_if_most_readings_are_left_out(tmp_path: Path) -> None:
    """A robot stands at its dock before the drive: these readings are the oldest of one place and direction."""
    whole, wait = tape(), 40
    first, second = whole.odometry[0], NANOSECONDS
    earlier = range(first.stamp - wait * second, first.stamp, second // 10)
    standing = [first._replace(stamp=stamp) for stamp in earlier]
    heard = [m for m in whole.ranges if m.stamp == whole.ranges[0].stamp]
    waiting = [m._replace(stamp=stamp) for stamp in earlier for m in heard]
    drive = whole._replace(odometry=standing + whole.odometry, ranges=waiting + whole.ranges)
    bag = write_tape(tmp_path / 'bag', drive)
    source = read_drives([bag], Parameters.from_flat({'max_readings': 300}), {}).source
    assert source['counts']['accepted'] == len(drive.ranges)
    assert source['stamps'] == [earlier[0], whole.ranges[-1].stamp]
    assert source['duration_s'] == pytest.approx((whole.ranges[-1].stamp - earlier[0]) / second)
