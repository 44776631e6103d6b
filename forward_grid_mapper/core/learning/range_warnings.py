"""Warnings about values of Range messages that give a wrong map without any error: ranges, limits, cones, variances.

They are a part of `input_warnings`, and use the readings alone.
"""

from __future__ import annotations

import math
from collections.abc import Iterable

import numpy as np
from numpy.typing import NDArray

from ..common.readings import Floats, Readings

LEAST_READINGS = 30
"""Fewest readings of a sensor that is checked."""

STANDSTILL_STEP = 0.01, 0.01
"""Metres and radians: a robot that moves by less stands still."""

LEAST_DRIVEN = 1.0
"""Metres that sensors must have moved before their range limit is checked: from one place all walls may be near or
far."""

LEAST_OF_PART = 5
"""Fewest readings in a block of time, or in a twelfth of the circle, that counts."""

NARROWEST, WIDEST = math.radians(3.0), math.radians(90.0)
"""No sonar has a smaller or larger field of view than these."""

REACHED_SHARE = 0.6
"""max_range is too large if all echoes are within this fraction of it."""

LEAST_NO_ECHO = 0.05
"""At least this fraction of the readings must have no echo: in a small closed room all echoes are near, but all
readings have one."""

LEAST_ECHOES = 200
"""Fewest echoes for checks of the range limit."""

SENTINEL_SHARE, BEYOND_SHARE, OF_SENTINEL = 0.05, 0.005, 0.05
"""A sentinel is a certain range that a driver sends for 'no echo'. At least the first fraction of the echoes has this
range, and at most the second fraction is longer (or shorter, if it is the shortest), or the third fraction of those at
the sentinel: the more readings are without an echo, the more random ones there are beyond it."""

MOST_NO_ECHO = 0.01
"""With a sentinel, at most this fraction of the readings of a sensor has no echo."""

VALUE_TOLERANCE = 0.0005
"""Metres within which two ranges are the same value of the driver."""

FEWEST_WITH_SENTINEL, MOST_AT_SENTINEL = 2, 0.7
"""Fewest sensors with a sentinel if other sensors have none, and the largest part of their readings that are at it."""

GAP_BELOW, LEAST_DIRECTIONS = 0.05, 3
"""Within this many metres below a sentinel there are few echoes, unlike for a wall; and it is sent in at least this
many twelfths of the circle."""

GAP_ABOVE = 0.1
"""Within this many metres above a sentinel that is the shortest range there are few echoes."""

LARGEST_SIGMA = 0.5
"""The σ of no sonar is this many metres."""


def range_warnings(readings: Readings) -> list[str]:
    """Return warnings about the values of readings in the order of their stamps; empty if there is no suspicion."""
    checks = (_high_sentinel, _sentinel_of_some, _low_sentinel, _field_of_view, _range_limit, _variance)
    return [text for check in checks if (text := check(readings))]


def sensors(readings: Readings) -> Iterable[tuple[str, Readings]]:
    """Yield name and readings of every sensor that has enough of them."""
    for number, name in enumerate(readings.sensor_names):
        mine = readings.sensor == number
        if np.count_nonzero(mine) >= LEAST_READINGS:
            yield name, readings.select(mine)


def _high_sentinel(readings: Readings) -> str:
    """Check for a sentinel below max_range: the longest range, which occurs again and again."""
    heard, towards = _echoes_if_no_reading_lacks_one(readings)
    longest, share = _longest_of_many(heard, towards)
    if not share:
        return ''
    return (
        f'{share:.0%} of the echoes are at {longest:.3f} m, hardly any is longer, and no reading is '
        'without an echo: does the driver send this range if there is no echo? Then set the parameter max_range to '
        f'{0.98 * longest:.2g}, otherwise a wall is mapped at that range'
    )


