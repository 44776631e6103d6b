"""Consistency checks: extrinsics or odometry that are mirrored, rotated or wrongly scaled, wrong cones, late stamps.

Such faults cause no error message, only a wrong map. Each of them can be undone: mirrored sensors are mirrored back,
stamps are shifted back. So a small map of a part of the drive is made for each assumed fault, with the fault undone,
and compared with the map of the unchanged readings. If the input is sound, none of them explains the readings better.
Small offsets, of stamps or of the poses of the sensors, and a scale of ranges are then estimated from a longer part
(`sensor_calibration`).

Ranges that are too large by a factor look like odometry that is too small by it.

It costs some thirty maps of at most `MOST_READINGS` readings each, however long the drive is, and a dozen larger ones
for each offset that is estimated.
"""

from __future__ import annotations

import math
from collections.abc import Iterator, Mapping
from dataclasses import replace
from operator import itemgetter
from typing import NamedTuple

import numpy as np

from ..common.parameters import Parameters
from ..common.readings import Floats, Readings
from ..messages.message_types import NANOSECONDS, Pose2
from .sensor_calibration import (
    FORWARD,
    LEFT,
    QUANTITIES,
    SCALE,
    TIME,
    YAW,
    OffsetEstimate,
    Quantity,
    hardly_distinguishable,
    offset_estimates,
    sigmas,
)
from .trial_maps import MountedReadings, coarse_parameters, trial_map

MOST_READINGS, LEAST_READINGS = 800, 300
"""Most readings of the part that is mapped; with fewer than the second, no check is made."""

LEAST_GAIN_A_READING = 0.1
"""Nats a reading by which the map with a fault undone must be better. In sound drives it is at most 0.05."""

LEAST_TOTAL_GAIN = 50.0
"""Nats by which it must be better in total."""

OFFSET_PART, OFFSET_READINGS = 4000, 1200
"""Readings of the part from which offsets are guessed, and how many of them are mapped: offsets show over a longer part
than other faults."""

LEAST_GUESS_GAIN = 12.0
"""Nats that the best guess of an offset must gain for the offset to be estimated."""

LONGER_GAIN, LONGER_SIGMAS = 0.05, 4.0
"""If wrong signs or axes gain as much, but less than `LEAST_GAIN_A_READING`, the longer part decides: few sensors, most
of them without an echo, tell little in a short one. Nats a reading and, over blocks of readings, standard errors."""

FACTORS = (0.3048, 0.5, 2.0, 3.281)
"""Scale factors of odometry that are tried: feet for metres, and radius for diameter of a wheel, and their inverses."""

WIDTHS = (1 / 6, 0.25, 0.5, 2.0, 3.0)
"""Factors of the stated field of view that are tried."""

LEAST_NARROW_GAIN = 0.07
"""Nats a reading by which the map with narrower cones must be better. In sound drives it is always worse, also if
odometry drifts; it is at most 0.04 better if the sensors are rotated by 15°."""

WIDEST = 1.5
"""Largest half field of view, radians."""

LEAST_TRAVEL_STEPS = 40
"""Fewest steps of `travel` for checks of the direction of travel."""

ALIGNED_LENGTH, SCATTERED_LENGTH = 0.9, 0.7
"""Mean resultant lengths of angles: at least the first if they agree, at most the second if they do not."""

SAME_YAW = 0.01
"""The yaw of odometry is constant if it varies by less than this, radians."""

FASTEST_TURN = 10.0
"""No robot does half of its turning faster than this many radians a second; a yaw in degrees looks so."""

LEAST_FAST_TURN, LEAST_FAST_TIME = 2 * math.pi, 0.05
"""Least total turn, radians, and least fraction of the time with such fast turns: odometry may jump now and then."""

CHECK = 'check the poses of the sensors on the robot (parameters, --sensor or transforms)'

REP_103 = 'REP 103 has x forward, y to the left and yaw counter-clockwise'


