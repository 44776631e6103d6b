"""Warnings about readings and odometry that were rejected: which are too many, of which sensors, and what to do."""

from __future__ import annotations

from collections import Counter
from collections.abc import Container, Mapping

from .rep117 import ODOMETRY_REASONS, REASONS, SILENT_DRIVER

_BROKEN = (
    'is the sensor dead or not connected, or is something always in front of it? Repair it, or leave out its topic; '
    'with invalid_range = no_echo, all space in front of it would be mapped as free'
)
"""If it is nearly all readings of a single sensor, they do not stand for 'no echo'."""

MANY_REJECTED = 0.2
"""Fraction of the readings whose rejection for one reason gives a warning."""

NEARLY_ALL, LEAST_READINGS = 0.9, 30
"""Fraction of the readings of one sensor whose rejection for one reason gives a warning, however few they are among
all; and their least number."""

NO_ECHO_REASONS, NO_ECHO_REJECTED, MOST_NO_ECHO = ('nan_range', 'too_near', 'below_min_range'), 0.05, 0.01
"""Reasons for which values that drivers send for 'no echo' are rejected. If at least the first fraction of the readings
of most sensors is rejected so, and at most the second fraction of all others has no echo, they stand for it."""

LEAST_NAN_SENSORS = 2
"""This many sensors suffice for NaN: a single one may be broken."""

PAUSED = 'paused'
"""The reason for readings that came while the user had paused mapping: they say nothing about sensors."""

CHOSEN_BY_USER = {'over_range'}
"""Reasons that the user chose, which are no fault of a sensor: there may be no object in its direction."""

OF_ROBOTS, OF_FLOORS = ('base_link', 'base_footprint'), ('odom', 'map')
"""Usual names of frames of robots, and of fixed frames."""


def rejection_warnings(
    rejected: Mapping[str, int],
    received: int,
    what: str = 'readings',
    known: Container[str] = (),
    dead: Mapping[str, int] | None = None,
) -> list[str]:
    """Return a warning for each reason, other than known ones, for which many of the readings were rejected.

    Those that came during a pause do not count, nor those of dead sensors by reason, from `of_dead_sensors`.
    """
    dead = dead or {}
    judged = received - rejected.get(PAUSED, 0) - sum(dead.values())
    counts = {reason: count - dead.get(reason, 0) for reason, count in rejected.items()}
    return [
        f'{count} of {judged} {what} were rejected as {reason}: {REASONS[reason]}'
        for reason, count in counts.items()
        if count > MANY_REJECTED * judged and reason not in known and reason != PAUSED
    ]


def of_dead_sensors(by_frame: Mapping[str, Mapping[str, int]], accepted: Mapping[str, tuple[int, int]]) -> Counter[str]:
    """Return the rejected readings of dead sensors, by reason; the parameters are those of `sensor_rejections`.

    Nearly all readings of a dead sensor are values that drivers send for 'no echo', and the other sensors hardly send
    them. Otherwise they stand for 'no echo', and the sensor only has nothing within range.
    """
    counts = {frame: _without_paused(by_frame.get(frame, {})) for frame in {*by_frame, *accepted}}
    received = {frame: sum(each.values()) + accepted.get(frame, (0, 0))[0] for frame, each in counts.items()}
    dead: Counter[str] = Counter()
    for reason in NO_ECHO_REASONS:
        of_reason = {frame: each.get(reason, 0) for frame, each in counts.items() if received[frame]}
        lost = {frame for frame, n in of_reason.items() if n >= max(NEARLY_ALL * received[frame], LEAST_READINGS)}
        others = of_reason.keys() - lost
        if len(others) >= len(lost) and all(of_reason[each] < NO_ECHO_REJECTED * received[each] for each in others):
            dead[reason] = sum(of_reason[frame] for frame in lost)
    return +dead


def swapped_frames(frame_id: str, child_frame_id: str) -> list[str]:
    """Return a warning if usual names of the frames of odometry are swapped, or none; a name may have a prefix."""
    fixed, moving = (frame.rpartition('/')[2] for frame in (frame_id, child_frame_id))
    if fixed not in OF_ROBOTS and moving not in OF_FLOORS:
        return []
    return [
        f'odometry has frame_id {frame_id} and child_frame_id {child_frame_id or "(none)"}: the first must be the '
        'fixed frame, such as odom, and the second that of the robot, such as base_link (REP 105); correct its '
        'driver, otherwise the maps are in the wrong frame'
    ]


