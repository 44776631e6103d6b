"""What Range messages say of themselves before they have a pose: ranges against the limits that come with them.

A range in centimetres beside a max_range in metres is 'no echo' by REP 117, and one below a min_range in centimetres is
rejected: neither is an error, and both give a wrong map. So the values are looked at as they come.
"""

from __future__ import annotations

import math

from .message_types import RangeMessage

SAMPLES = 1024
"""Messages that are looked at; of more, ever fewer are taken, so that they are spread over the whole drive."""

ENOUGH = 30
"""Messages below which nothing is said."""

BEYOND = 1.1
"""Times max_range from which on a range lies beyond it; many drivers send a little more for 'no echo'."""

MANY = 0.15
"""Part of the finite ranges that lie beyond max_range, or below min_range, where units differ."""

SENTINEL = 0.5
"""Where one value makes up this part of those beyond, it is what the driver sends for 'no echo'."""

FARTHEST = 100.0
"""Metres that no sonar measures, and hardly any other Range sensor."""

NEAR = 0.2
"""Part of such a max_range within which all ranges lie where it alone is wrong."""

STATED = 1e6
"""A max_range from which on none is stated: drivers send the largest number they know."""

UNITS = {'feet': 3.281, 'inches': 39.37, 'centimetres': 100.0, 'millimetres': 1000.0}
"""How many of them a metre has."""


class LimitWatch:
    """Takes Range messages and says whether ranges and limits seem to be in different units."""

    def __init__(self) -> None:
        self.clear()

    def clear(self) -> None:
        """Forget all messages."""
        self._samples: list[RangeMessage] = []
        self._every, self._count = 1, 0

    def add(self, message: RangeMessage) -> None:
        """Look at a message; costs next to nothing for most of them."""
        self._count += 1
        if self._count % self._every:
            return
        self._samples.append(message)
        if len(self._samples) == SAMPLES:
            del self._samples[::2]
            self._every *= 2

    def warnings(self) -> list[str]:
        """Return what seems to be wrong; empty if nothing is."""
        finite = [m for m in self._samples if math.isfinite(m.range) and m.range > 0 and 0 < m.max_range < math.inf]
        if len(finite) < ENOUGH:
            return []
        # one cause has several symptoms; the first that is reported is enough
        first = next((text for check in (_beyond, _far, _below) if (text := check(finite))), '')
        return [first] if first else []


def _beyond(messages: list[RangeMessage]) -> str:
    ratios = sorted(m.range / m.max_range for m in messages if m.range > BEYOND * m.max_range)
    values = [m.range for m in messages if m.range > BEYOND * m.max_range]
    if len(values) < MANY * len(messages) or values.count(max(set(values), key=values.count)) > SENTINEL * len(values):
        return ''
    # the farthest echoes come near max_range, whatever their unit
    ratio = ratios[int(0.98 * (len(ratios) - 1))]
    unit = min(UNITS, key=lambda name: abs(math.log(UNITS[name] / ratio)))
    limit = sorted(m.max_range for m in messages)[len(messages) // 2]
    return (
        f'{len(values)} of {len(messages)} ranges looked at are larger than max_range ({limit:g} m), up to '
        f'{ratio:.0f} times as large, and so count as no echo: are the ranges in {unit} and the limits in metres? '
        f'Messages must state metres; correct the driver'
    )


def _below(messages: list[RangeMessage]) -> str:
    # limits that contradict each other are rejected for that
    below = [m for m in messages if m.range < m.min_range < m.max_range]
    if len(below) < MANY * len(messages):
        return ''
    ratios = sorted(m.min_range / m.range for m in below)
    limit = sorted(m.min_range for m in messages)[len(messages) // 2]
    # a sonar's blind zone is a few centimetres, and its limits have one unit
    if limit < 1.0 and ratios[len(ratios) // 2] < 2.0:
        return ''
    return (
        f'{len(below)} of {len(messages)} ranges looked at are below min_range ({limit:g} m), and so are rejected: are '
        f'the limits in centimetres or millimetres and the ranges in metres? Messages '
        f'must state metres; correct the driver'
    )


def _far(messages: list[RangeMessage]) -> str:
    # in a corridor most ranges are short
    large = sorted(m.range for m in messages)[9 * len(messages) // 10]
    limit = sorted(m.max_range for m in messages)[len(messages) // 2]
    if limit < FARTHEST:
        return ''
    if large > FARTHEST:
        return (
            f'a tenth of the ranges is larger than {large:.0f} m, and max_range is {limit:.4g} m, farther than sonars '
            f'hear: are ranges and limits in centimetres or millimetres? Messages must state metres; correct the driver'
        )
    farthest = max((m.range for m in messages if m.range < m.max_range), default=0.0)
    if farthest > NEAR * limit:
        return ''
    cause = 'is it in centimetres or millimetres' if limit < STATED else 'does the driver state no limit'
    return (
        f'max_range is {limit:.4g} m, and no range is larger than {farthest:.1f} m: {cause}? A reading without echo is '
        f'taken to say that all is free up to max_range; correct the driver, or set the parameter max_range'
    )
