"""Consistency checks: extrinsics or odometry that are mirrored, rotated or wrongly scaled, wrong cones, late stamps.

Such faults cause no error message, only a wrong map. Each of them can be undone: mirrored sensors are mirrored back,
stamps are shifted back. So a small map of a part of the drive is made for each assumed fault, with the fault undone,
and compared with the map of the unchanged readings. If the input is sound, none of them explains the readings better.

Poses and cones are changed, never ranges, so the likelihoods of all these maps can be compared. Ranges that are too
large by a factor look like odometry that is too small by it.

It costs some twenty maps of at most `MOST` readings each, however long the drive is.
"""

from __future__ import annotations

import math
from collections.abc import Iterator, Mapping
from dataclasses import dataclass, replace
from operator import itemgetter
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from ..common.errors import InputError
from ..common.parameters import Parameters
from ..common.readings import Floats, Readings, in_canonical_order
from ..evidence.evidence import Evidence
from ..maps.log_odds_map import map_grid
from ..maps.traversed import traversed_cells
from ..messages.message_types import NANOSECONDS, Pose2
from ..runtime.memory import memory_for_pairs
from ..runtime.threads import cores
from ..search.search import Search

MOST, ENOUGH = 800, 300
"""Most readings of the part that is mapped; with fewer than the second, no check is made."""

CELL, REACH = 0.1, 60.0
"""Smallest cells of these maps, metres, and most cells that the 0.9 quantile of ranges spans: they limit the cost."""

GAIN = 0.1
"""Nats a reading by which the map with a fault undone must be better. In sound drives it is at most 0.05."""

LEAST_SHIFT, SHIFT_GAIN = 0.2, 0.15
"""Smallest shift of stamps that is tried, seconds: stamps of real sensors may be that late. Nats a reading that it must
gain; in sound drives it gains at most 0.11."""

TOTAL = 50.0
"""Nats by which it must be better in total."""

SHIFTS = (LEAST_SHIFT, 0.5, 0.75, 1.0)
"""Seconds by which stamps are shifted, in both directions."""

FACTORS = (0.3048, 0.5, 2.0, 3.281)
"""Scale factors of odometry that are tried: feet for metres, and radius for diameter of a wheel, and their inverses."""

WIDTHS = (1 / 6, 0.25, 0.5, 2.0, 3.0)
"""Factors of the stated field of view that are tried."""

NARROW_GAIN = 0.07
"""Nats a reading by which the map with narrower cones must be better. In sound drives it is always worse, also if
odometry drifts; it is at most 0.04 better if the sensors are rotated by 15°."""

WIDEST = 1.5
"""Largest half field of view, radians."""

STEP = 0.05
"""Metres of driving over which a direction of travel is measured."""

STEPS = 40
"""Fewest such steps for checks of the direction of travel."""

ALIGNED, AWRY = 0.9, 0.7
"""Mean resultant lengths of angles: at least the first if they agree, at most the second if they do not."""

SAME_YAW = 0.01
"""The yaw of odometry is constant if it varies by less than this, radians."""

SPINNING = 10.0
"""No robot does half of its turning faster than so many radians a second; a yaw in degrees looks so."""

TURNED, TURNING = 2 * math.pi, 0.05
"""Least total turn, radians, and least fraction of the time with such fast turns: odometry may jump now and then."""

REP_103 = 'REP 103 has x forward, y to the left and yaw counter-clockwise'


