"""Readings of several drives in one table."""

from __future__ import annotations

import dataclasses

import numpy as np
import pytest

from forward_grid_mapper.core.common.readings import Readings, of_drives


def drive(*names: str) -> Readings:
    count = len(names) or 1
    return Readings.from_columns(
        names, x=range(count), y=0.0, yaw=0.0, z=[1.0] * count, z_max=2.0, half_angle=0.1, sensor=range(count)
    )


def test_sensors_with_the_same_name_in_two_drives_are_one_sensor() -> None:
    both = of_drives([drive('left', 'right'), drive('front', 'left')])
    assert both.sensor_names == ('front', 'left', 'right')
    assert (both.sensor.tolist(), both.drive.tolist()) == ([1, 2, 0, 1], [0, 0, 1, 1])


def test_sensor_without_name_is_not_merged_with_a_named_one() -> None:
    both = of_drives([drive('left'), drive()])
    assert [both.sensor_names[k] for k in both.sensor] == ['left', '']


@pytest.mark.parametrize(
    ('change', 'message'),
    [
        ({'stamps': [1, 2]}, 'there is no column stamps; there are: x, y, yaw, z'),
        ({'z': None}, 'column z is missing'),
        ({'x': None}, 'column x is missing'),
    ],
)
def test_missing_or_unknown_column_is_rejected(change: dict[str, object], message: str) -> None:
    columns = {'x': 0.0, 'y': 0.0, 'yaw': 0.0, 'z': [1.0, 1.5], 'z_max': 2.0, 'half_angle': 0.1} | change
    with pytest.raises(ValueError, match=message):
        Readings.from_columns(**{name: value for name, value in columns.items() if value is not None})


def test_drives_of_other_readings_are_rejected() -> None:
    one = drive('left', 'right')
    assert one.drive.tolist() == [0, 0]
    with pytest.raises(ValueError, match='2 readings cannot have the drives of 3'):
        dataclasses.replace(one, drive=np.arange(3, dtype=np.int32))
