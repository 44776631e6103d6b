"""Warnings about input that gives a wrong map without any error; each names the cause and the remedy.

The checks use the readings alone, so that the node and the offline tool give the same warnings. Messages, before they
become readings, are checked by `messages.limit_watch`.

Thresholds are far from the values of sound drives, since nobody reads warnings that are often wrong.
"""

from __future__ import annotations

from collections.abc import Iterable

import numpy as np

from ..common.grid import cone_boxes
from ..common.readings import Floats, Readings
from .range_warnings import LEAST_OF_PART, LEAST_READINGS, STANDSTILL_STEP, moving, range_warnings, sensors, turned

LEAST_COPIES = 0.3
"""Fraction of the readings that must be copies of others; a driver may send a value twice now and then."""

WHOLE_SECOND_TOLERANCE, LEAST_IN_A_SECOND = 1_000_000, 2.0
"""All stamps are within this many nanoseconds after a whole second if nanosec is not filled in, or is in another unit;
and a sensor has at least this many readings in each such second."""

SAME_STAMP_SHARE = 0.3
"""Fraction of the readings of a sensor that have the stamp of another one with a different range."""

LEAST_PAIRS = 100
"""Fewest pairs of readings of a frame whose ranges are tested for a period; few may have one at random."""

LONGEST_PERIOD = 32
"""Most sensors with one frame; no ring of sonars has more."""

REPEAT_RATIO = 0.25
"""A range differs from that of one round of sensors before by at most this fraction of the difference between
neighbours. Upper quartiles are compared, since some readings are random."""

NEIGHBOUR_DIFFERENCE = 0.3
"""Metres by which the ranges of neighbouring sensors differ in at least a quarter of the cases; less may be noise."""

REPEAT_SHARE = 0.5
"""One round of sensors apart, ranges differ by that much at most this often, relative to those of neighbours. An echo
that comes and goes may change a quarter of the ranges from one to the next, and by chance a little fewer some readings
apart, so that the quartiles are far from each other."""

LARGEST_TURN = 0.05
"""Steps between readings during which the sensor turned by more, radians, are ignored: a sensor on a servo, or on a
robot that spins, detects the same objects periodically. So are steps in which it moved by more than
`NEIGHBOUR_DIFFERENCE`: sensors that share a frame measure from one place, and after a jump back of the clock, readings
of two places alternate.
"""

LEAST_STANDSTILL = 8.0
"""Shortest standstill whose ranges are checked, seconds."""

BLOCK_LENGTH = 3.0
"""Seconds of the blocks of a standstill whose median ranges are compared."""

RANGE_CHANGE, CHANGED_SHARE = 0.4, 0.3
"""If the robot in fact drives, at least the second fraction of the medians differ from the median of all by more than
the first, metres. People who pass a standing robot change the ranges of a sensor only now and then."""

CHANGED_SENSORS = 0.6
"""Fraction of the sensors whose ranges must change: people walk in front of some, but driving changes most."""

STUCK_SHARE, STUCK_DISTANCE = 0.97, 2.0
"""A stuck sensor repeats one range to the millimetre in this fraction of its readings, over this many metres of
driving."""

STUCK_TURN = 0.5
"""The robot must have turned by this many radians as well: along a straight wall, a range stays the same."""

STOPPED_FOR, STOPPED_PAUSES = 10.0, 3.0
"""A sensor stopped if others sent readings for this many seconds after its last one, and for this many times its
longest pause before."""

FASTEST = 15.0
"""No robot with sonars drives this many metres a second; 0.2 m/s in centimetres look like 20 m/s."""

NEXT_READINGS = 4
"""The slowest of the ways to this many next readings of a sensor counts: after a jump back of the clock, readings of
two places alternate, and one of the next was measured a moment later."""

OUTLIER_SHARE, OUTLIER_SWEEPS = 0.02, 2
"""Largest fraction of the readings, and of rounds of all sensors, that should not make the map much larger; one wrong
pose affects a round."""

LEAST_AREA_RATIO = 4.0
"""The map is at least this many times as large with them."""

LEAST_AREA = 400.0
"""They add at least this many square metres; for small maps it does not matter."""


def input_warnings(readings: Readings) -> list[str]:
    """Return warnings about readings; empty if there is no suspicion."""
    if len(readings) < LEAST_READINGS:
        return []
    if text := _whole_seconds(readings):
        # the other checks compare readings in their order
        return [text]
    by_time = readings.select(np.argsort(readings.stamp, kind='stable'))
    checks = (_copies, _shared_frame, _speed, _standing, _stuck, _stopped, _extent)
    return [*(text for check in checks if (text := check(by_time))), *range_warnings(by_time)]


def _listed(names: list[str]) -> str:
    return ', '.join(names[:8]) + (f' and {len(names) - 8} more' if len(names) > 8 else '')