@dataclass(frozen=True)
class _Drive:
    """Readings, sorted by stamp, with the pose of the robot at each of them.

    `robot` and `extrinsics` have shape (3, N): x, y in metres and yaw in radians, of the robot in the map frame and of
    the sensor in the frame of the robot.
    """

    readings: Readings
    robot: Floats
    extrinsics: Floats

    def part(self, which: slice) -> _Drive:
        return _Drive(self.readings.select(which), self.robot[:, which], self.extrinsics[:, which])

    def placed(self, robot: Floats | None = None, extrinsics: Floats | None = None) -> Readings:
        """Return the readings with other poses of the robot, or of the sensors on it."""
        x, y, yaw = self.robot if robot is None else robot
        forward, left, turn = self.extrinsics if extrinsics is None else extrinsics
        cos, sin = np.cos(yaw), np.sin(yaw)
        return replace(
            self.readings, x=x + cos * forward - sin * left, y=y + sin * forward + cos * left, yaw=yaw + turn
        )

    def robot_at(self, seconds: float) -> Floats:
        """Return the robot's poses so many seconds after the stamps, shape (3, N)."""
        stamp = (self.readings.stamp - self.readings.stamp[0]) / NANOSECONDS
        known, first = np.unique(stamp, return_index=True)
        columns = (self.robot[0], self.robot[1], np.unwrap(self.robot[2]))
        return np.stack([np.interp(stamp + seconds, known, column[first]) for column in columns])


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
    drive = _drive(readings, extrinsics)
    if drive is None:
        return []
    # a yaw in degrees looks random, and so may look like any other fault
    if warning := _spinning(drive) or _axes(drive):
        return [warning]
    drive = _stretch(drive)
    p = _coarse(parameters or Parameters(), drive.readings)
    count, given = len(drive.readings), _objective(drive.readings, p)
    gains = (((_objective(fault.undone, p) - given) / count, fault) for fault in _faults(drive))
    gain, fault = max(gains, key=itemgetter(0))
    if gain < max(fault.least, TOTAL / count):
        return []
    return [f'{fault.warning} (with this corrected, a map explains {count} readings better by {gain:.2f} nats each)']


def _drive(readings: Readings, extrinsics: Mapping[str, Pose2]) -> _Drive | None:
    """Return the readings of known sensors by stamp, with the poses of the robot; None if there are too few."""
    known = np.array([name in extrinsics for name in readings.sensor_names] or [False])
    chosen = np.flatnonzero(known[readings.sensor])
    if len(chosen) < ENOUGH:
        return None
    readings = readings.select(chosen[np.argsort(readings.stamp[chosen], kind='stable')])
    nowhere = Pose2(0.0, 0.0, 0.0)
    table = np.array([extrinsics.get(name, nowhere) for name in readings.sensor_names], np.float64)
    forward, left, turn = mounted = table[readings.sensor].T
    yaw = readings.yaw - turn
    cos, sin = np.cos(yaw), np.sin(yaw)
    robot = np.stack([readings.x - cos * forward + sin * left, readings.y - sin * forward - cos * left, yaw])
    return _Drive(readings, robot, mounted)


def _stretch(drive: _Drive) -> _Drive:
    """Return the `MOST` consecutive readings with the most driving and turning, where wrong poses matter most."""
    count = len(drive.readings)
    if count <= MOST:
        return drive
    x, y, yaw = drive.robot
    moved = np.concatenate([[0.0], np.cumsum(np.hypot(np.diff(x), np.diff(y)) + np.abs(np.diff(np.unwrap(yaw))))])
    # turns of the path count as well, in case the yaw is wrong
    at, directions = _travel(drive)
    if len(at) > 1:
        turns = np.concatenate([[0.0], np.cumsum(np.abs(np.diff(np.unwrap(directions))))])
        moved += np.interp(np.arange(count), at, turns)
    first = int(np.argmax(moved[MOST - 1 :] - moved[: count - MOST + 1]))
    return drive.part(slice(first, first + MOST))


def _coarse(parameters: Parameters, readings: Readings) -> Parameters:
    """Return the parameters of the small maps, with coarse cells if ranges are long."""
    reach = float(np.quantile(readings.z, 0.9))
    cell = max(parameters.grid.resolution, CELL, reach / REACH)
    return replace(parameters, grid=replace(parameters.grid, resolution=cell))


def _objective(readings: Readings, parameters: Parameters) -> float:
    """Return the objective of the map that the search finds for readings; -inf if the map would be too large."""
    readings = in_canonical_order(readings)
    try:
        grid = map_grid(readings, parameters)
    except InputError:
        return -math.inf
    search = parameters.search
    evidence = Evidence(grid, parameters.model, memory_for_pairs(parameters), search.threads or cores())
    evidence.extend(readings)
    found = Search(evidence, search, traversed_cells(readings, grid).ravel()).run(lambda progress: None)
    return float(evidence.tempered_log_likelihood + found.log_prior)


class _Fault(NamedTuple):
    """An assumed fault: the warning, the readings with the fault undone, and the least gain for the warning."""

    warning: str
    undone: Readings
    least: float = GAIN


