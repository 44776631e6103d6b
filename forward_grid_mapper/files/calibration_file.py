"""A file with the calibration of wheel odometry: values, standard deviations, and how to apply them by hand."""

from __future__ import annotations

import math
from collections.abc import Mapping
from pathlib import Path

import yaml

from ..core.common.errors import ParameterError
from ..core.common.parameter import LARGEST_NUMBER
from ..core.trajectory.certainty import CalibrationEstimate
from .small_text import read_text

FILE_KEYS = {
    'scale': 'travel_factor',
    'turn_scale': 'turn_factor',
    'bias': 'turn_per_metre_deg',
    'heading': 'direction_deg',
}
"""Keys of the file for the values of the core's calibration."""

LARGEST_VALUES = {'scale': 0.5, 'turn_scale': 0.5, 'bias': math.radians(30.0), 'heading': math.radians(45.0)}
"""Largest values of a file, positive or negative: larger ones would mean that the file is for another robot."""

HOW_TO_APPLY = {
    'scale': 'factor for every measured distance, or for the radius of both wheels',
    'turn_scale': 'factor for every measured turn, or divisor of the wheel separation',
    'bias': 'degrees to add to the yaw for each metre driven forwards (to the left is positive); if the robot has two '
    'wheels b metres apart, the right wheel is larger than the left one by a fraction of 0.0175 * b * this value',
    'heading': 'direction of travel, in degrees to the left of the heading; the odometry frame, or the mounting of '
    'the sensors, is rotated by this angle',
}


def calibration_text(estimates: Mapping[str, CalibrationEstimate], drive: str) -> str:
    """Return the file of a calibration, with the names of `core.trajectory.odometry_model`; '' without values."""
    if not estimates:
        return ''
    lines = [
        f'# Calibration of the wheel odometry of {_plain(drive)}, estimated from its sonar readings.',
        '# Each value has its standard deviation. The values are for this drive: measure a straight line and a full',
        '# turn before you change a wheel. process_bag applies them to other drives of this robot with',
        '# --odometry-calibration.',
    ]
    for name, key in FILE_KEYS.items():
        lines.append('')
        if name not in estimates:
            lines.append(f'# {key}: not known; this drive does not determine it')
            continue
        value, sigma = _shown(name, *estimates[name])
        lines += [f'# {HOW_TO_APPLY[name]}', f'{key}: {value:.4f}  # ± {sigma:.4f}']
    return '\n'.join(lines) + '\n'


def load_calibration(path: Path | str) -> dict[str, float]:
    """Return the calibration of a file, with the names of `core.trajectory.odometry_model`.

    Raises
    ------
    ParameterError
        Naming the file, if it cannot be read, or contains anything else.
    """
    path = Path(path)
    try:
        document = yaml.safe_load(read_text(path, ParameterError))
    except OSError as error:
        raise ParameterError(f'{path} cannot be read: {error.strerror}') from error
    except (yaml.YAMLError, RecursionError, ValueError) as error:
        raise ParameterError(f'{path} is not valid YAML: {error}') from error
    if not isinstance(document, dict) or not document:
        raise ParameterError(f'{path} contains no calibration, such as "travel_factor: 1.012"')
    names = {key: name for name, key in FILE_KEYS.items()}
    found = {}
    for key, value in document.items():
        if key not in names:
            raise ParameterError(f'{path}: {key!r} is not one of {", ".join(names)}')
        name = names[key]
        # an integer may be too large for a float; NaN fails the comparison
        if isinstance(value, bool) or not isinstance(value, (int, float)) or not abs(value) < LARGEST_NUMBER:
            raise ParameterError(f'{path}: {key} is {value!r}, not a finite number')
        figure = value - 1.0 if key.endswith('factor') else math.radians(value)
        if abs(figure) > LARGEST_VALUES[name]:
            raise ParameterError(f'{path}: {key} is {value:g}, which is not possible for a calibration of wheels')
        found[name] = figure
    return found


def _shown(name: str, value: float, sigma: float) -> tuple[float, float]:
    """Return a value, and its σ, in the units of the file."""
    if FILE_KEYS[name].endswith('factor'):
        return 1.0 + value, sigma
    return math.degrees(value), math.degrees(sigma)


def _plain(text: str) -> str:
    """Return a name without characters that would end a comment."""
    return text if text.isprintable() else text.encode('unicode_escape').decode()
