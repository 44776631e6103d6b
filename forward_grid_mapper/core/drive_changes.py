"""Changes between drives: a door that was closed in one and open in another, or furniture that was moved.

The map of all drives can show only one state. If a place is free on it, echoes of the drive with an object there are
unexplained. A change is reported where many of them are close together, and readings of other drives in the same
direction have echoes from beyond.
"""

from __future__ import annotations

import itertools
from collections.abc import Iterator, Sequence
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from .common.readings import Readings
from .maps.map_set import MapSet

PLACE_SIZE = 0.6
"""Side of the square of a place, metres: a door is a little wider."""

LEAST_UNEXPLAINED = 5
"""Fewest unexplained echoes in a place that is examined."""

LEAST_ECHOES, LEAST_PASSED = 10, 6
"""Fewest echoes of the one drive, and fewest readings of the others that pass: fewer are due to chance or people."""

MOST_PASSED_BY_OWN, MOST_ECHOES_OF_OTHERS = 0.2, 0.5
"""Most passing readings of the one drive for each of its echoes, and most echoes of the others for each of their
passing readings: the edge of a cone meets the frame of an open door."""

AXIS_TOLERANCE = 0.15
"""Largest distance of the axis of a reading from the middle of the place, metres."""

LARGEST_ANGLE = np.radians(30.0)
"""Largest angle between readings that are compared, radians: sound at a slant passes smooth walls."""

END_TOLERANCE = 0.3
"""Metres within which the range of a reading ends at the place; longer ones pass it."""

NEIGHBOUR_SQUARES = 3
"""Squares to each side of the one with the most echoes that the local mean, and the place around it, may touch."""

MOST_NAMED = 3


class Change(NamedTuple):
    """A changed place, metres: `echoes` of `drive` end there, and `passed` readings of other drives pass it."""

    drive: int
    x: float
    y: float
    echoes: int
    passed: int


def changes(maps: MapSet, drives: int) -> list[Change]:
    """Return the changed places, those with most echoes first."""
    found = [change for number in range(drives) for change in _changes_of(maps, number)]
    return sorted(found, key=lambda change: (-change.echoes, change.drive, change.x, change.y))


def _changes_of(maps: MapSet, number: int) -> Iterator[Change]:
    """Yield the places at which one drive has an object and the others have none."""
    readings = maps.readings
    end = _ends(readings)
    row, column = maps.grid.cells_of(end[:, 0], end[:, 1])
    inside = (row >= 0) & (row < maps.grid.height) & (column >= 0) & (column < maps.grid.width)
    mine = readings.drive == number
    odd = maps.unexplained & readings.echo & mine & inside
    odd[odd] = maps.ml[row[odd], column[odd]] == 0
    if np.count_nonzero(odd) < LEAST_UNEXPLAINED:
        return
    own, others = (_SortedEchoes(readings.select(readings.echo & each)) for each in (mine, ~mine))
    for place in _places(end[odd]):
        change = _change_at(own, others, number, place)
        if change is not None:
            yield change


def _ends(readings: Readings) -> NDArray[np.float64]:
    """Return the point at the range of each reading on its axis, shape (N, 2), metres."""
    x, y = readings.x + readings.z * np.cos(readings.yaw), readings.y + readings.z * np.sin(readings.yaw)
    return np.stack([x, y], axis=1)


def _places(points: NDArray[np.float64]) -> Iterator[NDArray[np.float64]]:
    """Yield the places with the most points, each without the points of the places before it."""
    # a long drive has thousands of places, so each looks only at the squares around it
    squares, of, counts = np.unique(np.floor(points / PLACE_SIZE), axis=0, return_inverse=True, return_counts=True)
    of = of.ravel()
    number = {(x, y): k for k, (x, y) in enumerate(squares.tolist())}
    of_square = np.split(np.argsort(of, kind='stable'), np.cumsum(counts)[:-1])
    left, remaining = np.ones(len(points), np.bool_), len(points)
    while remaining >= LEAST_UNEXPLAINED and counts.max() >= LEAST_UNEXPLAINED / 2:
        x, y = squares[counts.argmax()].tolist()
        squares_around = np.arange(-NEIGHBOUR_SQUARES, NEIGHBOUR_SQUARES + 1)
        around = itertools.product(x + squares_around, y + squares_around)
        near = np.sort(np.concatenate([of_square[number[each]] for each in around if each in number]))
        near = near[left[near]]
        place = _densest(points[near], np.array([x + 0.5, y + 0.5]) * PLACE_SIZE)
        yield place
        gone = near[(np.abs(points[near] - place) <= PLACE_SIZE).all(axis=1)]
        left[gone] = False
        np.subtract.at(counts, of[gone], 1)
        remaining -= len(gone)


