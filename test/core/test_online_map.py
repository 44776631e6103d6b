"""The online map: about as good as a batch, and of constant memory for repeated readings."""

from __future__ import annotations

import dataclasses
import importlib.util
import math
from pathlib import Path
from types import ModuleType
from typing import NamedTuple

import numpy as np
import pytest
from failing import Allocations

from forward_grid_mapper.core import online_map
from forward_grid_mapper.core.common.errors import InputError
from forward_grid_mapper.core.common.grid import Grid, part_of, united
from forward_grid_mapper.core.common.parameters import Parameters
from forward_grid_mapper.core.common.readings import Readings
from forward_grid_mapper.core.evidence import evidence as evidence_module
from forward_grid_mapper.core.evidence.evidence import Evidence
from forward_grid_mapper.core.evidence.neighbourhood import patterns
from forward_grid_mapper.core.mapping import Mapper
from forward_grid_mapper.core.online_map import MARGIN, OnlineMap
from forward_grid_mapper.core.runtime import threads
from forward_grid_mapper.core.sensor.cone_table import walk
from forward_grid_mapper.recordings.read_drive import read_drive
from forward_grid_mapper.simulation.drive import Recording, corridor_drive, door_drive
from forward_grid_mapper.simulation.score import score_map, visible_surface
from forward_grid_mapper.simulation.sonar import NOISY, sonar_ring
from samples import PLAIN, random_readings

AREA = Grid(0.1, -5, 3, 40, 30)


def in_sweeps(readings: Readings, parameters: Parameters, size: int = 24) -> OnlineMap:
    online = OnlineMap(parameters)
    for begin in range(0, len(readings), size):
        online.add(readings.select(slice(begin, begin + size)))
    return online


def f1(recording: Recording, readings: Readings, grid: Grid, ml: np.ndarray) -> float:
    return score_map(ml, grid, recording.world, visible_surface(recording.world, readings)).f1


def some(seed: int = 0, count: int = 150) -> Readings:
    readings = random_readings(np.random.default_rng(seed), AREA, count, z_max=2.0)
    readings.half_angle[:] = 0.2
    return readings


def consistent(online: OnlineMap) -> bool:
    """Whether the whole state equals one built from the current map."""
    evidence = online._evidence
    maps = evidence.state.maps
    stored = [maps.evidence.copy(), maps.pattern.copy()]
    likelihood = evidence.log_likelihood
    evidence.rebuild()
    return (
        np.array_equal(stored[0], maps.evidence)
        and np.array_equal(stored[1], patterns(maps.occupied, evidence.grid.shape))
        and likelihood == evidence.log_likelihood
    )


@pytest.mark.parametrize('drive', ['door', 'corridor'])
def test_readings_in_sweeps_give_about_the_map_of_a_batch(drive: str) -> None:
    recording = door_drive(3, NOISY) if drive == 'door' else corridor_drive()
    readings = recording.readings
    parameters = Parameters()
    maps = Mapper(parameters).run(readings)
    online = in_sweeps(readings, parameters)
    grid, ml, uncertainty = online.maps()
    assert ml.shape == uncertainty.shape == grid.shape
    assert (ml[np.isnan(uncertainty)] == -1).all()
    whole, found = f1(recording, readings, maps.grid, maps.ml), f1(recording, readings, grid, ml)
    assert found > whole - 0.03
    assert consistent(online)


def test_grid_is_that_of_a_batch() -> None:
    maps = Mapper(Parameters()).run(some())
    assert in_sweeps(some(), Parameters()).grid == maps.grid


