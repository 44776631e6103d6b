"""Trajectories as text."""

from __future__ import annotations

import math
from pathlib import Path

import numpy as np
import pytest

from forward_grid_mapper.core.common.readings import Readings
from forward_grid_mapper.core.trajectory.certainty import CalibrationEstimate
from forward_grid_mapper.core.trajectory.outcome import Refinement
from forward_grid_mapper.core.trajectory.windows import Odometry
from forward_grid_mapper.files.pose_files import poses_from_tum
from forward_grid_mapper.files.report_text import report_text
from forward_grid_mapper.files.trajectory_text import calibration_words, estimate_words, trajectory_data, tum_text


def test_tum_lines_hold_stamp_position_and_quaternion() -> None:
    poses = np.array([[1.0, -2.0, 0.0], [1.5, 0.25, math.pi / 2]])
    text = tum_text(Odometry(np.array([1_700_000_000_000_000_005, 1_700_000_001_500_000_000]), poses))
    first, second = text.splitlines()
    assert first.split()[0] == '1700000000.000000005'
    values = [float(word) for word in second.split()]
    assert values == pytest.approx([1700000001.5, 1.5, 0.25, 0, 0, 0, math.sqrt(0.5), math.sqrt(0.5)])


@pytest.mark.parametrize('stamp', [-500_000_000, -1_500_000_000, -1, 0, 1, 2_500_000_000])
def test_negative_stamps_are_read_back(tmp_path: Path, stamp: int) -> None:
    (tmp_path / 'a.tum').write_text(tum_text(Odometry(np.array([stamp]), np.zeros((1, 3)))))
    stamps, _ = poses_from_tum(tmp_path / 'a.tum')
    assert stamps.tolist() == [stamp / 1e9]


def test_calibration_in_words() -> None:
    words = calibration_words({'scale': 0.012, 'heading': 0.0, 'bias': -math.radians(0.5), 'turn_scale': -0.02})
    assert words == (
        'distances are measured 1.2 % too short; going straight is measured as turning 0.5° a metre to the left; '
        'turns are measured 2.0 % too large'
    )
    assert calibration_words({'scale': 0.001}) == ''
    # turns that are measured twice as large as they are have the factor 0.5
    assert calibration_words({'turn_scale': -0.5}) == 'turns are measured 100.0 % too large'
    assert estimate_words({}) == 'the drive does not determine the errors of the wheels'
    assert estimate_words({'scale': CalibrationEstimate(0.25, 0.025)}).startswith(
        'distances are measured 20.0 % too short (± 1.6 %)'
    )
    # less than two standard deviations are no error
    assert estimate_words({'heading': CalibrationEstimate(math.radians(0.5), math.radians(0.3))}).startswith(
        'the robot drives along its heading within the accuracy (± 0.3°)'
    )
    assert estimate_words({'heading': CalibrationEstimate(math.radians(0.5), math.radians(0.2))}).startswith(
        'the robot drives 0.5° to the left of its heading (± 0.2°)'
    )
    assert '1.0° to the right of' in calibration_words({'heading': -math.radians(1.0)})


def test_report_has_the_calibration_with_its_accuracy() -> None:
    path = Odometry(np.array([0, 10**9]), np.zeros((2, 3)))
    nothing = Readings.from_columns(x=[], y=[], yaw=[], z=[], z_max=[], half_angle=[])
    outcome = Refinement(True, 'readings are predicted better', nothing, path, {'scale': 0.01})
    data = trajectory_data(outcome, estimates={'scale': CalibrationEstimate(0.01, 0.002)})
    assert data['calibration_estimates'] == {'scale': {'value': 0.01, 'sigma': 0.002}}
    assert 'measure a straight line' in ' '.join(report_text({'input': {'trajectory': data}}).split())


def test_report_states_whether_the_trajectory_was_refined() -> None:
    refined = {
        'refined': True,
        'reason': 'readings are predicted better',
        'odometry_off_m': 5.432,
        'odometry_off_deg': 16.0,
        'places_recognised': 1,
        'odometry': 'turns are measured 2.0 % too large',
    }
    text = ' '.join(report_text({'input': {'trajectory': refined}}).split())
    assert 'off by 5.43 m and 16.0°' in text
    assert '1 place recognised' in text
    # the node does not ask which of them the drive determines
    assert 'turns are measured 2.0 % too large; the drive may not determine these values' in text
    assert 'measure a straight line' not in text
    estimates = {
        'calibration_estimates': {'turn_scale': {'value': -0.02, 'sigma': 0.004}},
        'odometry': 'turns are … too large (± 0.4 %)',
    }
    text = ' '.join(report_text({'input': {'trajectory': refined | estimates}}).split())
    assert 'Wheels turns are … too large (± 0.4 %); these values are for this drive: measure a straight line' in text
    assert 'may not determine' not in text
    refined |= {
        'calibration_estimates': {},
        'odometry': 'the drive does not show whether distances are measured too long',
    }
    assert 'measure a straight line' not in report_text({'input': {'trajectory': refined}})
    left = report_text({'input': {'trajectory': {'refined': False, 'reason': 'the drive is short'}}})
    assert "odometry's, not refined: the drive is short" in left
    assert 'Wheels' not in left
