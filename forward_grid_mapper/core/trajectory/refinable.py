"""Which drives are refined: in others, too little shows whether a trajectory is better than odometry."""

from __future__ import annotations

import math

import numpy as np

from ..common.readings import Readings
from ..common.words import counted
from .windows import Odometry

SHORTEST = 8.0
"""Shortest drive that is refined, metres: shorter ones drift little, and have few readings for the judgement."""

FEWEST_READINGS = 200

LEAST_ECHOES = 0.05
"""Fraction of the readings that must have an echo."""

ONE_WAY = 0.97
"""Mean resultant length of the directions on the robot in which a single sensor looks, if it hardly turns."""


def without_times(readings: Readings, odometry: Odometry) -> str:
    """Return why the odometry does not cover all readings; empty if it does."""
    if not len(odometry.stamp):
        return "there are no poses of odometry, as in a journal or after a jump of odometry's clock"
    early, late = readings.stamp.min(initial=odometry.stamp[0]), readings.stamp.max(initial=odometry.stamp[-1])
    if early < odometry.stamp[0] or late > odometry.stamp[-1]:
        return "there are readings at times without odometry, as after a jump of odometry's clock"
    return ''


def unfit(readings: Readings, odometry: Odometry) -> str:
    """Return why a drive cannot be refined; empty if it can."""
    if reason := without_times(readings, odometry):
        return reason
    if len(odometry.stamp) < 2 or odometry.travel[-1] < SHORTEST:
        # rounded down, so that it does not look long enough
        length = math.floor(10 * odometry.travel[-1]) / 10
        return f'the drive is {length:.1f} m long; the drift of odometry can be measured from {SHORTEST:g} m on'
    if len(readings) < FEWEST_READINGS:
        return f'the drive has {counted(len(readings), "reading")}; at least {FEWEST_READINGS} are needed'
    if readings.echo.mean() < LEAST_ECHOES:
        return f'only {readings.echo.mean():.0%} of the readings have an echo'
    directions = np.exp(1j * (readings.yaw - odometry.at(readings.stamp)[:, 2]))
    if len(np.unique(readings.sensor)) == 1 and abs(directions.mean()) > ONE_WAY:
        return (
            'there is only one sensor, which is fixed to the robot and cannot distinguish a rotation from a sideways '
            'translation'
        )
    return ''
