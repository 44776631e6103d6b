"""Normals of surfaces, and pairs that are omitted because a reading exceeds the incidence angle."""

from __future__ import annotations

import dataclasses
import math

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

import naive
from forward_grid_mapper.core.common.constants import LEAST_AGREEMENT, LEAST_WEIGHT, WEIGHT_CELL
from forward_grid_mapper.core.common.grid import Grid
from forward_grid_mapper.core.common.parameter_groups import ModelParameters
from forward_grid_mapper.core.common.readings import Readings
from forward_grid_mapper.core.evidence.cell_flip import find_observing, flip
from forward_grid_mapper.core.evidence.evidence import Evidence
from forward_grid_mapper.core.runtime import threads
from forward_grid_mapper.core.sensor.surface_normals import (
    WEIGHT_UNIT,
    exceeds_incidence_angle,
    gather,
    no_normals,
    normals_of,
    on_larger_grid,
    square_of,
    sum_across,
    sum_columns,
    unit_of_sums,
)
from samples import plain_model, random_readings

GRID = Grid(0.1, -7, 12, 25, 20)
MODEL = ModelParameters(sigma=0.06, p_hit=0.6, p_rand=0.1, p_lost=0.1, max_incidence_angle=0.7)


def along_wall(count: int = 150, seed: int = 0) -> Readings:
    """Readings of a robot that passes a wall at y = 3, at all incidence angles; many have no echo of it."""
    rng = np.random.default_rng(seed)
    readings = random_readings(rng, GRID, count, z_max=2.5)
    readings.y[:] = 1.5 + 0.3 * rng.random(count)
    readings.yaw[:] = math.pi / 2 + rng.uniform(-1.3, 1.3, count)
    readings.half_angle[:] = rng.choice([0.02, 0.1, 0.25], count)
    to_wall = (3.0 - readings.y) / np.sin(readings.yaw)
    square = np.abs(readings.yaw - math.pi / 2) < 0.3
    readings.z[:] = np.where(square, to_wall, np.where(rng.random(count) < 0.5, 2.5, 2.3)).clip(0.1, 2.5)
    return readings


def sums_of(evidence: Evidence, part: tuple[int, int]) -> np.ndarray:
    s = evidence.state
    sums = np.zeros((3, evidence.grid.size), np.int64)
    gather(s.cones, evidence.grid.shape, part, sums, s.stop)
    return sums


def made(readings: Readings, model: ModelParameters = MODEL, **options: object) -> Evidence:
    evidence = Evidence(GRID, model, **options)
    evidence.extend(readings)
    return evidence


@pytest.mark.parametrize('readings', [along_wall(), random_readings(np.random.default_rng(1), GRID, 100)])
def test_normals_are_those_of_the_twin(readings: Readings) -> None:
    model = MODEL
    evidence = made(readings, model)
    sums = sums_of(evidence, (0, len(readings)))
    expected = naive.normals(readings, GRID, model)
    for actual, exact in zip(sums, expected, strict=True):
        assert np.abs(actual.reshape(GRID.shape) * WEIGHT_UNIT - exact).max() < 1e-3
    halves = sums_of(evidence, (0, 37)) + sums_of(evidence, (37, len(readings)))
    assert np.array_equal(halves, sums)
    normals = normals_of(sums, GRID, model.max_incidence_angle)
    cosine, sine, mass = (naive.box_sum(values) for values in expected)
    for row, column in np.ndindex(GRID.shape):
        c = row * GRID.width + column
        m, length = mass[row, column], math.hypot(cosine[row, column], sine[row, column])
        if abs(m - LEAST_WEIGHT) > 1e-2 and abs(length - LEAST_AGREEMENT * m) > 1e-2:
            assert normals.known[c] == (m >= LEAST_WEIGHT and length >= LEAST_AGREEMENT * m)
        if normals.known[c]:
            normal = 0.5 * math.atan2(sine[row, column], cosine[row, column])
            along = normals.x[c] * math.cos(normal) + normals.y[c] * math.sin(normal)
            assert abs(along) == pytest.approx(1.0, abs=1e-4)
        assert normals.before[row, column] == normals.known.reshape(GRID.shape)[row, :column].sum()
    assert normals.cos2_limit == pytest.approx(math.cos(0.7) ** 2)
    assert 5 < normals.known.sum() < GRID.size


def test_normals_of_a_wall_are_perpendicular_to_it() -> None:
    evidence = made(along_wall())
    normals = normals_of(sums_of(evidence, (0, len(evidence))), GRID, MODEL.max_incidence_angle)
    row = round(3.0 / 0.1) - GRID.row
    wall = normals.known.reshape(GRID.shape)[row, 5:20]
    assert wall.sum() > 10
    assert np.abs(normals.y.reshape(GRID.shape)[row, 5:20][wall == 1]).min() > 0.9


