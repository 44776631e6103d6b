"""Cells that the robot drove over: at each pose and between consecutive poses."""

from __future__ import annotations

import dataclasses
import math

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from forward_grid_mapper.core.common.grid import Grid
from forward_grid_mapper.core.common.readings import Readings
from forward_grid_mapper.core.maps.traversed import (
    LONGEST_PAUSE,
    LONGEST_STEP,
    MEANWHILE,
    STRIDES,
    longest_step,
    mark_traversed,
    traversed_cells,
)

GRID = Grid(0.1, -10, 5, 40, 30)
MS = 1_000_000


def readings_at(x: list[float], y: list[float], stamp: list[int]) -> Readings:
    return Readings.from_columns(x=x, y=y, yaw=0.0, z=np.ones(len(x)), z_max=2.0, half_angle=0.1, stamp=stamp)


def cells(*places: tuple[float, float]) -> set[tuple[int, int]]:
    out = {(math.floor(y / 0.1) - GRID.row, math.floor(x / 0.1) - GRID.column) for x, y in places}
    return {(r, c) for r, c in out if 0 <= r < GRID.height and 0 <= c < GRID.width}


def traversed_by(*arguments: list[float]) -> set[tuple[int, int]]:
    return {(int(r), int(c)) for r, c in np.argwhere(traversed_cells(readings_at(*arguments), GRID))}


@settings(max_examples=60, deadline=None)
@given(st.integers(0, 2**32 - 1), st.integers(1, 12))
def test_traversed_cells_are_those_of_points_and_lines_between(seed: int, count: int) -> None:
    rng = np.random.default_rng(seed)
    x, y = np.cumsum(rng.uniform(-0.5, 0.5, (2, count)), axis=1) + np.array([[0.5], [2.0]])
    stamp = np.cumsum(rng.choice([0, 100, 400, 600], count)) * MS
    shuffle = rng.permutation(count) if len(set(stamp)) == count else np.arange(count)
    found = traversed_by(x[shuffle], y[shuffle], stamp[shuffle])
    expected = cells(*zip(x, y, strict=True))
    assert expected <= found
    near = set(expected)
    for i, j in ((i, i + stride) for i in range(count) for stride in STRIDES if i + stride < count):
        step = math.hypot(x[j] - x[i], y[j] - y[i])
        if stamp[j] - stamp[i] <= LONGEST_PAUSE and step <= LONGEST_STEP:
            way = [(x[i] + f * (x[j] - x[i]), y[i] + f * (y[j] - y[i])) for f in np.linspace(0, 1, 400)]
            near |= cells(*way)
            # points on the line are at most a quarter of a cell apart
            coarse = int(step / 0.1 * 4.0) + 2
            expected |= cells(
                *((x[i] + f * (x[j] - x[i]), y[i] + f * (y[j] - y[i])) for f in np.arange(coarse) / (coarse - 1))
            )
    assert found <= near | expected
    assert len(found ^ expected) <= 2, 'but for rounding'


@pytest.mark.parametrize('count', [8, 12, 16, 24])
def test_middle_of_a_ring_of_sonars_is_traversed_at_standstill(count: int) -> None:
    yaw = np.arange(2 * count) * 2 * math.pi / count
    x, y = 0.52 + 0.25 * np.cos(yaw), 1.97 + 0.25 * np.sin(yaw)
    found = traversed_by(x, y, np.arange(2 * count) * 10 * MS)
    inside = cells(*((0.52 + u, 1.97 + v) for u in (-0.1, 0.0, 0.1) for v in (-0.1, 0.0, 0.1)))
    # free space reaches a cell beyond the traversed cells
    beside = {(row + v, column + u) for row, column in found for u in (-1, 0, 1) for v in (-1, 0, 1)}
    assert inside <= beside


@pytest.mark.parametrize(
    ('pause', 'step', 'joined'), [(400, 0.7, True), (500, 0.7, True), (501, 0.7, False), (400, 0.81, False)]
)
def test_poses_with_a_long_pause_or_step_are_not_joined(pause: int, step: float, joined: bool) -> None:
    found = traversed_by([0.05, 0.05 + step], [1.05, 1.05], [0, pause * MS])
    assert len(found) == (round(step / 0.1) + 1 if joined else 2)


