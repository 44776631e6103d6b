"""A trajectory as text: poses in the TUM format, and the errors of odometry in everyday words."""

from __future__ import annotations

import math
from collections.abc import Mapping
from typing import Any

from ..core.trajectory.certainty import CalibrationEstimate
from ..core.trajectory.odometry_model import CALIBRATION
from ..core.trajectory.outcome import Refinement
from ..core.trajectory.windows import Odometry

LEAST_SCALE, LEAST_ANGLE = 0.003, math.radians(0.1)
"""Smallest values of the calibration that are mentioned: fractions, and radians or radians a metre."""

CLEAR = 2.0
"""An error of odometry is stated from so many standard deviations on."""


def tum_text(trajectory: Odometry) -> str:
    """Return a line for each pose, `stamp x y z qx qy qz qw` in seconds and metres, the format that evo reads."""
    lines = []
    for stamp, (x, y, yaw) in zip(trajectory.stamp.tolist(), trajectory.pose.tolist(), strict=True):
        # for a stamp before 0 the sign comes first
        sign, (seconds, rest) = '-' if stamp < 0 else '', divmod(abs(stamp), 10**9)
        lines.append(
            f'{sign}{seconds}.{rest:09d} {x:.6f} {y:.6f} 0 0 0 {math.sin(yaw / 2):.9f} {math.cos(yaw / 2):.9f}'
        )
    return '\n'.join(lines) + '\n'


def trajectory_files(outcome: Refinement, odometry: Odometry, number: int | None = None) -> dict[str, str]:
    """Return the texts of trajectory and odometry by file name; empty if odometry is used as the trajectory.

    Parameters
    ----------
    outcome : Refinement
    odometry : Odometry
    number : int, optional
        Number of the drive, from 1 on, if there are several.
    """
    if not outcome.accepted:
        return {}
    paths = {'trajectory': outcome.trajectory, 'odometry': odometry}
    return {_tum_name(kind, number): tum_text(path) for kind, path in paths.items()}


def _tum_name(kind: str, number: int | None) -> str:
    return f'{kind}.tum' if number is None else f'{kind}_{number}.tum'


def trajectory_data(
    outcome: Refinement,
    number: int | None = None,
    fitted: str = '',
    estimates: Mapping[str, CalibrationEstimate] | None = None,
) -> dict[str, Any]:
    """Return the trajectory's data for the report: metres, degrees, nats, fractions and radians.

    `number` is as in `trajectory_files`; `fitted` describes how it was moved to fit other drives, `estimates` are the
    values of the calibration that the drive determines, if they were computed.
    """
    data: dict[str, Any] = {
        'refined': outcome.accepted,
        'file': _tum_name('trajectory', number) if outcome.accepted else '',
        'reason': outcome.reason,
        'fitted': fitted,
        'odometry_off_m': outcome.moved,
        'odometry_off_deg': math.degrees(outcome.turned),
        'places_recognised': outcome.loops,
        'gain_a_reading': outcome.gain,
        'calibration': dict(outcome.calibration),
        'odometry': calibration_words(outcome.calibration) if outcome.accepted else '',
    }
    if estimates is not None and outcome.accepted:
        data['calibration_estimates'] = {
            name: {'value': value, 'sigma': sigma} for name, (value, sigma) in estimates.items()
        }
        data['odometry'] = estimate_words(estimates)
    return data


def estimate_words(estimates: Mapping[str, CalibrationEstimate]) -> str:
    """Return the errors of odometry that the drive determines, each with its standard deviation, in words."""
    words = []
    for name, (value, sigma) in estimates.items():
        said = calibration_words({name: value}) if abs(value) > CLEAR * sigma else ''
        if not said:
            said = f'{_EXACT[name]} within the accuracy'
        error = math.degrees(sigma) if name in ('bias', 'heading') else 100 * sigma / (1 + value) ** 2
        words.append(f'{said} (± {error:.1f}{"°" if name in ("bias", "heading") else " %"})')
    if unknown := [_ASKED[name] for name in CALIBRATION if name not in estimates]:
        if len(unknown) == len(CALIBRATION):
            return 'the drive does not determine the errors of the wheels'
        words.append(f'the drive does not show {" or ".join(unknown)}')
    return '; '.join(words)


_EXACT = {
    'scale': 'distances are measured correctly',
    'heading': 'the robot drives along its heading',
    'bias': 'straight driving is measured correctly',
    'turn_scale': 'turns are measured correctly',
}
_ASKED = {
    'scale': 'whether distances are measured too long',
    'heading': 'whether the robot drives along its heading',
    'bias': 'whether going straight is measured as turning',
    'turn_scale': 'whether turns are measured too large',
}


def calibration_words(calibration: Mapping[str, float]) -> str:
    """Return the errors of odometry in words for the robot's owner; '' if they are too small."""
    words = []
    # the calibration corrects the measurement, so the measurement has the inverse factor, or the opposite error
    scale, turn_scale = (1 / (1 + calibration.get(name, 0.0)) - 1 for name in ('scale', 'turn_scale'))
    bias, heading = -calibration.get('bias', 0.0), calibration.get('heading', 0.0)
    if abs(scale) >= LEAST_SCALE:
        words.append(f'distances are measured {abs(scale):.1%} too {"long" if scale > 0 else "short"}')
    if abs(bias) >= LEAST_ANGLE:
        side = 'left' if bias > 0 else 'right'
        words.append(f'going straight is measured as turning {math.degrees(abs(bias)):.1f}° a metre to the {side}')
    if abs(turn_scale) >= LEAST_SCALE:
        words.append(f'turns are measured {abs(turn_scale):.1%} too {"large" if turn_scale > 0 else "small"}')
    if abs(heading) >= LEAST_ANGLE:
        side = 'left' if heading > 0 else 'right'
        words.append(f'the robot drives {math.degrees(abs(heading)):.1f}° to the {side} of its heading')
    return '; '.join(words).replace('%', ' %')
