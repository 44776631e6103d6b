"""Poses of sensors from a tree of static transforms."""

from __future__ import annotations

import math

import numpy as np
import pytest

from forward_grid_mapper.bags.static_transforms import StaticTransforms
from forward_grid_mapper.core.common.errors import InputError
from forward_grid_mapper.core.messages.message_types import Pose2

NONE = (0.0, 0.0, 0.0)
IDENTITY = (0.0, 0.0, 0.0, 1.0)


def about(axis: str, angle: float) -> tuple[float, float, float, float]:
    vector = [0.0, 0.0, 0.0]
    vector['xyz'.index(axis)] = math.sin(angle / 2)
    return (*vector, math.cos(angle / 2))


def test_lookup_along_a_chain_in_both_directions() -> None:
    transforms = StaticTransforms()
    transforms.add('base', 'deck', (1.0, 0.0, 0.5), about('z', math.pi / 2))
    transforms.add('/deck', '/sonar', (2.0, 0.0, 0.0), about('z', math.pi / 2))
    transforms.add('base', 'mast', (0.0, 3.0, 0.0), IDENTITY)
    x, y, yaw = transforms.lookup('base', 'sonar')
    assert (x, y, abs(yaw)) == pytest.approx((1.0, 2.0, math.pi))
    x, y, yaw = transforms.lookup('/sonar', 'base')
    assert (x, y, abs(yaw)) == pytest.approx((1.0, 2.0, math.pi))
    assert transforms.lookup('mast', 'deck') == pytest.approx((1.0, -3.0, math.pi / 2))
    assert transforms.lookup('base', 'base') == Pose2(0.0, 0.0, 0.0)
    assert transforms.lookup('base', 'nowhere') is None
    assert transforms.frames == ['base', 'deck', 'mast', 'sonar']
    assert len(transforms) == 3


def test_separate_trees_are_not_joined() -> None:
    transforms = StaticTransforms()
    transforms.add('base', 'a', NONE, IDENTITY)
    transforms.add('other', 'b', NONE, IDENTITY)
    assert transforms.lookup('a', 'b') is None


def test_yaw_of_an_upside_down_sensor_is_mirrored() -> None:
    transforms = StaticTransforms()
    transforms.add('base', 'flipped', (0.0, 0.0, 1.0), about('x', math.pi))
    transforms.add('flipped', 'sonar', (1.0, 1.0, 0.0), about('z', 0.5))
    assert transforms.lookup('base', 'sonar') == pytest.approx((1.0, -1.0, -0.5))


@pytest.mark.parametrize('degrees', [-59.0, 0.0, 59.0])
def test_pose_of_a_tilted_sensor_is_projected(degrees: float) -> None:
    transforms = StaticTransforms()
    transforms.add('base', 'turned', NONE, about('z', 1.0))
    transforms.add('turned', 'sonar', NONE, about('y', math.radians(degrees)))
    assert transforms.lookup('base', 'sonar') == pytest.approx((0.0, 0.0, 1.0))


@pytest.mark.parametrize(('degrees', 'side'), [(61.0, 'down'), (90.0, 'down'), (-61.0, 'up'), (-90.0, 'up')])
def test_sensor_that_looks_at_floor_or_ceiling_is_rejected(degrees: float, side: str) -> None:
    transforms = StaticTransforms()
    transforms.add('base', 'sonar_9', NONE, about('y', math.radians(degrees)))
    with pytest.raises(InputError, match=f"'sonar_9' looks {side}"):
        transforms.lookup('base', 'sonar_9')


@pytest.mark.parametrize(
    ('translation', 'quaternion'),
    [
        (NONE, (0.0, 0.0, 0.0, 0.0)),
        (NONE, (0.0, 0.0, 1.0, 1.0)),
        (NONE, (math.nan, 0.0, 0.0, 1.0)),
        ((math.inf, 0.0, 0.0), IDENTITY),
    ],
)
def test_transform_with_bad_numbers_is_rejected(translation: tuple[float, ...], quaternion: tuple[float, ...]) -> None:
    transforms = StaticTransforms()
    with pytest.raises(InputError, match="'base' to 'sonar'"):
        transforms.add('/base', 'sonar', translation, quaternion)
    assert transforms.lookup('base', 'sonar') is None


