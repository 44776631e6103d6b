"""The algebra of planar poses, for any angles."""

from __future__ import annotations

import math

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from forward_grid_mapper.core.trajectory.poses import compose, inverse, relative, wrapped

METRES = st.floats(-100.0, 100.0)
RADIANS = st.floats(-20.0, 20.0)
POSES = st.builds(lambda x, y, yaw: np.array([x, y, yaw]), METRES, METRES, RADIANS)


def same(one: np.ndarray, other: np.ndarray) -> bool:
    """Whether two poses are equal up to full turns."""
    return bool(np.allclose(one[:2], other[:2], atol=1e-9)) and abs(math.remainder(one[2] - other[2], math.tau)) < 1e-9


@given(POSES, POSES)
def test_relative_pose_undoes_composition(frame: np.ndarray, pose: np.ndarray) -> None:
    assert same(relative(frame, compose(frame, pose)), pose)
    assert same(compose(frame, relative(frame, pose)), pose)
    assert same(compose(pose, inverse(pose)), np.zeros(3)) and same(compose(inverse(pose), pose), np.zeros(3))


@given(POSES, POSES, POSES)
def test_composition_is_associative(a: np.ndarray, b: np.ndarray, c: np.ndarray) -> None:
    assert same(compose(compose(a, b), c), compose(a, compose(b, c)))


@given(POSES, POSES)
def test_yaw_of_a_relative_pose_is_at_most_half_a_turn(frame: np.ndarray, pose: np.ndarray) -> None:
    assert -math.pi <= relative(frame, pose)[2] <= math.pi
    assert -math.pi <= inverse(pose)[2] <= math.pi


@given(RADIANS)
def test_wrapped_angle_is_the_same_direction(angle: float) -> None:
    assert -math.pi <= wrapped(angle) <= math.pi
    assert math.remainder(float(wrapped(angle)) - angle, math.tau) == pytest.approx(0.0, abs=1e-9)