def _densest(points: NDArray[np.float64], place: NDArray[np.float64]) -> NDArray[np.float64]:
    """Return the local mean of points near a place (mean shift)."""
    for _ in range(3):
        here = (np.abs(points - place) <= PLACE_SIZE / 2).all(axis=1)
        place = points[here].mean(axis=0) if here.any() else place
    return place


class _SortedEchoes:
    """Readings with an echo, sorted, so that those near a place are found without a pass over all of them."""

    def __init__(self, readings: Readings) -> None:
        r = readings.select(np.argsort(readings.x, kind='stable'))
        self._rows = np.stack([r.x, r.y, np.cos(r.yaw), np.sin(r.yaw), r.z, r.yaw])
        # from farther away, no axis ends at a place or passes it
        self._reach = float(readings.z.max(initial=0.0)) + END_TOLERANCE

    def at(self, place: NDArray[np.float64]) -> _Towards:
        """Return the readings near a place, with those whose axis leads to it."""
        x, y = place.tolist()
        first, last = np.searchsorted(self._rows[0], [x - self._reach, x + self._reach]).tolist()
        rows = self._rows[:, first:last]
        px, py, ax, ay, z, yaw = rows[:, np.abs(rows[1] - y) <= self._reach]
        along, beside = (x - px) * ax + (y - py) * ay, np.abs((x - px) * ay - (y - py) * ax)
        towards = (along > 0) & (beside <= AXIS_TOLERANCE)
        return _Towards(yaw, towards & (np.abs(z - along) <= END_TOLERANCE), towards & (z > along + END_TOLERANCE))


class _Towards(NamedTuple):
    """Yaws of some readings, radians, and which of them end at a place, and which go on beyond it; shape (N,)."""

    yaw: NDArray[np.float64]
    ends: NDArray[np.bool_]
    goes_on: NDArray[np.bool_]


def _change_at(own: _SortedEchoes, others: _SortedEchoes, number: int, place: NDArray[np.float64]) -> Change | None:
    """Return the change at a place between one drive, `number`, and the others; None if there is none."""
    yaw, ends, goes_on = own.at(place)
    echoes = int(ends.sum())
    if echoes < LEAST_ECHOES or goes_on.sum() > MOST_PASSED_BY_OWN * echoes:
        return None
    # directions are modulo a half turn
    direction = np.angle(np.exp(2j * yaw[ends]).sum()) / 2
    yaw, ends, goes_on = others.at(place)
    alike = np.abs(np.angle(np.exp(2j * (yaw - direction)))) / 2 <= LARGEST_ANGLE
    passed = int((goes_on & alike).sum())
    if passed < LEAST_PASSED or (ends & alike).sum() > MOST_ECHOES_OF_OTHERS * passed:
        return None
    return Change(number, float(place[0]), float(place[1]), echoes, passed)


def change_warnings(maps: MapSet, names: Sequence[str]) -> list[str]:
    """Return warnings about changed places, at most `MOST_NAMED` of them; empty if there is none."""
    found = changes(maps, len(names)) if len(names) > 1 else []
    texts = [
        f'there was an obstacle at x = {change.x:.1f} m, y = {change.y:.1f} m during {names[change.drive]} '
        f'({change.echoes} echoes) and not during other drives ({change.passed} readings of theirs pass): was a door '
        'shut, or an object moved? The map is free there'
        for change in found[:MOST_NAMED]
    ]
    if len(found) > MOST_NAMED:
        texts.append(f'and drives contradict each other at {len(found) - MOST_NAMED} more places')
    return texts
