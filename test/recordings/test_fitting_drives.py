"""Several refined drives: the choice of the drives to which others are fitted."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest

from forward_grid_mapper.core.common.parameters import Parameters
from forward_grid_mapper.core.common.readings import Readings
from forward_grid_mapper.core.trajectory.holding_out import Gain
from forward_grid_mapper.core.trajectory.outcome import Refinement
from forward_grid_mapper.core.trajectory.registration import Registration
from forward_grid_mapper.core.trajectory.windows import Odometry
from forward_grid_mapper.recordings import refined


def outcome(number: int, accepted: bool, lost: bool = False) -> Refinement:
    """Result of a drive whose readings all have x = `number`."""
    readings = Readings.from_columns(
        ('s',), x=np.array([float(number)]), y=0.0, yaw=0.0, z=1.0, z_max=2.0, half_angle=0.1
    )
    trajectory = Odometry.of(np.arange(2) * 10**9, np.zeros((2, 3)))
    return Refinement(accepted, '', readings, trajectory, {}, lost=lost)


@pytest.mark.parametrize(
    ('drives', 'expected'),
    [
        # (refined, heading lost) of each drive, and the reference drives of each drive that was fitted
        (((True, False), (False, False)), [{1}]),
        (((True, False), (False, True)), []),
        (((False, True), (True, False), (True, False)), [{1}]),
        (((True, False), (False, True), (False, False), (True, False)), [{2}, {0, 2}]),
        (((True, False), (True, False)), [{0}]),
    ],
)
def test_no_drive_is_fitted_to_one_with_lost_heading(
    drives: tuple[tuple[bool, bool], ...], expected: list[set[int]], monkeypatch: pytest.MonkeyPatch
) -> None:
    fitted_to: list[set[int]] = []

    def register(readings: Readings, begin: Any, others: Readings, *_: Any) -> Registration:
        fitted_to.append(set(others.x.astype(int).tolist()))
        return Registration(begin, Gain(0.0, 1.0))

    monkeypatch.setattr(refined, 'register', register)
    outcomes = [outcome(number, *drive) for number, drive in enumerate(drives)]
    out, words = refined._fitted(outcomes, Parameters())
    assert fitted_to == expected
    assert out == outcomes and words == [''] * len(drives)
