"""Errors of real wheel odometry: systematic ones, and noise, in recordings that have corrected odometry as well.

    python benchmarks/wheel_noise.py --shared ../shared/data

For stretches of several lengths, prints the systematic errors (least squares) and the noise that remains, along the
robot, across it, and of its yaw. The variance of the noise is a sum of a part for each metre of travel and one for each
radian of turning (least squares without negative parts), so each noise has two standard deviations: a √metre, and a
√radian. Stretches have the same progress; a radian of turning counts as a third of a metre. Short drives do not tell
the two parts apart well, and the errors of the corrected odometry count as noise.
"""

from __future__ import annotations

import argparse
import math
from pathlib import Path

import numpy as np
from scipy.optimize import nnls

from forward_grid_mapper.core.common.parameters import Parameters
from forward_grid_mapper.core.trajectory.poses import relative, wrapped
from forward_grid_mapper.core.trajectory.windows import Odometry
from forward_grid_mapper.recordings.read_drive import read_drive

RECORDINGS = ('building_a', 'building_b', 'building_c')

STRETCHES = (1.0, 2.0, 4.0)
"""Metres of progress of a stretch."""

AXES = ('along', 'm'), ('across', 'm'), ('yaw', '°')
"""The components of a motion, and their units."""


def sums(values: np.ndarray, progress: np.ndarray, ends: np.ndarray) -> np.ndarray:
    """Return the sum of the values of each motion over each stretch."""
    return np.diff(np.interp(ends, progress, np.concatenate([[0.0], np.cumsum(values)])))


def noise_of(residual: np.ndarray, travel: np.ndarray, turned: np.ndarray) -> np.ndarray:
    """Return the standard deviations of residuals, a √metre of travel and a √radian of turning, shape (2,)."""
    parts, _ = nnls(np.stack([travel, turned], axis=1), residual**2)
    out: np.ndarray = np.sqrt(parts)
    return out


def main() -> None:
    """Read the recordings and print their errors."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument('--shared', type=Path, required=True, help='folder of the recordings')
    folder = parser.parse_args().shared
    present = [name for name in RECORDINGS if (folder / name / 'bag').exists()]
    if not present:
        parser.error(f'none of {", ".join(RECORDINGS)} is in {folder}')
    for name in present:
        measured, true = (
            Odometry.of(*read_drive(folder / name / 'bag', Parameters(), {}, None, topic).associator.odometry)
            for topic in ('/odom', '/odom_corrected')
        )
        exact = relative(true.pose[:-1], true.pose[1:])
        at = measured.at(true.stamp)
        error = relative(at[:-1], at[1:]) - exact
        in_units = np.column_stack([error[:, :2], np.degrees(wrapped(error[:, 2]))])
        travel, turned = np.hypot(exact[:, 0], exact[:, 1]), np.abs(exact[:, 2])
        progress = np.concatenate([[0.0], np.cumsum(travel + turned / 3.0)])
        print(f'{name}: {travel.sum():.0f} m, {math.degrees(turned.sum()):.0f}° turned')
        for length in STRETCHES:
            ends = np.arange(0.0, progress[-1], length)
            ahead, turn, of_travel, of_turns = (
                sums(values, progress, ends) for values in (exact[:, 0], exact[:, 2], travel, turned)
            )
            regressors = np.stack([ahead, turn], axis=1)
            words = []
            for (axis, unit), errors in zip(AXES, in_units.T, strict=True):
                summed = sums(errors, progress, ends)
                fit = np.linalg.lstsq(regressors, summed, rcond=None)[0]
                straight, turning = noise_of(summed - regressors @ fit, of_travel, of_turns)
                words.append(
                    f'{axis} {fit[0]:+.3f} {unit}/m {fit[1]:+.3f} {unit}/rad, noise {straight:.3f} {unit}/√m '
                    f'{turning:.3f} {unit}/√rad'
                )
            print(f'  {length:g} m: ' + '; '.join(words))


if __name__ == '__main__':
    main()
