"""The whole run: properties of the three maps."""

from __future__ import annotations

import dataclasses
import math
from functools import lru_cache

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

import naive
from forward_grid_mapper.core.common.constants import FARTHEST_RANDOM
from forward_grid_mapper.core.common.errors import Cancelled, InputError
from forward_grid_mapper.core.common.grid import Grid
from forward_grid_mapper.core.common.parameters import Parameters
from forward_grid_mapper.core.common.readings import Readings
from forward_grid_mapper.core.mapping import Mapper
from forward_grid_mapper.core.maps import final_maps
from forward_grid_mapper.core.maps.map_set import MapSet
from forward_grid_mapper.core.maps.traversed import traversed_cells
from forward_grid_mapper.core.search.prior import wall_prior
from forward_grid_mapper.core.search.search import ROUNDING
from forward_grid_mapper.core.sensor.forward_model import log_likelihood
from forward_grid_mapper.simulation.drive import corridor_drive
from samples import PLAIN, PLAIN_MODEL, random_readings

AREA = Grid(0.1, -13, 4, 30, 20)


def run(readings: Readings, **values: object) -> MapSet:
    return Mapper(Parameters().varied(values)).run(readings)


def some(seed: int = 0, count: int = 400) -> Readings:
    readings = random_readings(np.random.default_rng(seed), AREA, count)
    readings.half_angle[:] = 0.15
    return readings


def same(a: MapSet, b: MapSet) -> bool:
    return a.grid == b.grid and all(
        np.array_equal(getattr(a, name), getattr(b, name), equal_nan=True) for name in ('live', 'ml', 'uncertainty')
    )


def test_maps_do_not_depend_on_the_order_of_arrival() -> None:
    readings = some()
    shuffled = readings.select(np.random.default_rng(1).permutation(len(readings)))
    assert same(run(readings), run(shuffled))


@pytest.mark.parametrize('z_max', [1e30, float(np.finfo(np.float32).max), 1e300])
def test_maps_of_a_driver_that_knows_no_largest_range(z_max: float) -> None:
    readings = some()
    readings = readings.select(readings.echo)
    made = [
        run(dataclasses.replace(readings, z_max=np.full(len(readings), limit)), p_rand=1e-4, p_lost=0.0, sigma=0.01)
        for limit in (z_max, FARTHEST_RANDOM)
    ]
    assert all(maps.statistics['converged'] for maps in made)
    assert same(*made)


def test_maps_do_not_depend_on_sensor_numbers() -> None:
    readings = some()
    half = (np.arange(len(readings)) % 2).astype(np.int32)
    stamps = np.arange(len(readings)) // 8
    a = dataclasses.replace(readings, sensor=half, stamp=stamps, sensor_names=('left', 'right'))
    b = dataclasses.replace(readings, sensor=(1 - half).astype(np.int32), stamp=stamps, sensor_names=('right', 'left'))
    assert same(run(a), run(b))


def mirrored(readings: Readings) -> Readings:
    return dataclasses.replace(readings, x=-readings.x, yaw=math.pi - readings.yaw)


def turned(readings: Readings) -> Readings:
    return dataclasses.replace(readings, x=-readings.y, y=readings.x.copy(), yaw=readings.yaw + math.pi / 2)


@pytest.mark.parametrize('values', [PLAIN, {}], ids=['paper', 'defaults'])
# fixed examples: in about one of a hundred, two moves of the search have exactly the same gain
@settings(max_examples=12, deadline=None, derandomize=True)
@given(seed=st.integers(0, 2**31 - 1), count=st.integers(1, 500))
def test_turned_or_mirrored_readings_give_turned_or_mirrored_maps(
    values: dict[str, float], seed: int, count: int
) -> None:
    # readings from irregular places: of flips with exactly the same gain, the first in the order of cells is taken
    readings = some(seed, count)
    plain, mirror, turn = (run(r, **values) for r in (readings, mirrored(readings), turned(readings)))
    for name, tolerance in (('ml', 0), ('live', 1e-5), ('uncertainty', 1e-4)):
        expected = getattr(plain, name)
        np.testing.assert_allclose(getattr(mirror, name)[:, ::-1], expected, atol=tolerance)
        np.testing.assert_allclose(np.rot90(getattr(turn, name), 1), expected, atol=tolerance)


@pytest.mark.parametrize('seed', range(4))
def test_mirrored_readings_with_plain_model_differ_only_by_ties(seed: int) -> None:
    # two neighbours may be equally near, and then the first in the order of cells is taken
    plain, mirror = (run(r, **PLAIN) for r in (some(seed), mirrored(some(seed))))
    assert (mirror.ml[:, ::-1] != plain.ml).sum() <= 4
    assert mirror.objective == pytest.approx(plain.objective, abs=2.0)


