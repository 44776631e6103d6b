"""Places that several drives contradict: a door that was shut in one and open in another, furniture that was moved.

The map of all drives can show only one of both. Where it is free, echoes of the drive that met something there are
unexplained. They are told where they gather, and where readings of other drives that look the same way go on and hear
an echo from beyond.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from .common.readings import Readings
from .maps.map_set import MapSet

EDGE = 0.6
"""Metres of a place: a door is little wider."""

UNEXPLAINED = 5
"""Unexplained echoes in one place from where on it is looked at."""

ENOUGH, PASSED = 10, 6
"""Echoes of the one drive, and readings of the others that go on: fewer come about by chance, or by who walks by."""

AGAINST, SHARE = 0.2, 0.5
"""How many of its readings may go on for each of these echoes, and how many of the others' may end there for each that
goes on: the edge of a cone meets the frame of an open door."""

BESIDE = 0.15
"""Metres by which the axis of a reading may miss the middle of the place."""

SLANT = np.radians(30.0)
"""How much readings may look another way: a smooth wall is passed by what meets it at a slant."""

MARGIN = 0.3
"""Metres by which an echo is from somewhere else than the place."""

NAMED = 3


class Change(NamedTuple):
    """A place, in metres: `echoes` of `drive` end there, `passed` readings of other drives go on."""

    drive: int
    x: float
    y: float
    echoes: int
    passed: int


def changes(maps: MapSet, drives: int) -> list[Change]:
    """Return the places that drives contradict, those with most echoes first."""
    found = [change for number in range(drives) for change in _of(maps, number)]
    return sorted(found, key=lambda change: (-change.echoes, change.drive, change.x, change.y))


def _of(maps: MapSet, number: int) -> Iterator[Change]:
    """Yield the places where one drive met what the others did not."""
    readings = maps.readings
    end = np.stack([readings.x + readings.z * np.cos(readings.yaw), readings.y + readings.z * np.sin(readings.yaw)], 1)
    row, column = maps.grid.cells_of(end[:, 0], end[:, 1])
    inside = (row >= 0) & (row < maps.grid.height) & (column >= 0) & (column < maps.grid.width)
    odd = maps.unexplained & readings.echo & (readings.drive == number) & inside
    odd[odd] = maps.ml[row[odd], column[odd]] == 0
    left = end[odd]
    # the densest place first, and then what is left beside it
    while len(left) >= UNEXPLAINED:
        bins, counts = np.unique(np.floor(left / EDGE), axis=0, return_counts=True)
        if counts.max() < UNEXPLAINED / 2:
            return
        place = _densest(left, (bins[counts.argmax()] + 0.5) * EDGE)
        change = _judged(readings, number, place)
        if change is not None:
            yield change
        left = left[(np.abs(left - place) > EDGE).any(axis=1)]


def _densest(points: NDArray[np.float64], place: NDArray[np.float64]) -> NDArray[np.float64]:
    """Return the middle of the points about a place, which is moved there."""
    for _ in range(3):
        here = (np.abs(points - place) <= EDGE / 2).all(axis=1)
        place = points[here].mean(axis=0) if here.any() else place
    return place


def _judged(readings: Readings, number: int, place: NDArray[np.float64]) -> Change | None:
    """Return what the drives say of a place, if they contradict each other."""
    away = place - np.stack([readings.x, readings.y], axis=1)
    axis = np.stack([np.cos(readings.yaw), np.sin(readings.yaw)], axis=1)
    along, beside = (away * axis).sum(axis=1), np.abs(away[:, 0] * axis[:, 1] - away[:, 1] * axis[:, 0])
    looks = readings.echo & (along > 0) & (beside <= BESIDE)
    ends = looks & (np.abs(readings.z - along) <= MARGIN)
    goes_on = looks & (readings.z > along + MARGIN)
    own = readings.drive == number
    echoes = int((ends & own).sum())
    if echoes < ENOUGH or (goes_on & own).sum() > AGAINST * echoes:
        return None
    # directions are the same to both sides
    way = np.angle(np.exp(2j * readings.yaw[ends & own]).sum()) / 2
    alike = np.abs(np.angle(np.exp(2j * (readings.yaw - way)))) / 2 <= SLANT
    passed = int((goes_on & alike & ~own).sum())
    if passed < PASSED or (ends & alike & ~own).sum() > SHARE * passed:
        return None
    return Change(number, float(place[0]), float(place[1]), echoes, passed)


def change_warnings(maps: MapSet, names: Sequence[str]) -> list[str]:
    """Return a warning for the places that drives contradict, `NAMED` of them at the most; empty if there is none."""
    found = changes(maps, len(names)) if len(names) > 1 else []
    told = [
        f'there was an obstacle at x = {change.x:.1f} m, y = {change.y:.1f} m during {names[change.drive]} '
        f'({change.echoes} echoes) and not during other drives ({change.passed} readings of theirs pass): was a door '
        'shut, or an object moved? The map is free there'
        for change in found[:NAMED]
    ]
    if len(found) > NAMED:
        told.append(f'and drives contradict each other at {len(found) - NAMED} more places')
    return told