def _copies(readings: Readings) -> str:
    order = np.lexsort((readings.z, readings.sensor, readings.stamp))
    stamp, sensor, z = readings.stamp[order], readings.sensor[order], readings.z[order]
    same = (stamp[1:] == stamp[:-1]) & (sensor[1:] == sensor[:-1]) & (z[1:] == z[:-1])
    copies = int(np.count_nonzero(same))
    # readings that all have one stamp are another fault
    if copies < LEAST_COPIES * len(z) or len(np.unique(stamp)) < 0.1 * len(z) / max(len(readings.sensor_names), 1):
        return ''
    return (
        f'{copies} of {len(z)} readings are copies of others (same sensor, stamp and range), and their evidence '
        'counts twice: was a topic recorded twice, or do two nodes publish it? Leave one of them out (range_topics). '
        'Was a bag played twice, or in a loop? Play it once'
    )


def _whole_seconds(readings: Readings) -> str:
    """Check for stamps whose nanoseconds are not filled in or in another unit, and for constant stamps."""
    if readings.stamp.min() < 0 or np.any(readings.stamp % 1_000_000_000 >= WHOLE_SECOND_TOLERANCE):
        return ''
    most = max((len(mine) / len(np.unique(mine.stamp // 1_000_000_000)) for _, mine in sensors(readings)), default=0.0)
    if most < LEAST_IN_A_SECOND:
        return ''
    stamps = 'all stamps are equal' if np.ptp(readings.stamp) == 0 else 'all stamps are whole seconds'
    return (
        f'{stamps}, although a sensor has {most:.0f} readings at each: does the driver set header.stamp, with nanosec '
        'in nanoseconds? Readings are placed with the pose of the robot at their stamp'
    )


def _shared_frame(readings: Readings) -> str:
    suspects = []
    for name, mine in sensors(readings):
        z = mine.z
        one_pose = (turned(mine) <= LARGEST_TURN) & (np.hypot(np.diff(mine.x), np.diff(mine.y)) <= NEIGHBOUR_DIFFERENCE)
        differ = (mine.stamp[1:] == mine.stamp[:-1]) & (np.abs(np.diff(z)) > NEIGHBOUR_DIFFERENCE)
        at_once = np.count_nonzero(differ & one_pose) > SAME_STAMP_SHARE * len(z)
        steps = np.abs(np.diff(z))[one_pose]
        neighbours = float(np.quantile(steps, 0.75)) if len(steps) else 0.0
        periods = range(3, min(LONGEST_PERIOD, len(z) // 10) + 1)
        most = REPEAT_SHARE * float(np.mean(steps > NEIGHBOUR_DIFFERENCE)) if len(steps) else 0.0
        takes_turns = (
            len(steps) >= LEAST_PAIRS
            and neighbours > NEIGHBOUR_DIFFERENCE
            and any(_repeats(np.abs(z[k:] - z[:-k]), REPEAT_RATIO * neighbours, most) for k in periods)
        )
        if at_once or takes_turns:
            suspects.append(name)
    if not suspects:
        return ''
    return (
        f'the readings of frame {_listed(suspects)} alternate like those of several sensors: do all sensors have the '
        'same frame_id? Set a different one for each in its driver, with its pose; otherwise all readings are mapped '
        'from the same pose'
    )


def _repeats(differences: Floats, quartile: float, most: float) -> bool:
    """Return whether ranges that are some readings apart differ as little as those of one sensor."""
    return bool(np.quantile(differences, 0.75) < quartile and np.mean(differences > NEIGHBOUR_DIFFERENCE) <= most)


def _speed(readings: Readings) -> str:
    """Check for poses in other units than metres: most of the time, the robot seems to drive far too fast."""
    speeds = []
    for _, mine in sensors(readings):
        speed = np.full(len(mine) - NEXT_READINGS, np.inf)
        for k in range(1, NEXT_READINGS + 1):
            seconds = (mine.stamp[k:] - mine.stamp[:-k]) / 1e9
            way = np.hypot(mine.x[k:] - mine.x[:-k], mine.y[k:] - mine.y[:-k])
            # readings of a robot that stands do not count
            ahead = np.where(way > STANDSTILL_STEP[0], way, 0.0)[: len(speed)]
            after = seconds[: len(speed)]
            speed = np.minimum(speed, np.divide(ahead, after, out=np.full(len(speed), np.inf), where=after > 0.0))
        speeds.append(speed[(speed > 0.0) & np.isfinite(speed)])
    driven = np.concatenate(speeds) if speeds else np.zeros(0)
    if len(driven) < LEAST_READINGS or np.median(driven) < FASTEST:
        return ''
    return (
        f'the poses move at {np.median(driven):.0f} m/s: are they in millimetres or centimetres, or are their stamps '
        'in another unit? Poses must be in metres, and stamps in seconds: correct the odometry, or the file of poses'
    )


def _standing(readings: Readings) -> str:
    """Check for times in which odometry stands still although the ranges of most sensors change."""
    lasted = 0.0
    names, per_sensor = [], []
    for name, mine in sensors(readings):
        names.append(name)
        per_sensor.append(mine)
    if not names:
        return ''
    for begin, end in _still_times(per_sensor[0]):
        changed = [_ranges_change(mine, begin, end) for mine in per_sensor]
        judged = [change for change in changed if change is not None]
        if len(judged) >= max(1, len(names) // 2) and sum(judged) >= CHANGED_SENSORS * len(judged):
            lasted += (end - begin) / 1e9
    if not lasted:
        return ''
    return (
        f'odometry does not change for {lasted:.0f} s while the ranges of most sensors change: does the robot drive '
        'while odometry is not updated? Check its wheel encoders, or choose another odometry topic'
    )


def _still_times(mine: Readings) -> Iterable[tuple[int, int]]:
    """Yield begin and end, in nanoseconds, of the times in which a sensor did not move."""
    cuts = np.flatnonzero(moving(mine))
    for first, last in zip([0, *cuts.tolist()], [*cuts.tolist(), len(mine)], strict=True):
        # steps below the threshold may add up
        part = slice(first, last)
        wide = max(float(np.ptp(mine.x[part])), float(np.ptp(mine.y[part])))
        if mine.stamp[last - 1] - mine.stamp[first] >= LEAST_STANDSTILL * 1e9 and wide <= STANDSTILL_STEP[0]:
            yield int(mine.stamp[first]), int(mine.stamp[last - 1])


def _ranges_change(mine: Readings, begin: int, end: int) -> bool | None:
    """Return whether the ranges change as if the robot drives; None if there are too few readings."""
    inside = (mine.stamp >= begin) & (mine.stamp <= end)
    z, block = mine.z[inside], ((mine.stamp[inside] - begin) / (BLOCK_LENGTH * 1e9)).astype(np.int64)
    parts = np.split(z, np.flatnonzero(np.diff(block)) + 1)
    medians = np.array([np.median(part) for part in parts if len(part) >= LEAST_OF_PART])
    if len(medians) * BLOCK_LENGTH < LEAST_STANDSTILL / 2:
        return None
    return bool(np.mean(np.abs(medians - np.median(z)) > RANGE_CHANGE) >= CHANGED_SHARE)


def _stuck(readings: Readings) -> str:
    suspects = []
    for name, mine in sensors(readings):
        heard = mine.z[mine.echo]
        if len(heard) < STUCK_SHARE * len(mine) or not _drives_and_turns(mine):
            continue
        rounded = np.rint(heard * 1000.0).astype(np.int64)
        values, counts = np.unique(rounded, return_counts=True)
        most = int(counts.argmax())
        if counts[most] >= STUCK_SHARE * len(mine):
            suspects.append(f'{name} ({values[most] / 1000.0:.3f} m)')
    if not suspects:
        return ''
    return (
        f'sensor {_listed(suspects)} gives the same range everywhere: is it broken, or does it hear a part of the '
        'robot? Repair it, or leave out its topic'
    )


def _stopped(readings: Readings) -> str:
    """Check for sensors without readings in the last part of a drive, in which others have some."""
    missing: dict[str, float] = {}
    for drive in np.unique(readings.drive):
        together = readings.select(readings.drive == drive)
        for name, mine in sensors(together):
            rest = float(together.stamp[-1] - mine.stamp[-1]) / 1e9
            if rest >= max(STOPPED_FOR, STOPPED_PAUSES * float(np.diff(mine.stamp).max()) / 1e9):
                missing[name] = max(rest, missing.get(name, 0.0))
    if not missing:
        return ''
    return (
        f'in the last {max(missing.values()):.0f} s of a drive there are no readings of {_listed(list(missing))}, but '
        'of others: was a sensor unplugged, or did its driver stop?'
    )


def _drives_and_turns(mine: Readings) -> bool:
    path = float(np.hypot(np.diff(mine.x), np.diff(mine.y)).sum())
    return path >= STUCK_DISTANCE and float(np.ptp(np.unwrap(mine.yaw))) >= STUCK_TURN


def _extent(readings: Readings) -> str:
    """Check for a few readings without which the map would be much smaller."""
    few = min(OUTLIER_SWEEPS * len(readings.sensor_names), int(OUTLIER_SHARE * len(readings)))
    if not few:
        return ''
    boxes = cone_boxes(readings.x, readings.y, readings.yaw, readings.half_angle, readings.z)
    # how far each reading reaches to the left, right, bottom and top
    reached = np.array([[-1.0], [1.0], [-1.0], [1.0]]) * boxes
    ordered = np.sort(reached, axis=1)
    whole, rest = ordered[:, -1], ordered[:, -few - 1]
    if _area(whole) < LEAST_AREA_RATIO * _area(rest) or _area(whole) - _area(rest) < LEAST_AREA:
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
