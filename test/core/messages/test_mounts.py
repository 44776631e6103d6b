"""Poses of sensors on the robot; numbers in wrong units are rejected."""

from __future__ import annotations

import array
import math

import numpy as np
import pytest

from forward_grid_mapper.core.common.errors import ParameterError
from forward_grid_mapper.core.messages.message_types import Pose2
from forward_grid_mapper.core.messages.mounts import FARTHEST_MOUNT, TURN, far_mounts, mount_from


@pytest.mark.parametrize('form', [list, tuple, np.array, lambda values: array.array('d', values)])
def test_pose_from_any_sequence_of_three_numbers(form: type) -> None:
    assert mount_from('left', form([0.1, -0.2, 1.5])) == Pose2(0.1, -0.2, 1.5)


@pytest.mark.parametrize('kind', [np.float32, np.int32])
def test_pose_from_numpy_numbers(kind: type) -> None:
    assert mount_from('left', np.array([1, 0, -2], kind)) == Pose2(1.0, 0.0, -2.0)


def test_values_at_the_limits_are_accepted() -> None:
    assert mount_from('left', [FARTHEST_MOUNT, 0, float(np.float32(-TURN))]).x == FARTHEST_MOUNT


@pytest.mark.parametrize(
    ('values', 'message'),
    [
        ([0.1, 0.2, 90], r'left: a yaw of 90 is in radians, .*; 90 degrees are 1\.5708'),
        ([0.1, 0.2, -6.3], 'more than a full turn'),
        ([8, 8, 0], r'left: the sensor would be 11\.3 m away .* in metres'),
        ([0.1, 0.2], 'three finite numbers'),
        ([0.1, 0.2, True], 'three finite numbers'),
        ([0.1, 0.2, math.nan], 'three finite numbers'),
        ('0.1, 0.2, 1.5', 'three finite numbers'),
        (None, 'three finite numbers'),
    ],
)
def test_bad_pose_is_rejected_with_reason(values: object, message: str) -> None:
    with pytest.raises(ParameterError, match=message):
        mount_from('left', values)


def test_warning_names_far_sensors_and_the_largest_distance() -> None:
    near = Pose2(FARTHEST_MOUNT, 0.0, 0.0)
    assert far_mounts({}) == far_mounts({'left': near}) == []
    (warning,) = far_mounts({'left': near, 'back': Pose2(-150.0, 0.0, 0.0), 'front': Pose2(0.0, 170.0, 0.0)})
    assert 'put back, front up to 170 m away' in warning and 'millimetres' in warning and 'left' not in warning
    (warning,) = far_mounts({f'sonar_{k:02d}': Pose2(20.0 + k, 0.0, 0.0) for k in range(24)})
    assert 'sonar_07 and others up to 43 m' in warning and 'sonar_08' not in warning