def test_maps_share_a_grid_and_match_likelihood_and_objective() -> None:
    maps = run(some(), **PLAIN)
    assert maps.live.shape == maps.ml.shape == maps.uncertainty.shape == maps.grid.shape
    assert np.array_equal(np.isnan(maps.uncertainty), maps.ml == -1)
    assert set(np.unique(maps.ml)) == {-1, 0, 1}
    likelihood = log_likelihood(maps.readings, maps.grid, maps.ml, maps.parameters.model)
    # logs are integers of rounded likelihoods
    error = ROUNDING * len(maps.readings)
    assert maps.log_likelihood == pytest.approx(likelihood, abs=error)
    prior = maps.parameters.search.prior
    assert maps.objective - maps.log_likelihood == pytest.approx(
        (maps.ml == 1).sum() * math.log(prior / (1 - prior)), abs=1e-9
    )
    assert not (maps.ml == 1)[traversed_cells(maps.readings, maps.grid)].any()


@pytest.mark.parametrize('values', [{}, {'least_passed': 1.5}, {'wall_cost': 3.0, 'likelihood_exponent': 1.0}])
def test_maps_share_a_grid_with_default_parameters(values: dict[str, float]) -> None:
    maps, plain = run(some(), **values), run(some(), **PLAIN)
    assert maps.live.shape == maps.ml.shape == maps.uncertainty.shape == maps.grid.shape
    determined = ~np.isnan(maps.uncertainty)
    traversed = traversed_cells(maps.readings, maps.grid)
    assert not (determined & (plain.ml == -1) & ~traversed).any(), 'what nobody saw is unknown'
    assert not (maps.ml[~determined] != -1).any(), 'and so is what the readings say nothing about'
    assert (maps.ml[determined] == -1).any(), 'of what was seen, but not gone through, they may say something'
    assert ((plain.ml != -1) & ~determined).any()


def test_cells_below_the_robot_are_free_at_standstill() -> None:
    # a ring of 16 sonars around a hole that they do not see; three sweeps in a square room
    yaw = np.tile(np.arange(16) * math.pi / 8, 3)
    wall = 1.5 / np.maximum(np.abs(np.cos(yaw)), np.abs(np.sin(yaw)))
    readings = Readings.from_columns(
        x=0.03 + 0.25 * np.cos(yaw),
        y=0.02 + 0.25 * np.sin(yaw),
        yaw=yaw,
        z=wall - 0.25,
        z_max=4.0,
        half_angle=0.13,
        stamp=np.arange(48) * 10_000_000,
    )
    maps = run(readings)
    row, column = -maps.grid.row, -maps.grid.column
    place = (slice(row - 2, row + 3), slice(column - 2, column + 3))
    assert (maps.ml[place] == 0).all()
    assert maps.uncertainty[place].max() < 0.1


@pytest.mark.parametrize('exponent', [0.7, 1.0])
def test_objective_is_tempered_likelihood_and_prior_of_the_found_map(
    exponent: float, monkeypatch: pytest.MonkeyPatch
) -> None:
    # the map before walls are extended and unknown cells are determined; the likelihood is that of whole cones
    monkeypatch.setattr(final_maps, 'EXTENSION', 0.0)
    whole = {**PLAIN_MODEL, 'least_passed': 0.0, 'likelihood_exponent': exponent}
    maps = run(some(), **whole)
    likelihood = log_likelihood(maps.readings, maps.grid, maps.ml, maps.parameters.model)
    assert maps.log_likelihood == pytest.approx(likelihood, abs=ROUNDING * len(maps.readings))
    traversed = traversed_cells(maps.readings, maps.grid)
    prior = wall_prior(maps.parameters.search, traversed.ravel(), maps.grid.resolution)
    actual = naive.log_prior(prior, maps.ml == 1, maps.grid.shape)
    assert maps.objective - exponent * maps.log_likelihood == pytest.approx(actual, abs=1e-9)
    assert (maps.ml == 1).any()
    assert not (maps.ml == 1)[traversed].any()


def test_occupied_traversed_cells_of_the_start_map_are_freed() -> None:
    maps = run(some(), **PLAIN)
    wrong = maps.ml.copy()
    wrong[traversed_cells(maps.readings, maps.grid)] = 1
    again = Mapper(maps.parameters).run(maps.readings, start=(maps.grid, wrong))
    assert not (again.ml == 1)[traversed_cells(maps.readings, maps.grid)].any()


