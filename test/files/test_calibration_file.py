"""The file of a calibration: its values are read back, unknown ones are left out, and bad files are rejected."""

from __future__ import annotations

import math
from pathlib import Path

import pytest
import yaml

from forward_grid_mapper.core.common.errors import ParameterError
from forward_grid_mapper.core.trajectory.certainty import CalibrationEstimate
from forward_grid_mapper.files.calibration_file import calibration_text, load_calibration

CALIBRATION = {
    'scale': CalibrationEstimate(0.012, 0.004),
    'heading': CalibrationEstimate(-0.01, 0.003),
    'bias': CalibrationEstimate(math.radians(0.5), math.radians(0.1)),
    'turn_scale': CalibrationEstimate(-0.02, 0.005),
}


def test_calibration_file_is_read_back(tmp_path: Path) -> None:
    text = calibration_text(CALIBRATION, 'monday')
    (tmp_path / 'calibration.yaml').write_text(text)
    found = load_calibration(tmp_path / 'calibration.yaml')
    assert found == pytest.approx({name: value for name, (value, _) in CALIBRATION.items()}, abs=2e-4)
    figures = yaml.safe_load(text)
    assert figures['travel_factor'] == 1.012
    assert figures['turn_per_metre_deg'] == 0.5
    assert '1.0120  # ± 0.0040' in text
    assert 'of monday' in text


def test_unknown_values_are_left_out_with_a_comment() -> None:
    text = calibration_text({'bias': CALIBRATION['bias']}, 'two\nlines')
    assert list(yaml.safe_load(text)) == ['turn_per_metre_deg']
    assert '# travel_factor: not known; this drive does not determine it' in text
    assert calibration_text({}, 'monday') == ''


@pytest.mark.parametrize(
    ('text', 'reason'),
    [
        ('', 'contains no calibration'),
        ('- 1.0', 'contains no calibration'),
        ('travel_factor: [', 'is not valid YAML'),
        ('travel: 1.0', "'travel' is not one of travel_factor"),
        ('travel_factor: fast', "'fast', not a finite number"),
        ('travel_factor: true', 'not a finite number'),
        ('travel_factor: .nan', 'not a finite number'),
        ('travel_factor: -.inf', 'not a finite number'),
        (f'travel_factor: 1{400 * "0"}', 'not a finite number'),
        ('travel_factor: 0.3', 'which is not possible for a calibration of wheels'),
        ('turn_per_metre_deg: 90', 'which is not possible for a calibration of wheels'),
    ],
)
def test_bad_calibration_file_is_rejected_with_reason(tmp_path: Path, text: str, reason: str) -> None:
    file = tmp_path / 'calibration.yaml'
    file.write_text(text)
    with pytest.raises(ParameterError, match='calibration') as caught:
        load_calibration(file)
    assert reason in str(caught.value)
    with pytest.raises(ParameterError, match='absent'):
        load_calibration(tmp_path / 'absent.yaml')
