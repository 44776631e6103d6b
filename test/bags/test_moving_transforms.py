"""Poses of frames between two stamps are those of tf2: straight lines, and rotations at constant speed."""

from __future__ import annotations

import math
from types import SimpleNamespace as Made
from typing import Any

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy.spatial.transform import Rotation, Slerp

from forward_grid_mapper.bags.moving_transforms import MovingTransforms
from forward_grid_mapper.bags.static_transforms import StaticTransforms
from forward_grid_mapper.core.messages.extrinsics import STEEP, Mount

SECOND = 1_000_000_000
numbers = st.floats(-3.0, 3.0)


def message(stamp: int, parent: str, child: str, offset: Any, turn: Any) -> Any:
    header = Made(stamp=Made(sec=stamp // SECOND, nanosec=stamp % SECOND), frame_id=parent)
    translation = Made(**dict(zip('xyz', offset, strict=True)))
    rotation = Made(**dict(zip('xyzw', turn, strict=True)))
    item = Made(header=header, child_frame_id=child, transform=Made(translation=translation, rotation=rotation))
    return Made(transforms=[item])


@settings(deadline=None)
@given(
    turns=st.tuples(*2 * [st.tuples(numbers, numbers, numbers)]),
    offsets=st.tuples(*2 * [st.tuples(numbers, numbers, numbers)]),
    part=st.floats(0.0, 1.0),
    sign=st.sampled_from([1.0, -1.0]),
)
def test_poses_between_two_stamps(turns: Any, offsets: Any, part: float, sign: float) -> None:
    rotations = Rotation.from_rotvec(turns)
    joints = MovingTransforms(StaticTransforms(), {'servo'})
    for k in range(2):
        quaternion = (sign if k else 1.0) * rotations[k].as_quat()
        joints.add_message(message((k + 1) * SECOND, '/base', 'servo', offsets[k], quaternion))
    stamp = SECOND + round(part * SECOND)
    mount = joints.lookup('base', '/servo', stamp)
    # half a turn has two ways
    if (rotations[0].inv() * rotations[1]).magnitude() > math.pi - 1e-3:
        return
    expected = Slerp([0.0, 1.0], rotations)((stamp - SECOND) / SECOND)
    x, y, z = expected.apply([1.0, 0.0, 0.0])
    if abs(abs(math.asin(np.clip(z, -1.0, 1.0))) - math.radians(60)) < 1e-3:
        return
    if abs(z) > math.sin(math.radians(60)):
        assert mount == STEEP
        return
    assert isinstance(mount, Mount)
    where = (1.0 - part) * np.array(offsets[0]) + part * np.array(offsets[1])
    assert mount[:2] == pytest.approx(where[:2], abs=1e-6)
    assert math.remainder(mount.yaw - math.atan2(y, x), math.tau) == pytest.approx(0.0, abs=1e-6)
    assert mount.elevation == pytest.approx(math.asin(z), abs=1e-6)


def test_static_transforms_take_precedence_and_other_frames_are_ignored() -> None:
    fixed = StaticTransforms()
    fixed.add('base', 'mast', (0.5, 0.0, 0.0), (0.0, 0.0, 0.0, 1.0))
    joints = MovingTransforms(fixed, {'mast', 'servo'})
    none = (0.0, 0.0, 0.0, 1.0)
    for stamp in (SECOND, 2 * SECOND):
        joints.add_message(message(stamp, 'base', 'mast', (9.0, 9.0, 9.0), none))
        joints.add_message(message(stamp, 'mast', 'servo', (0.1, stamp / SECOND, 0.0), none))
        joints.add_message(message(stamp, 'base', 'wheel', (9.0, 9.0, 9.0), none))
    assert joints.lookup('base', 'servo', 3 * SECOND // 2) == pytest.approx((0.6, 1.5, 0.0))
    assert joints.connects('base', 'servo') and not joints.connects('base', 'wheel')
    assert joints.lookup('base', 'wheel', SECOND) is None


def test_invalid_transforms_are_left_out() -> None:
    joints = MovingTransforms(StaticTransforms(), {'servo'})
    bad = [((math.nan, 0.0, 0.0), (0.0, 0.0, 0.0, 1.0)), ((0.0, 0.0, 0.0), (0.0, 0.0, 0.0, 0.0))]
    for k, (offset, turn) in enumerate([((1.0, 0.0, 0.0), (0.0, 0.0, 0.0, 1.0)), *bad]):
        joints.add_message(message((k + 1) * SECOND, 'base', 'servo', offset, turn))
    assert joints.lookup('base', 'servo', SECOND) == pytest.approx((1.0, 0.0, 0.0))
    assert joints.lookup('base', 'servo', SECOND - 1) == 'late_transform'
    assert joints.lookup('base', 'servo', 2 * SECOND) == 'late_transform'
    # a frame of which all transforms are invalid is known, but never has a pose
    only = MovingTransforms(StaticTransforms(), {'servo'})
    only.add_message(message(SECOND, 'base', 'servo', *bad[0]))
    assert only.lookup('base', 'servo', SECOND) == 'late_transform'


def test_loops_of_frames_end() -> None:
    joints = MovingTransforms(StaticTransforms(), {'a', 'b'})
    for parent, child in (('a', 'b'), ('b', 'a')):
        joints.add_message(message(SECOND, parent, child, (1.0, 0.0, 0.0), (0.0, 0.0, 0.0, 1.0)))
    assert not joints.connects('base', 'a')
    assert joints.lookup('base', 'a', SECOND) is None


def test_frames_are_connected_as_soon_as_their_transforms_come() -> None:
    joints = MovingTransforms(StaticTransforms(), {'servo', 'sonar'})
    none = (0.0, 0.0, 0.0, 1.0)
    joints.add_message(message(SECOND, 'base', 'servo', (0.5, 0.0, 0.0), none))
    assert joints.lookup('base', 'sonar', SECOND) is None and not joints.connects('base', 'sonar')
    joints.add_message(message(SECOND, 'servo', 'sonar', (0.1, 0.0, 0.0), none))
    assert joints.connects('base', 'sonar')
    assert joints.lookup('base', 'sonar', SECOND)[:3] == pytest.approx((0.6, 0.0, 0.0))