def consistency_warnings(
    readings: Readings, extrinsics: Mapping[str, Pose2], parameters: Parameters | None = None
) -> list[str]:
    """Return warnings about poses, stamps or cones of readings; empty if there is no suspicion.

    Parameters
    ----------
    readings : Readings
    extrinsics : mapping
        Fixed poses of the sensors on the robot, by `sensor_names`; sensors without one are left out.
    parameters : Parameters, optional

    Notes
    -----
    Swapped left and right are not found in a straight drive, and shifted stamps hardly in a slow one.
    """
    drive = MountedReadings.of(readings, extrinsics)
    if len(drive) < LEAST_READINGS:
        return []
    # a yaw in degrees looks random, and so may look like any other fault
    if warning := _yaw_unit_warning(drive) or _axis_warning(drive):
        return [warning]
    parameters = parameters or Parameters()
    part = drive.moving_part(MOST_READINGS)
    p = coarse_parameters(parameters, part.readings)
    count, given = len(part), trial_map(part.readings, p).objective
    tried = ((trial_map(fault.undone, p).objective - given, fault) for fault in _faults(part))
    gain, fault = max(tried, key=itemgetter(0))
    known = gain / count if gain >= max(fault.least * count, LEAST_TOTAL_GAIN) else 0.0
    if not known and gain >= LEAST_GUESS_GAIN:
        gain, count = _over_longer_part(drive, fault.warning, parameters)
        known = gain / count
    found = _significant_offsets(drive, parameters, known)
    if found and found[0].gain > known * found[0].readings:
        return [_offset_warning(found, parameters.association.range_time_offset)]
    return [_explained(fault.warning, count, gain)] if known else []


def _over_longer_part(drive: MountedReadings, warning: str, parameters: Parameters) -> tuple[float, int]:
    """Return the gain of wrong signs or axes over the longer part, nats, and its readings; 0 if not significant."""
    part = drive.moving_part(OFFSET_PART)
    undone = [fault.undone for fault in _axis_faults(part) if fault.warning == warning]
    if not undone:
        return 0.0, len(part)
    p = coarse_parameters(parameters, part.readings)
    given, better = trial_map(part.readings, p), trial_map(undone[0], p)
    gain = better.objective - given.objective
    sure = gain >= max(LONGER_GAIN * len(part), LEAST_TOTAL_GAIN)
    return gain if sure and sigmas(better.blocks - given.blocks) >= LONGER_SIGMAS else 0.0, len(part)


def _significant_offsets(drive: MountedReadings, parameters: Parameters, known: float) -> list[OffsetEstimate]:
    """Return the significant offsets that may explain the readings better than by `known`, nats a reading."""
    part = drive.moving_part(OFFSET_PART).randomly_thinned(OFFSET_READINGS)
    p = coarse_parameters(parameters, part.readings)
    given, suspects = trial_map(part.readings, p).objective, {}
    for quantity in QUANTITIES:
        tried = ((trial_map(quantity.corrected(part, guess), p).objective, guess) for guess in quantity.guesses)
        best, guess = max(tried)
        if best - given >= max(LEAST_GUESS_GAIN, known * len(part)):
            suspects[quantity] = guess
    return offset_estimates(drive, suspects, parameters) if suspects else []


def _explained(warning: str, count: int, gain: float) -> str:
    better = f'with this corrected, a map explains {count} readings better by {gain / count:.2f} nats each'
    return f'{warning} ({better})'