@pytest.mark.parametrize(
    ('resolution', 'within', 'part'), [(0.1, 1, 1.0), (0.05, 3, 0.5), (0.06, 2, 1.0), (0.4, 0, 1.0)]
)
def test_box_sums_cover_a_square_in_metres_with_fractions_of_cells(resolution: float, within: int, part: float) -> None:
    rng = np.random.default_rng(0)
    values = rng.integers(-1000, 1000, (9, 12))
    weights = np.ones(2 * within + 1)
    weights[[0, -1]] = part
    expected = np.zeros(values.shape)
    for row, column in np.ndindex(values.shape):
        for i, j in np.ndindex(len(weights), len(weights)):
            y, x = row + i - within, column + j - within
            if 0 <= y < 9 and 0 <= x < 12:
                expected[row, column] += weights[i] * weights[j] * values[y, x]
    square = square_of(resolution)
    assert square == (within, part)
    assert unit_of_sums(resolution) == pytest.approx(WEIGHT_UNIT * (resolution / WEIGHT_CELL) ** 2)

    def box_sums(bottom: int, top: int, left: int, right: int) -> np.ndarray:
        out, columns = np.empty((top - bottom, right - left)), np.empty(right - left + 2 * within)
        for row, column in np.ndindex(out.shape):
            sum_columns(values, bottom + row, left - within, square, columns)
            out[row, column] = sum_across(columns, column, square)
        return out

    whole = box_sums(0, 9, 0, 12)
    assert whole == pytest.approx(expected, abs=1e-9)
    # bit-identical, so that renewed normals equal normals estimated at once
    for bottom, top, left, right in ((0, 1, 0, 1), (2, 9, 0, 5), (8, 9, 11, 12), (1, 4, 3, 12)):
        assert np.array_equal(box_sums(bottom, top, left, right), whole[bottom:top, left:right])


def test_share_of_known_normals_does_not_depend_on_the_cell_size() -> None:
    readings, share = along_wall(400), []
    for parts in (1, 2, 4):
        grid = Grid(0.1 / parts, GRID.column * parts, GRID.row * parts, GRID.width * parts, GRID.height * parts)
        evidence = Evidence(grid, MODEL)
        evidence.extend(readings)
        share.append(evidence.state.normals.known.mean())
    assert share == pytest.approx([share[0]] * 3, rel=0.15)


def test_readings_without_echo_give_no_normals() -> None:
    readings = along_wall()
    readings.z[:] = readings.z_max
    assert not made(readings).state.normals.known.any()


def test_limit_of_90_degrees_omits_no_pairs() -> None:
    readings = along_wall()
    for angle in (math.pi / 2, 1.5708):
        evidence = made(readings, dataclasses.replace(MODEL, max_incidence_angle=angle))
        assert evidence.state.normals.cos2_limit == no_normals().cos2_limit == 0.0
    # at a limit whose cosine is nearly zero, no reading exceeds it
    sums = sums_of(evidence, (0, len(readings)))
    assert normals_of(sums, GRID, math.pi / 2).cos2_limit < 1e-12


@pytest.mark.parametrize('readings', [along_wall(), random_readings(np.random.default_rng(2), GRID, 120)])
def test_pairs_are_those_of_the_cone_without_grazed_cells(readings: Readings) -> None:
    model = MODEL
    evidence, plain = made(readings, model), made(readings, dataclasses.replace(model, max_incidence_angle=math.pi / 2))
    s = evidence.state
    found: list[dict[int, int]] = [{} for _ in range(GRID.size)]
    total = cut = 0
    for t in range(len(readings)):
        free, band, density, _ = naive.pairs_of(s, t)
        whole_free, whole_band, whole_density, _ = naive.pairs_of(plain.state, t)
        grazed = naive.left_out(readings, t, GRID, model, s.normals)
        # in the same order
        assert free == [c for c in whole_free if c not in grazed]
        kept = [(c, g) for c, g in zip(whole_band, whole_density, strict=True) if c not in grazed]
        assert list(zip(band, density, strict=True)) == kept
        total += len(grazed)
        cut += s.reading_states[t]['runs'] > plain.state.reading_states[t]['runs']
        for zone, cells in ((0, band), (1, free)):
            for c in cells:
                found[c][t] = zone
    assert total > 50
    assert cut > 3, 'no run was cut in two'
    for c in range(GRID.size):
        n = find_observing(s, c)
        assert n == len(found[c])
        assert {int(t): int(zone) for t, zone in s.observing[:n]} == found[c]
    # a cell that is only grazed counts as seen
    assert np.array_equal(s.maps.seen, plain.state.maps.seen)


def snapshot(evidence: Evidence) -> list[object]:
    s = evidence.state
    kept = ('through', 'runs', 'bands', 'blocking', 'multiplicity', 'occupy', 'release', 'likelihood')
    return [
        *(array.tolist() for array in s.maps),
        *(s.reading_states[name].tolist() for name in kept),
        *map(list, s.normals[:3]),
    ]