def test_growing_grid_keeps_the_state(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(online_map, 'REFINE_LEAST', math.inf)
    near = some()
    away = dataclasses.replace(near, x=near.x + 25.0, y=near.y - 18.0, stamp=near.stamp + 10**12)
    # a few readings that are sufficient for walls
    online = in_sweeps(near, Parameters().varied({'p_rand': 0.3, 'p_lost': 0.4}))
    grid, before = online.maps()[:2]
    room = online._evidence.grid
    traversed, since = online._traversed.copy(), online._not_refined
    online.add(away)
    larger, ml = online.maps()[:2]
    assert online._evidence.grid.size > room.size
    assert larger.union(grid) == larger
    assert np.array_equal(part_of(larger, ml, grid), before)
    assert (ml == 1).sum() > (before == 1).sum()
    assert len(online) == len(near) + len(away)
    rows, columns = online._evidence.grid.window(room)
    assert online._traversed[rows, columns][traversed].all()
    moved = since[0] + rows.start, since[1] + rows.start, since[2] + columns.start, since[3] + columns.start
    assert online._not_refined == united(moved, online._around(online._evidence, away)), 'what is to be refined'
    assert consistent(online)
    again = in_sweeps(near, Parameters())
    assert again._evidence.grid == room
    assert room.width >= grid.width + 2 * MARGIN


@pytest.mark.parametrize('values', [PLAIN, {}], ids=['plain', 'whole'])
def test_repeated_readings_only_add_weight(values: dict[str, float]) -> None:
    readings = some()
    online = in_sweeps(readings, Parameters().varied(values), 150)
    count = len(online)
    # after some repetitions normals no longer change, and pairs are computed again where they change
    for _ in range(4):
        online.add(readings)
    taken = online._evidence.nbytes
    for _ in range(3):
        online.add(readings)
    assert len(online) == count
    assert online._evidence.nbytes == taken
    evidence = online._evidence
    weight = evidence.state.reading_states['multiplicity'][:count]
    assert weight.sum() == 8 * len(readings)
    # as if each kept reading had come this number of times
    often = Evidence(evidence.grid, evidence.model, start=evidence.state.maps.occupied.reshape(evidence.grid.shape))
    kept = np.array(sorted(set(online._index_by_key.values())))
    assert kept.tolist() == list(range(count))
    first: dict[int, int] = {}
    for i, key in enumerate(keys_of(online, readings)):
        first.setdefault(online._index_by_key[key], i)
    often.extend(readings.select(np.repeat([first[k] for k in range(count)], weight)))
    for name in ('evidence', 'seen', 'pattern'):
        assert np.array_equal(getattr(often.state.maps, name), getattr(evidence.state.maps, name))
    assert often.log_likelihood == evidence.log_likelihood
    assert consistent(online)


def keys_of(online: OnlineMap, readings: Readings) -> list[bytes]:
    """The keys under which the readings are counted, one for each."""
    out = []
    for i in range(len(readings)):
        fresh = OnlineMap(online._parameters)
        out += fresh._keys(readings.select(slice(i, i + 1)))
    return out


@pytest.mark.parametrize(
    ('change', 'same'),
    [
        ({'x': 0.004}, True),
        ({'x': 0.06}, False),
        ({'yaw': 0.01}, True),
        ({'yaw': 0.12}, False),
        ({'z': 0.01}, True),
        ({'z': 0.06}, False),
        ({'z_max': 0.5}, False),
        ({'half_angle': 0.01}, False),
        ({'stamp': 10**12}, True),
    ],
    ids=str,
)
def test_only_readings_near_in_all_values_are_merged(change: dict[str, float], same: bool) -> None:
    # in the middle of the steps within which readings are merged
    at: dict[str, object] = {'x': 1.02, 'y': 1.02, 'yaw': 0.02, 'z': 1.02, 'z_max': 3.0, 'half_angle': 0.2, 'stamp': 0}
    online = OnlineMap(Parameters())
    for values in (at, at | {name: at[name] + step for name, step in change.items()}):
        online.add(Readings.from_columns(**{k: [v] if k == 'z' else v for k, v in values.items()}))
    assert len(online) == (1 if same else 2)


@pytest.mark.parametrize('portion', [1, 7, 1000])
def test_numbers_of_readings_do_not_depend_on_portions(monkeypatch: pytest.MonkeyPatch, portion: int) -> None:
    readings = some(3, 60).select(np.r_[0:40, 20:60, 0:60])
    expected = OnlineMap(Parameters())
    expected.add(readings)
    monkeypatch.setattr(online_map, 'PORTION', portion)
    monkeypatch.setattr(online_map, 'PARTS', 3)
    online = OnlineMap(Parameters())
    online.add(readings)
    numbers: dict[bytes, int] = {}
    for key in keys_of(online, readings):
        numbers.setdefault(key, len(numbers))
    assert dict(online._index_by_key) == dict(expected._index_by_key) == numbers
    assert state_of(online).same(state_of(expected))
    online.dismantle()
    assert len(online._index_by_key) == 0 == len(list(online._index_by_key))


def test_keys_ignore_the_sign_of_zero() -> None:
    reading = dataclasses.replace(some(count=1), x=np.zeros(1), y=np.zeros(1), yaw=np.zeros(1))
    below = dataclasses.replace(reading, x=-reading.x, y=-reading.y, yaw=-reading.yaw)
    (one,), (other,) = (OnlineMap(Parameters())._keys(each) for each in (reading, below))
    assert one == other


def test_readings_of_different_sensors_are_not_merged() -> None:
    reading = some(count=1)
    online = OnlineMap(Parameters())
    online.add(reading)
    online.add(dataclasses.replace(reading, sensor=reading.sensor + 1, sensor_names=('left', 'right')))
    assert len(online) == 2


def test_map_can_be_adopted() -> None:
    readings, parameters = some(), Parameters()
    maps = Mapper(parameters).run(readings)
    online = in_sweeps(readings, parameters)
    online.adopt(maps.grid, maps.ml)
    grid, ml, _ = online.maps()
    occupied = online._evidence.state.maps.occupied.reshape(online._evidence.grid.shape)
    window = online._evidence.grid.window(maps.grid)
    assert np.array_equal(occupied[window] == 1, maps.ml == 1)
    assert occupied.sum() == (maps.ml == 1).sum()
    assert grid == maps.grid
    assert (ml[maps.ml == 1] == 1).all()
    assert consistent(online)
    # only a part: the other cells are free
    corner = Grid(grid.resolution, grid.column, grid.row, 5, 4)
    online.adopt(corner, np.ones(corner.shape, np.int8))
    assert online._evidence.state.maps.occupied.sum() == 20
    assert consistent(online)


def test_map_before_the_first_reading_is_empty() -> None:
    online = OnlineMap(Parameters())
    online.adopt(AREA, np.ones(AREA.shape, np.int8))
    online.add(some(count=0))
    grid, ml, uncertainty = online.maps()
    assert (grid.size, ml.size, uncertainty.size, len(online)) == (0, 0, 0, 0)


def same(a: OnlineMap, b: OnlineMap) -> bool:
    return a.grid == b.grid and all(
        np.array_equal(x, y, equal_nan=True) for x, y in zip(a.maps()[1:], b.maps()[1:], strict=True)
    )


def test_cleared_map_equals_a_new_one_and_empty_adds_have_no_effect() -> None:
    online, fresh = in_sweeps(some(1), Parameters()), in_sweeps(some(2), Parameters())
    online.clear()
    assert (len(online), online.grid.size) == (0, 0)
    for begin in range(0, 150, 24):
        online.add(some(count=0))
        online.add(some(2).select(slice(begin, begin + 24)))
    assert same(online, fresh)


@pytest.mark.parametrize('turned', [False, True])
def test_grid_of_a_corridor_has_margins_within_max_cells(turned: bool) -> None:
    way = np.arange(0.0, 60.0, 0.5)
    x, y = (way * 0.0, way) if turned else (way, way * 0.0)
    readings = Readings.from_columns(
        ('a',), x=x, y=y, yaw=way, z=np.ones(len(way)), z_max=2.0, half_angle=0.13, stamp=(way * 1e9).astype(np.int64)
    )
    online = in_sweeps(readings, Parameters())
    room, needed = online._evidence.grid, online.grid
    assert needed.width <= room.width <= 1.5 * needed.width + 2 * MARGIN
    assert needed.height <= room.height <= 1.5 * needed.height + 2 * MARGIN
    for most in (online.grid.size + 1000, room.size - 1):
        bounded = in_sweeps(readings, Parameters().varied({'max_cells': most}))
        assert bounded.grid == online.grid
        assert bounded._evidence.grid.size <= most


def test_sweep_of_a_driver_that_knows_no_largest_range_examines_only_its_surroundings() -> None:
    readings = Readings.from_columns(
        ('a',), x=[0.0, 0.0, 60.0], y=0.0, yaw=0.0, z=[1.0, 3.0, 1.0], z_max=3.4e38, half_angle=0.13, stamp=np.arange(3)
    )
    online = in_sweeps(readings, Parameters(), 2)
    left, right = online._around(online._evidence, readings.select(slice(2, 3)))[2:]
    assert online._evidence.grid.width > 600
    # it reaches 1.4 m, and the readings around as far as the longest one, 3.4 m
    assert 68 <= right - left <= 90
    assert consistent(online)


def test_many_readings_at_once_are_not_stored_twice() -> None:
    online = OnlineMap(Parameters())
    online.add(some(count=3000))
    assert len(online._size_readings) == online_map.MOST_SIZE_READINGS
    assert online._size_readings.x.base is None


def test_cells_below_a_large_robot_are_free() -> None:
    # two sensors 3 m apart, on both sides of a car
    way = np.repeat(np.arange(0.0, 12.0, 0.1), 2)
    left = np.tile([0, 1], len(way) // 2)
    side = 2.0 * left - 1.0
    moving = {'x': way, 'y': 1.5 * side + 0.05, 'yaw': side * np.pi / 2, 'sensor': left}
    readings = Readings.from_columns(
        ('right', 'left'),
        **moving,
        stamp=(way * 1e9).astype(np.int64) + left,
        z=np.ones(len(way)),
        z_max=2.0,
        half_angle=0.13,
    )
    online, whole = in_sweeps(readings, Parameters()), Mapper(Parameters()).run(readings)
    grid = online._evidence.grid
    across = np.full(28, 6.05), np.arange(-1.35, 1.45, 0.1)
    assert online._traversed[grid.cells_of(*across)].all()
    assert (whole.ml[whole.grid.cells_of(*across)] == 0).all()


def test_map_continues_without_memory_to_pack_pairs(monkeypatch: pytest.MonkeyPatch) -> None:
    recording = door_drive(3, NOISY, 0)
    whole = in_sweeps(recording.readings, Parameters())
    tried = []

    def grow(self: Evidence, grid: Grid) -> None:
        if grid == self.grid:
            tried.append(grid)
            raise MemoryError
        return was(self, grid)

    was = Evidence.grow
    monkeypatch.setattr(Evidence, 'grow', grow)
    monkeypatch.setattr(evidence_module, 'MOST_UNUSED', -1.0)
    short = in_sweeps(recording.readings, Parameters())
    assert tried and same(short, whole)


def test_jump_is_not_traversed() -> None:
    readings = some(count=2)
    readings.x[:], readings.y[:], readings.stamp[:] = [0.0, 12.0], [1.0, 1.0], [0, 10**8]
    online = OnlineMap(Parameters())
    for k in range(2):
        online.add(readings.select(slice(k, k + 1)))
    assert online._traversed.sum() == 2
    # the second robot drives on
    near = dataclasses.replace(readings.select(slice(1, 2)), x=np.array([12.5]), stamp=np.array([2 * 10**8]))
    online.add(near)
    assert online._traversed.sum() == 7
    local = online._prior.local.reshape(online._evidence.grid.shape)
    assert np.array_equal(local < local.max(), online._traversed)


def test_reading_too_far_away_is_rejected_and_changes_nothing() -> None:
    online = in_sweeps(some(), Parameters().varied({'max_cells': 100_000}))
    count, before = len(online), [array.copy() for array in online.maps()[1:]]
    far = dataclasses.replace(some(count=1), x=np.array([1e5]))
    with pytest.raises(InputError, match='max_cells'):
        online.add(far)
    assert len(online) == count
    for old, new in zip(before, online.maps()[1:], strict=True):
        assert np.array_equal(old, new, equal_nan=True)


def test_many_readings_at_once_give_the_map_of_a_batch(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(online_map, 'SEARCH_ALL_FROM', 100)
    values = {**PLAIN, 'resolution': 0.1}
    readings = some(count=140)
    online = OnlineMap(Parameters().varied(values))
    online.add(readings)
    assert len(online) == len(readings)
    maps = Mapper(Parameters().varied(values)).run(readings)
    grid, ml, uncertainty = online.maps()
    assert grid == maps.grid
    assert np.array_equal(ml, maps.ml)
    np.testing.assert_allclose(uncertainty, maps.uncertainty, atol=1e-5)


def test_map_is_searched_again_at_intervals(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(online_map, 'REFINE_EVERY', 50)
    often = in_sweeps(some(), Parameters())
    assert often._new_readings == 150 - 2 * 72
    # only what changed since is searched the next time
    assert often._not_refined == often._around(often._evidence, some().select(slice(144, 150)))
    assert consistent(often)
    for name in ('REFINE_EVERY', 'REFINE_LEAST'):
        monkeypatch.setattr(online_map, name, math.inf)
    never = in_sweeps(some(), Parameters())
    assert never._new_readings == 150
    heights = [online._evidence.log_likelihood for online in (often, never)]
    assert heights[0] != heights[1]


def test_repeated_readings_in_one_call_are_merged() -> None:
    readings = door_drive(1, NOISY, seed=0).readings.select(slice(0, 48))
    twice = readings.select(np.repeat(np.arange(len(readings)), 2))
    together, apart = OnlineMap(Parameters()), OnlineMap(Parameters())
    together.add(twice)
    apart.add(readings)
    kept = len(apart)
    apart.add(readings)
    assert len(together) == len(apart) == kept
    states = [online._evidence.state for online in (together, apart) if online._evidence is not None]
    weights = [state.reading_states['multiplicity'][:kept].tolist() for state in states]
    assert weights[0] == weights[1]
    assert sum(weights[0]) == len(twice)


def fed(parts: list[Readings], values: dict[str, float]) -> OnlineMap:
    online = OnlineMap(Parameters().varied(values))
    for part in parts:
        online.add(part)
    return online


class State(NamedTuple):
    """The whole state of readings and cells, by cell of the grid of the map."""

    arrays: list[np.ndarray]
    readings: object
    counts: tuple[int, int]

    def same(self, other: State) -> bool:
        equal = all(np.array_equal(*pair) for pair in zip(self.arrays, other.arrays, strict=True))
        return equal and self.readings == other.readings and self.counts == other.counts


def state_of(online: OnlineMap) -> State:
    evidence = online._evidence
    s, n = evidence.state, len(online)
    window = evidence.grid.window(online.grid)
    of_cells = (s.maps.occupied, s.maps.evidence, s.maps.seen, s.maps.pattern)
    arrays = [values.reshape(evidence.grid.shape)[window].copy() for values in of_cells]
    arrays += [s.reading_states[name][:n].copy() for name in ('multiplicity', 'occupy', 'release', 'likelihood')]
    if len(s.normals.known):
        arrays.append(s.normals.known.reshape(evidence.grid.shape)[window].copy())
    counts = online.taken, online._new_readings
    return State([*arrays, online._traversed[window].copy()], dict(online._index_by_key), counts)


@pytest.mark.slow
@pytest.mark.parametrize('case', ['first', 'more', 'grown', 'refined', 'many'])
def test_call_without_memory_adds_no_readings_or_all(monkeypatch: pytest.MonkeyPatch, case: str) -> None:
    monkeypatch.setattr(online_map, 'REFINE_LEAST', 60)
    monkeypatch.setattr(online_map, 'SEARCH_ALL_FROM', 50 if case == 'many' else 5000)
    monkeypatch.setattr(threads, 'LEAST_PART', 20)
    # every third reading repeats an earlier one
    readings = some(3, 100)
    readings = readings.select(np.r_[0:100, 0:50])
    parts = [readings.select(slice(k, k + 24)) for k in range(0, 144, 24)]
    if case == 'grown':
        # too few readings for a refinement of the map, which has its own case
        parts[1] = dataclasses.replace(parts[1], x=parts[1].x + 9.0, stamp=parts[1].stamp + 10**12)
    if case == 'many':
        parts = [parts[0], readings.select(slice(24, 100)), parts[5]]
    at = {'first': 0, 'more': 1, 'grown': 1, 'refined': 2, 'many': 1}[case]
    if case != 'many':
        # after the failing call comes one that repeats part of the first
        parts = [*parts[: at + 1], parts[4]]
    values = {'threads': 3}
    whole = fed(parts, values)
    # kernels cannot be compiled while functions of numpy are replaced
    expected, wanted = whole.maps(), state_of(whole)
    allocations = Allocations(monkeypatch)
    refused = searched_later = 0
    first = fed(parts[:at], values)
    for which in allocations.to_fail(lambda: first.add(parts[at])):
        online = fed(parts[:at], values)
        taken = online.taken
        try:
            with allocations.failing(which):
                online.add(parts[at])
        except MemoryError:
            pass
        done = allocations.count < which
        if online._evidence is not None:
            assert consistent(online)
            assert online._evidence.state.reading_states['multiplicity'][: len(online)].sum() == online.taken
        assert len(online._index_by_key) == len(online)
        assert online.taken in (taken, taken + len(parts[at]))
        accepted = online.taken > taken
        if not accepted:
            refused += 1
            online.add(parts[at])
        searched_later += accepted and not done
        for part in parts[at + 1 :]:
            online.add(part)
        if not accepted or done:
            assert state_of(online).same(wanted)
            for map_values, map_of in zip(online.maps()[1:], expected[1:], strict=True):
                assert np.array_equal(map_values, map_of, equal_nan=True)
        assert consistent(online)
        assert online.taken == whole.taken
        assert state_of(online).readings == wanted.readings
    assert done
    assert refused > 15
    assert searched_later or case == 'first'


def test_readings_that_could_not_be_added_are_not_known(monkeypatch: pytest.MonkeyPatch) -> None:
    readings, online = some(), OnlineMap(Parameters())
    online.add(readings.select(slice(0, 50)))

    def without_memory(*arguments: object) -> None:
        raise MemoryError

    with monkeypatch.context() as patched, pytest.raises(MemoryError):
        patched.setattr(Evidence, 'extend', without_memory)
        online.add(readings.select(slice(50, 100)))
    assert (len(online._index_by_key), online.taken) == (len(online), 50)
    online.add(readings.select(slice(50, 100)))
    assert (len(online._index_by_key), online.taken) == (len(online), 100)
    assert consistent(online)


def test_cells_count_merged_readings_with_their_multiplicity(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(online_map, 'REFINE_LEAST', 60)
    readings = some(4, 200)
    online = in_sweeps(readings.select(np.r_[0:200, 0:120, 40:200]), Parameters())
    assert online._evidence.state.normals.known.any()
    away = dataclasses.replace(readings.select(slice(0, 24)), x=readings.x[:24] + 30.0)
    online.add(away)
    evidence = online._evidence
    assert 0 < len(online) < online.taken
    times = evidence.state.reading_states['multiplicity'][: len(online)].astype(np.int64)
    cones = evidence.state.cones
    counted = np.zeros(evidence.grid.size, np.int64)
    cells, distances = np.empty(50_000, np.int32), np.empty(50_000)
    for t in range(len(online)):
        n = walk(cones, t, evidence.grid.shape, cells, distances)
        counted[cells[:n]] += times[t]
    assert np.array_equal(evidence.state.maps.seen, counted)
    assert times.max() > 1


@pytest.mark.parametrize('drive', ['door', 'corridor'])
def test_search_from_its_own_result_never_changes_the_map(drive: str) -> None:
    recording = door_drive(3, NOISY) if drive == 'door' else corridor_drive()
    readings = recording.readings.select(slice(0, 3000))
    parameters = Parameters()
    first = maps = Mapper(parameters).run(readings)
    assert first.searched.shape == first.grid.shape
    # walls are extended only once
    assert (first.searched == 1).sum() < (first.ml == 1).sum()
    for _ in range(3):
        maps = Mapper(parameters).run(readings, start=(maps.grid, maps.searched))
        assert np.array_equal(maps.ml, first.ml)
        assert np.array_equal(maps.searched, first.searched)
        assert maps.objective == first.objective
    online = in_sweeps(readings, parameters)
    online.adopt(first.grid, first.searched)
    counts = set()
    for _ in range(3):
        grid, searched = online.searched()
        online.adopt(grid, searched)
        counts.add((int((searched == 1).sum()), int((online.maps()[1] == 1).sum())))
    assert len(counts) == 1
    assert counts.pop()[0] == (first.searched == 1).sum()


def test_normals_are_those_of_all_readings_at_once() -> None:
    readings = door_drive(3, NOISY, seed=0).readings
    online = in_sweeps(readings, Parameters(), 8)
    online._refine(online._evidence)
    evidence = online._evidence
    # as if all readings had come at once
    kept = Evidence(evidence.grid, evidence.model, start=evidence.state.maps.occupied.reshape(evidence.grid.shape))
    first: dict[int, int] = {}
    for i, key in enumerate(keys_of(online, readings)):
        first.setdefault(online._index_by_key[key], i)
    times = evidence.state.reading_states['multiplicity'][: len(online)]
    kept.extend(readings.select(np.repeat([first[k] for k in range(len(online))], times)))
    for name in ('known', 'x', 'y', 'before'):
        assert np.array_equal(getattr(kept.state.normals, name), getattr(evidence.state.normals, name))
    for name in ('evidence', 'seen', 'pattern'):
        assert np.array_equal(getattr(kept.state.maps, name), getattr(evidence.state.maps, name))
    assert kept.log_likelihood == evidence.log_likelihood
    assert evidence.state.normals.known.sum() > 100


def scoring_tool(shared: Path) -> ModuleType:
    for needed in ('scipy', 'PIL'):
        pytest.importorskip(needed)
    spec = importlib.util.spec_from_file_location('score_map', shared / 'tools' / 'score_map.py')
    assert spec is not None
    assert spec.loader is not None
    module = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(module)
    return module


def test_few_readings_of_wide_cones_give_a_map_as_good_as_a_batch() -> None:
    wide = sonar_ring(field_of_view=math.radians(30.0))
    recording = door_drive(3, NOISY, seed=0, sonars=wide)
    maps = Mapper(Parameters()).run(recording.readings)
    grid, ml, _ = in_sweeps(recording.readings, Parameters()).maps()
    # without surface normals it is worse by .015
    assert f1(recording, recording.readings, grid, ml) > f1(recording, recording.readings, maps.grid, maps.ml) - 0.01


@pytest.mark.parametrize('name', ['office_a', 'office_b'])
def test_recording_in_sweeps_gives_a_map_as_good_as_a_batch(shared: Path, name: str) -> None:
    tool, folder = scoring_tool(shared), shared / 'data' / name
    truth, origin, resolution = tool.load(folder / 'reference.yaml')
    path_xy = np.loadtxt(folder / 'trajectory.csv', delimiter=',', ndmin=2)
    readings = read_drive(folder / 'bag', Parameters(), {}, odom_topic='/odom_corrected').associator.readings

    def f1(grid: Grid, ml: np.ndarray) -> float:
        values = np.where(ml < 0, np.nan, ml)
        p = tool.resample(values, np.array(grid.origin), grid.resolution, truth.shape, origin, resolution)
        path = tool.path_cells(path_xy, origin, resolution, truth.shape)
        return float(tool.score(p, truth, path, resolution)['f1'])

    batch = Mapper(Parameters()).run(readings)
    grid, ml, _ = in_sweeps(readings, Parameters(), 8).maps()
    assert f1(grid, ml) > f1(batch.grid, batch.ml) - 0.02
