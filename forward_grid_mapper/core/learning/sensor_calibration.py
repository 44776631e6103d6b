"""Calibration of all sensors together: time offset of their stamps, common pose on the robot, and scale of ranges.

Only the right value makes readings from different places, in different directions and at different speeds agree with
one map. So a small map is made for each of a few values, and the value of the largest objective J is looked for. Near
it, J is a parabola. Its vertex is the estimate θ, and the standard error follows from its curvature A = −∂²J/∂θ² and
the variance B of the score over blocks of successive readings: √B / A (sandwich estimator, as in `standard_errors`);
that of a maximum on a grid of cells is added.

A value is wrong if the gain of the right one, summed over the blocks, is `SIGMAS` standard errors or more. J alone
cannot tell: odometry that drifts looks a little like a time offset in each turn, but not equally in all turns.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import replace
from typing import NamedTuple

import numpy as np

from ..common.parameters import Parameters
from ..common.readings import Floats, Readings
from .trial_maps import BLOCKS, MountedReadings, TrialMap, coarse_parameters, trial_map

MOST_READINGS = 4000
"""Most readings of the maps from which a value is estimated."""

LEAST_GAIN, SIGMAS = 30.0, 3.0
"""Least gain of J, nats, and least gain over the blocks, standard errors, for a value to be reported as wrong."""

AS_GOOD_SHARE = 0.8
"""Part of the gain of the best quantity from which another may be the cause as well."""

GRID_ERROR_STEPS = 0.25
"""Standard error of the maximum on a map of cells, in steps."""

MOST_STEPS = 12
"""Most steps from the first guess."""


class Quantity(NamedTuple):
    """What is calibrated.

    Attributes
    ----------
    guesses : tuple of float
        Values that are tried first; the search climbs from the best one.
    step : float
        Distance between the values at which J is evaluated near its maximum.
    corrected : callable
        Returns the readings, if a value is right.
    """

    guesses: tuple[float, ...]
    step: float
    corrected: Callable[[MountedReadings, float], Readings]


TIME = Quantity((-0.75, -0.4, -0.15, 0.15, 0.4, 0.75), 0.05, MountedReadings.shifted)
"""Seconds from the stamps of readings to their measurements."""

YAW = Quantity(
    tuple(math.radians(angle) for angle in (-50, -25, -8, 8, 25, 50)), math.radians(2.5), MountedReadings.rotated
)
"""Rotation of all sensors about the origin of the robot's frame, radians, counter-clockwise."""

FORWARD = Quantity((-0.15, 0.15), 0.05, lambda drive, value: drive.moved(forward=value))
LEFT = Quantity((-0.15, 0.15), 0.05, lambda drive, value: drive.moved(left=value))
"""Translation of all sensors on the robot, metres."""

SCALE = Quantity((-0.12, -0.05, 0.05, 0.12), 0.02, lambda drive, value: drive.scaled(1.0 + value))
"""By which part of itself a distance driven is longer than odometry says, so that ranges are too long for it."""

QUANTITIES = (TIME, YAW, FORWARD, LEFT, SCALE)


class OffsetEstimate(NamedTuple):
    """A value that explains the readings better than zero.

    Attributes
    ----------
    quantity : Quantity
    value, error : float
        With its standard error.
    gain : float
        By which J is larger than at zero, nats.
    sigmas : float
        The gain over the blocks, in its standard errors.
    readings : int
        Number of readings of the maps.
    best : TrialMap
        Of the nearest value that was tried.
    """

    quantity: Quantity
    value: float
    error: float
    gain: float
    sigmas: float
    readings: int
    best: TrialMap

    def gained_by(self, best: TrialMap, given: TrialMap) -> OffsetEstimate:
        """Return the estimate with the gain of one map, made with its value, over another, made without."""
        gain = best.objective - given.objective
        return self._replace(best=best, gain=gain, sigmas=sigmas(best.blocks - given.blocks))

    @property
    def significant(self) -> bool:
        """Whether zero is wrong."""
        return self.gain >= LEAST_GAIN and self.sigmas >= SIGMAS and abs(self.value) >= SIGMAS * self.error


def offset_estimates(
    drive: MountedReadings, suspects: dict[Quantity, float], parameters: Parameters
) -> list[OffsetEstimate]:
    """Return the significant estimates, that of the largest J first.

    Parameters
    ----------
    drive : MountedReadings
    suspects : dict
        First guesses of the quantities that may be wrong.
    parameters : Parameters
    """
    part = drive.moving_part(MOST_READINGS)
    p = coarse_parameters(parameters, part.readings)
    given = trial_map(part.readings, p)
    found = [_estimate(part, quantity, guess, given, p) for quantity, guess in suspects.items()]
    wrong = [each for each in found if each and each.significant]
    if wrong:
        # a wall on the border of two cells gains as much if the cells are moved, which tells nothing about sensors
        without = _on_best_cells(part.readings, given, p)
        for k, each in enumerate(wrong):
            with_value = _on_best_cells(each.quantity.corrected(part, each.value), each.best, p)
            wrong[k] = each.gained_by(with_value, without)
    return sorted((each for each in wrong if each.significant), key=lambda each: -each.gain)


def hardly_distinguishable(best: OffsetEstimate, other: OffsetEstimate) -> bool:
    """Return whether the drive hardly tells which of two quantities is wrong: at constant speed, late is behind."""
    return other.gain >= AS_GOOD_SHARE * best.gain or sigmas(best.best.blocks - other.best.blocks) < SIGMAS - 1


def _estimate(
    part: MountedReadings, quantity: Quantity, guess: float, given: TrialMap, parameters: Parameters
) -> OffsetEstimate | None:
    """Climb from a guess to the maximum of J; None if there is none nearby."""
    step, tried = quantity.step, {0: given}

    def at(k: int) -> TrialMap:
        if k not in tried:
            tried[k] = trial_map(quantity.corrected(part, k * step), parameters)
        return tried[k]

    best = round(guess / step)
    for _ in range(MOST_STEPS):
        top = max((best, best - 1, best + 1), key=lambda k: at(k).objective)
        if top == best:
            break
        best = top
    else:
        return None
    near = (-2, -1, 0, 1, 2)
    a, b, _ = np.polyfit(near, [at(best + k).objective for k in near], 2)
    if not (math.isfinite(a) and a < 0.0):
        return None
    offset = min(max(-b / (2 * a), -1.0), 1.0)
    scores = (at(best + 1).blocks - at(best - 1).blocks) / 2
    error = math.sqrt(BLOCKS * float(np.var(scores, ddof=1))) / (-2 * a)
    found = at(best)
    return OffsetEstimate(
        quantity,
        (best + offset) * step,
        math.hypot(error, GRID_ERROR_STEPS) * step,
        found.objective - given.objective,
        sigmas(found.blocks - given.blocks),
        len(part),
        found,
    )


def _on_best_cells(readings: Readings, known: TrialMap, parameters: Parameters) -> TrialMap:
    """Return the best map of the same readings: a known one, or one on cells that are moved by half of a cell."""
    half = parameters.grid.resolution / 2
    moved = (replace(readings, x=readings.x - x, y=readings.y - y) for x, y in ((half, 0.0), (0.0, half), (half, half)))
    return max((known, *(trial_map(each, parameters) for each in moved)), key=lambda each: each.objective)


def sigmas(gains: Floats) -> float:
    """Return the sum of gains of blocks in its standard errors."""
    error = math.sqrt(len(gains) * float(np.var(gains, ddof=1)))
    return float(gains.sum()) / error if error else 0.0
