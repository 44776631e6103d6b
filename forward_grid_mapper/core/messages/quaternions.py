"""Conversion of orientations (quaternions) into headings in the plane, for both the node and bags."""

from __future__ import annotations

import math

TOLERANCE = 0.01
"""Bound on |x² + y² + z² + w² − 1|; tf2 has the same one, so node and bags accept the same quaternions."""

STEEPEST = math.radians(60.0)
"""Largest angle between an x axis and the plane, radians. Beyond it the heading is ill-defined, and the range of a
sensor in the plane is less than half of what it measures."""

Rotation = tuple[tuple[float, float, float], tuple[float, float, float], tuple[float, float, float]]
"""Rows of a rotation matrix; its first column is the x axis."""


def rotation_of(x: float, y: float, z: float, w: float) -> Rotation | None:
    """Return the rotation of a quaternion, normalised to length one; None if not finite, or beyond `TOLERANCE`."""
    square = x * x + y * y + z * z + w * w
    # a NaN compares false
    if not abs(square - 1.0) <= TOLERANCE:
        return None
    s = 2.0 / square
    return (
        (1.0 - s * (y * y + z * z), s * (x * y - z * w), s * (x * z + y * w)),
        (s * (x * y + z * w), 1.0 - s * (x * x + z * z), s * (y * z - x * w)),
        (s * (x * z - y * w), s * (y * z + x * w), 1.0 - s * (x * x + y * y)),
    )


def elevation_of(x: float, y: float, z: float) -> float:
    """Return the angle of a direction above the plane, radians; negative below it."""
    return math.atan2(z, math.hypot(x, y))


def heading_of(x: float, y: float, z: float) -> float | None:
    """Return the heading of an x axis in the plane, radians; None if it leaves the plane by more than `STEEPEST`."""
    return None if abs(elevation_of(x, y, z)) > STEEPEST else math.atan2(y, x)


def yaw_of(x: float, y: float, z: float, w: float) -> float | None:
    """Return the heading of a robot, whose x axis looks ahead, radians.

    None if the quaternion is not normalised, if x is too steep, or if z points down: the projection on the plane would
    exchange left and right.
    """
    rotation = rotation_of(x, y, z, w)
    if rotation is None or rotation[2][2] <= 0.0:
        return None
    return heading_of(rotation[0][0], rotation[1][0], rotation[2][0])