@lru_cache(maxsize=1)
def along_a_corridor() -> MapSet:
    """The default maps of a drive in which readings exceed the incidence angle of walls, and walls are extended."""
    readings = corridor_drive(0).readings
    maps = run(readings.select(np.arange(len(readings)) < 3000))
    assert maps.normals.known.any() and maps.normals.cos2_limit > 0
    return maps


def test_likelihood_is_that_of_the_final_map_by_definition() -> None:
    maps = along_a_corridor()
    some_of_them = np.arange(0, len(maps.readings), 61)
    readings = maps.readings.select(some_of_them)
    actual = maps.forward_model().expectations(maps.ml).log_likelihood
    assert maps.log_likelihood == pytest.approx(actual.sum(), abs=1e-6)
    left_out = 0
    for k, t in enumerate(some_of_them):
        met = naive.obstacles(readings, k, maps.grid, maps.ml, maps.parameters.model, maps.normals)
        sigma = naive.sigma_of(readings, k, maps.grid, maps.parameters.model)
        exact = naive.likelihood(readings.z[k], readings.z_max[k], sigma, met, maps.parameters.model)
        assert actual[t] == pytest.approx(math.log(exact), abs=1e-9)
        left_out += len(naive.obstacles(readings, k, maps.grid, maps.ml, maps.parameters.model)) - len(met)
    assert left_out > 0, 'no reading exceeds the incidence angle'


def test_search_has_the_same_likelihood_as_the_forward_model() -> None:
    maps = along_a_corridor()
    mapper, seen = Mapper(maps.parameters), []
    mapper.run(maps.readings, lambda stage, progress: seen.append(mapper.so_far()) if progress else None)
    _, searched = seen[-1]
    assert ((maps.ml == 1) & (searched != 1)).any(), 'walls were extended'
    error = ROUNDING * len(maps.readings)
    actual = maps.statistics['searched_log_likelihood']
    assert actual == pytest.approx(maps.forward_model().log_likelihood(searched), abs=error)
    assert actual != pytest.approx(maps.log_likelihood, abs=error)
    traversed = traversed_cells(maps.readings, maps.grid).ravel()
    prior = wall_prior(maps.parameters.search, traversed, maps.grid.resolution)
    for ml, objective, likelihood in (
        (maps.ml, maps.objective, maps.log_likelihood),
        (searched, maps.statistics['searched_objective'], actual),
    ):
        assert objective - likelihood == pytest.approx(naive.log_prior(prior, ml == 1, maps.grid.shape), abs=1e-6)


@pytest.mark.parametrize('seed', [0, 1, 2, None], ids=['0', '1', '2', 'along a corridor'])
def test_unexplained_readings_are_most_likely_random(seed: int | None) -> None:
    # computed here: in the list of parameters, each process that collects tests would compute it
    maps = along_a_corridor() if seed is None else run(some(seed), **PLAIN)
    random = maps.forward_model().expectations(maps.ml).random
    assert np.array_equal(maps.unexplained, random > 0.5)
    assert 0 < maps.unexplained.sum() < len(maps.readings)


def test_likelihood_is_the_same_with_a_larger_live_map() -> None:
    maps = along_a_corridor()
    g = maps.grid
    larger = Grid(g.resolution, g.column - 7, g.row - 2, g.width + 10, g.height + 11)
    beside = maps.with_live(larger, np.full(larger.shape, np.nan, np.float32))
    assert beside.grid == larger
    # sums of distances to places with other numbers
    assert beside.forward_model().log_likelihood(beside.ml) == pytest.approx(maps.log_likelihood, abs=1e-6)


def test_intermediate_map_is_available_during_the_search() -> None:
    mapper, seen = Mapper(Parameters().varied(PLAIN)), []
    assert mapper.so_far() is None
    maps = mapper.run(some(), lambda stage, progress: seen.append(mapper.so_far()) if progress else None)
    assert len(seen) == maps.statistics['iterations']
    for grid, ml in seen:
        assert grid == maps.grid
        assert np.array_equal(ml == -1, maps.ml == -1)
    assert np.array_equal(seen[-1][1], maps.ml)
    assert not any(ml is maps.ml for _, ml in seen), 'a copy'


def test_run_without_readings_raises() -> None:
    with pytest.raises(InputError, match='no reading'):
        run(some(count=0))


def test_run_can_be_cancelled_at_any_stage() -> None:
    for stage in ('index', 'search', 'standard map', 'post-processing', 'uncertainty'):
        mapper = Mapper(Parameters())
        with pytest.raises(Cancelled):
            mapper.run(
                some(), lambda name, progress, stage=stage, mapper=mapper: mapper.cancel() if name == stage else None
            )


def test_run_with_one_reading() -> None:
    maps = run(some(count=1))
    assert maps.statistics['converged']
    assert len(maps.unexplained) == 1
