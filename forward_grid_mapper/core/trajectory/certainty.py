"""The calibration of the odometry from a drive, with standard deviations.

Walls measure the yaw all along a trajectory. So the errors of the yaw of odometry follow from a linear regression over
pieces of the drive, and their standard deviations from its residuals:

    Δyaw of the trajectory − Δyaw of odometry  =  bias · ahead + turn_scale · Δyaw of odometry + noise

The noise is that of the odometry, so it is part of the turn on the right, and least squares would find turns of
odometry too large (errors in variables). The turn of the trajectory has hardly any of it, and is the instrument: the
residuals are uncorrelated with `ahead` and with it.

Scale and heading cannot be found by regression: where readings do not tell the distance, as along a bare corridor, the
trajectory follows the odometry and would agree with it. They are found from the likelihood of readings: f(c) is the
mean log-likelihood ratio of a block of readings on the map of what lies around it, if all motions have the calibration
c. From the slopes g_b and curvatures h_b of blocks b at c,

    top − c  =  −Σ g_b / Σ h_b        σ²  =  Σ (g_b + h_b (top − c))² / (Σ h_b)²

Loop closures do not give the scale, since a map that is larger everywhere closes as well.
"""

from __future__ import annotations

import math
from collections.abc import Mapping
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from ..common.parameters import Parameters
from ..common.readings import Floats, Readings
from .holding_out import blocks_of, held_out, predicted
from .local_map import for_matching
from .odometry_model import CALIBRATION, calibrated, with_yaw
from .poses import wrapped
from .scans import Scans
from .windows import Odometry, cut

PIECE = 2.0
"""Metres of progress of each piece in the regression."""

FEWEST_PIECES = 8

STEPS = {'scale': 0.02, 'heading': math.radians(1.0)}
"""Steps of the finite differences: fraction, and radians."""

MOST_BLOCKS, LENGTH, SPAN = 40, 3, 5.0
"""Most blocks, windows of each, and metres of progress before and after a block within which windows make its map."""

DENSITY = 80.0
"""Readings a metre to which drives are thinned, to save time."""

FEWEST_BLOCKS = 8

FARTHEST_TOP = 2.0
"""Largest distance of the top of the parabola from the middle, steps."""

LEAST_SIGMA = {'scale': 0.01, 'heading': math.radians(0.3), 'bias': math.radians(0.05), 'turn_scale': 0.003}
"""Added to σ in quadrature; along true poses, readings are likeliest at a scale that is off by about so much."""

LARGEST_SIGMA = {'scale': 0.015, 'heading': math.radians(0.6), 'bias': math.radians(0.5), 'turn_scale': 0.015}
"""Values with a larger σ are not determined by the drive, and are left out."""


YAW_ERRORS = ('bias', 'turn_scale')
"""The values that `yaw_errors` returns."""


class CalibrationEstimate(NamedTuple):
    """A value of the calibration, and its standard deviation."""

    value: float
    sigma: float


def determined_calibration(
    readings: Readings,
    odometry: Odometry,
    trajectory: Odometry,
    calibration: dict[str, float],
    parameters: Parameters,
    stop: NDArray[np.uint8],
) -> dict[str, CalibrationEstimate]:
    """Return those values of the calibration that a drive determines, by the names of `CALIBRATION`.

    Parameters
    ----------
    readings : Readings
        Placed by odometry.
    odometry, trajectory : Odometry
        Poses at the same stamps.
    calibration : dict
        The values that were estimated together with the trajectory.
    parameters : Parameters
    stop : uint8, shape (1,)
        Not 0 to end the work.

    Raises
    ------
    Cancelled
        If `stop` was set.
    """
    found = yaw_errors(odometry, trajectory)
    found |= translation_errors(readings, odometry, trajectory, calibration, parameters, stop)
    stated = {
        name: CalibrationEstimate(value, math.hypot(sigma, LEAST_SIGMA[name])) for name, (value, sigma) in found.items()
    }
    return {name: stated[name] for name in CALIBRATION if name in stated and stated[name].sigma <= LARGEST_SIGMA[name]}


def combined_calibration(
    first: Mapping[str, float], estimates: Mapping[str, CalibrationEstimate]
) -> dict[str, CalibrationEstimate]:
    """Return the calibration of raw odometry, if `estimates` are for odometry to which `first` was applied."""
    one = {name: first.get(name, 0.0) for name in CALIBRATION}
    found = {}
    for name, (value, sigma) in estimates.items():
        if name == 'heading':
            both = one[name] + value
        elif name == 'bias':
            turns = estimates['turn_scale'].value if 'turn_scale' in estimates else 0.0
            both = (1 + turns) * one[name] + value * (1 + one['scale'])
        else:
            both = (1 + one[name]) * (1 + value) - 1
        found[name] = CalibrationEstimate(both, sigma)
    return found


