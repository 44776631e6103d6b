"""Evidence of single cells (`explain`), compared with evaluations of whole maps by all readings."""

from __future__ import annotations

import math

import numpy as np
import pytest

from forward_grid_mapper.core.common.grid import Grid
from forward_grid_mapper.core.common.parameters import Parameters
from forward_grid_mapper.core.common.readings import Readings
from forward_grid_mapper.core.mapping import Mapper
from forward_grid_mapper.core.maps.cell_evidence import ROUNDING, CellEvidence, cell_evidence
from forward_grid_mapper.core.maps.map_set import MapSet
from forward_grid_mapper.core.sensor.forward_model import expectations
from samples import random_readings

AREA = Grid(0.1, -8, -5, 26, 20)


def evidence_at(maps: MapSet, row: int, column: int) -> CellEvidence:
    x, y = (float(values[k]) for values, k in zip(maps.grid.centers(), (column, row), strict=True))
    return cell_evidence(maps.readings, maps.grid, maps.ml, maps.parameters, maps.normals, (x, y))


@pytest.mark.parametrize('seed', range(6))
@pytest.mark.parametrize('exponent', [1.0, 0.4])
def test_nats_of_each_reading_are_the_difference_of_two_maps(seed: int, exponent: float) -> None:
    rng = np.random.default_rng(seed)
    readings = random_readings(rng, AREA, 150, z_max=1.5)
    maps = Mapper(Parameters().varied({'likelihood_exponent': exponent, 'end_cost': 0.05, 'prior': 0.5})).run(readings)
    occupied = (maps.ml == 1).astype(np.int8)

    def likelihoods(changed: np.ndarray) -> np.ndarray:
        model = maps.parameters.model
        return expectations(maps.readings, maps.grid, changed, model, maps.normals).log_likelihood

    cells = np.flatnonzero(maps.ml.ravel() >= 0)
    walls = np.flatnonzero(maps.ml.ravel() == 1)
    assert len(walls) > 0
    for cell in [*rng.choice(cells, 12), *rng.choice(walls, 4)]:
        row, column = divmod(int(cell), maps.grid.width)
        found = evidence_at(maps, row, column)
        assert (found.row, found.column) == (row, column)
        with_it, without = occupied.copy(), occupied.copy()
        with_it[row, column], without[row, column] = 1, 0
        expected = exponent * (likelihoods(with_it) - likelihoods(without))
        actual = np.zeros(len(maps.readings))
        actual[found.readings] = found.nats
        assert actual == pytest.approx(np.where(np.abs(expected) > ROUNDING, expected, 0.0), abs=1e-8)
        assert found.data == pytest.approx(expected.sum(), abs=1e-6)
        assert (np.diff(np.abs(found.nats)) <= 0).all()
        nothing = without.copy()
        nothing[max(row - 1, 0) : row + 2, max(column - 1, 0) : column + 2] = 0
        wall = exponent * (likelihoods(with_it) - likelihoods(nothing)).sum()
        assert found.wall == pytest.approx(wall, abs=1e-6)


def wall_ahead(z: list[float]) -> MapSet:
    """A sensor at the origin that looks along x."""
    readings = Readings.from_columns(
        ('ahead',), x=0.05, y=0.05, yaw=0.0, z=z, z_max=2.0, half_angle=0.1, stamp=np.arange(len(z)) * 10**9
    )
    return Mapper(Parameters()).run(readings)


def test_readings_are_classified_by_where_they_end() -> None:
    maps = wall_ahead([1.0] * 6 + [1.6, 2.0])
    row = -maps.grid.row
    found = evidence_at(maps, row, 10 - maps.grid.column)
    assert found.ends_here.sum() == 6
    assert found.silent.sum() == 1
    assert (found.nats[found.ends_here] > 0).all()
    assert (found.nats[~found.ends_here] < 0).all()
    assert found.distance == pytest.approx(np.full(8, 1.0 - 0.03), abs=1e-6)
    assert not found.traversed


def test_readings_that_passed_a_wall_are_marked() -> None:
    maps = wall_ahead([1.0] * 6 + [1.6, 2.0])
    for column, behind in ((5, False), (10, False), (12, False), (16, True)):
        found = evidence_at(maps, -maps.grid.row, column - maps.grid.column)
        assert len(found.readings)
        assert (found.through_wall == behind).all()


def test_cell_below_the_path_of_a_sensor_is_marked_as_traversed() -> None:
    maps = wall_ahead([1.0] * 6)
    assert evidence_at(maps, -maps.grid.row, -maps.grid.column).traversed


def test_prior_of_a_cell_depends_on_its_neighbours() -> None:
    maps = wall_ahead([1.0] * 6)
    alone = Parameters().search
    ml = np.full(maps.grid.shape, 0, np.int8)
    actual = cell_evidence(maps.readings, maps.grid, ml, maps.parameters, maps.normals, (1.05, 0.05))
    assert actual.prior == pytest.approx(-2 * alone.end_cost - alone.wall_cost * 0.1)
    assert math.isfinite(actual.data)