def ring(radius: float, count: int, sweeps: int, drive: float = 0.0, jump: float = 0.0) -> Readings:
    """Sweeps of a ring of sonars on a robot that drives `drive` metres a sweep and jumps before the last one."""
    k = np.arange(count * sweeps)
    yaw = k % count * 2 * math.pi / count
    x = 1.0 + drive * (k / count) + np.where(k // count == sweeps - 1, jump, 0.0)
    return Readings.from_columns(
        tuple(f'sonar_{n}' for n in range(count)),
        x=x + radius * np.cos(yaw),
        y=2.0 + radius * np.sin(yaw),
        yaw=yaw,
        z=np.ones(len(k)),
        z_max=2.0,
        half_angle=0.1,
        stamp=k * 15 * MS,
        sensor=k % count,
    )


@pytest.mark.parametrize('radius', [0.25, 0.75, 1.2])
@pytest.mark.parametrize('drive', [0.0, 0.2])
def test_middle_of_a_large_robot_is_traversed(radius: float, drive: float) -> None:
    readings = ring(radius, 16, 5, drive)
    found = {(int(r), int(c)) for r, c in np.argwhere(traversed_cells(readings, GRID))}
    beside = {(row + v, column + u) for row, column in found for u in (-1, 0, 1) for v in (-1, 0, 1)}
    inside = cells(*((1.0 + u, 2.0 + v) for u in (-0.1, 0.0, 0.1) for v in (-0.1, 0.0, 0.1)))
    assert inside <= beside
    assert LONGEST_STEP <= longest_step(readings)
    assert longest_step(readings) == pytest.approx(max(LONGEST_STEP, 2 * radius + MEANWHILE), abs=0.5 * drive + 1e-9)


@pytest.mark.parametrize('radius', [0.25, 0.75])
@pytest.mark.parametrize('jump', [1.9, 2.4])
def test_jump_is_not_joined_at_any_size_of_the_robot(radius: float, jump: float) -> None:
    wide = Grid(0.1, -10, -10, 80, 60)
    still, jumped = ring(radius, 16, 6), ring(radius, 16, 6, jump=jump)
    assert longest_step(jumped) == pytest.approx(longest_step(still))
    ahead = dataclasses.replace(still, x=still.x + jump)
    either = traversed_cells(still, wide) | traversed_cells(ahead, wide)
    found = traversed_cells(jumped, wide)
    _, columns = np.nonzero(found & ~either)
    # cells between the two places, except for pairs of sensors that the jump brought closer together
    x, _ = wide.centers()
    between = (x[columns] > 1.0 + radius + 0.1) & (x[columns] < 1.0 + jump - radius - 0.1)
    assert not between.any() or jump - 2 * radius < longest_step(still)


def test_longest_step_with_two_sensors() -> None:
    two = readings_at([0.0, 3.0] * 2, [2.0] * 4, [0, 1, 2, 3])
    two = dataclasses.replace(two, sensor=np.array([0, 1, 0, 1], np.int32), sensor_names=('a', 'b'))
    assert longest_step(two) == pytest.approx(3.0 + MEANWHILE)
    assert longest_step(two.select(slice(0, 3))) == LONGEST_STEP
    far = dataclasses.replace(two, x=two.x * 2)
    assert longest_step(far) == LONGEST_STEP, 'sensors of one robot are not so far apart'
    assert longest_step(two.select(slice(0, 0))) == LONGEST_STEP


def test_traversed_cells_follow_the_order_of_stamps() -> None:
    # there and back: in the given order, the ends would be joined
    x, y, stamp = [0.05, 1.65, 0.85], [1.05, 1.05, 1.05], [0, 600 * MS, 300 * MS]
    assert traversed_by(x, y, stamp) == cells(*((0.05 + 0.1 * k, 1.05) for k in range(17)))


def test_poses_off_the_grid_are_ignored_and_set_cells_stay_set() -> None:
    assert traversed_by([-1e6, 1e6, 0.05], [0.0, 0.0, 1.05], [0, 1, 2]) == cells((0.05, 1.05))
    traversed = np.zeros(GRID.shape, bool)
    traversed[3, 4] = True
    mark_traversed(np.zeros(0), np.zeros(0), np.zeros(0, np.int64), GRID, traversed)
    mark_traversed(np.array([0.05]), np.array([1.05]), np.array([7]), GRID, traversed)
    assert {(int(r), int(c)) for r, c in np.argwhere(traversed)} == {(3, 4)} | cells((0.05, 1.05))
