"""Places like the worlds of well-known robot simulators, most of them without walls at right angles, for trajectories.

And corridors that bend, or have a corner that is not square. The scale was developed on the cave, the arena
and the hexagon with seeds 0, 1 and 5. Each function returns a world and the corners of a path through it, in metres.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from functools import partial

import numpy as np
from scipy import ndimage

from forward_grid_mapper.core.common.grid import Grid
from forward_grid_mapper.core.common.readings import Floats
from forward_grid_mapper.simulation.world import World, cells_along

Place = tuple[World, Floats]
Point = tuple[float, float]

CELL, MARGIN = 0.1, 0.5
"""Size of the cells of the true map, and width of its border, metres."""


def line(*points: Point) -> Floats:
    """Return the segments of a line through points, shape (S, 4)."""
    corners = np.array(points, np.float64)
    return np.hstack([corners[:-1], corners[1:]])


def outline(corners: Sequence[Point] | Floats) -> Floats:
    """Return the segments of a closed line, shape (S, 4)."""
    points = np.asarray(corners, np.float64)
    return np.hstack([points, np.roll(points, -1, axis=0)])


def box(x0: float, y0: float, x1: float, y1: float) -> Floats:
    """Return the outline of a rectangle, shape (4, 4)."""
    return outline([(x0, y0), (x1, y0), (x1, y1), (x0, y1)])


def around(x: float, y: float, radius: float, count: int, first: float = 0.0) -> Floats:
    """Return `count` points at equal angles on a circle, the first one at the angle `first`, shape (count, 2)."""
    angle = first + 2.0 * math.pi * np.arange(count) / count
    return np.stack([x + radius * np.cos(angle), y + radius * np.sin(angle)], axis=1)


def world_of(name: str, walls: list[Floats], inside: Point) -> World:
    """Return the world with these walls, all rough; `inside` is a point where the robot can drive."""
    segments = np.concatenate(walls)
    low, high = segments.reshape(-1, 2).min(0) - MARGIN, segments.reshape(-1, 2).max(0) + MARGIN
    column, row = np.floor(low / CELL).astype(int).tolist()
    width, height = (np.ceil(high / CELL).astype(int) - [column, row]).tolist()
    grid = Grid(CELL, column, row, width, height)
    reference = np.zeros(grid.shape, np.int8)
    for segment in segments:
        reference[cells_along(segment, grid)] = 1
    part, _ = ndimage.label(reference == 0)
    at = tuple(int(index[0]) for index in grid.cells_of(np.array([inside[0]]), np.array([inside[1]])))
    reference[(reference == 0) & (part != part[at])] = -1
    smooth, none = np.zeros(len(segments), np.bool_), np.zeros(grid.shape, np.bool_)
    return World(name, segments, smooth, grid, reference, (), none)


def hexagon() -> Place:
    """Return six walls around nine pillars."""
    walls = [outline(around(0.0, 0.0, 2.9, 6, math.pi / 6))]
    walls += [outline(around(1.1 * i, 1.1 * j, 0.15, 10)) for i in (-1, 0, 1) for j in (-1, 0, 1)]
    between = [(0.55, 0.55), (0.55, -0.55), (-0.55, -0.55), (-0.55, 0.55), (0.55, 0.55)]
    outside = [
        (1.75, 0.5),
        (1.7, -1.2),
        (0.0, -1.9),
        (-1.7, -1.2),
        (-1.75, 1.4),
        (0.0, 1.95),
        (1.65, 1.3),
        (1.65, 0.55),
    ]
    return world_of('hexagon', walls, between[0]), np.array([*between, *outside] * 3)


def house() -> Place:
    """Return five rooms with furniture."""
    walls = [box(0.0, 0.0, 12.0, 9.0), line((5.0, 0.0), (5.0, 3.2)), line((5.0, 4.2), (5.0, 9.0))]
    walls += [line((0.0, 5.0), (2.0, 5.0)), line((3.0, 5.0), (5.0, 5.0)), line((5.0, 5.5), (7.5, 5.5))]
    walls += [line((8.5, 5.5), (12.0, 5.5)), line((9.0, 0.0), (9.0, 2.0)), line((9.0, 3.0), (9.0, 5.5))]
    walls += [box(0.3, 0.3, 2.2, 1.2), box(3.2, 2.0, 3.9, 2.7), box(6.2, 1.0, 7.2, 1.6), box(10.5, 0.3, 11.7, 1.4)]
    walls += [box(0.3, 7.5, 1.8, 8.7), box(6.0, 7.5, 8.0, 8.5), outline(around(10.5, 7.5, 0.35, 12))]
    way = [(4.3, 3.7), (2.5, 3.7), (2.5, 6.2), (3.5, 7.6), (2.5, 6.2), (2.5, 3.7), (4.3, 3.7), (8.0, 3.6), (8.0, 4.6)]
    way += [(8.0, 6.6), (9.3, 7.8), (9.3, 6.4), (8.0, 6.6), (8.0, 2.5), (10.5, 2.5), (10.5, 4.2), (9.8, 2.5)]
    way += [(8.0, 2.5), (7.8, 3.7), (4.3, 3.7), (4.2, 1.2), (2.8, 1.6), (2.5, 3.7)]
    return world_of('house', walls, way[0]), np.array(way + way[1:-1][::-1])


def arena() -> Place:
    """Return a round room with four boxes at any angle."""
    rng = np.random.default_rng(3)
    walls = [outline(around(0.0, 0.0, 5.0, 48))]
    for x, y in ((2.0, 1.0), (-2.0, 2.0), (-1.0, -2.5), (2.5, -2.0)):
        angle = rng.uniform(0.0, 3.0)
        turn = np.array([[math.cos(angle), math.sin(angle)], [-math.sin(angle), math.cos(angle)]])
        walls.append((box(-0.4, -0.25, 0.4, 0.25).reshape(-1, 2) @ turn + [x, y]).reshape(-1, 4))
    lap = around(0.0, 0.0, 3.9, 16)
    way = np.concatenate([[(0.0, 0.0)], lap, [(0.0, 0.0), (0.0, 3.5)], lap[4:], [(0.0, 0.0)]])
    return world_of('arena', walls, (0.0, 0.0)), way


def cave() -> Place:
    """Return a way around, four metres wide, between walls without a straight piece; two laps."""
    rng, count = np.random.default_rng(5), 160
    angle = 2.0 * math.pi * np.arange(count) / count

    def waves(mean: float, size: float, most: int) -> Floats:
        terms = [rng.normal() * size / k * np.cos(k * angle + rng.uniform(0.0, 6.28)) for k in range(1, most)]
        return np.asarray(mean + np.sum(terms, axis=0))

    outer, inner = waves(7.0, 1.3, 9), waves(3.0, 0.45, 7)
    rock, pillar, middle = (
        np.stack([1.5 * r * np.cos(angle), r * np.sin(angle)], axis=1) for r in (outer, inner, (outer + inner) / 2)
    )
    lap = middle[::6]
    return world_of('cave', [outline(rock), outline(pillar)], tuple(lap[0])), np.concatenate([lap, lap, lap[:6]])


def warehouse() -> Place:
    """Return two rows of five shelves in a hall."""
    walls = [box(0.0, 0.0, 30.0, 18.0)]
    for k in range(5):
        walls += [box(left, 2.5 + 3.0 * k, right, 3.5 + 3.0 * k) for left, right in ((3.0, 13.0), (16.0, 27.0))]
    way = [(1.5, 1.2), (28.5, 1.2), (28.5, 4.5), (1.5, 4.5), (1.5, 7.5), (28.5, 7.5), (28.5, 10.5), (1.5, 10.5)]
    way += [(1.5, 13.5), (14.5, 13.5), (14.5, 1.2), (1.5, 1.2), (1.5, 4.5)]
    return world_of('warehouse', walls, way[0]), np.array(way)


def bent_corridor(radius: float) -> Place:
    """Return a corridor of 34 m that bends to the left all along, with niches and cupboards; there and back."""
    length, half, pieces = 34.0, 1.1, 12

    def at(along: float, aside: float) -> Point:
        """Return the place at this distance along the middle line, and to the left of it."""
        angle = along / radius
        return (radius - aside) * math.sin(angle), radius - (radius - aside) * math.cos(angle)

    walls = [line(at(end, -half), at(end, half)) for end in (0.0, length)]
    for side in (-half, half):
        for k in range(pieces):
            begin, end = length * k / pieces, length * (k + 1) / pieces
            inner = side + math.copysign(0.3 if (k + (side > 0)) % 3 else -0.3, side)
            straight = [at(along, side) for along in np.arange(begin, end - 1.0, 0.4).tolist()]
            walls.append(line(*straight, at(end - 1.0, side), at(end - 1.0, inner), at(end, inner), at(end, side)))
    way = [at(along, 0.0) for along in np.arange(1.5, length - 1.4, 2.0).tolist()]
    return world_of(f'radius {radius:g} m', walls, way[0]), np.array(way + way[-2::-1])


def slanted_corridor(degrees: float) -> Place:
    """Return a corridor along four sides of a block, one of which meets the next at this angle; twice around."""
    width, height, half = 16.0, 9.0, 0.9
    angle = math.radians(degrees)
    middle = np.array([(0.0, 0.0), (width, 0.0), (width, height), (-height / math.tan(angle), height)])
    along = np.roll(middle, -1, axis=0) - middle
    along /= np.linalg.norm(along, axis=1, keepdims=True)
    inwards = np.stack([-along[:, 1], along[:, 0]], axis=1)

    def side(aside: float) -> Floats:
        """Return the corners of the line this far inside of the middle of the corridor."""
        out = np.empty_like(middle)
        for k in range(len(middle)):
            normals = inwards[[k - 1, k]]
            out[k] = np.linalg.solve(normals, normals @ middle[k] + aside)
        return out

    outer = side(-half)
    walls = [outline(side(half)), outline(outer)]
    for k, corner in enumerate(outer):
        length = math.dist(corner, outer[(k + 1) % len(outer)])
        for part in (0.2 + 0.05 * k, 0.7 - 0.05 * k):
            foot = corner + part * length * along[k]
            step, deep = 0.6 * along[k], 0.3 * inwards[k]
            walls.append(outline(np.array([foot, foot + step, foot + step + deep, foot + deep])))
    way = np.concatenate([middle, middle, middle[:2]])
    return world_of(f'corner of {degrees:g} degrees', walls, (0.0, 0.0)), way


BENT: dict[str, Callable[[], Place]] = {
    f'radius {radius:g} m': partial(bent_corridor, radius) for radius in (30.0, 50.0, 80.0, 120.0, 1e6)
}

SLANTED: dict[str, Callable[[], Place]] = {
    f'corner of {degrees:g}°': partial(slanted_corridor, degrees) for degrees in (65.0, 75.0, 80.0, 90.0)
}

PLACES: dict[str, Callable[[], Place]] = {f.__name__: f for f in (hexagon, house, arena, cave, warehouse)}
