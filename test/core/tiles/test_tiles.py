"""Tiles compared with the whole map: their readings, exact windows, and invisible seams."""

from __future__ import annotations

import dataclasses
import math
import pickle
import time
from concurrent.futures import ThreadPoolExecutor
from functools import lru_cache, partial
from typing import Any

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

import naive
from forward_grid_mapper.core.common.errors import Cancelled, InputError
from forward_grid_mapper.core.common.grid import Grid
from forward_grid_mapper.core.common.parameters import Parameters
from forward_grid_mapper.core.common.readings import Readings, in_canonical_order
from forward_grid_mapper.core.evidence.evidence import Evidence
from forward_grid_mapper.core.mapping import Mapper
from forward_grid_mapper.core.maps.log_odds_map import map_grid
from forward_grid_mapper.core.maps.map_set import MapSet
from forward_grid_mapper.core.maps.traversed import traversed_cells
from forward_grid_mapper.core.search.prior import log_prior, prior_gains, wall_prior
from forward_grid_mapper.core.search.search import LEAST_GAIN, ROUNDING, Search
from forward_grid_mapper.core.tiled_mapping import TiledMapper
from forward_grid_mapper.core.tiles import tile_steps
from forward_grid_mapper.core.tiles.mosaic import Mosaic
from forward_grid_mapper.core.tiles.schedule import Schedule
from forward_grid_mapper.core.tiles.tiling import Tiling, boxes_of, common_part, widest_of
from forward_grid_mapper.simulation.drive import corridor_drive, drive
from forward_grid_mapper.simulation.sonar import NOISY, front_array
from forward_grid_mapper.simulation.world import rooms_world
from samples import random_readings

AREA = Grid(0.1, -13, 7, 60, 45)
PAPER = {'end_cost': 0.0, 'least_passed': 0.0, 'max_incidence_angle': math.pi / 2}
TOUR = np.array([[1.5, 1.5], [3.0, 3.45], [9.0, 3.45], [9.0, 2.0], [10.5, 6.5]])


@lru_cache
def tour() -> Readings:
    return drive(rooms_world(), TOUR, 0.1, front_array(), NOISY, seed=2).readings


@lru_cache
def whole(**settings: Any) -> MapSet:
    return Mapper(Parameters().varied(settings)).run(tour())


def mosaic(readings: Readings, parameters: Parameters, size: float) -> Mosaic:
    readings = in_canonical_order(readings)
    return Mosaic(readings, map_grid(readings, parameters), parameters, size)


def with_normals(made: Mosaic, parameters: Parameters) -> Mosaic:
    for number in made.filled:
        made.store_normals(number, tile_steps.estimate_normals(made.input_of(number), parameters))
    return made


# ---- tiles


@settings(max_examples=10, deadline=None)
@given(seed=st.integers(0, 10**6), size=st.floats(0.8, 9.0))
def test_tile_has_all_readings_that_touch_its_window(seed: int, size: float) -> None:
    p = Parameters()
    readings = random_readings(np.random.default_rng(seed), AREA, 12, z_max=3.0)
    grid = map_grid(readings, p)
    boxes = boxes_of(readings, p)
    tiling = Tiling(grid, size, widest_of(boxes))
    cores = np.zeros(grid.shape, int)
    for tile in tiling.tiles:
        cores[grid.window(tile.core)] += 1
    assert (cores == 1).all()
    cells = [naive.cells_of(readings, t, grid, p.model) for t in range(len(readings))]
    touched = [[divmod(c, grid.width) for c in of] for of in cells]
    found = tiling.readings_of(boxes)
    for number, tile in enumerate(tiling.tiles):
        np.testing.assert_array_equal(np.flatnonzero(tiling.touching(number, boxes)), found[number])
        for window in (False, True):
            part = (tile.core, tile.window)[window]
            near = [k for k, t in enumerate(tiling.tiles) if common_part((t.core, t.window)[window], part).size]
            assert set(near) <= set(tiling.with_windows_in(part) if window else tiling.with_cores_in(part)), (
                'a tile that lies there is missing'
            )
        box = tiling.box(number, readings.select(found[number]), p)
        for k, other in enumerate(tiling.tiles):
            if common_part(other.core, box).size:
                assert number in tiling.with_boxes_in(other.core), f'the box of {number} overlaps the core of {k}'
    for tile, indices in zip(tiling.tiles, found, strict=True):
        rows, columns = grid.window(tile.window)
        inside = {
            t
            for t, cells in enumerate(touched)
            if any(rows.start <= r < rows.stop and columns.start <= c < columns.stop for r, c in cells)
        }
        assert inside <= set(indices.tolist())
        assert (np.diff(indices) > 0).all()
    owners = tiling.owners(readings)
    for t, owner in enumerate(owners.tolist()):
        assert t in found[owner]
    for colour in tiling.colours:
        of_colour = np.concatenate([found[number] for number in colour])
        assert len(of_colour) == len(set(of_colour.tolist())), 'two tiles of one colour share a reading'
    assert sorted(number for colour in tiling.colours for number in colour) == list(range(len(tiling.tiles)))