def odometry_rejections(
    rejected: Mapping[str, int], received: int, least: float = 0.0, what: str = 'odometry messages'
) -> list[str]:
    """Return a warning for each reason for which more than a fraction `least` of odometry was rejected."""
    return [
        f'{count} of {received} {what} were rejected: {ODOMETRY_REASONS[reason]}'
        for reason, count in rejected.items()
        if count > least * received
    ]


def sensor_rejections(
    by_frame: Mapping[str, Mapping[str, int]], accepted: Mapping[str, tuple[int, int]], known: Container[str] = ()
) -> list[str]:
    """Return a warning for each reason, other than known ones, for which nearly all readings of a sensor are rejected.

    There is one as well if those without an echo are rejected, of all sensors: the map lacks their free space. There is
    none for reasons that the user chose, for those that are frequent among the readings of other sensors
    (`rejection_warnings`), and if no sensor works. Readings that came during a pause do not count.

    Parameters
    ----------
    by_frame : mapping of str to mapping of str to int
        Number of rejected readings of each frame, by reason.
    accepted : mapping of str to (int, int)
        From `ReadingBuffer.counts`.
    """
    by_frame = {frame: judged for frame, counts in by_frame.items() if (judged := _without_paused(counts))}
    rejected: Counter[str] = sum(map(Counter, by_frame.values()), Counter())
    dead = of_dead_sensors(by_frame, accepted)
    many = MANY_REJECTED * (rejected.total() + sum(count for count, _ in accepted.values()) - dead.total())
    lost: dict[str, list[str]] = {}
    for frame, counts in by_frame.items():
        received = sum(counts.values()) + accepted.get(frame, (0, 0))[0]
        reason = max(counts, key=lambda each: counts[each])
        reported = not frame or reason in CHOSEN_BY_USER or reason in known or rejected[reason] - dead[reason] > many
        if counts[reason] >= max(NEARLY_ALL * received, LEAST_READINGS) and not reported:
            lost.setdefault(reason, []).append(frame)
    if not set(accepted).difference(*lost.values()):
        return []
    return [
        f'nearly all readings of {", ".join(sorted(frames)[:8])}{f" and {len(frames) - 8} more" * (len(frames) > 8)} '
        f'were rejected as {reason}: {_BROKEN if reason in NO_ECHO_REASONS else REASONS[reason]}'
        for reason, frames in lost.items()
    ] + _instead_of_no_echo(by_frame, accepted, rejected, {*lost, *(each for each in NO_ECHO_REASONS if each in known)})


def _without_paused(counts: Mapping[str, int]) -> dict[str, int]:
    return {reason: count for reason, count in counts.items() if reason != PAUSED}


def _instead_of_no_echo(
    by_frame: Mapping[str, Mapping[str, int]],
    accepted: Mapping[str, tuple[int, int]],
    rejected: Mapping[str, int],
    known: Container[str],
) -> list[str]:
    """Return a warning if the driver sends a value for 'no echo' that is rejected, even if that happens seldom."""
    used, silent = (sum(numbers[k] for numbers in accepted.values()) for k in (0, 1))
    received = used + sum(rejected.values())
    if silent > MOST_NO_ECHO * used:
        return []
    warnings = []
    for reason in NO_ECHO_REASONS:
        count = rejected.get(reason, 0)
        # an object may be too near to some sensors for a while
        shares = [
            by_frame.get(frame, {}).get(reason, 0) / (sum(by_frame.get(frame, {}).values()) + numbers[0])
            for frame, numbers in accepted.items()
            # a sensor of which all readings were left out is known, but has no count
            if numbers[0] or by_frame.get(frame)
        ]
        concerned, fewest = sum(share >= NO_ECHO_REJECTED for share in shares), NO_ECHO_REJECTED * received
        enough = concerned > len(shares) / 2
        if reason == 'nan_range':
            # no object makes a range NaN, so a few sensors of a robot in a small room suffice
            enough, fewest = concerned >= LEAST_NAN_SENSORS, 0.0
        if enough and max(fewest, LEAST_READINGS) <= count <= MANY_REJECTED * received and reason not in known:
            warnings.append(
                f'{count} of {received} readings were rejected as {reason}, and no other reading is without an echo: '
                f'does the driver send this if there is no echo? {SILENT_DRIVER[0].upper()}{SILENT_DRIVER[1:]}'
            )
    return warnings
