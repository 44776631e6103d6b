"""Thinning of readings: of repeated readings the newest are kept, in any order of arrival."""

from __future__ import annotations

import dataclasses
import threading
from collections.abc import Callable

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from forward_grid_mapper.core.common.parameters import Parameters
from forward_grid_mapper.core.common.readings import Readings
from forward_grid_mapper.core.mapping import Mapper
from forward_grid_mapper.core.messages.reading_buffer import ReadingBuffer
from forward_grid_mapper.core.messages.thinning import kept
from forward_grid_mapper.simulation.drive import corridor_drive
from forward_grid_mapper.simulation.score import score_map, visible_surface


def made(rng: np.random.Generator, count: int, places: int = 5) -> Readings:
    """Readings from few places, many of them with equal stamps."""
    return Readings.from_columns(
        names=('left', 'right'),
        x=rng.integers(0, places, count) * 0.5,
        y=0.0,
        yaw=rng.integers(0, 3, count) * 1.0 - 1.0,
        z=rng.integers(1, 4, count) + rng.integers(0, 2, count) * 0.01,
        z_max=3.0,
        half_angle=0.2,
        stamp=rng.integers(0, max(count // 3, 1), count),
        sensor=rng.integers(0, 2, count),
    )


def rows(readings: Readings) -> list[tuple[object, ...]]:
    """The readings in canonical order."""
    names = np.array(readings.sensor_names or ('',))[readings.sensor]
    columns = (readings.x, readings.y, readings.yaw, readings.z, readings.stamp, names)
    return sorted(zip(*(column.tolist() for column in columns), strict=True))


def appended(readings: Readings, bound: int, order: np.ndarray) -> ReadingBuffer:
    buffer = ReadingBuffer(bound)
    columns = {f.name: getattr(readings, f.name) for f in dataclasses.fields(readings) if f.name != 'sensor_names'}
    sensor = columns.pop('sensor')
    for k in order:
        values = {name: column[k] for name, column in columns.items()}
        buffer.append(readings.sensor_names[sensor[k]], **values)
    return buffer


@settings(deadline=None, max_examples=60)
@given(st.integers(0, 2**32 - 1), st.integers(1, 300), st.integers(1, 120), st.integers(1, 40))
def test_kept_readings_do_not_depend_on_order_or_time_of_thinning(
    seed: int, count: int, bound: int, places: int
) -> None:
    rng = np.random.default_rng(seed)
    readings = made(rng, count, places)
    expected = rows(readings.select(kept(readings, bound)))
    assert len(expected) == min(count, bound)
    for order in (np.arange(count), rng.permutation(count)):
        buffer = appended(readings, bound, order)
        assert len(buffer) == count
        assert buffer.stored <= bound + bound // 8
        assert rows(buffer.bounded()) == expected


def test_standstill_removes_only_repeated_readings() -> None:
    drive = corridor_drive(0).readings
    rng = np.random.default_rng(1)
    still = dataclasses.replace(
        drive.select(rng.integers(0, 24, 50_000)), stamp=drive.stamp.max() + np.arange(50_000, dtype=np.int64)
    )
    buffer = ReadingBuffer(len(drive) + 500)
    buffer.extend(drive)
    buffer.extend(still)
    left = buffer.bounded()
    assert len(left) == len(drive) + 500
    moved = left.stamp <= drive.stamp.max()
    # repeated readings of the drive itself are removed as well, but each bin keeps one
    assert np.count_nonzero(moved) > 0.9 * len(drive)


def test_quarter_of_the_readings_gives_about_the_same_map() -> None:
    drive = corridor_drive(0, passes=2)
    visible = visible_surface(drive.world, drive.readings.select(slice(None, None, 40)))
    few = drive.readings.select(kept(drive.readings, len(drive.readings) // 4))
    scores = []
    for readings in (drive.readings, few):
        maps = Mapper(Parameters()).run(readings)
        scores.append(score_map(maps.ml, maps.grid, drive.world, visible))
    assert scores[1].doors_open == scores[0].doors_open == 6
    assert scores[1].f1 > scores[0].f1 - 0.05


def test_each_reading_is_seen_before_thinning() -> None:
    rng = np.random.default_rng(3)
    readings = made(rng, 1000)
    buffer = ReadingBuffer(64)
    seen: list[Readings] = []

    def look() -> None:
        seen.append(buffer.snapshot(sum(map(len, seen))))

    buffer.before_thinning.append(look)
    for part in np.array_split(np.arange(1000), 40):
        buffer.extend(readings.select(part))
    look()
    assert sorted(row for part in seen for row in rows(part)) == rows(readings)


def test_thinning_without_memory_is_done_later() -> None:
    readings = made(np.random.default_rng(3), 1000)
    buffer, waiting = ReadingBuffer(64), list[Callable[[], None]]()
    buffer.run_in_background = lambda thin, done: waiting.append(lambda: done(thin()))
    full = [True]

    def look() -> None:
        if full:
            full.clear()
            raise MemoryError

    buffer.before_thinning.append(look)
    buffer.extend(readings.select(slice(0, 100)))
    with pytest.raises(MemoryError):
        waiting.pop()()
    assert buffer.stored == 100 and not waiting
    buffer.extend(readings.select(slice(100, 200)))
    waiting.pop()()
    assert buffer.stored <= 64 and len(buffer) == 200


def test_snapshots_from_another_thread_are_consistent() -> None:
    buffer = ReadingBuffer(500)
    done = threading.Event()
    wrong: list[str] = []

    def watch() -> None:
        while not done.is_set():
            seen = buffer.snapshot()
            if len(seen) and not (np.diff(seen.stamp) > 0).all():
                wrong.append('out of order')
            if not (seen.z == seen.stamp % 97 + 1.0).all():
                wrong.append('mixed')

    thread = threading.Thread(target=watch)
    thread.start()
    for k in range(20_000):
        buffer.append(
            'sonar', x=k % 50, y=0.0, yaw=0.0, z=k % 97 + 1.0, z_max=200.0, half_angle=0.1, sigma=0.0, stamp=k
        )
    done.set()
    thread.join(60.0)
    assert not wrong
    buffer.clear()
    assert (len(buffer), buffer.stored, len(buffer.snapshot(7))) == (0, 0, 0)
