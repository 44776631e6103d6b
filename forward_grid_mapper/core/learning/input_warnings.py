"""Warnings about input that gives a wrong map without any error; each names the cause and the remedy.

The checks use the readings alone, so that the node and the offline tool give the same warnings. Messages, before they
become readings, are checked by `messages.limit_watch`.

Thresholds are far from the values of sound drives, since nobody reads warnings that are often wrong.
"""

from __future__ import annotations

import math
from collections.abc import Iterable

import numpy as np
from numpy.typing import NDArray

from ..common.grid import cone_boxes
from ..common.readings import Floats, Readings

ENOUGH = 30
"""Fewest readings of a sensor that is checked."""

COPIES = 0.3
"""Fraction of the readings that must be copies of others; a driver may send a value twice now and then."""

COARSE, CROWDED = 1_000_000, 2.0
"""All stamps are within so many nanoseconds after a whole second if nanosec is not filled in, or is in another unit;
and a sensor has at least so many readings in each such second."""

AT_ONCE = 0.3
"""Fraction of the readings of a sensor that have the stamp of another one with a different range."""

SHARED = 100
"""Fewest pairs of readings of a frame whose ranges are tested for a period; few may have one at random."""

LONGEST_PERIOD = 32
"""Most sensors with one frame; no ring of sonars has more."""

REPEATS = 0.25
"""A range differs from that of one round of sensors before by at most this fraction of the difference between
neighbours. Upper quartiles are compared, since some readings are random."""

DIFFERS = 0.3
"""Metres by which the ranges of neighbouring sensors differ in at least a quarter of the cases; less may be noise."""

AS_BEFORE = 0.05
"""Steps between readings during which the sensor turned by more, radians, are ignored: a sensor on a servo, or on a
robot that spins, detects the same objects periodically."""

STILL = 0.01, 0.01
"""Metres and radians: a robot that moves by less stands still."""

STANDS = 8.0
"""Shortest standstill whose ranges are checked, seconds."""

JUDGED = 1.0
"""Metres that sensors must have moved before their range limit is checked: from one place all walls may be near or
far."""

BLOCK = 3.0
"""Seconds of the blocks of a standstill whose median ranges are compared."""

LEAST = 5
"""Fewest readings of a sensor in such a block."""

CHANGED, OFTEN = 0.4, 0.3
"""If the robot in fact drives, at least the second fraction of the medians differ from the median of all by more than
the first, metres. People who pass a standing robot change the ranges of a sensor only now and then."""

MOST_CHANGED = 0.6
"""Fraction of the sensors whose ranges must change: people walk in front of some, but driving changes most."""

STUCK, MOVED = 0.97, 2.0
"""A stuck sensor repeats one range to the millimetre in this fraction of its readings, over so many metres of
driving."""

TURNED = 0.5
"""The robot must have turned by so many radians as well: along a straight wall, a range may stay the same for long."""

FASTEST = 15.0
"""No robot with sonars drives so many metres a second; 0.2 m/s in centimetres look like 20 m/s."""

NARROW, WIDE = math.radians(3.0), math.radians(90.0)
"""No sonar has a smaller or larger field of view than these."""

REACHED = 0.6
"""max_range is too large if all echoes are within this fraction of it."""

SILENT = 0.05
"""At least this fraction of the readings must have no echo: in a small closed room all echoes are near, but all
readings have one."""

ECHOES = 200
"""Fewest echoes for checks of the range limit."""

CEILING, ABOVE = 0.05, 0.005
"""A driver that sends a certain range for 'no echo' does so in at least the first fraction of its echoes, and at most
the second fraction is longer."""

NONE = 0.01
"""Then at most this fraction of the readings has no echo."""

SAME = 0.0005
"""Metres within which two ranges are the same value of the driver."""

BELOW, DIRECTIONS = 0.05, 3
"""Within so many metres below that range there are few echoes, unlike for a wall; and it is sent in at least so many
twelfths of the circle."""

