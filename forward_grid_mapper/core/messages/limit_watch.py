"""Checks of Range messages before association: ranges in other units than their limits.

A range in centimetres with a max_range in metres is 'no echo' by REP 117, and one below a min_range in centimetres is
rejected. Neither is an error, but both give a wrong map. So the values of incoming messages are checked: those of all
sensors together, since most robots have one driver for all, and if there is no suspicion, those of each sensor.
"""

from __future__ import annotations

import math
from typing import Any

import numpy as np
from numpy.typing import NDArray

from ..common.readings import Floats
from .message_batch import Ranges
from .message_types import RangeMessage
from .sensor_records import record_of

SAMPLES = 256
"""Most messages of a sensor that are sampled; they are spread over the whole drive. Those that tell nothing about units
are left out: a sensor may seldom have an echo."""

LEAST_MESSAGES = 30
"""Fewest messages for a check."""

BEYOND_RATIO = 1.1
"""A range is beyond max_range if it is this many times as large; many drivers send a little more for 'no echo'."""

MANY_OF_ALL, MANY_OF_ONE = 0.15, 0.3
"""Fractions of the finite ranges that are beyond max_range, or below min_range, if units differ: of all sensors, which
may be of several kinds, also without the one with the most such ranges; and of one sensor."""

SENTINEL_SHARE = 0.5
"""If one value has this fraction of the ranges beyond, the driver sends it for 'no echo'."""

LONGEST_RANGE = 100.0
"""Metres; no sonar measures so far, and hardly any other Range sensor."""

REACHED_SHARE = 0.2
"""If all ranges are within this fraction of such a max_range, only max_range is wrong."""

LARGEST_STATED = 1e6
"""From this value on, max_range is taken as not stated: drivers send the largest number."""

UNITS = {'feet': 3.281, 'inches': 39.37, 'centimetres': 100.0, 'millimetres': 1000.0}
"""Units in a metre, in increasing order."""


class _Samples:
    """Ranges and limits of messages of a sensor, spread over the whole drive."""

    def __init__(self) -> None:
        # range, min_range and max_range of each
        self._values = np.empty((SAMPLES, 3))
        self._held, self._every, self._count = 0, 1, 0

    @property
    def values(self) -> Floats:
        """Ranges, least ranges and largest ranges, shape (N, 3)."""
        return self._values[: self._held]

    def add(self, range: float, least: float, limit: float) -> None:
        """Count a message, and sample it if it is its turn."""
        self._count += 1
        if self._count % self._every:
            return
        self._values[self._held] = range, least, limit
        self._held += 1
        self._halve()

    def add_all(self, values: Floats) -> None:
        """Apply `add` to each row, shape (N, 3)."""
        done = 0
        while done < len(values):
            # the next sample, and as many as there is space for
            skip = self._every - 1 - self._count % self._every
            taken = values[done + skip :: self._every][: SAMPLES - self._held]
            if not len(taken):
                break
            step = skip + 1 + (len(taken) - 1) * self._every
            self._values[self._held : self._held + len(taken)] = taken
            self._held, self._count, done = self._held + len(taken), self._count + step, done + step
            self._halve()
        self._count += len(values) - done

    def _halve(self) -> None:
        """If the samples are full, drop every second one, and sample half as often from now on."""
        if self._held == SAMPLES:
            self._held //= 2
            self._values[: self._held] = self._values[1::2].copy()
            self._every *= 2


class LimitWatch:
    """Samples Range messages and warns if ranges and limits seem to be in different units."""

    def __init__(self) -> None:
        self._of: dict[str, _Samples] = {}

    def clear(self) -> None:
        """Remove all samples."""
        self._of.clear()

    def add(self, message: RangeMessage, given: float = 0.0) -> None:
        """Take a message; `given` is the parameter `max_range`, 0 if it is not set.

        That of the message is wrong then if no sonar measures so far, or if it is smaller. A larger one may be right:
        the user may want to map only what is near.
        """
        if samples := record_of(self._of, message.frame_id, _Samples):
            limit = message.max_range
            if given:
                limit = max(limit, given) if limit < LONGEST_RANGE else given
            if _usable(message.range, message.min_range, limit):
                samples.add(message.range, message.min_range, limit)

    def add_all(self, messages: Ranges, given: float = 0.0) -> None:
        """Apply `add` to many messages."""
        limits = messages.max_range
        if given:
            limits = np.where(limits < LONGEST_RANGE, np.maximum(limits, given), given)
        values = np.stack([messages.range, messages.min_range, limits], axis=1)
        usable = _usable(*values.T)
        for frame, part in messages.of_each():
            if samples := record_of(self._of, frame, _Samples):
                samples.add_all(values[part][usable[part]])

    def warnings(self) -> list[str]:
        """Return warnings; empty if there is no suspicion."""
        if not self._of:
            return []
        values = [samples.values for samples in self._of.values()]
        counts = [len(of_one) for of_one in values]
        # if only one of several has ranges, there are none to compare with
        alone = len(values) > 1 and np.count_nonzero(counts) == 1
        if of_all := _suspicion(np.concatenate(values), None if alone else np.repeat(np.arange(len(values)), counts)):
            return [of_all]
        found = {frame: _suspicion(samples.values) for frame, samples in sorted(self._of.items())}
        return [f'sensor {frame}: {suspicion}' for frame, suspicion in found.items() if suspicion]

    @property
    def impossible(self) -> str:
        """What is wrong with max_range, if no sonar measures so far; '' if it is plausible, or if none is stated.

        A map with such a limit takes minutes, and shows nothing but the error.
        """
        values = np.concatenate([np.empty((0, 3)), *(samples.values for samples in self._of.values())])
        if len(values) < LEAST_MESSAGES or _middle(values[:, 2]) >= LARGEST_STATED:
            return ''
        return _limits_too_large(values.T)


