"""Readings of several drives in one table."""

from __future__ import annotations

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