FLOOR = 0.1
"""Within so many metres above the shortest range there are few echoes, if it stands for 'no echo'."""

SCATTER = 0.5
"""The σ of no sonar is so many metres."""

HANDFUL, SWEEPS = 0.02, 2
"""Largest fraction of the readings, and of rounds of all sensors, that should not make the map much larger; one wrong
pose affects a round."""

MULTIPLE = 4.0
"""The map is at least so many times as large with them."""

LARGE = 400.0
"""They add at least so many square metres; for small maps it does not matter."""


def input_warnings(readings: Readings) -> list[str]:
    """Return warnings about readings; empty if there is no suspicion."""
    if len(readings) < ENOUGH:
        return []
    if text := _whole_seconds(readings):
        # the other checks compare readings in their order
        return [text]
    by_time = readings.select(np.argsort(readings.stamp, kind='stable'))
    of_drives = (_copies, _shared_frame, _speed, _standing, _stuck, _extent)
    of_messages = (_ceiling, _floor, _field_of_view, _reach, _scatter)
    return [text for check in (*of_drives, *of_messages) if (text := check(by_time))]


def _sensors(readings: Readings) -> Iterable[tuple[str, Readings]]:
    """Yield name and readings of every sensor that has enough of them."""
    for number, name in enumerate(readings.sensor_names):
        mine = readings.sensor == number
        if np.count_nonzero(mine) >= ENOUGH:
            yield name, readings.select(mine)


def _listed(names: list[str]) -> str:
    return ', '.join(names[:8]) + (f' and {len(names) - 8} more' if len(names) > 8 else '')


def _copies(readings: Readings) -> str:
    order = np.lexsort((readings.z, readings.sensor, readings.stamp))
    stamp, sensor, z = readings.stamp[order], readings.sensor[order], readings.z[order]
    same = (stamp[1:] == stamp[:-1]) & (sensor[1:] == sensor[:-1]) & (z[1:] == z[:-1])
    copies = int(np.count_nonzero(same))
    # readings that all have one stamp are another fault
    if copies < COPIES * len(z) or len(np.unique(stamp)) < 0.1 * len(z) / max(len(readings.sensor_names), 1):
        return ''
    return (
        f'{copies} of {len(z)} readings are copies of others (same sensor, stamp and range), and their evidence '
        'counts twice: was a topic recorded twice, or do two nodes publish it? Leave one of them out (range_topics)'
    )


