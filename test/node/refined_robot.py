"""A node in the process of the test with a quick refiner, and its expected live map."""

from __future__ import annotations

import threading
from typing import Any

import numpy as np
import pytest
from drift_samples import bend, replaced_by
from inside import Inside

from forward_grid_mapper.core.common.parameters import Parameters
from forward_grid_mapper.core.mapping import Mapper
from forward_grid_mapper.core.maps.log_odds_map import LogOddsMap
from forward_grid_mapper.core.trajectory.poses import compose, relative
from forward_grid_mapper.core.trajectory.windows import Odometry


class HeldRun:
    """A run of EM that waits until the test lets it continue."""

    def __init__(self, monkeypatch: pytest.MonkeyPatch) -> None:
        self.begun, self.go_on = threading.Event(), threading.Event()
        run = Mapper.run

        def waits(*arguments: Any) -> Any:
            self.begun.set()
            assert self.go_on.wait(60.0)
            return run(*arguments)

        monkeypatch.setattr(Mapper, 'run', waits)


def odometry_of(robot: Inside) -> Odometry:
    return Odometry.of(*robot.node.associator.odometry)


def refined(robot: Inside, *, count: int = 200) -> tuple[Inside, Odometry]:
    robot.drive(0, count)
    assert robot.call(robot.node.em.run_em)[0]
    return robot, odometry_of(robot)


def live_of(robot: Inside) -> tuple[Any, np.ndarray]:
    """The live map of all readings received by the node."""
    robot.node.feed.feed()
    snapshot = robot.node.live.snapshot()
    return snapshot.grid, snapshot.probability


def expected_live(robot: Inside, bent: Odometry | None) -> tuple[Any, np.ndarray]:
    """The expected live map of all readings: along the refined trajectory for odometry until `bent`, or of odometry."""
    readings = robot.node.associator.readings
    if bent is not None:
        then = bend(bent)
        at = np.clip(readings.stamp, bent.stamp[0], bent.stamp[-1])
        sensors = np.stack([readings.x, readings.y, readings.yaw], 1)
        placed = compose(then.at(at), relative(bent.at(at), sensors))
        readings = replaced_by(readings, placed)
    live = LogOddsMap(Parameters())
    live.add(readings)
    return live.grid, live.probability()


def assert_live(robot: Inside, bent: Odometry | None) -> None:
    (grid, ours), (expected_grid, theirs) = live_of(robot), expected_live(robot, bent)
    assert grid == expected_grid
    assert np.array_equal(np.isnan(ours), np.isnan(theirs))
    assert np.nanmax(np.abs(ours - theirs)) < 1e-3


def begin(robot: Inside) -> None:
    """Let the node receive the first messages of the drive."""
    robot.drive(0, 1)
    robot.until(lambda: robot.node.trajectory.distance._newest is not None)
