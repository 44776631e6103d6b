"""A trajectory as text: poses in the TUM format, and what was found out about the odometry in the words of an owner."""

from __future__ import annotations

import math
from collections.abc import Mapping
from typing import Any

from ..core.trajectory.certainty import Estimate
from ..core.trajectory.odometry_model import CALIBRATION
from ..core.trajectory.outcome import Refinement
from ..core.trajectory.windows import Odometry

LEAST_SCALE, LEAST_ANGLE = 0.003, math.radians(0.1)
"""Parts, and radians or radians a metre, from which on a figure of the calibration is worth a word."""


def tum_text(trajectory: Odometry) -> str:
    """Return a line for each pose, `stamp x y z qx qy qz qw` in seconds and metres, as evo reads them."""
    lines = []
    for stamp, (x, y, yaw) in zip(trajectory.stamp.tolist(), trajectory.pose.tolist(), strict=True):
        # a stamp before 0 counts backwards
        sign, (seconds, rest) = '-' if stamp < 0 else '', divmod(abs(stamp), 10**9)
        lines.append(
            f'{sign}{seconds}.{rest:09d} {x:.6f} {y:.6f} 0 0 0 {math.sin(yaw / 2):.9f} {math.cos(yaw / 2):.9f}'
        )
    return '\n'.join(lines) + '\n'


def trajectory_files(outcome: Refinement, odometry: Odometry, number: int | None = None) -> dict[str, str]:
    """Return the texts of trajectory and odometry by the names of their files; none where odometry stays.

    Parameters
    ----------
    outcome : Refinement
    odometry : Odometry
    number : int, optional
        Of the drive, from 1 on, where there are several.
    """
    if not outcome.accepted:
        return {}
    paths = {'trajectory': outcome.trajectory, 'odometry': odometry}
    return {_tum_name(kind, number): tum_text(path) for kind, path in paths.items()}


def _tum_name(kind: str, number: int | None) -> str:
    return f'{kind}.tum' if number is None else f'{kind}_{number}.tum'


def trajectory_data(
    outcome: Refinement, number: int | None = None, fitted: str = '', told: Mapping[str, Estimate] | None = None
) -> dict[str, Any]:
    """Return what became of the trajectory, for the report: metres, degrees, nats, parts and radians.

    `number` is as in `trajectory_files`; `fitted` says how it was moved to fit other drives, `told` what the drive
    tells of its odometry with certainty, if that was asked.
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
    if told is not None and outcome.accepted:
        data['told'] = {name: {'value': value, 'sigma': sigma} for name, (value, sigma) in told.items()}
        data['odometry'] = told_words(told)
    return data


def told_words(told: Mapping[str, Estimate]) -> str:
    """Return what the wheels do as far as the drive tells it, each figure with its standard deviation."""
    words = []
    for name, (value, sigma) in told.items():
        said = calibration_words({name: value}) if abs(value) > sigma else ''
        if not said:
            said = f'{_EXACT[name]} within the accuracy'
        error = math.degrees(sigma) if name in ('bias', 'heading') else 100 * sigma
        words.append(f'{said} (± {error:.1f}{"°" if name in ("bias", "heading") else " %"})')
    if unknown := [_ASKED[name] for name in CALIBRATION if name not in told]:
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
    """Return what the wheels do, for the robot's owner; empty if they do nothing worth a word."""
    words = []
    # the calibration makes right what is measured, so the measurement errs the other way
    scale, turn_scale = -calibration.get('scale', 0.0), -calibration.get('turn_scale', 0.0)
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