def _sentinel_of_some(readings: Readings) -> str:
    """Check for a sentinel of some sensors, whose driver is another one."""
    always = {name: mine for name, mine in sensors(readings) if _always_hears(mine)}
    if _always_hears(readings) or not always:
        return ''
    moved = {name: mine.select(moving(mine)) for name, mine in always.items()}
    heard, towards = (np.concatenate([getattr(mine, of) for mine in moved.values()]) for of in ('z', 'yaw'))
    longest, _ = _longest_of_many(heard, towards)
    parts = {name: np.mean(np.abs(mine.z - longest) < VALUE_TOLERANCE) for name, mine in moved.items() if len(mine)}
    # what a sensor hears nearly all the time may be the robot, or the wall along which it drives
    names = [name for name, part in parts.items() if SENTINEL_SHARE <= part <= MOST_AT_SENTINEL]
    # if the others hear nothing from farther away, it may be a wall
    farther = np.mean(readings.z[readings.echo] > longest + VALUE_TOLERANCE)
    if len(names) < FEWEST_WITH_SENTINEL or farther < BEYOND_SHARE:
        return ''
    return (
        f'{", ".join(names[:8])}{f" and {len(names) - 8} more" * (len(names) > 8)}: the longest range is '
        f'{longest:.3f} m again and again, and no reading is without an echo, unlike those of other sensors: does its '
        'driver send this range if there is no echo? Let it send +inf (REP 117), otherwise a wall is mapped there'
    )


def _longest_of_many(heard: Floats, towards: Floats) -> tuple[float, float]:
    """Return the longest range that occurs often, without others near it, and its fraction; zeros without one."""
    if len(heard) < LEAST_ECHOES:
        return 0.0, 0.0
    values, counts = np.unique(heard.round(3), return_counts=True)
    often = values[counts >= SENTINEL_SHARE * len(heard)]
    if not len(often):
        return 0.0, 0.0
    longest = float(often[-1])
    same = np.abs(heard - longest) < VALUE_TOLERANCE
    nearly = (heard > longest - GAP_BELOW) & (heard < longest) & ~same
    count, almost = int(np.count_nonzero(same)), int(np.count_nonzero(nearly))
    longer = int(np.count_nonzero(heard >= longest + VALUE_TOLERANCE))
    few = longer <= max(BEYOND_SHARE * len(heard), OF_SENTINEL * count)
    if not few or count < 2 * almost or not _all_around(towards[same]):
        return 0.0, 0.0
    return longest, count / len(heard)


def _low_sentinel(readings: Readings) -> str:
    """Check for a sentinel that is the shortest range: a driver may send 0, raised to min_range."""
    heard, towards = _echoes_if_no_reading_lacks_one(readings)
    if len(heard) < LEAST_ECHOES:
        return ''
    shortest = round(float(np.quantile(heard, BEYOND_SHARE)), 3)
    same = np.abs(heard - shortest) < VALUE_TOLERANCE
    nearly = (heard < shortest + GAP_ABOVE) & (heard > shortest) & ~same
    count, almost = int(np.count_nonzero(same)), int(np.count_nonzero(nearly))
    if count < SENTINEL_SHARE * len(heard) or count < 2 * almost or not _all_around(towards[same]):
        return ''
    # what a single sensor hears, or others all the time, may be the robot
    parts = [float(np.mean(np.abs(mine.z - shortest) < VALUE_TOLERANCE)) for _, mine in sensors(readings)]
    at_it = [part for part in parts if part >= SENTINEL_SHARE]
    if len(at_it) < min(2, len(parts)) or min(at_it) > 0.5:
        return ''
    return (
        f'{count / len(heard):.0%} of the echoes are at {shortest:.3f} m, hardly any is shorter, and no reading is '
        f'without an echo: does the driver send this range if there is no echo? Let it send +inf (REP 117), otherwise '
        f'the robot is mapped as walled in'
    )


def _always_hears(mine: Readings) -> bool:
    """Return whether hardly any reading of a sensor is without an echo."""
    return bool(np.count_nonzero(~mine.echo) <= MOST_NO_ECHO * len(mine))


def _echoes_if_no_reading_lacks_one(readings: Readings) -> tuple[Floats, Floats]:
    """Return ranges and directions, radians, of the echoes while the robot moves; none if readings have no echo."""
    # during a standstill ranges are constant
    parts = [mine.select(mine.echo & moving(mine)) for _, mine in sensors(readings)]
    if not parts or not _always_hears(readings):
        return np.zeros(0), np.zeros(0)
    return np.concatenate([mine.z for mine in parts]), np.concatenate([mine.yaw for mine in parts])