def test_boxes_of_far_tiles_are_not_searched() -> None:
    tiling = Tiling(Grid(0.1, 0, 0, 4000, 4000), 10.0, 5.0)
    near = tiling.with_boxes_in(tiling.tiles[len(tiling.tiles) // 2 + 20].core)
    assert len(near) == 9


def test_schedule_of_many_tiles_takes_no_time() -> None:
    across = range(-30, 30)
    boxes = {60 * r + c + 2000: Grid(0.1, 100 * c - 30, 100 * r - 30, 160, 160) for r in across for c in across}
    schedule, begun = Schedule(boxes), time.process_time()
    for number, box in boxes.items():
        schedule.searched(number, box)
    assert time.process_time() - begun < 5.0, 'the whole map is gone through for each box, one by one'
    schedule = Schedule(boxes, ())
    changed = Grid(0.1, -40, 71, 10, 5)
    schedule.searched(7, changed)
    assert schedule.stale == {k for k, box in boxes.items() if common_part(box, changed).size} != set()


# ---- windows


@pytest.mark.parametrize('size', [2.0, 5.0])
@pytest.mark.parametrize('settings', [{}, PAPER])
def test_normals_evidence_and_maps_of_cores_equal_those_of_the_whole(size: float, settings: dict[str, Any]) -> None:
    p, maps = Parameters().varied(settings), whole(**settings)
    made = with_normals(mosaic(tour(), p, size), p)
    np.testing.assert_array_equal(made.all_normals().x, maps.normals.x)
    np.testing.assert_array_equal(made.all_normals().known, maps.normals.known)
    made.occupied[:] = maps.searched == 1
    evidence = Evidence(maps.grid, p.model, start=made.occupied)
    evidence.extend(made.readings)
    total = evidence.state.maps.evidence.reshape(maps.grid.shape)
    for number in made.filled:
        around = made.input_of(number)
        own = tile_steps._evidence(around, p).state.maps.evidence.reshape(around.box.shape)
        window = around.tile.window
        np.testing.assert_array_equal(own[around.box.window(window)], total[maps.grid.window(window)])
    searched = 0.0
    for number in range(len(made.tiling.tiles)):
        done = tile_steps.finish_core(made.input_of(number), p)
        made.store_finished(number, done)
        searched += done.log_likelihood
    for number in made.filled:
        made.store_judged(number, tile_steps.judge_readings(made.input_of(number), p))
    made.dynamic[made.ml != 0] = 0
    for name in ('ml', 'uncertainty', 'searched', 'unexplained', 'dynamic'):
        np.testing.assert_array_equal(getattr(made, name), getattr(maps, name), name)
    assert made.log_likelihood.sum() == maps.log_likelihood
    assert searched == pytest.approx(maps.statistics['searched_log_likelihood'], abs=1e-6)


def test_held_cells_do_not_change() -> None:
    p = Parameters()
    rng = np.random.default_rng(3)
    readings = in_canonical_order(tour())
    grid = map_grid(readings, p)
    traversed = traversed_cells(readings, grid)
    start = ((rng.random(grid.shape) < 0.05) & ~traversed).astype(np.uint8)
    for _ in range(8):
        bottom, left = int(rng.integers(0, grid.height - 20)), int(rng.integers(0, grid.width - 20))
        window = bottom, bottom + 20, left, left + 20
        evidence = Evidence(grid, p.model, start=start)
        evidence.extend(readings)
        search = Search(evidence, p.search, traversed.ravel(), window, hold=True)
        prior = wall_prior(p.search, traversed.ravel(), grid.resolution)
        before = _objective(evidence, prior)
        found = search.improve()
        after = evidence.state.maps.occupied.reshape(grid.shape)
        outside = np.ones(grid.shape, bool)
        outside[bottom : bottom + 20, left : left + 20] = False
        np.testing.assert_array_equal(after[outside], start[outside])
        assert found.progress.flips > 0
        assert _objective(evidence, prior) > before


def _objective(evidence: Evidence, prior: Any) -> float:
    return evidence.tempered_log_likelihood + log_prior(
        prior, evidence.state.maps.occupied, evidence.state.maps.pattern
    )


# ---- the map


@pytest.mark.parametrize(('size', 'settings'), [(2.0, {}), (5.0, {}), (5.0, PAPER)])
def test_no_flip_gains_anywhere_at_the_end(size: float, settings: dict[str, Any]) -> None:
    p = Parameters().varied(settings)
    maps = TiledMapper(p, size).run(tour())
    occupied = (maps.searched == 1).astype(np.uint8)
    evidence = Evidence(maps.grid, p.model, start=occupied)
    evidence.extend(maps.readings)
    traversed = traversed_cells(maps.readings, maps.grid).ravel()
    prior = wall_prior(p.search, traversed, maps.grid.resolution)
    state = evidence.state.maps
    gain = state.evidence * evidence.state.model.nats
    gain += prior_gains(prior, state.occupied, state.pattern, maps.grid.width)
    seen = state.seen > 0
    assert (gain <= LEAST_GAIN + ROUNDING * state.seen + 1e-9)[seen].all()
    assert not occupied.ravel()[traversed].any()
    assert maps.statistics['searched_objective'] == pytest.approx(_objective(evidence, prior), abs=1e-6)
    reference = whole(**settings)
    assert maps.grid == reference.grid
    np.testing.assert_array_equal(maps.live, reference.live)
    best = reference.statistics['searched_objective']
    assert maps.statistics['searched_objective'] >= best - 0.003 * abs(best)


def test_single_tile_gives_the_whole_map() -> None:
    # tiles meet at the origin
    readings = dataclasses.replace(tour(), x=tour().x + 100.0, y=tour().y + 100.0)
    maps, reference = TiledMapper(Parameters(), 1000.0).run(readings), Mapper(Parameters()).run(readings)
    assert maps.statistics['tiles'] == 1
    for name in ('live', 'ml', 'uncertainty'):
        np.testing.assert_array_equal(getattr(maps, name), getattr(reference, name))


def test_maps_do_not_depend_on_how_many_tiles_are_searched_at_once() -> None:
    maps = [TiledMapper(Parameters(), 3.0).run(tour())]
    with ThreadPoolExecutor(4) as pool:
        maps.append(TiledMapper(Parameters(), 3.0, pool.map, 4).run(tour()))

    def backwards(work: Any, items: Any) -> list[Any]:
        return [work(item) for item in list(items)[::-1]][::-1]

    shuffled = tour().select(np.random.default_rng(0).permutation(len(tour())))
    maps.append(TiledMapper(Parameters(), 3.0, backwards).run(shuffled))
    for other in maps[1:]:
        for name in ('live', 'ml', 'uncertainty', 'searched', 'dynamic'):
            np.testing.assert_array_equal(getattr(other, name), getattr(maps[0], name))
        assert other.objective == maps[0].objective
        assert other.statistics['flips'] == maps[0].statistics['flips']


def test_tiles_as_small_as_a_cone_give_about_the_same_map() -> None:
    readings, p = corridor_drive(0).readings, Parameters()
    reference = Mapper(p).run(readings)
    maps = TiledMapper(p, 5.0).run(readings)
    best = reference.statistics['searched_objective']
    assert maps.statistics['searched_objective'] >= best - 0.001 * abs(best)
    # the number of occupied cells is about the same with and without tiles
    walls = [int((m.ml == 1).sum()) for m in (maps, reference)]
    assert abs(walls[0] - walls[1]) < 0.02 * walls[1]
    # readings near a seam are explained as well as others
    near = [np.abs((m.readings.x + 2.5) % 5.0 - 2.5) < 0.5 for m in (maps, reference)]
    share = [
        [float(m.unexplained[side].mean()) for side in (n, ~n)] for m, n in zip((maps, reference), near, strict=True)
    ]
    assert share[0][0] - share[1][0] == pytest.approx(share[0][1] - share[1][1], abs=0.01)


def test_tiled_mapper_can_be_cancelled_and_rejects_bad_input() -> None:
    mapper = TiledMapper(Parameters(), 3.0)
    with pytest.raises(Cancelled):
        mapper.run(tour(), lambda stage, progress: mapper.cancel() if stage == 'search' else None)
    with pytest.raises(InputError, match='max_cells'):
        TiledMapper(Parameters().varied({'max_cells': 10_000, 'resolution': 0.05}), 3.0).run(tour())
    with pytest.raises(InputError, match='nothing to map'):
        TiledMapper(Parameters(), 3.0).run(tour().select(slice(0, 0)))


def test_surroundings_of_a_tile_can_be_pickled() -> None:
    p = Parameters()
    made = with_normals(mosaic(tour(), p, 4.0), p)
    number = made.filled[len(made.filled) // 2]
    around = made.input_of(number)
    job = pickle.loads(pickle.dumps(partial(tile_steps.search_alone, parameters=p)))
    sent = pickle.loads(pickle.dumps(around))
    np.testing.assert_array_equal(job(sent).occupied, tile_steps.search_alone(around, p).occupied)
    assert dataclasses.asdict(sent.readings).keys() == dataclasses.asdict(around.readings).keys()