def yaw_errors(odometry: Odometry, trajectory: Odometry) -> dict[str, CalibrationEstimate]:
    """Return `bias` and `turn_scale` by regression of the yaw of a trajectory; empty if the drive is too short."""
    ends = np.arange(0.0, odometry.progress[-1], PIECE)
    if len(ends) <= FEWEST_PIECES:
        return {}
    knots = odometry.progress
    pose = odometry.pose
    middle = pose[:-1, 2] + np.diff(pose[:, 2]) / 2
    steps = np.diff(pose[:, :2], axis=0)
    ahead = np.concatenate([[0.0], np.cumsum(np.cos(middle) * steps[:, 0] + np.sin(middle) * steps[:, 1])])
    columns = [np.diff(np.interp(ends, knots, column)) for column in (ahead, pose[:, 2])]
    difference = np.diff(np.interp(ends, knots, np.unwrap(wrapped(trajectory.pose[:, 2] - pose[:, 2]))))
    regressors = np.stack(columns, axis=1)
    instruments = np.stack([columns[0], columns[1] + difference], axis=1)
    product = instruments.T @ regressors
    if np.linalg.matrix_rank(product) < 2:
        return {}
    inverse = np.linalg.inv(product)
    values = inverse @ (instruments.T @ difference)
    residual = difference - regressors @ values
    # standard errors robust to heteroscedasticity, since wheels slip now and then
    spread = instruments * (residual * math.sqrt(len(residual) / (len(residual) - 2)))[:, None]
    sigma = np.sqrt(np.diag(inverse @ (spread.T @ spread) @ inverse.T))
    return {name: CalibrationEstimate(float(v), float(s)) for name, v, s in zip(YAW_ERRORS, values, sigma, strict=True)}


def translation_errors(
    readings: Readings,
    odometry: Odometry,
    trajectory: Odometry,
    calibration: dict[str, float],
    parameters: Parameters,
    stop: NDArray[np.uint8],
) -> dict[str, CalibrationEstimate]:
    """Return `scale` and `heading` from the likelihood of readings; what they do not determine is left out."""
    parameters = for_matching(parameters)
    every = max(int(len(readings) / max(DENSITY * odometry.travel[-1], 1.0)), 1)
    windows = cut(thinned(readings, every), odometry)
    scans = Scans(windows, parameters, stop, np.zeros_like(held_out(len(windows))))
    turned = with_yaw(odometry, odometry.progress, np.unwrap(wrapped(trajectory.pose[:, 2] - odometry.pose[:, 2])))
    blocks = blocks_of(len(windows), LENGTH, MOST_BLOCKS)

    def value_at(trial: dict[str, float]) -> Floats:
        translation = np.array([trial['scale'], trial['heading'], 0.0, 0.0])
        return predicted(scans, calibrated(turned, translation).at(windows.node_stamp), blocks, SPAN)

    start = {name: calibration.get(name, 0.0) for name in STEPS}
    middle = value_at(start)
    found = {}
    for name, step in STEPS.items():
        low, high = (value_at({**start, name: start[name] + sign * step}) for sign in (-1, 1))
        estimate = parabola_top(low, middle, high)
        if estimate is not None:
            found[name] = CalibrationEstimate(start[name] + step * estimate.value, step * estimate.sigma)
    return found


def thinned(readings: Readings, every: int) -> Readings:
    """Return every n-th reading of each sensor, with another offset for each sensor."""
    readings = readings.select(np.argsort(readings.stamp, kind='stable'))
    stay = np.zeros(len(readings), np.bool_)
    for number in np.unique(readings.sensor):
        mine = np.flatnonzero(readings.sensor == number)
        stay[mine[number % every :: every]] = True
    return readings.select(stay)


def parabola_top(low: Floats, middle: Floats, high: Floats) -> CalibrationEstimate | None:
    """Return the top of the parabola through the sums of blocks' values, in steps from the middle.

    None if there is no maximum, or if it is farther than `FARTHEST_TOP`.

    Parameters
    ----------
    low, middle, high : float64, shape (B,)
        Value of each block one step below the middle, at it, and one step above it; NaN if unknown.
    """
    known = np.isfinite(low) & np.isfinite(middle) & np.isfinite(high)
    if known.sum() < FEWEST_BLOCKS:
        return None
    slope = (high[known] - low[known]) / 2
    curvature = high[known] - 2 * middle[known] + low[known]
    total = float(curvature.sum())
    if total >= 0.0:
        return None
    top = -float(slope.sum()) / total
    if abs(top) > FARTHEST_TOP:
        return None
    off = slope + curvature * top
    return CalibrationEstimate(top, float(np.sqrt((off**2).sum())) / -total)
