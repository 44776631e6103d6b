"""A drive with odometry that drifts, as messages, and parameters with the poses of its sensors."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import yaml

from forward_grid_mapper.core.common.readings import Readings
from forward_grid_mapper.core.messages.message_types import OdometryMessage, RangeMessage
from forward_grid_mapper.core.trajectory.outcome import Refinement, replaced
from forward_grid_mapper.core.trajectory.poses import compose
from forward_grid_mapper.core.trajectory.windows import Odometry
from forward_grid_mapper.simulation.drift import LEVELS, with_drift
from forward_grid_mapper.simulation.drive import Recording, drive
from forward_grid_mapper.simulation.sonar import NOISY, sonar_ring
from forward_grid_mapper.simulation.world import building_tour, building_world

Message = RangeMessage | OdometryMessage


def exact_drive() -> Recording:
    """A drive of 25 m through a building."""
    return drive(building_world(), building_tour()[:10], 0.15, sonar_ring(16), NOISY, seed=3)


def bent_drive() -> Recording:
    """The drive with odometry that drifts, 0.8 m off in the root mean square."""
    return with_drift(exact_drive(), LEVELS['high'], 6)


def in_turn(recording: Recording) -> list[Message]:
    """The messages by stamp, odometry before the ranges with the same stamp."""
    messages: list[Message] = [*recording.odometry, *recording.ranges]
    return sorted(messages, key=lambda message: message.stamp)


def write_parameters(path: Path, recording: Recording, **values: Any) -> Path:
    """Write a parameter file with the poses of the sensors."""
    mounts = {f'sensors.{frame}.pose': list(map(float, pose)) for frame, pose in recording.extrinsics}
    reliable = {'range_reliability': 'reliable', 'odom_reliability': 'reliable'}
    parameters = {**reliable, **mounts, **values}
    path.write_text(yaml.safe_dump({'forward_grid_mapper': {'ros__parameters': parameters}}))
    return path


def bend(odometry: Odometry) -> Odometry:
    """Return a trajectory that differs from odometry by a curve, and by at least one metre at its end."""
    count = len(odometry.stamp)
    turned = compose(odometry.pose[0], np.array([0.0, 0.0, 0.5]))
    ahead = compose(turned, np.stack([np.linspace(0.0, 1.0, count), np.zeros(count), np.zeros(count)], 1))
    pose = compose(ahead, odometry.pose - odometry.pose[0])
    return Odometry(odometry.stamp, pose)


class QuickRefiner:
    """Stand-in for `Refiner`: returns the trajectory of `bend` at once, or rejects it."""

    accepts = True

    def __init__(self, parameters: Any) -> None:
        pass

    def cancel(self) -> None:
        pass

    def run(self, readings: Readings, odometry: Odometry, watch: Any) -> Refinement:
        watch('quick', 0.5)
        if not self.accepts:
            return Refinement(False, 'the test says so', readings, odometry, {})
        trajectory = bend(odometry)
        return Refinement(
            True, 'better', replaced(readings, odometry, trajectory), trajectory, {'scale': 0.02}, 1.5, 0.2, 3, 0.1
        )


def replaced_by(readings: Readings, poses: np.ndarray) -> Readings:
    """Return readings with sensors at other poses, shape (N, 3)."""
    return replace(readings, x=poses[:, 0].copy(), y=poses[:, 1].copy(), yaw=poses[:, 2].copy())