def _faults(drive: _Drive) -> Iterator[_Fault]:
    """Yield all faults that are checked."""
    yield from _of_axes(drive)
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
            NARROW_GAIN if width < 1 else GAIN,
        )
    for shift in SHIFTS:
        for sign, word in ((-1, 'late'), (1, 'early')):
            yield _Fault(
                f'the stamps of the readings seem to be about {shift:g} s {word} against those of odometry; drivers '
                'must stamp a reading at the time of its measurement, all by the same clock',
                drive.placed(robot=drive.robot_at(sign * shift)),
                SHIFT_GAIN if shift == LEAST_SHIFT else GAIN,
            )


def _of_axes(drive: _Drive) -> Iterator[_Fault]:
    """Yield wrong signs and axes."""
    x, y, yaw = drive.robot
    forward, left, turn = drive.extrinsics
    check = 'check the poses of the sensors on the robot (parameters, --sensor or transforms)'
    yield _Fault(
        f'left and right of the sensors seem to be swapped; {check}, or the signs of y and yaw in odometry. {REP_103}',
        drive.placed(extrinsics=np.stack([forward, -left, -turn])),
    )
    yield _Fault(
        f'the yaw of the sensors seems to have the wrong sign; {check}. {REP_103}',
        drive.placed(extrinsics=np.stack([forward, left, -turn])),
    )
    yield _Fault(
        f'y or yaw of odometry seems to have the wrong sign; correct its driver. {REP_103}',
        drive.placed(robot=np.stack([x, y, -yaw])),
    )
    for degrees, word in ((90, ' to the left'), (-90, ' to the right'), (180, '')):
        angle = math.radians(-degrees)
        cos, sin = math.cos(angle), math.sin(angle)
        by = f'{abs(degrees)} degrees{word}'
        yield _Fault(
            f'the sensors seem to be rotated by {by}; {check}, or the axes of odometry. {REP_103}',
            drive.placed(extrinsics=np.stack([cos * forward - sin * left, sin * forward + cos * left, turn + angle])),
        )
    at, directions = _travel(drive)
    if np.ptp(yaw) < SAME_YAW and len(at) >= 2:
        yield _Fault(
            'the yaw of odometry never changes, although the robot turns; does its driver leave out the orientation? '
            'Correct the driver',
            drive.placed(robot=np.stack([x, y, np.interp(np.arange(len(x)), at, np.unwrap(directions))])),
        )


def _travel(drive: _Drive) -> tuple[NDArray[np.int64], Floats]:
    """Return indices of readings between which the robot drove `STEP`, and the direction of travel there, radians."""
    x, y, _ = drive.robot
    driven = np.concatenate([[0.0], np.cumsum(np.hypot(np.diff(x), np.diff(y)))])
    at = np.searchsorted(driven, np.arange(STEP, driven[-1], STEP))
    at = at[np.diff(at, prepend=-1) > 0]
    return at[:-1], np.arctan2(np.diff(y[at]), np.diff(x[at]))


def _spinning(drive: _Drive) -> str:
    """Return a warning if the yaw is in another unit than radians, so that the robot seems to turn far too fast."""
    known, first = np.unique(drive.readings.stamp, return_index=True)
    seconds = np.diff(known) / NANOSECONDS
    turned = np.abs(np.remainder(np.diff(drive.robot[2, first]) + math.pi, 2 * math.pi) - math.pi)
    fast = turned > SPINNING * seconds
    total = float(turned.sum())
    if total < TURNED or turned[fast].sum() < total / 2 or seconds[fast].sum() < TURNING * seconds.sum():
        return ''
    speed = float(np.median(turned[fast] / seconds[fast]))
    return (
        f'the yaw of the robot turns at {speed:.0f} rad/s: is it in degrees? Odometry has it as a quaternion, whose '
        f'z is the sine, and w the cosine, of half the yaw in radians: correct its driver, or the file of poses'
    )


def _axes(drive: _Drive) -> str:
    """Return a warning if the direction of travel turns against the yaw, so that an axis is wrong; otherwise ''.

    A robot drives forwards, or backwards, or, if it is holonomic, in any direction. None drives to the right whenever
    it turns to the left, and to the left whenever it turns to the right.
    """
    at, directions = _travel(drive)
    if len(at) < STEPS:
        return ''
    yaw = drive.robot[2, at]
    # doubled angles, for which backwards equals forwards, do not help if the robot drives along two axes only
    for times in (1, 2):
        with_yaw = abs(np.mean(np.exp(1j * times * (directions - yaw))))
        against_yaw = np.mean(np.exp(1j * times * (directions + yaw)))
        if abs(against_yaw) >= ALIGNED and with_yaw <= AWRY:
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
