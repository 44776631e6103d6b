"""The standard map at moments of the drive: the map of all readings until then."""

from __future__ import annotations

import numpy as np
import pytest

from forward_grid_mapper.core.common.parameters import Parameters
from forward_grid_mapper.core.mapping import Mapper
from forward_grid_mapper.core.maps.log_odds_map import LogOddsMap
from forward_grid_mapper.core.maps.map_set import MapSet
from forward_grid_mapper.core.maps.moments import moments
from forward_grid_mapper.core.maps.reading_causes import CAUSES, RANDOM, likeliest_causes
from forward_grid_mapper.simulation.drive import door_drive


@pytest.fixture(scope='module')
def maps() -> MapSet:
    """Maps of a drive past a door, with readings in random order."""
    readings = door_drive(1, seed=3).readings
    return Mapper(Parameters()).run(readings.select(np.random.default_rng(0).permutation(len(readings))))


@pytest.mark.parametrize('count', [1, 2, 7])
def test_moment_is_the_map_of_all_readings_until_then(maps: MapSet, count: int) -> None:
    found = list(moments(maps, count))
    assert len(found) == count
    stamps, order = maps.readings.stamp, np.argsort(maps.readings.stamp, kind='stable')
    for k, moment in enumerate(found, 1):
        assert moment.live.shape == maps.grid.shape
        part = order[: len(np.concatenate(np.array_split(order, count)[:k]))]
        assert moment.stamp == stamps[part].max()
        live = LogOddsMap(maps.parameters)
        live.add(maps.readings.select(part))
        np.testing.assert_array_equal(moment.live, live.probability(maps.grid))
    np.testing.assert_array_equal(found[-1].live, maps.live)


def test_number_of_known_cells_grows(maps: MapSet) -> None:
    known = [int(np.isfinite(moment.live).sum()) for moment in moments(maps, 6)]
    assert known == sorted(known) and known[0] < known[-1]


def test_number_of_moments_is_at_most_that_of_readings(maps: MapSet) -> None:
    few = Mapper(Parameters()).run(maps.readings.select(slice(3)))
    assert len(list(moments(few, 8))) == 3


def test_likeliest_causes_are_those_of_the_forward_model(maps: MapSet) -> None:
    causes = likeliest_causes(maps)
    np.testing.assert_array_equal(causes == RANDOM, maps.unexplained)
    expected = maps.forward_model().expectations(maps.ml)
    for k in np.flatnonzero(causes != RANDOM)[::50]:
        values = {name: getattr(expected, name)[k] for name in CAUSES if name != 'random'}
        assert CAUSES[causes[k]] == max(values, key=lambda name: values[name])
