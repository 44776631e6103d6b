"""Offsets of all sensors are where the objective is largest, unless cells alone explain that."""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import replace

import numpy as np
import pytest

from forward_grid_mapper.core.common.parameters import Parameters
from forward_grid_mapper.core.common.readings import Readings
from forward_grid_mapper.core.learning import sensor_calibration
from forward_grid_mapper.core.learning.sensor_calibration import (
    FORWARD,
    LEFT,
    TIME,
    OffsetEstimate,
    hardly_distinguishable,
    offset_estimates,
)
from forward_grid_mapper.core.learning.trial_maps import BLOCKS, MountedReadings, TrialMap
from forward_grid_mapper.core.messages.message_types import NANOSECONDS, Pose2

NOISE = np.random.default_rng(0).normal(0.0, 0.2, BLOCKS)


def straight() -> MountedReadings:
    """A drive along the x axis at 1 m/s, with one sensor that looks far ahead, so that cells have 0.2 m."""
    count = 1000
    readings = Readings.from_columns(
        x=np.arange(count) / 100,
        y=np.zeros(count),
        yaw=np.zeros(count),
        z=np.full(count, 12.0),
        z_max=np.full(count, 15.0),
        half_angle=np.full(count, 0.13),
        stamp=np.arange(count, dtype=np.int64) * NANOSECONDS // 100,
    )
    readings = replace(readings, sensor_names=('sonar',))
    return MountedReadings.of(readings, {'sonar': Pose2(0.0, 0.0, 0.0)})


@pytest.fixture
def explained(monkeypatch: pytest.MonkeyPatch) -> Callable[[Callable[[float, float], float]], None]:
    """Let maps explain readings by a function of their mean x and y, nats."""

    def by(objective: Callable[[float, float], float]) -> None:
        def made(readings: Readings, parameters: Parameters) -> TrialMap:
            value = objective(float(readings.x.mean()), float(readings.y.mean()))
            return TrialMap(value, (1.0 + NOISE) * value / BLOCKS, 0.0)

        monkeypatch.setattr(sensor_calibration, 'trial_map', made)

    return by


def test_maximum_is_found_between_the_steps(explained) -> None:
    explained(lambda x, y: 200 - 2e4 * (y - 0.117) ** 2)
    (found,) = offset_estimates(straight(), {LEFT: 0.15}, Parameters())
    assert found.quantity is LEFT
    assert found.value == pytest.approx(0.117, abs=1e-6)
    assert 0.01 < found.error < 0.03
    assert found.sigmas > 3.0


def test_gain_of_moved_cells_is_no_offset(explained) -> None:
    def of_borders(x: float, y: float) -> float:
        return 100 * math.cos(math.pi * (y - 0.1) / 0.2) ** 2

    explained(of_borders)
    assert offset_estimates(straight(), {LEFT: 0.15}, Parameters()) == []
    # beside a true offset it does not matter
    explained(lambda x, y: of_borders(x, y) + 900 - 3e4 * (y - 0.15) ** 2)
    (found,) = offset_estimates(straight(), {LEFT: 0.15}, Parameters())
    assert found.value == pytest.approx(0.15, abs=0.03)


def test_small_or_uncertain_gain_is_no_offset(explained, monkeypatch: pytest.MonkeyPatch) -> None:
    explained(lambda x, y: 25 - 2e4 * (y - 0.03) ** 2)
    assert offset_estimates(straight(), {LEFT: 0.05}, Parameters()) == []
    explained(lambda x, y: 200 - 2e4 * (y - 0.117) ** 2)
    monkeypatch.setattr('forward_grid_mapper.core.learning.sensor_calibration.SIGMAS', 1e9)
    assert offset_estimates(straight(), {LEFT: 0.15}, Parameters()) == []


def test_search_without_a_maximum_ends(explained) -> None:
    explained(lambda x, y: 100 * y)
    assert offset_estimates(straight(), {LEFT: 0.15}, Parameters()) == []


def test_late_is_as_good_as_behind_at_constant_speed(explained) -> None:
    explained(lambda x, y: 300 - 1e4 * (x - straight().readings.x.mean() + 0.2) ** 2)
    found = offset_estimates(straight(), {TIME: -0.15, FORWARD: -0.15}, Parameters())
    assert {each.quantity for each in found} == {TIME, FORWARD}
    for each in found:
        # at 1 m/s; positions of the last readings of the part are not known after its end
        assert each.value == pytest.approx(-0.2, abs=0.02)
    assert hardly_distinguishable(found[0], found[1])


def test_clearly_worse_quantity_is_no_rival() -> None:
    nothing = np.zeros(BLOCKS)
    best = OffsetEstimate(TIME, 0.2, 0.01, 500.0, 9.0, 4000, TrialMap(0.0, nothing + 12.5 + NOISE, 0.0))
    other = OffsetEstimate(FORWARD, 0.2, 0.01, 300.0, 6.0, 4000, TrialMap(0.0, nothing + 7.5, 0.0))
    assert not hardly_distinguishable(best, other)
    assert hardly_distinguishable(best, other._replace(gain=450.0))
    assert hardly_distinguishable(best, other._replace(best=best.best))
