"""Headings from orientations: the same for odometry, static transforms of bags, and TF in the node."""

from __future__ import annotations

import math
from collections.abc import Callable
from types import SimpleNamespace

import pytest

from forward_grid_mapper.bags.static_transforms import StaticTransforms
from forward_grid_mapper.core.common.errors import InputError
from forward_grid_mapper.core.messages.extrinsics import Mount
from forward_grid_mapper.core.messages.message_types import Pose2, odometry_message
from forward_grid_mapper.node.frames import TfExtrinsics, Transforms

XYZW = tuple[float, float, float, float]


def given(quaternion: XYZW, x: float) -> tuple[SimpleNamespace, SimpleNamespace]:
    return SimpleNamespace(x=x, y=2.0, z=0.3), SimpleNamespace(**dict(zip('xyzw', quaternion, strict=True)))


def by_odometry(quaternion: XYZW, x: float = 1.0) -> Pose2 | None:
    position, orientation = given(quaternion, x)
    header = SimpleNamespace(stamp=SimpleNamespace(sec=0, nanosec=0), frame_id='odom')
    pose = SimpleNamespace(pose=SimpleNamespace(position=position, orientation=orientation))
    return odometry_message(SimpleNamespace(header=header, child_frame_id='base', pose=pose)).pose


def by_bag(quaternion: XYZW, x: float = 1.0) -> Pose2 | None:
    transforms = StaticTransforms()
    try:
        transforms.add('base', 'sonar', (x, 2.0, 0.3), quaternion)
        return transforms.lookup('base', 'sonar')
    except InputError:
        return None


def by_tf(quaternion: XYZW, x: float = 1.0) -> Pose2 | None:
    pytest.importorskip('rclpy', reason='the transforms of the node need rclpy')
    translation, rotation = given(quaternion, x)
    found = SimpleNamespace(transform=SimpleNamespace(translation=translation, rotation=rotation))
    buffer = SimpleNamespace(lookup_transform=lambda *names: found)
    pose = TfExtrinsics({}, Transforms(buffer))('base', 'sonar', 0)
    return pose if isinstance(pose, Pose2) else None


everywhere = pytest.mark.parametrize('convert', [by_odometry, by_bag, by_tf])
Convert = Callable[..., Pose2 | None]


def turned(yaw: float, pitch: float, scale: float = 1.0) -> XYZW:
    """A rotation by yaw, and then by pitch; `scale` is the length of the quaternion."""
    a, b = yaw / 2, pitch / 2
    x, y, z, w = (
        -math.sin(a) * math.sin(b),
        math.cos(a) * math.sin(b),
        math.sin(a) * math.cos(b),
        math.cos(a) * math.cos(b),
    )
    return scale * x, scale * y, scale * z, scale * w


@everywhere
@pytest.mark.parametrize('scale', [0.9951, 1.0, 1.0049])
@pytest.mark.parametrize('pitch', [0.0, 0.7, math.radians(59.9), -math.radians(59.9)])
@pytest.mark.parametrize('yaw', [-3.0, 0.0, 2.5])
def test_orientation_of_nearly_unit_length_is_projected(
    convert: Convert, yaw: float, pitch: float, scale: float
) -> None:
    assert convert(turned(yaw, pitch, scale)) == pytest.approx((1.0, 2.0, yaw))


@everywhere
@pytest.mark.parametrize('scale', [0.0, 0.98, 0.994, 1.006, 1.02, 2.0, math.nan, math.inf])
def test_quaternion_that_tf2_rejects_is_rejected(convert: Convert, scale: float) -> None:
    assert convert(turned(0.5, 0.0, scale)) is None


@everywhere
@pytest.mark.parametrize('scale', [0.9951, 1.0, 1.0049])
@pytest.mark.parametrize('pitch', [math.radians(60.1), -math.radians(60.1), math.pi / 2])
def test_steep_axis_has_no_heading(convert: Convert, pitch: float, scale: float) -> None:
    assert convert(turned(0.5, pitch, scale)) is None


@everywhere
@pytest.mark.parametrize('x', [math.nan, math.inf])
def test_position_that_is_not_finite_is_rejected(convert: Convert, x: float) -> None:
    assert convert(turned(0.5, 0.0), x) is None


UPSIDE_DOWN = (math.cos(0.25), math.sin(0.25), 0.0, 0.0)


@pytest.mark.parametrize('convert', [by_bag, by_tf])
def test_sensor_upside_down_looks_along_its_x_axis(convert: Convert) -> None:
    assert convert(UPSIDE_DOWN) == pytest.approx((1.0, 2.0, 0.5))


def test_robot_upside_down_has_no_pose_in_the_plane() -> None:
    assert by_odometry(UPSIDE_DOWN) is None


@pytest.mark.parametrize('pitch', [0.0, 0.5, -0.9])
def test_bag_and_tf_give_the_same_elevation(pitch: float) -> None:
    found = by_bag(turned(0.5, pitch)), by_tf(turned(0.5, pitch))
    for mount in found:
        assert isinstance(mount, Mount)
        assert mount.elevation == pytest.approx(-pitch)
