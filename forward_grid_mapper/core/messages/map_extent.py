"""The extent of the map, and whether it may grow by one more reading."""

from __future__ import annotations

import math
from collections.abc import Callable
from typing import Any

import numpy as np
from numpy.typing import NDArray

from ..common.constants import arc_depths
from ..common.parameters import Parameters
from ..common.readings import Floats, Readings
from ..sensor.density import CUT
from .message_batch import REASON
from .message_types import Pose2
from .rep117 import Measurement, Measurements

LARGEST_COORDINATE = 2e7
"""Largest possible coordinate, metres: half the circumference of the Earth."""

LARGEST_CONE = 2_000_000
"""Most cells in the cone of a reading, so that none blocks the node for long."""


def possible(pose: Pose2) -> bool:
    """Return whether a pose is finite and on Earth; comparisons are false for NaN."""
    return abs(pose.x) < LARGEST_COORDINATE and abs(pose.y) < LARGEST_COORDINATE and math.isfinite(pose.yaw)


def reach_with_margin(measured: Measurement, parameters: Parameters) -> float:
    """Return the reach of a reading in all maps, plus two cells, metres."""
    sigma = measured.sigma or parameters.model.sigma
    return float(_reach(measured.z, measured.z_max, sigma, parameters, max, min))


def _reach(
    z: Any, z_max: Any, sigma: Any, parameters: Parameters, highest: Callable[..., Any], lowest: Callable[..., Any]
) -> Any:
    """Return `reach_with_margin` of numbers or of arrays; `highest` and `lowest` are `max` and `min` for them."""
    cell = parameters.grid.resolution
    evaluated = z + CUT * highest(sigma, cell / 2)
    return highest(lowest(evaluated, z_max), z + arc_depths(cell)[1]) + 2 * cell


_SIGNS = np.array([[1.0], [-1.0], [1.0], [-1.0]])

Box = tuple[float, float, float, float]
"""Left, right, bottom, top; metres."""


def _fits(box: Box, parameters: Parameters) -> bool:
    """Return whether a map of this box has at most `max_cells`."""
    cell = parameters.grid.resolution
    return ((box[1] - box[0]) / cell + 1) * ((box[3] - box[2]) / cell + 1) <= parameters.grid.max_cells


class MapExtent:
    """The box around all cones of the readings so far: left, right, bottom, top in metres."""

    def __init__(self) -> None:
        self.clear()

    def clear(self) -> None:
        """Make the map empty."""
        self._box = (math.inf, -math.inf, math.inf, -math.inf)

    def restore(self, readings: Readings, parameters: Parameters) -> dict[str, NDArray[np.bool_]]:
        """Grow by readings that an earlier run admitted, perhaps with other parameters.

        Returns
        -------
        dict of str → bool, shape (N,)
            Masks of the readings that are rejected, by reason (`rep117.REASONS`).
        """
        r = readings
        sigma = np.where(r.sigma > 0, r.sigma, parameters.model.sigma)
        reach = _reach(r.z, r.z_max, sigma, parameters, np.maximum, np.minimum)
        with np.errstate(over='ignore'):
            large = ~(r.half_angle * (reach / parameters.grid.resolution) ** 2 <= LARGEST_CONE)
        far = np.zeros(len(r), bool)
        rest = np.flatnonzero(~large)
        if len(rest):
            x, y, reach = r.x[rest], r.y[rest], reach[rest]
            sides = (x - reach).min(), (x + reach).max(), (y - reach).min(), (y + reach).max()
            box = self._grown(*map(float, sides))
            if _fits(box, parameters):
                self._box = box
            else:
                far[rest] = self._too_far(x, y, reach, parameters)
        return {'large_cone': large, 'too_far_away': far}

    def _too_far(self, x: Floats, y: Floats, reach: Floats, parameters: Parameters) -> NDArray[np.bool_]:
        """Grow by readings one after the other; return the mask of those that would make the map too large."""
        far = np.zeros(len(x), bool)
        for number, (px, py, around) in enumerate(zip(x.tolist(), y.tolist(), reach.tolist(), strict=True)):
            box = self._grown(px - around, px + around, py - around, py + around)
            if _fits(box, parameters):
                self._box = box
            else:
                far[number] = True
        return far

    def _grown(self, left: float, right: float, bottom: float, top: float) -> Box:
        """Return the union of the box and another one."""
        mine = self._box
        return min(mine[0], left), max(mine[1], right), min(mine[2], bottom), max(mine[3], top)

    def admit_all(self, poses: Floats, measured: Measurements, parameters: Parameters) -> NDArray[np.str_]:
        """Apply `admit` to many readings, one after the other; `poses` are those of the sensors, shape (N, 3)."""
        sigma = np.where(measured.sigma != 0, measured.sigma, parameters.model.sigma)
        reach = _reach(measured.z, measured.z_max, sigma, parameters, np.maximum, np.minimum)
        reason = np.full(len(poses), '', REASON)
        box = self._box_of_all(poses, measured.half_angle, reach, parameters)
        if box is not None:
            self._box = box
            return reason
        rows = zip(poses.tolist(), measured.half_angle.tolist(), reach.tolist(), strict=True)
        for number, (pose, half_angle, around) in enumerate(rows):
            reason[number] = self._admit(Pose2(*pose), around, half_angle, parameters)
        return reason

    def _box_of_all(self, poses: Floats, half_angle: Floats, reach: Floats, parameters: Parameters) -> Box | None:
        """Return the box around all readings; None if one of them might not be admitted."""
        x, y, yaw = poses.T
        if not ((np.abs(x) < LARGEST_COORDINATE) & (np.abs(y) < LARGEST_COORDINATE) & np.isfinite(yaw)).all():
            return None
        sides = np.stack([x - reach, -(x + reach), y - reach, -(y + reach)])
        mine = np.array(self._box) * _SIGNS[:, 0]
        grown = np.minimum.accumulate(np.concatenate([mine[:, None], sides], axis=1), axis=1) * _SIGNS
        left, right, bottom, top = grown[:, :-1]
        away = np.maximum(np.maximum(left - x, x - right), np.maximum(bottom - y, y - top))
        far = (away > parameters.association.max_jump) & (left <= right)
        box: Box = tuple(grown[:, -1].tolist())
        # with a tolerance, since a power and a product may differ in the last bit
        large = half_angle * (reach / parameters.grid.resolution) ** 2 > LARGEST_CONE * (1 - 1e-9)
        # the box only grows
        return None if far.any() or large.any() or not _fits(box, parameters) else box

    def admit(self, sensor: Pose2, measured: Measurement, parameters: Parameters) -> str:
        """Grow by a reading and return '', or return the reason for its rejection (`rep117.REASONS`)."""
        return self._admit(sensor, reach_with_margin(measured, parameters), measured.half_angle, parameters)

    def _admit(self, sensor: Pose2, reach: float, half_angle: float, parameters: Parameters) -> str:
        cell = parameters.grid.resolution
        if not possible(sensor):
            return 'too_far_away'
        left, right, bottom, top = self._box
        if left <= right:
            away = max(left - sensor.x, sensor.x - right, bottom - sensor.y, sensor.y - top)
            if away > parameters.association.max_jump:
                return 'far_from_map'
        box = self._grown(sensor.x - reach, sensor.x + reach, sensor.y - reach, sensor.y + reach)
        if not _fits(box, parameters):
            return 'too_far_away'
        if half_angle * (reach / cell) ** 2 > LARGEST_CONE:
            return 'large_cone'
        self._box = box
        return ''
