"""Drives with jumps of odometry: errors of the wheels from a part without jumps, and warnings about misplaced parts."""

from __future__ import annotations

from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest

from forward_grid_mapper.core.common.parameters import Parameters
from forward_grid_mapper.core.common.readings import Readings
from forward_grid_mapper.core.trajectory.outcome import Refinement
from forward_grid_mapper.core.trajectory.windows import Odometry
from forward_grid_mapper.recordings import refined

STAMPS = np.arange(10) * 10**9


def drive_of(name: str) -> Any:
    readings = Readings.from_columns(
        ('s',), x=np.arange(10.0), y=0.0, yaw=0.0, z=np.ones(10), z_max=2.0, half_angle=0.1, stamp=STAMPS
    )
    associator = SimpleNamespace(readings=readings, odometry=(STAMPS, np.zeros((10, 3))))
    return SimpleNamespace(associator=associator, source={'bag': name, 'warnings': []}, mounts=None)


def outcome_of(drive: Any, **values: Any) -> Refinement:
    trajectory = Odometry.of(STAMPS, np.full((10, 3), 0.1))
    return Refinement(True, 'better', drive.associator.readings, trajectory, {'scale': 0.01}, **values)


@pytest.mark.parametrize(('stretch', 'count'), [(None, 10), ((2 * 10**9, 7 * 10**9), 6)])
def test_errors_of_the_wheels_come_from_a_part_without_jumps(
    stretch: tuple[int, int] | None, count: int, monkeypatch: pytest.MonkeyPatch
) -> None:
    lengths: list[list[int]] = []

    def certain(readings: Readings, odometry: Odometry, trajectory: Odometry, *_: Any) -> dict[str, Any]:
        lengths.append([len(readings), len(odometry.stamp), len(trajectory.stamp)])
        return {}

    monkeypatch.setattr(refined, 'determined_calibration', certain)
    drive = drive_of('a')
    outcome = outcome_of(drive, stretch=stretch)
    odometry = Odometry.of(*drive.associator.odometry)
    for given in (None, refined.GivenCalibration({'scale': 0.0}, 'c.yaml')):
        refined._estimates(drive, odometry, outcome, Parameters(), lambda stage, part: None, given)
    assert lengths == [[count] * 3] * 2
    nothing = Refinement(True, 'placed', drive.associator.readings, outcome.trajectory, {})
    assert refined._estimates(drive, odometry, nothing, Parameters(), lambda stage, part: None, None) == {}
    assert len(lengths) == 2


@pytest.mark.parametrize('several', [False, True])
def test_part_that_could_not_be_placed_gives_a_warning(several: bool, monkeypatch: pytest.MonkeyPatch) -> None:
    one, other = drive_of('a.bag'), drive_of('b.bag')
    outcomes = [outcome_of(one, jumps='odometry jumps', unplaced=True), outcome_of(other, jumps='and is placed')]
    monkeypatch.setattr(refined, '_outcome', lambda drive, *_: outcomes[0 if drive is one else 1])
    monkeypatch.setattr(refined, '_estimates', lambda *_: {})
    monkeypatch.setattr(refined, '_fitted', lambda outcomes, parameters: (outcomes, [''] * len(outcomes)))
    source = {'warnings': [], 'drives': [dict(one.source), dict(other.source)]} if several else one.source
    drives: Any = SimpleNamespace(drives=(one, other) if several else (one,), source=source)
    refined.refine_drives(drives, Parameters())
    assert source['warnings'] == (['a.bag: odometry jumps'] if several else ['odometry jumps'])
