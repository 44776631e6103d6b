"""A short simulated drive, bags of it with any fault, and functions that run commands on them."""

from __future__ import annotations

import json
import math
from collections.abc import Callable, Iterable, Sequence
from functools import lru_cache
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
import pytest

from forward_grid_mapper.bags.writer import BagWriter
from forward_grid_mapper.commands import process_bag
from forward_grid_mapper.core.messages.message_types import OdometryMessage, Pose2, RangeMessage
from forward_grid_mapper.simulation.drive import BASE_FRAME, START, door_drive
from forward_grid_mapper.simulation.sonar import NOISY, front_array, sonar_ring

SECOND = 1_000_000_000
FILES = (
    {'maps.npz', 'maps.png', 'readings.npz', 'report.html', 'report.json', 'report.txt'}
    | {f'{name}.{suffix}' for name in ('live_map', 'ml_map', 'uncertainty_map') for suffix in ('pgm', 'yaml')}
    | {'live_map.png', 'uncertainty_map.png'}
)
Message = OdometryMessage | RangeMessage


class Tape(NamedTuple):
    """The content of a bag."""

    extrinsics: tuple[tuple[str, Pose2], ...]
    odometry: list[OdometryMessage]
    ranges: list[RangeMessage]

    def of(self, *frames: str) -> Tape:
        """The tape with only the ranges of these sensors."""
        return self._replace(ranges=[m for m in self.ranges if m.frame_id in frames])

    def with_ranges(self, **changes: Any) -> Tape:
        """The tape with each Range changed."""
        return self._replace(ranges=[m._replace(**changes) for m in self.ranges])

    def with_odometry(self, **changes: Any) -> Tape:
        """The tape with each Odometry changed."""
        return self._replace(odometry=[m._replace(**changes) for m in self.odometry])


@lru_cache(maxsize=1)
def tape() -> Tape:
    """A drive past a door with eight sonars; the numbers of a Range are exact in single precision."""
    recording = door_drive(1, NOISY, 0, front_array())
    exact = [
        m._replace(
            **{k: float(np.float32(getattr(m, k))) for k in ('range', 'min_range', 'max_range', 'field_of_view')}
        )
        for m in recording.ranges
    ]
    return Tape(recording.extrinsics, recording.odometry, exact)


def backwards_sensors() -> tuple[tuple[tuple[str, Pose2], ...], Tape]:
    """Poses of the sonars of a ring, and a drive past a door with transforms that rotate the sonars by 180 degrees."""
    made = door_drive(1, NOISY, 0, sonar_ring())
    wrong = tuple((frame, Pose2(-p.x, -p.y, p.yaw + math.pi)) for frame, p in made.extrinsics)
    return made.extrinsics, Tape(wrong, list(made.odometry), list(made.ranges))


def in_turn(drive: Tape) -> list[tuple[int, Message]]:
    """All messages, logged at their stamps, a Range after the Odometry with the same stamp."""
    return sorted(((m.stamp, m) for m in (*drive.odometry, *drive.ranges)), key=lambda item: item[0])


def write_tape(
    path: Path,
    drive: Tape,
    kind: str = 'mcap',
    *,
    logged: Iterable[tuple[int, Message]] | None = None,
    sonar_topic: Callable[[RangeMessage], str] = lambda message: '/sonar',
    odometry_topic: Callable[[OdometryMessage], str] = lambda message: '/odom',
    writer: type[BagWriter] = BagWriter,
) -> Path:
    """Write a bag of `logged` messages, by default all of the drive in turn; return its path."""
    with writer(path, kind) as bag:
        if drive.extrinsics:
            bag.write_static_transforms([(BASE_FRAME, frame, pose) for frame, pose in drive.extrinsics], START)
        for time, message in in_turn(drive) if logged is None else logged:
            if isinstance(message, OdometryMessage):
                bag.write_odometry(odometry_topic(message), message, time)
            else:
                bag.write_range(sonar_topic(message), message, time=time)
    return path


def code_of(main: Callable[[Sequence[str]], int], *arguments: object) -> int:
    """Run a command in this process; return its exit code, also if argparse exits."""
    try:
        return main([str(argument) for argument in arguments])
    except SystemExit as leaving:
        return int(leaving.code or 0)


def mapped(bag: Path, output: Path, *options: object) -> dict[str, Any]:
    """Map a bag, which must succeed; return the content of report.json."""
    assert code_of(process_bag.main, bag, '-o', output, *options) == 0
    return report_in(output)


def report_in(folder: Path) -> dict[str, Any]:
    """The report of a run, whose counts must add up."""

    def refuse(constant: str) -> None:
        raise AssertionError(f'{constant} is no JSON')

    report = json.loads((folder / 'report.json').read_text('utf-8'), parse_constant=refuse)
    counts = report['counts']
    assert counts['accepted'] + sum(counts['rejected'].values()) == counts['received']
    assert counts['accepted'] == report['result']['readings'] == sum(s['accepted'] for s in report['sensors'].values())
    return report


def arrays_in(folder: Path) -> dict[str, np.ndarray]:
    """All arrays of maps.npz."""
    with np.load(folder / 'maps.npz', allow_pickle=False) as archive:
        return dict(archive)


def assert_same_maps(one: Path, other: Path) -> None:
    """Compare two folders of results, number by number."""
    a, b = arrays_in(one), arrays_in(other)
    assert a.keys() == b.keys()
    for name in a:
        np.testing.assert_array_equal(a[name], b[name], name)


def error_of(capsys: pytest.CaptureFixture[str], folder: Path, *arguments: object, code: int = 1) -> str:
    """The error message of process_bag for wrong arguments; `folder` must stay unchanged."""
    before = everything_in(folder)
    capsys.readouterr()
    assert code_of(process_bag.main, *arguments) == code
    out, err = capsys.readouterr()
    assert out == ''
    assert 'Traceback' not in err
    message = err.partition('process_bag: error: ')[2]
    assert message, f'no error was printed: {err!r}'
    assert everything_in(folder) == before
    return message.rstrip('\n')


def everything_in(folder: Path) -> list[str]:
    """Paths of all files and folders at any depth."""
    return sorted(str(path) for path in folder.rglob('*'))
