"""Drives that fit the common map, and one that does not."""

from __future__ import annotations

import math
from dataclasses import replace
from functools import lru_cache

import numpy as np
import pytest

from forward_grid_mapper.core.common.parameters import Parameters
from forward_grid_mapper.core.common.readings import Readings, drives_of, in_canonical_order, of_drives
from forward_grid_mapper.core.drive_fit import LEAST_MISFIT, fit_warnings, misfits
from forward_grid_mapper.core.mapping import Mapper
from forward_grid_mapper.core.maps.map_set import MapSet
from forward_grid_mapper.simulation.drive import drive
from forward_grid_mapper.simulation.sonar import NOISY, front_array
from forward_grid_mapper.simulation.world import rooms_world

TOUR = np.array([[1.5, 1.5], [3.0, 3.45], [9.0, 3.45], [9.0, 2.0], [10.5, 6.5]])


@lru_cache
def tour(seed: int) -> Readings:
    return drive(rooms_world(), TOUR, 0.1, front_array(), NOISY, seed=seed).readings


def moved(readings: Readings, x: float, y: float, turn: float) -> Readings:
    """The readings of a robot with its frame at another place."""
    cos, sin = math.cos(turn), math.sin(turn)
    return replace(
        readings,
        x=cos * readings.x - sin * readings.y + x,
        y=sin * readings.x + cos * readings.y + y,
        yaw=readings.yaw + turn,
    )


def mapped(*drives: Readings) -> MapSet:
    return Mapper(Parameters()).run(of_drives(drives))


def test_drives_that_fit_give_no_warning() -> None:
    maps = mapped(*(tour(seed) for seed in range(3)))
    assert max(misfits(maps, 3)) < LEAST_MISFIT / 2
    assert fit_warnings(maps, ['a', 'b', 'c']) == []


@pytest.mark.parametrize('away', [(0.3, -0.3, 0.0), (0.0, 0.0, 0.1), (2.0, 1.0, 0.0)])
def test_warning_names_the_drive_that_does_not_fit(away: tuple[float, float, float]) -> None:
    maps = mapped(tour(0), moved(tour(1), *away), tour(2))
    (warning,) = fit_warnings(maps, ['monday', 'tuesday', 'sunday'])
    assert warning.startswith('tuesday (') and 'monday' not in warning and 'does not fit' in warning


def test_warning_names_both_of_two_drives() -> None:
    (warning,) = fit_warnings(mapped(tour(0), moved(tour(1), 0.4, 0.3, 0.0)), ['monday', 'tuesday'])
    assert 'monday' in warning and 'tuesday' in warning and 'do not fit each other' in warning


def test_single_and_short_drives_are_not_judged() -> None:
    assert fit_warnings(mapped(tour(0)), ['monday']) == []
    assert misfits(mapped(tour(0), moved(tour(1), 0.4, 0.3, 0.0).select(slice(0, 200))), 2)[1] == 0.0


def test_readings_of_drives_are_joined_and_split() -> None:
    names = ('b', 'a')
    one = Readings.from_columns(
        names, x=[1.0, 2.0], y=0.0, yaw=0.0, z=[1.0, 1.0], z_max=2.0, half_angle=0.1, sensor=[0, 1]
    )
    other = Readings.from_columns(
        ('c', 'b'), x=[3.0, 4.0], y=0.0, yaw=0.0, z=[1.0, 1.0], z_max=2.0, half_angle=0.1, sensor=[0, 1]
    )
    both = of_drives([one, other])
    assert both.sensor_names == ('a', 'b', 'c')
    assert [both.sensor_names[k] for k in both.sensor] == ['b', 'a', 'c', 'b']
    assert both.drive.tolist() == [0, 0, 1, 1]
    rng = np.random.default_rng(0)
    parted = drives_of(both.select(rng.permutation(4)))
    assert [sorted(part.x.tolist()) for part in parted] == [[1.0, 2.0], [3.0, 4.0]]
    assert [set(part.drive.tolist()) for part in parted] == [{0}, {1}]
    assert drives_of(one)[0] is one


def test_canonical_order_does_not_depend_on_the_order_of_drives() -> None:
    drives = [tour(seed) for seed in range(3)]
    found = [in_canonical_order(of_drives([drives[k] for k in order])) for order in ((0, 1, 2), (2, 0, 1), (1, 2, 0))]
    for other in found[1:]:
        for name in ('stamp', 'x', 'y', 'yaw', 'z', 'sensor'):
            np.testing.assert_array_equal(getattr(other, name), getattr(found[0], name))
