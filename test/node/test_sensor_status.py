"""The status of the sensors before EM, after EM and after a reset."""

from __future__ import annotations

import dataclasses

import numpy as np
import pytest

pytest.importorskip('rclpy', reason='the tests of the node need rclpy')

from diagnostic_msgs.msg import DiagnosticStatus

from forward_grid_mapper.core.common.parameters import Parameters
from forward_grid_mapper.core.learning.sensor_health import sensor_health
from forward_grid_mapper.core.mapping import Mapper
from forward_grid_mapper.node.sensor_status import (
    LEAST_PAUSES,
    LEAST_READINGS,
    READINGS_A_PAUSE,
    SensorWatch,
    unsent_warning,
)
from forward_grid_mapper.simulation.drive import drive
from forward_grid_mapper.simulation.sonar import NOISY
from forward_grid_mapper.simulation.world import rooms_world


def values(status: DiagnosticStatus) -> dict[str, str]:
    return {pair.key: pair.value for pair in status.values}


def test_dead_sensor_is_named_after_em() -> None:
    readings = drive(rooms_world(), np.array([[2.0, 2.0], [5.0, 2.0], [5.0, 6.0]]), 0.1, noise=NOISY).readings
    readings = dataclasses.replace(readings, z=np.where(readings.sensor == 4, readings.z_max, readings.z))
    counts = dict(zip(readings.sensor_names, zip(*readings.counts(), strict=True), strict=True))
    watch = SensorWatch()
    before = watch.status('mapper', counts)
    assert before.name == 'mapper: sensors' and before.level == DiagnosticStatus.OK
    assert values(before)['sonar_04'].endswith('readings, 100% max range')
    assert len(before.values) == 24
    assert values(watch.status('mapper', {'sonar': (1, 1)})) == {'sonar': '1 reading, 100% max range'}

    maps = Mapper(Parameters()).run(readings)
    watch.take(sensor_health(maps))
    after = watch.status('mapper', counts)
    assert after.level == DiagnosticStatus.WARN
    assert 'sonar_04 (never hears anything)' in after.message and after.message.count('sonar_') == 1
    assert values(after)['sonar_04'].endswith('never hears anything')
    assert values(after)['sonar_05'].endswith(': ok')

    watch.clear()
    assert watch.status('mapper', {}).level == DiagnosticStatus.OK


def test_driver_that_sends_nothing_without_echo_is_named_only_if_likely() -> None:
    assert f'and sent again, {LEAST_PAUSES} times' in unsent_warning(
        LEAST_PAUSES, {'left': (900, 0), 'right': (900, 9)}
    )
    assert unsent_warning(LEAST_PAUSES - 1, {'sonar': (1000, 0)}) == ''
    assert unsent_warning(LEAST_PAUSES, {'sonar': (LEAST_READINGS - 1, 0)}) == ''
    # readings without an echo arrive
    assert unsent_warning(LEAST_PAUSES, {'left': (900, 0), 'right': (900, 20)}) == ''
    # a pause in an hour may have any cause
    assert unsent_warning(2 * LEAST_PAUSES, {'sonar': (2 * LEAST_PAUSES * READINGS_A_PAUSE + 1, 0)}) == ''
    assert 'no echo' in unsent_warning(2 * LEAST_PAUSES, {'sonar': (2 * LEAST_PAUSES * READINGS_A_PAUSE, 0)})
