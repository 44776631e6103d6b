"""Pairs of readings and cells, compared with zones and densities in plain Python."""

from __future__ import annotations

import math

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

import naive
from forward_grid_mapper.core.common.grid import Grid
from forward_grid_mapper.core.evidence.evidence import Evidence
from forward_grid_mapper.core.evidence.pairs import _sort, make, workspace_for
from forward_grid_mapper.core.sensor.cone_table import walk
from forward_grid_mapper.core.sensor.density import CUT
from samples import plain_model, random_readings

GRID = Grid(0.1, -7, 12, 41, 33)


@pytest.mark.parametrize('some', [naive.awkward_readings, random_readings])
def test_runs_and_band_are_the_free_zone_and_the_rest_of_the_cone(some: object) -> None:
    readings = some(np.random.default_rng(4), GRID, 80)
    model = plain_model(sigma=0.06)
    evidence = Evidence(GRID, model)
    evidence.extend(readings)
    state = evidence.state
    cells, distances = np.empty(GRID.size, np.int32), np.empty(GRID.size)
    seen, pairs = np.zeros(GRID.size, int), 0
    for t in range(len(readings)):
        n = walk(state.cones, t, GRID.shape, cells, distances)
        away = dict(zip(cells[:n].tolist(), (distances[:n] * GRID.resolution).tolist(), strict=True))
        free, band, density, _ = naive.pairs_of(state, t)
        assert free == sorted(set(free)), 'in ascending order, each once'
        assert len(set(band)) == len(band)
        assert not set(free) & set(band)
        assert set(free) | set(band) == set(away)
        end = naive.free_end(readings, t, GRID, model)
        assert all(away[c] <= end + 1e-9 for c in free)
        assert all(away[c] >= end - 1e-9 for c in band)
        assert [away[c] for c in band] == sorted(away[c] for c in band)
        sigma = naive.sigma_of(readings, t, GRID, model)
        for c, actual in zip(band, density, strict=True):
            # at the cut of the noise, rounding may decide
            if abs(abs(readings.z[t] - away[c]) - CUT * sigma) > 1e-9:
                assert actual == pytest.approx(naive.normal(readings.z[t], away[c], sigma), rel=1e-6, abs=1e-30)
        seen[free + band] += 1
        pairs += len(free) + len(band)
    assert evidence.pairs == pairs
    assert np.array_equal(state.maps.seen, seen)


def test_each_run_is_in_one_row() -> None:
    evidence = Evidence(GRID, plain_model(sigma=0.01))
    evidence.extend(random_readings(np.random.default_rng(5), GRID, 60))
    state = evidence.state
    for reading_state in state.reading_states[:60]:
        runs = state.pairs.cell[reading_state['at'] : reading_state['at'] + 2 * reading_state['runs']].reshape(-1, 2)
        assert (runs[:, 0] <= runs[:, 1]).all()
        assert (runs[:, 0] // GRID.width == runs[:, 1] // GRID.width).all()


def test_cells_at_equal_distance_are_in_the_order_of_the_grid() -> None:
    grid = Grid(0.1, 0, 0, 21, 21)
    readings = naive.awkward_readings(np.random.default_rng(6), grid, 1)
    for name, value in {'x': 1.05, 'y': 1.05, 'yaw': 0.0, 'z': 0.5, 'z_max': 2.0, 'half_angle': 1.5}.items():
        getattr(readings, name)[:] = value
    evidence = Evidence(grid, plain_model())
    evidence.extend(readings)
    _, band, _, _ = naive.pairs_of(evidence.state, 0)
    squares = [(c % 21 - 10) ** 2 + (c // 21 - 10) ** 2 for c in band]
    assert list(zip(squares, band, strict=True)) == sorted(zip(squares, band, strict=True))


def test_recomputed_pairs_equal_the_stored_ones() -> None:
    model = plain_model()
    evidence = Evidence(GRID, model)
    evidence.extend(naive.awkward_readings(np.random.default_rng(7), GRID, 100))
    s = evidence.state
    for t, reading_state in enumerate(s.reading_states[:100]):
        sizes = (int(reading_state['runs']), int(reading_state['bands']))
        assert make(s.cones, s.lattice, s.normals, t, s.workspace.pairs, 0, s.workspace) == sizes
        words = 2 * sizes[0] + 2 * sizes[1]
        assert np.array_equal(
            s.workspace.pairs.cell[:words], s.pairs.cell[reading_state['at'] : reading_state['at'] + words]
        )


@given(
    st.lists(
        st.floats(0, 1e3) | st.integers(0, 5).map(float) | st.floats(5, 5 + 1e-12) | st.just(5e-324),
        max_size=60,
    )
)
def test_sort_is_stable(keys: list[float]) -> None:
    workspace = workspace_for(60)
    room = np.full(len(workspace.tally) + 10, -1, np.int32)
    workspace, m = workspace._replace(tally=room[: len(workspace.tally)]), len(keys)
    workspace.unsorted_key[:m] = keys
    workspace.unsorted[:m] = np.arange(m)
    _sort(workspace, m)
    assert (room[m + 1 :] == -1).all()
    order = sorted(range(m), key=lambda k: keys[k])
    assert workspace.cell[:m].tolist() == order
    assert workspace.key[:m].tolist() == [keys[k] for k in order]


def test_densities_integrate_to_one() -> None:
    # along a row of cells, far finer than sigma
    grid = Grid(0.005, 0, 0, 400, 1)
    readings = naive.awkward_readings(np.random.default_rng(8), grid, 1)
    for name, value in {'x': 0.0, 'y': 0.0025, 'yaw': 0.0, 'z': 1.0, 'z_max': 3.0, 'half_angle': 0.1}.items():
        getattr(readings, name)[:] = value
    readings.sigma[:] = 0.05
    evidence = Evidence(grid, plain_model())
    evidence.extend(readings)
    _, _, density, _ = naive.pairs_of(evidence.state, 0)
    assert math.fsum(density) * grid.resolution == pytest.approx(math.erf(CUT / math.sqrt(2)), abs=1e-5)
