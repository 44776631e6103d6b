"""Changes between drives: a door that was closed in one and open in another, or furniture that was moved.

The map of all drives can show only one state. If a place is free on it, echoes of the drive with an object there are
unexplained. A change is reported where many of them are close together, and readings of other drives in the same
direction have echoes from beyond.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from .common.readings import Readings
from .maps.map_set import MapSet

EDGE = 0.6
"""Side of the square of a place, metres: a door is a little wider."""

UNEXPLAINED = 5
"""Fewest unexplained echoes in a place that is examined."""

ENOUGH, PASSED = 10, 6
"""Fewest echoes of the one drive, and fewest readings of the others that pass: fewer are due to chance or people."""

AGAINST, SHARE = 0.2, 0.5
"""Most passing readings of the one drive for each of its echoes, and most echoes of the others for each of their
passing readings: the edge of a cone meets the frame of an open door."""

BESIDE = 0.15
"""Largest distance of the axis of a reading from the middle of the place, metres."""

SLANT = np.radians(30.0)
"""Largest angle between readings that are compared, radians: sound at a slant passes smooth walls."""

MARGIN = 0.3
"""Metres within which the range of a reading ends at the place; longer ones pass it."""

NAMED = 3


class Change(NamedTuple):
    """A changed place, metres: `echoes` of `drive` end there, and `passed` readings of other drives pass it."""

    drive: int
    x: float
    y: float
    echoes: int
    passed: int


def changes(maps: MapSet, drives: int) -> list[Change]:
    """Return the changed places, those with most echoes first."""
    found = [change for number in range(drives) for change in _of(maps, number)]
    return sorted(found, key=lambda change: (-change.echoes, change.drive, change.x, change.y))


def _of(maps: MapSet, number: int) -> Iterator[Change]:
    """Yield the places at which one drive has an object and the others have none."""
    readings = maps.readings
    end = np.stack([readings.x + readings.z * np.cos(readings.yaw), readings.y + readings.z * np.sin(readings.yaw)], 1)
    row, column = maps.grid.cells_of(end[:, 0], end[:, 1])
    inside = (row >= 0) & (row < maps.grid.height) & (column >= 0) & (column < maps.grid.width)
    odd = maps.unexplained & readings.echo & (readings.drive == number) & inside
    odd[odd] = maps.ml[row[odd], column[odd]] == 0
    remaining = end[odd]
    # the densest place first, and then the remaining echoes
    while len(remaining) >= UNEXPLAINED:
        bins, counts = np.unique(np.floor(remaining / EDGE), axis=0, return_counts=True)
        if counts.max() < UNEXPLAINED / 2:
            return
        place = _densest(remaining, (bins[counts.argmax()] + 0.5) * EDGE)
        change = _change_at(readings, number, place)
        if change is not None:
            yield change
        remaining = remaining[(np.abs(remaining - place) > EDGE).any(axis=1)]


def _densest(points: NDArray[np.float64], place: NDArray[np.float64]) -> NDArray[np.float64]:
    """Return the local mean of points near a place (mean shift)."""
    for _ in range(3):
        here = (np.abs(points - place) <= EDGE / 2).all(axis=1)
        place = points[here].mean(axis=0) if here.any() else place
    return place


def _change_at(readings: Readings, number: int, place: NDArray[np.float64]) -> Change | None:
    """Return the change at a place; None if there is none."""
    away = place - np.stack([readings.x, readings.y], axis=1)
    axis = np.stack([np.cos(readings.yaw), np.sin(readings.yaw)], axis=1)
    along, beside = (away * axis).sum(axis=1), np.abs(away[:, 0] * axis[:, 1] - away[:, 1] * axis[:, 0])
    towards = readings.echo & (along > 0) & (beside <= BESIDE)
    ends = towards & (np.abs(readings.z - along) <= MARGIN)
    goes_on = towards & (readings.z > along + MARGIN)
    own = readings.drive == number
    echoes = int((ends & own).sum())
    if echoes < ENOUGH or (goes_on & own).sum() > AGAINST * echoes:
        return None
    # directions are modulo a half turn
    direction = np.angle(np.exp(2j * readings.yaw[ends & own]).sum()) / 2
    alike = np.abs(np.angle(np.exp(2j * (readings.yaw - direction)))) / 2 <= SLANT
    passed = int((goes_on & alike & ~own).sum())
    if passed < PASSED or (ends & alike & ~own).sum() > SHARE * passed:
        return None
    return Change(number, float(place[0]), float(place[1]), echoes, passed)


def change_warnings(maps: MapSet, names: Sequence[str]) -> list[str]:
    """Return warnings about changed places, at most `NAMED` of them; empty if there is none."""
    found = changes(maps, len(names)) if len(names) > 1 else []
    texts = [
        f'there was an obstacle at x = {change.x:.1f} m, y = {change.y:.1f} m during {names[change.drive]} '
        f'({change.echoes} echoes) and not during other drives ({change.passed} readings of theirs pass): was a door '
        'shut, or an object moved? The map is free there'
        for change in found[:NAMED]
    ]
    if len(found) > NAMED:
        texts.append(f'and drives contradict each other at {len(found) - NAMED} more places')
    return texts
