"""The halves of a drive contradict each other if odometry drifts, and otherwise do not."""

from __future__ import annotations

import dataclasses
import math

import numpy as np
import pytest

from forward_grid_mapper.core.common.parameters import Parameters
from forward_grid_mapper.core.common.readings import Readings
from forward_grid_mapper.core.learning.agreement import contradiction
from forward_grid_mapper.simulation.drive import building_drive
from forward_grid_mapper.simulation.sonar import NOISY, front_array


@pytest.fixture(scope='module')
def there_and_back() -> Readings:
    """A drive through a building, and the same once more."""
    first, second = (building_drive(seed, 1, NOISY, False, front_array()).readings for seed in (0, 1))
    later = dataclasses.replace(second, stamp=second.stamp + int(first.stamp.max()) + 1)
    names = [field.name for field in dataclasses.fields(Readings) if field.name != 'sensor_names']
    columns = {name: np.concatenate([getattr(first, name), getattr(later, name)]) for name in names}
    return dataclasses.replace(first, **columns)


def turned(readings: Readings, after: int, angle: float) -> Readings:
    """Readings whose poses are rotated about the origin from a time on."""
    wrong = np.where(readings.stamp > after, angle, 0.0)
    cos, sin = np.cos(wrong), np.sin(wrong)
    return dataclasses.replace(
        readings,
        x=cos * readings.x - sin * readings.y,
        y=sin * readings.x + cos * readings.y,
        yaw=readings.yaw + wrong,
    )


def test_halves_of_a_sound_drive_agree(there_and_back: Readings) -> None:
    assert contradiction(there_and_back, Parameters()) < 0.03
    # the order of the readings does not matter
    shuffled = there_and_back.select(np.random.default_rng(0).permutation(len(there_and_back)))
    assert contradiction(shuffled, Parameters()) < 0.03


def test_halves_contradict_each_other_after_a_turn_of_the_poses(there_and_back: Readings) -> None:
    middle = int(np.median(there_and_back.stamp))
    assert contradiction(turned(there_and_back, middle, math.radians(4)), Parameters()) > 0.05
    # what is not seen again cannot contradict
    elsewhere = dataclasses.replace(there_and_back, x=there_and_back.x + 200.0 * (there_and_back.stamp > middle))
    assert contradiction(elsewhere, Parameters()) < 0.005


def test_few_readings_or_none_with_an_echo_say_nothing(there_and_back: Readings) -> None:
    silent = dataclasses.replace(there_and_back, z=there_and_back.z_max)
    assert contradiction(silent, Parameters()) == 0.0
    assert contradiction(there_and_back.select(slice(300)), Parameters()) == 0.0
    assert contradiction(there_and_back.select(slice(0)), Parameters()) == 0.0


def test_things_that_are_heard_from_one_side_only_are_no_contradiction() -> None:
    """On the way back they return nothing: their other side is smooth, and at a slant."""
    k = np.arange(2400)
    back = k >= 1200
    x = np.where(back, 24.0 - 0.02 * (k - 1200), 0.02 * k)
    # looks at things a metre away, a third of the way, and at a wall in between
    thing = (k % 2 == 0) & (np.remainder(x, 1.5) < 0.5)
    wall = k % 2 == 1
    z = np.where(wall, 1.5, np.where(thing & ~back, 1.0, 4.0))
    readings = Readings.from_columns(
        ('left', 'right'),
        x=x,
        y=np.where(back, 2.0, 0.0),
        yaw=np.where(wall ^ back, -math.pi / 2, math.pi / 2),
        z=z,
        z_max=4.0,
        half_angle=0.2,
        sensor=wall.astype(np.int32),
        stamp=k * 10**8,
    )
    assert contradiction(readings, Parameters()) < 0.02
