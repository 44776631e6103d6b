"""Warnings about maps that explain few readings."""

from __future__ import annotations

import dataclasses
from pathlib import Path
from types import SimpleNamespace

import numpy as np
import pytest

from forward_grid_mapper.core.common.errors import OutputError
from forward_grid_mapper.core.common.parameters import Parameters
from forward_grid_mapper.core.common.readings import Readings
from forward_grid_mapper.core.mapping import Mapper
from forward_grid_mapper.files.quality_warning import data_warnings, jumps_warning, quality_warning
from forward_grid_mapper.files.results import write_results
from forward_grid_mapper.simulation.drive import door_drive


def test_warning_if_no_map_explains_the_readings(tmp_path: Path) -> None:
    drive = door_drive(2).readings
    maps = Mapper(Parameters()).run(drive)
    assert quality_warning(maps) == ''
    rng = np.random.default_rng(1)
    # random echoes
    wild = dataclasses.replace(drive, z=rng.uniform(0.2, 1.0, len(drive)) * drive.z_max)
    wild = Mapper(Parameters()).run(wild)
    warning = quality_warning(wild)
    assert 'are the poses of the sensors' in warning
    report = write_results(tmp_path / 'maps', wild, {}, np.zeros((0, 2)), 'wild')
    assert warning in report['warnings']

    def refuse() -> None:
        raise OutputError('too late')

    with pytest.raises(OutputError, match='too late'):
        write_results(tmp_path / 'refused', wild, {}, np.zeros((0, 2)), 'wild', agree=refuse)
    assert [path.name for path in tmp_path.iterdir()] == ['maps'], 'whoever waited for the maps has gone'


def test_map_that_does_not_fit_refers_to_the_causes_before() -> None:
    """All sensors have one frame_id, which is said first."""
    k = np.arange(2000)
    ranges = np.array([0.5, 2.0, 3.0, 1.2, 2.6, 0.8, 1.7])[k % 7]
    shared = Readings.from_columns(
        ('sonar',),
        x=2.0 * np.cos(0.002 * k),
        y=2.0 * np.sin(0.002 * k),
        yaw=0.002 * k,
        z=ranges,
        z_max=4.0,
        half_angle=0.13,
        stamp=k * 20_000_000,
    )
    *causes, last = data_warnings(Mapper(Parameters()).run(shared), {})
    assert len(causes) == 1 and 'do all sensors have the same frame_id' in causes[0]
    assert 'if no other warning says why: are the poses of the sensors' in last


def test_odometry_that_has_only_velocities_is_named_if_the_map_does_not_fit() -> None:
    drive = door_drive(2).readings
    rng = np.random.default_rng(1)
    columns = dict.fromkeys(('x', 'y', 'yaw'), np.zeros(len(drive)))
    standing = dataclasses.replace(drive, **columns, z=rng.uniform(0.2, 1.0, len(drive)) * drive.z_max)
    assert 'not only the velocity (twist)' in quality_warning(Mapper(Parameters()).run(standing))
    # a robot that turns on the spot has odometry
    turning = dataclasses.replace(standing, yaw=np.linspace(0.0, 6.0, len(drive)))
    assert 'are the poses of the sensors' in quality_warning(Mapper(Parameters()).run(turning))


def test_warning_if_no_reading_has_an_echo() -> None:
    drive = door_drive(1).readings
    without_echo = Mapper(Parameters()).run(dataclasses.replace(drive, z=drive.z_max))
    assert any(
        text.startswith(f'none of {len(drive)} readings has an echo') for text in data_warnings(without_echo, {})
    )
    one = drive.z_max.copy()
    one[0] /= 2
    with_echo = Mapper(Parameters()).run(dataclasses.replace(drive, z=one))
    assert not any('has an echo' in text for text in data_warnings(with_echo, {}))


def test_half_of_the_readings_may_be_random() -> None:
    readings = door_drive().readings.select(slice(20))
    for random, warns in ((10, False), (11, True)):
        maps = SimpleNamespace(readings=readings, unexplained=np.arange(20) < random)
        assert bool(quality_warning(maps)) == warns


def test_driving_before_a_jump_does_not_include_it() -> None:
    steps = np.array([1.0, 2.0, 50.0, 4.0, 60.0])
    assert jumps_warning(steps, [2, 4], '').startswith('odometry jumps 2 times, first by 50.0 m after 3 m of driving')
    assert jumps_warning(steps, [0], '').startswith('odometry jumps once, by 1.0 m after 0 m of driving')
    assert jumps_warning(steps, [], '') == ''