def _whole_seconds(readings: Readings) -> str:
    """Check for stamps whose nanoseconds are not filled in or in another unit, and for constant stamps."""
    if readings.stamp.min() < 0 or np.any(readings.stamp % 1_000_000_000 >= COARSE):
        return ''
    most = max((len(mine) / len(np.unique(mine.stamp // 1_000_000_000)) for _, mine in _sensors(readings)), default=0.0)
    if most < CROWDED:
        return ''
    stamps = 'all stamps are equal' if np.ptp(readings.stamp) == 0 else 'all stamps are whole seconds'
    return (
        f'{stamps}, although a sensor has {most:.0f} readings at each: does the driver set header.stamp, with nanosec '
        'in nanoseconds? Readings are placed with the pose of the robot at their stamp'
    )


def _shared_frame(readings: Readings) -> str:
    suspects = []
    for name, mine in _sensors(readings):
        z = mine.z
        follows = mine.stamp[1:] == mine.stamp[:-1]
        at_once = np.count_nonzero(follows & (np.abs(np.diff(z)) > DIFFERS)) > AT_ONCE * len(z)
        steps = np.abs(np.diff(z))[_turned(mine) <= AS_BEFORE]
        neighbours = float(np.quantile(steps, 0.75)) if len(steps) else 0.0
        periods = range(3, min(LONGEST_PERIOD, len(z) // 10) + 1)
        rounds = [float(np.quantile(np.abs(z[k:] - z[:-k]), 0.75)) for k in periods]
        takes_turns = len(steps) >= SHARED and neighbours > DIFFERS and min(rounds) < REPEATS * neighbours
        if at_once or takes_turns:
            suspects.append(name)
    if not suspects:
        return ''
    return (
        f'the readings of frame {_listed(suspects)} alternate like those of several sensors: do all sensors have the '
        'same frame_id? Set a different one for each in its driver, with its pose; otherwise all readings are mapped '
        'from the same pose'
    )


def _speed(readings: Readings) -> str:
    """Check for poses in other units than metres: most of the time, the robot seems to drive far too fast."""
    speeds = []
    for _, mine in _sensors(readings):
        seconds = np.diff(mine.stamp) / 1e9
        way = np.hypot(np.diff(mine.x), np.diff(mine.y))
        drives = (way > STILL[0]) & (seconds > 0.0)
        speeds.append(way[drives] / seconds[drives])
    driven = np.concatenate(speeds) if speeds else np.zeros(0)
    if len(driven) < ENOUGH or np.median(driven) < FASTEST:
        return ''
    return (
        f'the poses move at {np.median(driven):.0f} m/s: are they in millimetres or centimetres, or are their stamps '
        'in another unit? Poses must be in metres, and stamps in seconds: correct the odometry, or the file of poses'
    )


def _standing(readings: Readings) -> str:
    """Check for times in which odometry stands still although the ranges of most sensors change."""
    lasted = 0.0
    names, per_sensor = [], []
    for name, mine in _sensors(readings):
        names.append(name)
        per_sensor.append(mine)
    if not names:
        return ''
    for begin, end in _still_times(per_sensor[0]):
        changed = [_changes(mine, begin, end) for mine in per_sensor]
        judged = [change for change in changed if change is not None]
        if len(judged) >= max(1, len(names) // 2) and sum(judged) >= MOST_CHANGED * len(judged):
            lasted += (end - begin) / 1e9
    if not lasted:
        return ''
    return (
        f'odometry does not change for {lasted:.0f} s while the ranges of most sensors change: does the robot drive '
        'while odometry is not updated? Check its wheel encoders, or choose another odometry topic'
    )


def _still_times(mine: Readings) -> Iterable[tuple[int, int]]:
    """Yield begin and end, in nanoseconds, of the times in which a sensor did not move."""
    cuts = np.flatnonzero(_moving(mine))
    for first, last in zip([0, *cuts.tolist()], [*cuts.tolist(), len(mine)], strict=True):
        # steps below the threshold may add up
        part = slice(first, last)
        wide = max(float(np.ptp(mine.x[part])), float(np.ptp(mine.y[part])))
        if mine.stamp[last - 1] - mine.stamp[first] >= STANDS * 1e9 and wide <= STILL[0]:
            yield int(mine.stamp[first]), int(mine.stamp[last - 1])


def _changes(mine: Readings, begin: int, end: int) -> bool | None:
    """Return whether the ranges change as if the robot drives; None if there are too few readings."""
    inside = (mine.stamp >= begin) & (mine.stamp <= end)
    z, block = mine.z[inside], ((mine.stamp[inside] - begin) / (BLOCK * 1e9)).astype(np.int64)
    parts = np.split(z, np.flatnonzero(np.diff(block)) + 1)
    medians = np.array([np.median(part) for part in parts if len(part) >= LEAST])
    if len(medians) * BLOCK < STANDS / 2:
        return None
    return bool(np.mean(np.abs(medians - np.median(z)) > CHANGED) >= OFTEN)


def _stuck(readings: Readings) -> str:
    suspects = []
    for name, mine in _sensors(readings):
        heard = mine.z[mine.echo]
        if len(heard) < STUCK * len(mine) or not _drove(mine):
            continue
        rounded = np.rint(heard * 1000.0).astype(np.int64)
        values, counts = np.unique(rounded, return_counts=True)
        most = int(counts.argmax())
        if counts[most] >= STUCK * len(mine):
            suspects.append(f'{name} ({values[most] / 1000.0:.3f} m)')
    if not suspects:
        return ''
    return (
        f'sensor {_listed(suspects)} gives the same range everywhere: is it broken, or does it hear a part of the '
        'robot? Repair it, or leave out its topic'
    )


def _drove(mine: Readings) -> bool:
    path = float(np.hypot(np.diff(mine.x), np.diff(mine.y)).sum())
    return path >= MOVED and float(np.ptp(np.unwrap(mine.yaw))) >= TURNED


def _ceiling(readings: Readings) -> str:
    """Check for a range below max_range that stands for 'no echo': the longest one, which occurs again and again."""
    heard, towards = _echoes_of_all_that_answer(readings)
    if len(heard) < ECHOES:
        return ''
    longest = round(float(np.quantile(heard, 1.0 - ABOVE)), 3)
    same = np.abs(heard - longest) < SAME
    nearly = (heard > longest - BELOW) & (heard < longest) & ~same
    count, almost = int(np.count_nonzero(same)), int(np.count_nonzero(nearly))
    if count < CEILING * len(heard) or count < 2 * almost or not _all_around(towards[same]):
        return ''
    return (
        f'{count / len(heard):.0%} of the echoes are at {longest:.3f} m, hardly any is longer, and no reading is '
        'without an echo: does the driver send this range if there is no echo? Then set the parameter max_range to '
        f'{0.98 * longest:.2g}, otherwise a wall is mapped at that range'
    )


def _floor(readings: Readings) -> str:
    """Check for a shortest range that stands for 'no echo': a driver may raise its 0 for that to min_range."""
    heard, towards = _echoes_of_all_that_answer(readings)
    if len(heard) < ECHOES:
        return ''
    shortest = round(float(np.quantile(heard, ABOVE)), 3)
    same = np.abs(heard - shortest) < SAME
    nearly = (heard < shortest + FLOOR) & (heard > shortest) & ~same
    count, almost = int(np.count_nonzero(same)), int(np.count_nonzero(nearly))
    if count < CEILING * len(heard) or count < 2 * almost or not _all_around(towards[same]):
        return ''
    # what a single sensor hears, or others all the time, may be the robot
    parts = [float(np.mean(np.abs(mine.z - shortest) < SAME)) for _, mine in _sensors(readings)]
    at_it = [part for part in parts if part >= CEILING]
    if len(at_it) < min(2, len(parts)) or min(at_it) > 0.5:
        return ''
    return (
        f'{count / len(heard):.0%} of the echoes are at {shortest:.3f} m, hardly any is as short, and no reading is '
        f'without an echo: does the driver send this range if there is no echo? Let it send +inf (REP 117), otherwise '
        f'the robot is mapped as walled in'
    )


def _echoes_of_all_that_answer(readings: Readings) -> tuple[Floats, Floats]:
    """Return ranges and directions, radians, of the echoes while the robot moves; none if readings have no echo."""
    # during a standstill ranges are constant
    parts = [mine.select(mine.echo & _moving(mine)) for _, mine in _sensors(readings)]
    if not parts or np.count_nonzero(~readings.echo) > NONE * len(readings):
        return np.zeros(0), np.zeros(0)
    return np.concatenate([mine.z for mine in parts]), np.concatenate([mine.yaw for mine in parts])


def _all_around(yaw: Floats) -> bool:
    """Return whether directions are spread: along a wall, a constant range occurs in the same one for long."""
    sectors = np.bincount((np.remainder(yaw, 2 * math.pi) / (2 * math.pi) * 12).astype(np.int64))
    return int(np.count_nonzero(sectors >= LEAST)) >= DIRECTIONS


def _moving(mine: Readings) -> NDArray[np.bool_]:
    """Return which readings of a sensor have another position or yaw of it than the reading before."""
    moved = (np.hypot(np.diff(mine.x), np.diff(mine.y)) > STILL[0]) | (_turned(mine) > STILL[1])
    return np.append(False, moved)


def _turned(mine: Readings) -> Floats:
    """Return the absolute turn of a sensor from each reading to the next, radians, shape (N - 1,)."""
    turned: Floats = np.abs(np.remainder(np.diff(mine.yaw) + math.pi, 2 * math.pi) - math.pi)
    return turned


def _field_of_view(readings: Readings) -> str:
    angle = 2 * readings.half_angle
    odd = (angle < NARROW) | (angle > WIDE)
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


def _reach(readings: Readings) -> str:
    echo = readings.echo & ~_of_fixed_distance(readings)
    heard: Floats = readings.z[echo]
    if max(np.ptp(readings.x), np.ptp(readings.y)) < JUDGED:
        return ''
    if len(heard) < ECHOES or np.count_nonzero(~echo) < SILENT * len(readings):
        return ''
    # a few random echoes may have any range
    part: NDArray[np.float64] = heard / readings.z_max[echo]
    farthest = float(np.quantile(part, 0.995))
    if farthest > REACHED:
        return ''
    limit = float(np.median(readings.z_max))
    metres = farthest * limit
    unit = 'is max_range in centimetres, millimetres or feet?' if farthest < 0.1 else 'does the sensor reach that far?'
    return (
        f'max_range is {limit:g} m, and no echo is from beyond {metres:.1f} m: {unit} A reading without an echo is '
        'evidence for free space up to max_range; set the parameter max_range to the range of the sensor'
    )


def _scatter(readings: Readings) -> str:
    """Look for a variance by which ranges would say next to nothing."""
    stated = readings.echo & (readings.sigma > 0.0) & ~_of_fixed_distance(readings)
    if np.count_nonzero(stated) < max(ENOUGH, 0.5 * np.count_nonzero(readings.echo)):
        return ''
    sigma = float(np.median(readings.sigma[stated]))
    if sigma < SCATTER:
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


def _extent(readings: Readings) -> str:
    """Check for a few readings without which the map would be much smaller."""
    few = min(SWEEPS * len(readings.sensor_names), int(HANDFUL * len(readings)))
    if not few:
        return ''
    boxes = cone_boxes(readings.x, readings.y, readings.yaw, readings.half_angle, readings.z)
    # how far each reading reaches to the left, right, bottom and top
    reached = np.array([[-1.0], [1.0], [-1.0], [1.0]]) * boxes
    ordered = np.sort(reached, axis=1)
    whole, rest = ordered[:, -1], ordered[:, -few - 1]
    if _area(whole) < MULTIPLE * _area(rest) or _area(whole) - _area(rest) < LARGE:
        return ''
    side = int(np.argmax(whole - rest))
    middle = (rest[side] + whole[side]) / 2
    one = int(np.argmax(reached[side]))
    x, y, z = (float(column[one]) for column in (readings.x, readings.y, readings.z))
    if (-x, x, -y, y)[side] > middle:
        cause = (
            f'their sensor is at ({x:.1f}, {y:.1f}) m, far from all others: did odometry jump? Choose another odometry '
            f'topic, or set the parameter max_jump to less than that'
        )
    else:
        cause = (
            f'one at ({x:.1f}, {y:.1f}) m has a range of {z:.1f} m, more than all others: does the sensor reach that '
            'far? If not, set the parameter max_range to its range'
        )
    return (
        f'{np.count_nonzero(reached[side] > middle)} of {len(readings)} readings make the map {_size(whole)} instead '
        f'of {_size(rest)}: {cause}'
    )


def _area(reached: Floats) -> float:
    return float((reached[0] + reached[1]) * (reached[2] + reached[3]))


def _size(reached: Floats) -> str:
    return f'{reached[0] + reached[1]:.0f} x {reached[2] + reached[3]:.0f} m'
