"""Inclined sensors: their readings projected into the plane, compared with rays and cones in space."""

from __future__ import annotations

import math

import numpy as np
import pytest

from forward_grid_mapper.core.common.parameter_groups import AssociationParameters
from forward_grid_mapper.core.messages.extrinsics import STEEP, Mount, mount_of, project, shadow_of
from forward_grid_mapper.core.messages.message_types import OdometryMessage, Pose2, RangeMessage
from forward_grid_mapper.core.messages.pose_association import PoseAssociator
from forward_grid_mapper.core.messages.rep117 import REASONS, Measurement, measure

STEPS = 20_000


def measured(z: float = 2.0, z_max: float = 4.0, half_angle: float = 0.2, variance: float = 0.04) -> Measurement:
    message = RangeMessage(0, 'sonar', z, 0.1, z_max, 2 * half_angle, variance)
    found = measure(message, AssociationParameters())
    assert isinstance(found, Measurement)
    return found


def values(m: Measurement) -> tuple[float, float, float, float]:
    return m.z, m.z_max, m.half_angle, m.sigma


def axis_of(yaw: float, elevation: float) -> np.ndarray:
    return np.array([math.cos(yaw) * math.cos(elevation), math.sin(yaw) * math.cos(elevation), math.sin(elevation)])


@pytest.mark.parametrize('half_angle', [0.01, 0.13, 0.26, 0.5])
@pytest.mark.parametrize('degrees', [0.0, 5.0, 30.0, -30.0, 59.0])
def test_projected_cone_is_as_wide_as_the_cone_seen_from_above(half_angle: float, degrees: float) -> None:
    """Rays around the rim of the cone: the largest angle between a ray and the axis, seen from above."""
    elevation = math.radians(degrees)
    axis = axis_of(0.0, elevation)
    side, up = np.array([0.0, 1.0, 0.0]), axis_of(0.0, elevation + math.pi / 2)
    turn = np.linspace(0.0, 2 * math.pi, STEPS)[:, None]
    rim = math.cos(half_angle) * axis + math.sin(half_angle) * (np.cos(turn) * side + np.sin(turn) * up)
    widest = np.arctan2(rim[:, 1], rim[:, 0]).max()
    assert shadow_of(half_angle, elevation) == pytest.approx(widest, abs=1e-7)


@pytest.mark.parametrize(('half_angle', 'degrees'), [(0.6, 60.0), (math.radians(31), -59.5), (1.5, 10.0)])
def test_cone_that_contains_the_vertical_is_rejected_as_steep(half_angle: float, degrees: float) -> None:
    elevation = math.radians(degrees)
    # the zenith or the nadir is within the cone
    assert math.acos(abs(axis_of(0.0, elevation)[2])) <= half_angle
    assert shadow_of(half_angle, elevation) is None
    m = measured(half_angle=half_angle)
    before = values(m)
    assert project(m, elevation) == STEEP
    assert values(m) == before
    assert STEEP in REASONS


def test_echo_of_a_vertical_wall_is_projected_onto_the_wall() -> None:
    """Rays and walls in space: the range along an inclined axis, and its end in the plane."""
    rng = np.random.default_rng(1)
    for _ in range(200):
        yaw, elevation = rng.uniform(-math.pi, math.pi), rng.uniform(-1.0, 1.0)
        bearing, away = yaw + rng.uniform(-1.2, 1.2), rng.uniform(0.3, 3.0)
        axis, normal = axis_of(yaw, elevation), axis_of(bearing, 0.0)
        along = away / float(axis @ normal)
        mount = mount_of(0.0, 0.0, axis.tolist())
        assert isinstance(mount, Mount)
        m = measured(along, 2 * along, 0.05, 0.01)
        assert project(m, mount.elevation) == ''
        x, y = m.z * math.cos(mount.yaw), m.z * math.sin(mount.yaw)
        assert x * normal[0] + y * normal[1] == pytest.approx(away)
        assert m.z_max == pytest.approx(2 * m.z)
        # a range that is too long by σ ends farther in the plane, by the new σ
        longer = measured(along + 0.1, 2 * along, 0.05, 0.01)
        project(longer, mount.elevation)
        assert m.sigma == pytest.approx(longer.z - m.z)


def test_range_at_30_degrees_of_elevation_is_scaled_by_the_cosine() -> None:
    m = measured(2.0 / math.cos(math.radians(30.0)))
    project(m, math.radians(30.0))
    assert m.z == pytest.approx(2.0)


def test_measurement_of_a_level_sensor_is_unchanged() -> None:
    for elevation in (0.0, -0.0, 1e-9):
        m = measured(1.2345)
        before = values(m)
        assert project(m, elevation) == ''
        assert values(m) == before


@pytest.mark.parametrize('elevation', [0.1, -0.7, 1.0])
def test_projection_keeps_no_echo_and_no_variance(elevation: float) -> None:
    m = measured(math.inf, variance=0.0)
    assert project(m, elevation) == ''
    assert m.z == m.z_max < 4.0
    assert m.sigma == 0.0


@pytest.mark.parametrize('degrees', [60.1, -60.1, 89.0, 90.0, -90.0])
def test_steep_sensors_are_rejected(degrees: float) -> None:
    assert mount_of(0.0, 0.0, axis_of(0.3, math.radians(degrees)).tolist()) == STEEP
    assert project(measured(half_angle=0.01), math.radians(degrees)) == STEEP


def test_mount_compares_and_composes_as_its_pose_in_the_plane() -> None:
    mount = Mount(1.0, 2.0, 0.5, -0.3)
    assert mount == Pose2(1.0, 2.0, 0.5) == (1.0, 2.0, 0.5)
    assert Pose2(1.0, 0.0, 0.0).compose(mount) == (2.0, 2.0, 0.5)
    assert mount.elevation == -0.3
    assert Mount(1.0, 2.0, 0.5).elevation == 0.0


def test_readings_are_projected_and_steep_ones_rejected_with_reason() -> None:
    mounts = {
        'level': Pose2(0.0, 0.0, 0.0),
        'down': Mount(0.0, 0.0, 0.0, -math.radians(30.0)),
        'floor': Mount(0.0, 0.0, 0.0, -math.pi / 2),
        'ceiling': STEEP,
    }
    p = PoseAssociator(lambda base, frame, stamp: mounts[frame], patient=True)
    p.add_odometry(OdometryMessage(0, 'odom', 'base', Pose2(0.0, 0.0, 0.0)))
    p.add_odometry(OdometryMessage(100, 'odom', 'base', Pose2(0.0, 0.0, 0.0)))
    for k, frame in enumerate(mounts):
        p.add_range(RangeMessage(k, frame, 2.0, 0.1, 4.0, 0.4))
    p.finish()
    readings = p.readings
    assert dict(p.rejected) == {STEEP: 2}
    assert p.rejected_by_frame == {'floor': {STEEP: 1}, 'ceiling': {STEEP: 1}}
    assert p.unknown_frames == set()
    assert readings.z.tolist() == pytest.approx([2.0, 2.0 * math.cos(math.radians(30.0))])
    assert readings.z_max.tolist() == pytest.approx([4.0, 4.0 * math.cos(math.radians(30.0))])
    assert readings.half_angle[1] == pytest.approx(math.asin(math.sin(0.2) / math.cos(math.radians(30.0))))