def _offset_warning(found: list[OffsetEstimate], time_offset: float) -> str:
    """Return the warning about the best of the estimates; `time_offset` is the one already added to stamps, seconds."""
    best, *others = found
    causes = [best, *(each for each in others if hardly_distinguishable(best, each))]
    said = ', or '.join(_words(each.quantity, each.value, each.error) for each in causes)
    remedies = []
    for each in causes:
        if each.quantity is TIME:
            remedies.append(
                f'set the parameter range_time_offset to {time_offset + each.value:.2f}, or correct the drivers, which '
                'must stamp a reading at the time of its measurement, all by the same clock'
            )
        elif each.quantity is SCALE:
            remedies.append(
                'correct the speed of sound in the drivers of the sensors (343 m/s at 20 °C), or the wheel radius in '
                'that of odometry'
            )
        elif CHECK not in remedies:
            remedies.append(CHECK)
    remedy = '; or '.join(remedies)
    which = '. The drive does not tell which: ' if len(causes) > 1 else '; '
    return _explained(f'{said}{which}{remedy}', best.readings, best.gain)


def _words(quantity: Quantity, value: float, error: float) -> str:
    """Return an offset in words."""
    size = abs(value)
    if quantity is TIME:
        word = 'late' if value < 0 else 'early'
        return f'the stamps of the readings are {size:.2f} s (±{error:.2f} s) too {word} against those of odometry'
    if quantity is SCALE:
        word = 'long' if value > 0 else 'short'
        return f'ranges are {size:.0%} (±{100 * error:.1f}) too {word} for the distances of odometry'
    if quantity is YAW:
        size, error, side = math.degrees(size), math.degrees(error), 'left' if value > 0 else 'right'
        return f'the sensors are rotated by {size:.0f} degrees (±{error:.1f}) to the {side} of their stated poses'
    side = {(FORWARD, True): 'forward of', (FORWARD, False): 'behind', (LEFT, True): 'to the left of'}.get(
        (quantity, value > 0), 'to the right of'
    )
    return f'the sensors are {size:.2f} m (±{error:.2f} m) {side} their stated poses'


class _Fault(NamedTuple):
    """An assumed fault: the warning, the readings with the fault undone, and the least gain for the warning."""

    warning: str
    undone: Readings
    least: float = LEAST_GAIN_A_READING


def _faults(drive: MountedReadings) -> Iterator[_Fault]:
    """Yield all faults that are checked."""
    yield from _axis_faults(drive)
    x, y, yaw = drive.robot
    for factor in FACTORS:
        much = f'{factor:.3g} times as far as' if factor > 1 else f'1/{1 / factor:.3g} as far as'
        yield _Fault(
            f'according to the readings, the robot drives {much} odometry says; are odometry or ranges in feet, or is '
            'the wheel radius wrong? Correct the driver: messages must be in metres',
            drive.placed(robot=np.stack([factor * x, factor * y, yaw])),
        )
    for width in WIDTHS:
        half = np.minimum(width * drive.readings.half_angle, WIDEST)
        stated, fitting = (round(math.degrees(2 * float(np.median(h)))) for h in (drive.readings.half_angle, half))
        yield _Fault(
            f'the field of view is stated as {stated} degrees, but the readings fit about {fitting} degrees; is it '
            'half of the angle, or twice the angle? Correct the driver, or set the parameter field_of_view',
            replace(drive.readings, half_angle=half),
            LEAST_NARROW_GAIN if width < 1 else LEAST_GAIN_A_READING,
        )


def _axis_faults(drive: MountedReadings) -> Iterator[_Fault]:
    """Yield wrong signs and axes."""
    x, y, yaw = drive.robot
    forward, left, turn = drive.extrinsics
    yield _Fault(
        f'left and right of the sensors seem to be swapped; {CHECK}, or the signs of y and yaw in odometry. {REP_103}',
        drive.placed(extrinsics=np.stack([forward, -left, -turn])),
    )
    yield _Fault(
        f'the yaw of the sensors seems to have the wrong sign; {CHECK}. {REP_103}',
        drive.placed(extrinsics=np.stack([forward, left, -turn])),
    )
    yield _Fault(
        f'y or yaw of odometry seems to have the wrong sign; correct its driver. {REP_103}',
        drive.placed(robot=np.stack([x, y, -yaw])),
    )
    for degrees, word in ((90, ' to the left'), (-90, ' to the right'), (180, '')):
        by = f'{abs(degrees)} degrees{word}'
        yield _Fault(
            f'the sensors seem to be rotated by {by}; {CHECK}, or the axes of odometry. {REP_103}',
            drive.rotated(math.radians(-degrees)),
        )
    at, directions = drive.travel()
    if np.ptp(yaw) < SAME_YAW and len(at) >= 2:
        yield _Fault(
            f'{_constant_yaw_words(float(yaw[0]), directions)} Correct the driver',
            drive.placed(robot=np.stack([x, y, np.interp(np.arange(len(x)), at, np.unwrap(directions))])),
        )


