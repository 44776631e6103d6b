"""Rotation of a quaternion, compared with the product of quaternions, and the heading of its x axis."""

from __future__ import annotations

import math

import numpy as np
import pytest

from forward_grid_mapper.core.messages.quaternions import (
    STEEPEST,
    TOLERANCE,
    elevation_of,
    heading_of,
    rotation_of,
    yaw_of,
)

XYZW = tuple[float, float, float, float]


def product(a: XYZW, b: XYZW) -> XYZW:
    """Hamilton's product."""
    av, bv = np.array(a[:3]), np.array(b[:3])
    vector = a[3] * bv + b[3] * av + np.cross(av, bv)
    return (*vector.tolist(), a[3] * b[3] - float(av @ bv))


@pytest.mark.parametrize('seed', range(10))
def test_rotation_of_a_vector_equals_the_quaternion_product(seed: int) -> None:
    rng = np.random.default_rng(seed)
    x, y, z, w = (rng.normal(size=4)).tolist()
    length = math.sqrt(x * x + y * y + z * z + w * w)
    q = (x / length, y / length, z / length, w / length)
    rotation = rotation_of(*q)
    assert rotation is not None
    back = (-q[0], -q[1], -q[2], q[3])
    for axis in np.eye(3):
        turned = product(product(q, (*axis.tolist(), 0.0)), back)
        assert np.array(rotation) @ axis == pytest.approx(np.array(turned[:3]))


@pytest.mark.parametrize('scale', [1.0 - 0.49 * TOLERANCE, 1.0 + 0.49 * TOLERANCE])
def test_quaternion_of_length_near_one_is_normalised(scale: float) -> None:
    half = 0.3
    rotation = rotation_of(0.0, 0.0, scale * math.sin(half), scale * math.cos(half))
    assert rotation is not None
    expected = [[math.cos(0.6), -math.sin(0.6), 0.0], [math.sin(0.6), math.cos(0.6), 0.0], [0.0, 0.0, 1.0]]
    assert np.array(rotation) == pytest.approx(np.array(expected))


@pytest.mark.parametrize('scale', [0.0, 1.0 - 0.51 * TOLERANCE, 1.0 + 0.51 * TOLERANCE, 2.0, math.nan, math.inf])
def test_quaternion_of_other_length_is_rejected(scale: float) -> None:
    q = tuple(scale * 0.5 for _ in range(4))
    assert rotation_of(*q) is None and yaw_of(*q) is None
    assert TOLERANCE == 0.01


def test_elevation_and_heading_of_a_vector() -> None:
    assert elevation_of(3.0, 4.0, 5.0) == pytest.approx(math.pi / 4)
    assert elevation_of(3.0, 4.0, -5.0) == pytest.approx(-math.pi / 4)
    assert heading_of(-1.0, 2.0, 0.1) == math.atan2(2.0, -1.0)
    assert pytest.approx(math.radians(60)) == STEEPEST
    for sign in (-1, 1):
        assert heading_of(0.0, 1.0, sign * math.tan(STEEPEST - 1e-6)) == pytest.approx(math.pi / 2)
        assert heading_of(0.0, 1.0, sign * math.tan(STEEPEST + 1e-6)) is None


@pytest.mark.parametrize('yaw', [-3.0, -1.0, 0.0, 0.5, 2.0])
@pytest.mark.parametrize('pitch', [-1.0, 0.0, 0.4])
def test_yaw_is_that_of_the_x_axis(yaw: float, pitch: float) -> None:
    turn = (0.0, 0.0, math.sin(yaw / 2), math.cos(yaw / 2))
    nod = (0.0, math.sin(pitch / 2), 0.0, math.cos(pitch / 2))
    roll = (math.sin(0.7), 0.0, 0.0, math.cos(0.7))
    assert yaw_of(*product(product(turn, nod), roll)) == pytest.approx(yaw)


def test_robot_upside_down_has_no_yaw() -> None:
    """Its left side is at its right in the plane: a rolled robot has a yaw, and one that is turned over has none."""
    for roll, upright in ((1.5, True), (-1.5, True), (1.6, False), (math.pi, False), (-2.0, False)):
        assert (yaw_of(math.sin(roll / 2), 0.0, 0.0, math.cos(roll / 2)) is not None) == upright
    # the quaternion of NED in ENU
    assert yaw_of(math.sqrt(0.5), math.sqrt(0.5), 0.0, 0.0) is None


def test_steep_x_axis_has_no_yaw() -> None:
    assert yaw_of(0.0, math.sin(0.6), 0.0, math.cos(0.6)) is None
    assert yaw_of(0.0, math.sin(0.5), 0.0, math.cos(0.5)) == pytest.approx(0.0)