def test_rejected_transform_matters_only_on_the_path() -> None:
    transforms = StaticTransforms()
    transforms.rejected['arm'] = 'the arm is broken'
    transforms.add('arm', 'sonar', NONE, IDENTITY)
    transforms.add('base', 'wheel', NONE, IDENTITY)
    assert transforms.lookup('base', 'wheel') is not None
    with pytest.raises(InputError, match='the arm is broken'):
        transforms.lookup('base', 'sonar')


def test_loop_of_transforms_ends_and_later_transforms_replace() -> None:
    transforms = StaticTransforms()
    transforms.add('a', 'b', NONE, IDENTITY)
    transforms.add('b', 'a', NONE, IDENTITY)
    assert transforms.lookup('c', 'a') is None
    with pytest.raises(InputError):
        transforms.add('a', '/a', NONE, IDENTITY)
    transforms.add('base', 'sonar', NONE, IDENTITY)
    transforms.add('base', 'sonar', (1.0, 0.0, 0.0), IDENTITY)
    assert transforms.lookup('base', 'sonar') == Pose2(1.0, 0.0, 0.0)


def test_composition_agrees_with_rotating_vectors() -> None:
    """Each step is applied to points with the formula v + 2 q × (q × v + w v)."""
    rng = np.random.default_rng(3)
    transforms = StaticTransforms()
    origin, tip = np.zeros(3), np.array([1.0, 0.0, 0.0])
    steps = []
    for i in range(4):
        # Small turns: the sensor stays within 60° of the plane.
        quaternion = np.append(rng.normal(0.0, 0.08, 3), 1.0)
        quaternion /= np.linalg.norm(quaternion)
        steps.append((rng.normal(size=3), quaternion))
        transforms.add(f'f{i}', f'f{i + 1}', steps[-1][0], quaternion)
    for offset, quaternion in reversed(steps):
        q, w = quaternion[:3], quaternion[3]
        origin, tip = (v + 2 * np.cross(q, np.cross(q, v) + w * v) + offset for v in (origin, tip))
    forward = tip - origin
    expected = (origin[0], origin[1], math.atan2(forward[1], forward[0]))
    assert transforms.lookup('f0', 'f4') == pytest.approx(expected)


@pytest.mark.parametrize(
    ('quaternion', 'length'),
    [
        ((3.0, 0.0, 0.0, 4.0), '5'),
        ((0.0, 2.0, 3.0, 6.0), '7'),
        ((1.0, 4.0, 8.0, 0.0), '9'),
        ((0.1, 0.2, 0.2, 0.4), '0.5'),
    ],
)
def test_message_states_the_length_of_a_bad_quaternion(quaternion: tuple[float, ...], length: str) -> None:
    with pytest.raises(InputError, match=f'a quaternion of length {length} instead of 1'):
        StaticTransforms().add('base', 'sonar', (0.0, 0.0, 0.0), quaternion)


@pytest.mark.parametrize('name', ['\x1b[31mred', 'a\nb', '\u202e', 'n' * 256])
def test_name_that_no_frame_has_is_rejected_and_not_shown(name: str) -> None:
    """It would change the colours of the terminal, or fill it."""
    for parent, child in ((name, 'sonar'), ('base', name)):
        transforms = StaticTransforms()
        with pytest.raises(InputError, match='too long or cannot be printed') as caught:
            transforms.add(parent, child, NONE, IDENTITY)
        assert name not in str(caught.value) and not transforms.frames


def test_different_poses_on_one_topic_are_a_doubt() -> None:
    transforms = StaticTransforms()
    transforms.add('base', 'left', NONE, IDENTITY)
    transforms.add('base', 'left', NONE, IDENTITY)
    transforms.add('base', 'right', NONE, IDENTITY)
    transforms.add('base', 'right', (1.0, 0.0, 0.0), IDENTITY)
    assert transforms.lookup('base', 'right') == Pose2(1.0, 0.0, 0.0)
    assert not transforms.doubts('base', 'left')
    (doubt,) = transforms.doubts('base', 'right')
    assert "different poses of 'right'" in doubt and 'the last one is used' in doubt


def test_valid_transform_replaces_a_rejected_one() -> None:
    """What is missing elsewhere is then not blamed on it."""
    transforms = StaticTransforms()
    transforms.add_if_valid('arm', 'sonar', NONE, (0.0, 0.0, 0.0, 0.5))
    with pytest.raises(InputError, match='quaternion of length'):
        transforms.lookup('base', 'sonar')
    transforms.add_if_valid('arm', 'sonar', NONE, IDENTITY)
    assert transforms.lookup('base', 'sonar') is None