def _constant_yaw_words(yaw: float, directions: Floats) -> str:
    """Return what is wrong with a yaw that never changes, radians, if the robot drives in these directions."""
    # doubled angles, since a robot that drives back along a line need not turn
    mean = np.mean(np.exp(2j * directions))
    if abs(mean) < ALIGNED_LENGTH:
        return 'the yaw of odometry never changes, although the robot turns; does its driver leave out the orientation?'
    # of the two directions along the line, that in which it mostly drives
    along = np.angle(mean) / 2
    forwards = along if np.cos(directions - along).sum() > 0.0 else math.remainder(along + math.pi, 2 * math.pi)
    return (
        f'the yaw of odometry is always {yaw:.2f} rad, but the robot drives in the direction {forwards:.2f} rad; does '
        'its driver leave out the orientation, or is the yaw in degrees?'
    )


def _yaw_unit_warning(drive: MountedReadings) -> str:
    """Return a warning if the yaw is in another unit than radians, so that the robot seems to turn far too fast."""
    known, first = np.unique(drive.readings.stamp, return_index=True)
    seconds = np.diff(known) / NANOSECONDS
    turned = np.abs(np.remainder(np.diff(drive.robot[2, first]) + math.pi, 2 * math.pi) - math.pi)
    fast = turned > FASTEST_TURN * seconds
    total = float(turned.sum())
    if (
        total < LEAST_FAST_TURN
        or turned[fast].sum() < total / 2
        or seconds[fast].sum() < LEAST_FAST_TIME * seconds.sum()
    ):
        return ''
    speed = float(np.median(turned[fast] / seconds[fast]))
    return (
        f'the yaw of the robot turns at {speed:.0f} rad/s: is it in degrees? Odometry has it as a quaternion, whose '
        f'z is the sine, and w the cosine, of half the yaw in radians: correct its driver, or the file of poses'
    )


def _axis_warning(drive: MountedReadings) -> str:
    """Return a warning if the direction of travel turns against the yaw, so that an axis is wrong; otherwise ''.

    A robot drives forwards, or backwards, or, if it is holonomic, in any direction. None drives to the right whenever
    it turns to the left, and to the left whenever it turns to the right.
    """
    at, directions = drive.travel()
    if len(at) < LEAST_TRAVEL_STEPS:
        return ''
    yaw = drive.robot[2, at]
    # doubled angles, for which backwards equals forwards, do not help if the robot drives along two axes only
    for times in (1, 2):
        with_yaw = abs(np.mean(np.exp(1j * times * (directions - yaw))))
        against_yaw = np.mean(np.exp(1j * times * (directions + yaw)))
        if abs(against_yaw) >= ALIGNED_LENGTH and with_yaw <= SCATTERED_LENGTH:
            break
    else:
        return ''
    angle = abs(np.angle(against_yaw)) / times
    if math.pi / 4 < angle < 3 * math.pi / 4:
        cause = 'x and y seem to be swapped'
    else:
        cause = 'y, or yaw, seems to have the wrong sign' if angle < math.pi / 4 else 'x seems to have the wrong sign'
    return (
        f'odometry turns to one side and moves to the other: {cause} in odometry. {REP_103}; correct its driver, or '
        'choose another odometry topic'
    )