def _all_around(yaw: Floats) -> bool:
    """Return whether directions are spread: along a wall, a constant range occurs in the same one for long."""
    sectors = np.bincount((np.remainder(yaw, 2 * math.pi) / (2 * math.pi) * 12).astype(np.int64))
    return int(np.count_nonzero(sectors >= LEAST_OF_PART)) >= LEAST_DIRECTIONS


def moving(mine: Readings) -> NDArray[np.bool_]:
    """Return which readings of a sensor have another position or yaw of it than the reading before."""
    moved = (np.hypot(np.diff(mine.x), np.diff(mine.y)) > STANDSTILL_STEP[0]) | (turned(mine) > STANDSTILL_STEP[1])
    return np.append(False, moved)


def turned(mine: Readings) -> Floats:
    """Return the absolute turn of a sensor from each reading to the next, radians, shape (N - 1,)."""
    turned: Floats = np.abs(np.remainder(np.diff(mine.yaw) + math.pi, 2 * math.pi) - math.pi)
    return turned


def _field_of_view(readings: Readings) -> str:
    angle = 2 * readings.half_angle
    odd = (angle < NARROWEST) | (angle > WIDEST)
    if np.count_nonzero(odd) < 0.5 * len(readings):
        return ''
    degrees = math.degrees(float(np.median(angle[odd])))
    cause = (
        'is it in degrees, or a default of a simulator?'
        if degrees > 90
        else 'is it half of the angle, or a default of the driver?'
    )
    return (
        f'the field of view is {degrees:.3g} degrees, which no sonar has; {cause} field_of_view is the full angle of '
        f'the cone in radians, 0.26 for 15 degrees: correct the driver, or set the parameter field_of_view'
    )


def _range_limit(readings: Readings) -> str:
    echo = readings.echo & ~_of_fixed_distance(readings)
    heard: Floats = readings.z[echo]
    if max(np.ptp(readings.x), np.ptp(readings.y)) < LEAST_DRIVEN:
        return ''
    if len(heard) < LEAST_ECHOES or np.count_nonzero(~echo) < LEAST_NO_ECHO * len(readings):
        return ''
    # a few random echoes may have any range
    part: NDArray[np.float64] = heard / readings.z_max[echo]
    farthest = float(np.quantile(part, 0.995))
    if farthest > REACHED_SHARE:
        return ''
    limit = float(np.median(readings.z_max))
    metres = farthest * limit
    unit = 'is max_range in centimetres, millimetres or feet?' if farthest < 0.1 else 'does the sensor reach that far?'
    return (
        f'max_range is {limit:g} m, and no echo is from beyond {metres:.1f} m: {unit} A reading without an echo is '
        'evidence for free space up to max_range; set the parameter max_range to the range of the sensor'
    )


def _variance(readings: Readings) -> str:
    """Look for a variance by which ranges would say next to nothing."""
    stated = readings.echo & (readings.sigma > 0.0) & ~_of_fixed_distance(readings)
    if np.count_nonzero(stated) < max(LEAST_READINGS, 0.5 * np.count_nonzero(readings.echo)):
        return ''
    sigma = float(np.median(readings.sigma[stated]))
    if sigma < LARGEST_SIGMA:
        return ''
    return (
        f'the messages state a variance of {sigma * sigma:.3g} m², as if ranges scattered by {sigma:.2g} m: is it in '
        f'another unit, or the deviation? Correct the driver: variance is in square metres, and 0 where it is not known'
    )


def _of_fixed_distance(readings: Readings) -> NDArray[np.bool_]:
    """Return which readings are echoes of fixed-distance rangers, at half of max_range (`rep117.measure`)."""
    z, z_max, sigma = readings.z, readings.z_max, readings.sigma
    found: NDArray[np.bool_] = np.isclose(2 * z, z_max) & np.isclose(12 * sigma, z_max)
    return found