def _usable(ranges: Any, least: Any, limits: Any) -> Any:
    """Return whether messages have a range and limits that do not contradict each other; of numbers or arrays."""
    # NaN is never smaller
    return (ranges > 0) & (ranges < math.inf) & (limits > 0) & (limits < math.inf) & (least <= limits)


def _suspicion(values: Floats, sensor: NDArray[np.int64] | None = None) -> str:
    """Return what is wrong with ranges and limits, in words; '' if there is no suspicion.

    Parameters
    ----------
    values : float64, shape (N, 3)
        Ranges, least ranges and largest ranges.
    sensor : int64, shape (N,), optional
        The sensor of each, if they are those of all sensors.
    """
    if len(values) < LEAST_MESSAGES:
        return ''
    finite = values.T
    # one cause has several symptoms; the first that is reported is enough
    return _larger_than_limits(finite, sensor) or _limits_too_large(finite) or _smaller_than_limits(finite, sensor)


def _are_many(found: NDArray[np.bool_], sensor: NDArray[np.int64] | None) -> bool:
    """Return whether ranges with a symptom are so many, and of so many sensors, that their units must differ."""
    count = np.count_nonzero(found)
    if sensor is None:
        return bool(count >= MANY_OF_ONE * len(found))
    # wrong units are those of the driver, while a single sensor may be covered or broken
    by_sensor, of_sensor = np.bincount(sensor[found], minlength=1), np.bincount(sensor)
    most = int(by_sensor.argmax())
    rest = len(found) - of_sensor[most]
    return bool(count >= MANY_OF_ALL * len(found) and count - by_sensor[most] >= MANY_OF_ALL * rest)


def _larger_than_limits(samples: Floats, sensor: NDArray[np.int64] | None) -> str:
    ranges, _, limits = samples
    beyond = ranges > BEYOND_RATIO * limits
    counts = np.unique(ranges[beyond], return_counts=True)[1]
    count = int(counts.sum())
    if not _are_many(beyond, sensor) or counts.max() > SENTINEL_SHARE * count:
        return ''
    # no echo comes from beyond max_range, whatever its unit
    ratio = _quantile(0.98, (ranges / limits)[beyond])
    unit = next((name for name, count in UNITS.items() if ratio < BEYOND_RATIO * count), 'millimetres')
    return (
        f'{count} of {len(ranges)} examined ranges are larger than max_range ({_middle(limits):g} m), up to '
        f'{ratio:.0f} times as large, and so are treated as no echo: are the ranges in {unit} and the limits in '
        'metres? Messages must state metres; correct the driver'
    )


def _smaller_than_limits(samples: Floats, sensor: NDArray[np.int64] | None) -> str:
    ranges, least, limits = samples
    # for fixed-distance rangers, both limits are equal
    below = (ranges < least) & (least < limits)
    count = int(below.sum())
    if not _are_many(below, sensor):
        return ''
    limit = _middle(least)
    # a sonar's blind zone is a few centimetres, and its limits have one unit; a single sensor may be covered by dirt
    if limit < 1.0 and (sensor is None or _middle((least / ranges)[below]) < 2.0):
        return ''
    return (
        f'{count} of {len(ranges)} examined ranges are below min_range ({limit:g} m), and so are rejected: are '
        f'the limits in centimetres or millimetres and the ranges in metres? Messages '
        f'must state metres; correct the driver'
    )


def _limits_too_large(samples: Floats) -> str:
    ranges, _, limits = samples
    limit = _middle(limits)
    if limit < LONGEST_RANGE:
        return ''
    # in a corridor most ranges are short
    large = _quantile(0.9, ranges)
    if large > LONGEST_RANGE:
        return (
            f'a tenth of the ranges is larger than {large:.0f} m, and max_range is {limit:.4g} m, farther than sonars '
            'can measure: are ranges and limits in centimetres or millimetres? Messages must state metres; correct '
            'the driver'
        )
    farthest = ranges[ranges < limits].max(initial=0.0)
    if farthest > REACHED_SHARE * limit:
        return ''
    cause = 'is it in centimetres or millimetres' if limit < LARGEST_STATED else 'does the driver state no limit'
    return (
        f'max_range is {limit:.4g} m, and no range is larger than {farthest:.1f} m: {cause}? A reading without an '
        'echo is evidence for free space up to max_range; correct the driver, or set the parameter max_range'
    )


def _middle(values: Floats) -> float:
    return float(np.sort(values)[len(values) // 2])


def _quantile(part: float, values: Floats) -> float:
    """Return the quantile `part` of values."""
    return float(np.sort(values)[int(part * (len(values) - 1))])
