"""Extrinsics: poses of sensors on the robot, and the projection of inclined sensors on the plane of the map.

An inclined sensor measures along its axis, but the map is a plane. The horizontal distance of a vertical wall is
r cos e for range r and elevation e of the axis. The projection of the cone is wider than the cone: its half angle a has
sin a = sin h / cos e for a cone of half angle h, by the two vertical planes through the sensor that touch the cone.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence

import numpy as np
from numpy.typing import NDArray

from ..common.readings import Floats
from .message_types import Pose2
from .quaternions import STEEPEST, elevation_of
from .rep117 import Measurement, Measurements

STEEP = 'steep_sensor'
"""The reason of `rep117.REASONS` for sensors that cannot be projected on the plane."""


class Mount(Pose2):
    """The pose of a sensor on the robot: the tuple is its projection on the plane.

    Attributes
    ----------
    elevation : float
        Of the axis of the sensor above the plane, radians: −pitch of REP 103.
    """

    elevation: float

    def __new__(cls, x: float, y: float, yaw: float, elevation: float = 0.0) -> Mount:
        """Return the pose; metres and radians."""
        made = super().__new__(cls, x, y, yaw)
        made.elevation = elevation
        return made


class Later:
    """The result of a look-up if the pose may still become known; `reason` is for readings whose time is over."""

    def __init__(self, reason: str) -> None:
        self.reason = reason


LATER = Later('unknown_extrinsics')
"""The frame is unknown so far."""

LATE = Later('late_transform')
"""The frame is known, but there is no transform at this stamp yet."""

ExtrinsicsLookup = Callable[[str, str, int], 'Pose2 | Later | str | None']
"""(base frame, sensor frame, stamp in ns) → pose of the sensor in the base frame, a `Later`, the reason why there can
be no reading of it (`rep117.REASONS`), or None if its pose is unknown. A `Pose2` is a `Mount` of elevation 0."""


def mount_of(x: float, y: float, axis: Sequence[float]) -> Mount | str:
    """Return the pose of a sensor at (x, y) that looks along `axis`, shape (3,), or `STEEP` if it is too steep."""
    elevation = elevation_of(*axis)
    return STEEP if abs(elevation) > STEEPEST else Mount(x, y, math.atan2(axis[1], axis[0]), elevation)


def shadow_of(half_angle: float, elevation: float) -> float | None:
    """Return the half angle of the projection of a cone, radians; None if the cone contains the vertical."""
    if half_angle + abs(elevation) >= math.pi / 2:
        return None
    return math.asin(math.sin(half_angle) / math.cos(elevation))


def project(measured: Measurement, elevation: float) -> str:
    """Project a measurement along an axis of this elevation on the plane, in place.

    Returns
    -------
    str
        '', or the reason why this is impossible; then it is unchanged.
    """
    factor = math.cos(elevation)
    if factor == 1.0:
        return ''
    shadow = None if abs(elevation) > STEEPEST else shadow_of(measured.half_angle, elevation)
    if shadow is None:
        return STEEP
    measured.half_angle = shadow
    # a reading without echo remains one, since z and z_max have the same factor
    measured.z, measured.z_max, measured.sigma = measured.z * factor, measured.z_max * factor, measured.sigma * factor
    return ''


def project_all(measured: Measurements, elevation: float) -> Measurements:
    """Return many measurements projected on the plane like `project`; an existing `reason` stays."""
    factor = math.cos(elevation)
    if factor == 1.0:
        return measured
    angles, of = np.unique(measured.half_angle, return_inverse=True)
    found = [None if abs(elevation) > STEEPEST else shadow_of(angle, elevation) for angle in angles.tolist()]
    steep = np.array([shadow is None for shadow in found], np.bool_)[of] & (measured.reason == '')
    shadows: Floats = np.array([shadow or 0.0 for shadow in found])[of]
    reason: NDArray[np.str_] = np.where(steep, STEEP, measured.reason)
    return Measurements(reason, measured.z * factor, measured.z_max * factor, shadows, measured.sigma * factor)