@settings(max_examples=25, deadline=None)
@given(
    st.integers(0, 2**32 - 1),
    st.lists(st.integers(0, GRID.size - 1), max_size=20),
)
def test_state_after_flips_equals_a_state_built_from_the_new_map(seed: int, cells: list[int]) -> None:
    readings, model = along_wall(60, seed), MODEL
    start = np.random.default_rng(seed).random(GRID.shape) < 0.1
    evidence, unstored = (made(readings, model, memory=m, start=start) for m in (math.inf, 0.0))
    for c in cells:
        start.ravel()[c] ^= True
        for each in (evidence, unstored):
            flip(each.state, c)
    fresh = snapshot(made(readings, model, start=start))
    assert snapshot(evidence) == fresh
    assert snapshot(unstored) == fresh
    evidence.rebuild()
    assert snapshot(evidence) == fresh


def test_number_of_threads_does_not_change_the_state(monkeypatch: pytest.MonkeyPatch) -> None:
    one = made(along_wall())
    monkeypatch.setattr(threads, 'LEAST_PART', 20)
    assert len(threads.parts(0, 150, 3)) == 3
    assert snapshot(made(along_wall(), threads=3)) == snapshot(one)
    half = one.state.pairs.cell.nbytes / 2
    less = made(along_wall(), threads=3, memory=half)
    assert 0 < less.unstored < 150
    assert snapshot(less) == snapshot(one)


def test_state_on_a_grown_grid_equals_that_on_a_large_grid() -> None:
    readings = along_wall()
    large = Grid(0.1, GRID.column - 11, GRID.row - 3, GRID.width + 30, GRID.height + 17)
    grown, whole = made(readings), Evidence(large, MODEL)
    grown.grow(large)
    whole.extend(readings)
    assert snapshot(grown) == snapshot(whole)


def test_normals_on_a_larger_grid_stay_in_place() -> None:
    normals = made(along_wall()).state.normals
    large = Grid(0.1, GRID.column - 11, GRID.row - 3, GRID.width + 30, GRID.height + 17)
    wide = on_larger_grid(normals, GRID, large)
    xs, ys = large.centers()
    rows, columns = GRID.cells_of(*np.meshgrid(xs, ys))
    inside = (rows >= 0) & (rows < GRID.height) & (columns >= 0) & (columns < GRID.width)
    for name in ('known', 'x', 'y'):
        actual, expected = getattr(wide, name).reshape(large.shape), getattr(normals, name).reshape(GRID.shape)
        assert np.array_equal(actual[inside], expected[rows[inside], columns[inside]])
        assert not actual[~inside].any()
    known = wide.known.reshape(large.shape)
    assert known.any()
    assert all(wide.before[row, k] == known[row, :k].sum() for row, k in np.ndindex(wide.before.shape))
    assert wide.cos2_limit == normals.cos2_limit
    assert on_larger_grid(no_normals(), GRID, large).cos2_limit == 0.0


def test_grazing_readings_do_not_contradict_a_wall() -> None:
    readings = along_wall()
    row = round(3.0 / 0.1) - GRID.row
    wall = np.zeros(GRID.shape, np.uint8)
    wall[row, 5:20] = 1
    graze, plain = (
        made(readings, model, start=wall).state.maps.evidence.reshape(GRID.shape)[row, 5:20]
        for model in (MODEL, plain_model(sigma=0.06, p_hit=0.6, p_rand=0.1, p_lost=0.1))
    )
    # evidence for freeing a cell of the wall
    assert graze.sum() < plain.sum()


def test_incidence_angle_applies_only_to_cells_nearer_than_the_range() -> None:
    normals = no_normals()._replace(
        known=np.ones(1, np.uint8), x=np.ones(1, np.float32), y=np.zeros(1, np.float32), cos2_limit=math.cos(0.7) ** 2
    )
    cones = made(along_wall(1)).state.cones.copy()
    reading = cones[0]
    reading['z'], reading['sigma'] = 10.0, 1.0
    for angle in np.linspace(-4, 4, 41):
        slanted = abs(math.cos(angle)) < math.cos(0.7)
        for d, through in ((7.9, True), (8.1, False), (0.5, True), (12.0, False)):
            assert exceeds_incidence_angle(normals, reading, 0, d * math.cos(angle), d * math.sin(angle)) == (
                slanted and through
            )
    normals.known[:] = 0
    assert not exceeds_incidence_angle(normals, reading, 0, 0.0, 5.0)
    normals.known[:] = 1
    assert exceeds_incidence_angle(normals, reading, 0, 0.0, 5.0)
    reading['z'] = 1.9
    assert not exceeds_incidence_angle(normals, reading, 0, 0.0, 0.1), 'within 2 sigma of the range everything is'
