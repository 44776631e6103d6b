"""A campus: many buildings along streets, and drives from building to building, each with its own seed.

The buildings are those of `building_world` with an entrance in the west, in rows; a row has as many buildings as there
are rows, or one more. A robot drives through all rooms of a building, out of its entrance, along the street to the next
one, and so on; at the last building it turns back. So drives meet in buildings, and together they map the streets.
"""

from __future__ import annotations

import itertools
import math
from collections.abc import Iterator
from functools import lru_cache

import numpy as np

from ..core.common.grid import Grid
from ..core.common.readings import Floats
from ..core.messages.message_types import NANOSECONDS
from .drive import START, Recording, drive_sweeps
from .sonar import NOISY, NoiseModel, SonarArray, sonar_ring
from .world import Door, World, building_tour, building_world

PITCH = 600, 420
"""Cells from a building to the next one in its row, and to the next row: 60 m and 42 m."""

ENTRANCE = 8.85
"""Metres from the lower edge of a building's plot to the middle of its entrance."""

BESIDE, STREET = 2.0, -3.0
"""Metres from a plot's corner to the lane along the entrances (to the west), and to the street (in y)."""

SPACING = 0.18
"""Metres between sweeps."""

RATE = 10.0
"""Rate of odometry between the sweeps, Hz: a fifth of `ODOMETRY_RATE`, since odometry fills most of a bag."""

START_INTERVAL = 600 * NANOSECONDS
"""Nanoseconds from the start of a drive to that of the next one."""


def campus_world(buildings: int) -> World:
    """Return a campus; with 100 buildings it has 600 x 420 m. All cells outdoors are free in the true map."""
    across = math.ceil(math.sqrt(buildings))
    up = math.ceil(buildings / across)
    one = building_world(entrance=True)
    grid = Grid(one.grid.resolution, 0, 0, across * PITCH[0], up * PITCH[1])
    reference, smooth = np.zeros(grid.shape, np.int8), np.zeros(grid.shape, np.bool_)
    segments, doors = [], []
    for number in range(buildings):
        x, y = corner(number, buildings)
        column, row = round(x / grid.resolution), round(y / grid.resolution)
        place = slice(row, row + one.grid.height), slice(column, column + one.grid.width)
        reference[place], smooth[place] = one.reference, one.smooth_cells
        segments.append(one.segments + np.array([x, y, x, y]))
        doors += [Door(door.x + x, door.y + y, door.width, door.axis) for door in one.doors]
    walls = np.concatenate(segments)
    return World('campus', walls, np.tile(one.smooth, buildings), grid, reference, tuple(doors), smooth)


def corner(number: int, buildings: int) -> tuple[float, float]:
    """Return the corner of a building's plot, metres; successive buildings are neighbours."""
    across = math.ceil(math.sqrt(buildings))
    row, column = divmod(number, across)
    # every second row backwards
    column = across - 1 - column if row % 2 else column
    # a lane leads past the plots in the west, and a street past those in the south
    return column * PITCH[0] * 0.1 + 10.0, row * PITCH[1] * 0.1 + 15.0


def _visited(first: int, buildings: int) -> Iterator[int]:
    """Yield buildings in the order in which a robot visits them, turning back at the last one and at the first."""
    there = list(range(buildings))
    round_trip = there + there[-2:0:-1]
    return itertools.islice(itertools.cycle(round_trip), first, None)


def _way(one: tuple[float, float], other: tuple[float, float]) -> Floats:
    """Return the path from the entrance of a building to that of another, shape (P, 2), metres."""
    points = [
        (one[0] - BESIDE, one[1] + ENTRANCE),
        (one[0] - BESIDE, one[1] + STREET),
        (other[0] - BESIDE, one[1] + STREET),
        (other[0] - BESIDE, other[1] + ENTRANCE),
    ]
    return np.array(points)


def campus_path(length: float, first: int, buildings: int, rng: np.random.Generator) -> Floats:
    """Return a path of `length` metres that begins in building `first`, shape (P, 2); its tours of a building vary."""
    tour = building_tour()
    path, last = np.zeros((0, 2)), None
    visited = _visited(first, buildings)
    while _along(path)[-1:].sum() < length:
        here = corner(next(visited), buildings)
        way: list[Floats] = [_way(last, here)] if last is not None and last != here else []
        path = np.concatenate([path, *way, np.array(here) + tour + rng.uniform(-0.05, 0.05, tour.shape)])
        path = path[np.r_[True, np.hypot(*np.diff(path, axis=0).T) > 1e-6]]
        last = here
    along = _along(path)
    end = [np.interp(length, along, column) for column in path.T]
    return np.concatenate([path[along < length], [end]])


def _along(path: Floats) -> Floats:
    """Return the distance along a path to each of its points, metres."""
    return np.concatenate([np.zeros(min(len(path), 1)), np.cumsum(np.hypot(*np.diff(path, axis=0).T))])


@lru_cache(maxsize=1)
def _world(buildings: int) -> World:
    return campus_world(buildings)


def campus_drive(
    number: int,
    buildings: int = 4,
    readings: int = 40_000,
    noise: NoiseModel = NOISY,
    seed: int = 0,
    sonars: SonarArray | None = None,
) -> Recording:
    """Return a drive through a campus; it depends on its number, but not on other drives.

    Parameters
    ----------
    number : int
        Of the drive, from 0; it begins in building `number` modulo `buildings`, `START_INTERVAL` after the one before.
    buildings : int
    readings : int
        Smallest number of readings: the last sweep is complete.
    noise : NoiseModel
    seed : int
        Of all drives together.
    sonars : SonarArray, optional
        Default: a ring of 24.
    """
    sonars = sonar_ring() if sonars is None else sonars
    rng = np.random.default_rng([seed, number])
    count = math.ceil(readings / len(sonars.yaws))
    path = campus_path(count * SPACING, number % buildings, buildings, rng)
    sweeps = np.array((np.arange(count) + 0.5) * SPACING, np.float64)
    of_noise = int(rng.integers(2**62))
    start = START + number * START_INTERVAL
    return drive_sweeps(_world(buildings), path, sweeps, sonars, noise, of_noise, start=start, rate=RATE)
