"""How far the map extends, and whether it may grow to hold one more reading."""

from __future__ import annotations

import math

from ..common.constants import arc_depth
from ..common.parameters import Parameters
from ..common.readings import Readings
from ..sensor.density import CUT
from .message_types import Pose2
from .rep117 import Measurement

FARTHEST = 2e7
"""Metres from the origin beyond which no pose can be right: half the way round the Earth."""

LARGEST_CONE = 2_000_000
"""Cells that one reading may touch, so that none keeps the node busy for longer than a moment."""


def possible(pose: Pose2) -> bool:
    """Return whether a pose is finite and on Earth; `max` and `min` would hide a NaN."""
    return abs(pose.x) < FARTHEST and abs(pose.y) < FARTHEST and math.isfinite(pose.yaw)


def reach_of(measured: Measurement, parameters: Parameters) -> float:
    """Return how far from the sensor the maps take note of a reading, and two cells more, in metres."""
    p = parameters
    cell = p.grid.resolution
    explained = measured.z + CUT * max(measured.sigma or p.model.sigma, cell / 2)
    return max(min(explained, measured.z_max), measured.z + arc_depth(cell)) + 2 * cell


class MapExtent:
    """The box around all cones of the readings so far: left, right, bottom, top in metres."""

    def __init__(self) -> None:
        self.clear()

    def clear(self) -> None:
        """Begin with an empty map."""
        self._box = (math.inf, -math.inf, math.inf, -math.inf)

    def restore(self, readings: Readings) -> None:
        """Grow to hold readings that were admitted before; there is at least one."""
        left, right, bottom, top = self._box
        reach = float(readings.z.max())
        self._box = (
            min(left, float(readings.x.min()) - reach),
            max(right, float(readings.x.max()) + reach),
            min(bottom, float(readings.y.min()) - reach),
            max(top, float(readings.y.max()) + reach),
        )

    def admit(self, sensor: Pose2, measured: Measurement, parameters: Parameters) -> str:
        """Grow to hold a reading and return '', or return the reason (`rep117.REASONS`) why the map cannot."""
        reach = reach_of(measured, parameters)
        cell = parameters.grid.resolution
        if not possible(sensor):
            return 'too_far_away'
        left, right, bottom, top = self._box
        if left <= right:
            away = max(left - sensor.x, sensor.x - right, bottom - sensor.y, sensor.y - top)
            if away > parameters.association.max_jump:
                return 'far_from_map'
        box = (
            min(left, sensor.x - reach),
            max(right, sensor.x + reach),
            min(bottom, sensor.y - reach),
            max(top, sensor.y + reach),
        )
        if not ((box[1] - box[0]) / cell + 1) * ((box[3] - box[2]) / cell + 1) <= parameters.grid.max_cells:
            return 'too_far_away'
        if measured.half_angle * (reach / cell) ** 2 > LARGEST_CONE:
            return 'large_cone'
        self._box = box
        return ''
