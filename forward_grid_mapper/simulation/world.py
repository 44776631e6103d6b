"""Worlds of thin walls with their true maps: the paper's corridors, and a floor plan to draw further ones.

Walls run along the centres of their cells. So the distance to a wall is the distance to the centres of its cells, and
a map of exact readings has no bias of half a cell.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass, field
from typing import Literal

import numpy as np
from numpy.typing import NDArray

from ..core.common.grid import Grid

Cell = tuple[int, int]
Axis = Literal['x', 'y']


@dataclass(frozen=True)
class Door:
    """An opening in a wall: centre `x`, `y` and free `width` in metres; `axis` is the one the wall runs along."""

    x: float
    y: float
    width: float
    axis: Axis


@dataclass(frozen=True)
class World:
    """Walls, and the true map, both in the map frame.

    Attributes
    ----------
    name : str
    segments : float64, shape (S, 4)
        Walls without thickness, x0, y0, x1, y1 in metres.
    smooth : bool, shape (S,)
        Walls that reflect sound like a mirror.
    grid : Grid
        The lattice of `reference`.
    reference : int8, shape `grid.shape`
        1 at walls, 0 where a robot could drive, -1 elsewhere.
    doors : tuple of Door
    smooth_cells : bool, shape `grid.shape`
        The occupied cells that smooth walls run through.
    """

    name: str
    segments: NDArray[np.float64]
    smooth: NDArray[np.bool_]
    grid: Grid
    reference: NDArray[np.int8]
    doors: tuple[Door, ...]
    smooth_cells: NDArray[np.bool_]


def cells_along(segment: NDArray[np.float64], grid: Grid) -> tuple[NDArray[np.int64], NDArray[np.int64]]:
    """Return the cells, (rows, columns) in `grid`, on a segment (x0, y0, x1, y1 in metres), in its order."""
    start, end = segment[:2], segment[2:]
    length = float(np.hypot(*(end - start)))
    # walls may end on a cell's face; a small margin keeps samples out of the next cell
    margin = 1e-6 / max(length, 1e-6)
    at = np.linspace(margin, 1.0 - margin, 2 + math.ceil(8.0 * length / grid.resolution))
    points = start + at[:, None] * (end - start)
    rows, columns = grid.cells_of(points[:, 0], points[:, 1])
    new = np.r_[True, (np.diff(rows) != 0) | (np.diff(columns) != 0)]
    return rows[new], columns[new]


@dataclass
class Floorplan:
    """Draws a world cell by cell; a cell is given as (column, row).

    Parameters
    ----------
    name : str
    width, height : int
        Size of the grid in cells; its lower left corner is the origin of the map frame.
    resolution : float
        Metres.
    """

    name: str
    width: int
    height: int
    resolution: float = 0.1
    _segments: list[tuple[float, float, float, float]] = field(default_factory=list)
    _smooth: list[bool] = field(default_factory=list)
    _doors: list[Door] = field(default_factory=list)

    def line(self, start: Cell, end: Cell, smooth: bool = False) -> None:
        """Draw a wall at any angle between the centres of two cells."""
        x0, y0, x1, y1 = ((cell + 0.5) * self.resolution for cell in (*start, *end))
        self._segments.append((x0, y0, x1, y1))
        self._smooth.append(smooth)

    def wall(
        self, axis: Axis, across: int, span: Cell, doors: tuple[Cell, ...] = (), smooth: Cell | None = None
    ) -> None:
        """Draw a wall along `axis` through row (axis x) or column (axis y) `across`.

        Parameters
        ----------
        span : (int, int)
            First and last cell along the axis.
        doors : tuple of (int, int)
            First and last *free* cell of each doorway.
        smooth : (int, int), optional
            First and last cell of a smooth stretch.
        """
        along = np.arange(span[0], span[1] + 1)
        kind = np.zeros(len(along), np.int64)
        if smooth is not None:
            kind[(along >= smooth[0]) & (along <= smooth[1])] = 1
        for first, last in doors:
            kind[(along >= first) & (along <= last)] = -1
            cells = ((first + last + 1) / 2, last - first + 1, across + 0.5)
            middle, width, side = (round(cell * self.resolution, 9) for cell in cells)
            x, y = (middle, side) if axis == 'x' else (side, middle)
            self._doors.append(Door(x, y, width, axis))
        cuts = np.flatnonzero(np.diff(kind)) + 1
        for piece in np.split(np.arange(len(along)), cuts):
            if kind[piece[0]] < 0:
                continue
            # a doorway is as wide as its free cells, so walls end at faces there, and at centres elsewhere
            low = along[piece[0]] + (0.5 if piece[0] == 0 else 0.0)
            high = along[piece[-1]] + (0.5 if piece[-1] == len(along) - 1 else 1.0)
            ends = (low, across + 0.5, high, across + 0.5) if axis == 'x' else (across + 0.5, low, across + 0.5, high)
            x0, y0, x1, y1 = (float(end * self.resolution) for end in ends)
            self._segments.append((x0, y0, x1, y1))
            self._smooth.append(bool(kind[piece[0]]))

    def box(self, low: Cell, high: Cell) -> None:
        """Draw the four walls of a rectangle with these corner cells."""
        for row in (low[1], high[1]):
            self.wall('x', row, (low[0], high[0]))
        for column in (low[0], high[0]):
            self.wall('y', column, (low[1], high[1]))

    def alcove(self, columns: Cell, row: int, end_row: int) -> None:
        """Draw the side and back walls of a room with an existing front wall, in `row`; its back is in `end_row`."""
        for column in columns:
            self.wall('y', column, (min(row, end_row), max(row, end_row)))
        self.wall('x', end_row, columns)

    def world(self, inside: Cell) -> World:
        """Return the world; cells that cannot be reached from cell `inside` are unknown in its reference map."""
        grid = Grid(self.resolution, 0, 0, self.width, self.height)
        segments = np.array(self._segments)
        smooth = np.array(self._smooth)
        occupied = np.zeros(grid.shape, bool)
        smooth_cells = np.zeros(grid.shape, bool)
        for segment, is_smooth in zip(segments, smooth, strict=True):
            cells = cells_along(segment, grid)
            occupied[cells] = True
            smooth_cells[cells] |= is_smooth
        reference = np.where(_reachable(~occupied, inside), 0, -1).astype(np.int8)
        reference[occupied] = 1
        return World(self.name, segments, smooth, grid, reference, tuple(self._doors), smooth_cells)


def _reachable(free: NDArray[np.bool_], seed: Cell) -> NDArray[np.bool_]:
    """Return the cells of `free` that are connected with `seed` by faces."""
    reached = np.zeros_like(free)
    reached[seed[1], seed[0]] = True
    count = 0
    while count != (count := int(reached.sum())):
        for _ in range(16):
            spread = reached.copy()
            spread[1:] |= reached[:-1]
            spread[:-1] |= reached[1:]
            spread[:, 1:] |= reached[:, :-1]
            spread[:, :-1] |= reached[:, 1:]
            reached = spread & free
    return reached


def door_world() -> World:
    """Return the world of the paper's Fig. 4: a corridor, 2.1 m wide, with a 0.6 m door into one room."""
    plan = Floorplan('door', 122, 107)
    plan.wall('x', 26, (6, 115))
    plan.wall('x', 48, (6, 115), doors=((58, 63),))
    plan.wall('y', 6, (26, 48))
    plan.wall('y', 115, (26, 48))
    plan.alcove((38, 83), 48, 84)
    return plan.world(inside=(60, 37))


def doors_world() -> World:
    """Return a world like the paper's Fig. 5: a corridor, 2.1 m wide, with two doors of 0.6 m on each side."""
    plan = Floorplan('doors', 114, 120)
    plan.wall('x', 48, (4, 109), doors=((28, 33), (79, 84)))
    plan.wall('x', 70, (4, 109), doors=((33, 38), (74, 79)))
    plan.wall('y', 4, (48, 70))
    plan.wall('y', 109, (48, 70))
    for columns, row, end in (((10, 52), 48, 12), ((60, 104), 48, 16), ((14, 54), 70, 108), ((58, 100), 70, 104)):
        plan.alcove(columns, row, end)
    return plan.world(inside=(56, 59))


def corridor_world() -> World:
    """Return a world like the paper's Fig. 6: a corridor of 62 m with six doors and 18 m of smooth wall."""
    plan = Floorplan('corridor', 641, 131)
    plan.wall('x', 76, (8, 632), doors=((90, 97), (205, 213), (520, 528)), smooth=(270, 449))
    plan.wall('x', 54, (8, 632), doors=((140, 148), (350, 357), (560, 568)))
    plan.wall('y', 8, (54, 76))
    plan.wall('y', 632, (54, 76))
    for columns, end in (((68, 120), 112), ((182, 240), 116), ((494, 556), 108)):
        plan.alcove(columns, 76, end)
    for columns, end in (((116, 170), 18), ((326, 382), 20), ((536, 600), 14)):
        plan.alcove(columns, 54, end)
    return plan.world(inside=(320, 65))


def rooms_world() -> World:
    """Return two rooms joined by a 0.9 m door, with a box, a slanting wall and no smooth surface."""
    plan = Floorplan('rooms', 120, 80)
    plan.box((8, 8), (111, 71))
    plan.wall('y', 58, (8, 71), doors=((30, 38),))
    plan.box((80, 50), (88, 56))
    plan.line((8, 55), (24, 71))
    return plan.world(inside=(30, 30))


# The rooms of `building_world` on each side of its corridor: first and last column, free cells of the door, and boxes
# in the room as two opposite corners.
_SOUTH = (
    (10, 76, (37, 43), (((38, 34), (48, 50)), ((20, 10), (66, 14)))),
    (76, 142, (106, 114), (((98, 38), (120, 44)), ((138, 30), (142, 56)))),
    (142, 222, (176, 183), (((166, 34), (172, 52)), ((194, 36), (200, 42)), ((150, 10), (180, 15)))),
    (222, 300, (258, 265), (((246, 40), (252, 46)), ((268, 34), (278, 50)), ((240, 10), (256, 13)))),
)
_NORTH = (
    (10, 100, (51, 58), (((34, 130), (40, 148)), ((62, 128), (78, 136)), ((20, 166), (50, 170)))),
    (100, 170, (127, 133), (((124, 128), (146, 142)), ((100, 140), (104, 158)))),
    (170, 235, (200, 208), (((196, 134), (200, 138)), ((208, 142), (212, 146)), ((190, 165), (225, 170)))),
    (235, 300, (264, 271), (((260, 126), (272, 150)), ((296, 130), (300, 150)))),
)


def building_world(entrance: bool = False) -> World:
    """Return a building of 40 x 16 m: a corridor, four rooms on each side of it, and a hall with nine pillars.

    Its doors are 0.7 to 0.9 m wide; tables, shelves and a slanting screen stand in the rooms. With `entrance`, a door
    leads from the west into the corridor.
    """
    plan = Floorplan('building', 420, 180)
    for row in (10, 170):
        plan.wall('x', row, (10, 410))
    plan.wall('y', 10, (10, 170), doors=((83, 93),) if entrance else ())
    plan.wall('y', 410, (10, 170))
    plan.wall('x', 78, (10, 300), doors=tuple(door for _, _, door, _ in _SOUTH))
    plan.wall('x', 98, (10, 300), doors=tuple(door for _, _, door, _ in _NORTH))
    plan.wall('y', 300, (10, 170), doors=((84, 92),))
    for rooms, rows in ((_SOUTH, (10, 78)), (_NORTH, (98, 170))):
        for _, side, _, boxes in rooms:
            if side < 300:
                plan.wall('y', side, rows)
            for low, high in boxes:
                plan.box(low, high)
    plan.line((180, 30), (186, 46))
    for column in (326, 354, 382):
        for row in (42, 86, 130):
            plan.box((column, row), (column + 3, row + 3))
    return plan.world(inside=(20, 88))


def building_tour() -> NDArray[np.float64]:
    """Return a tour through the corridor, all rooms and the hall of `building_world`, shape (P, 2), metres."""
    cells: list[Cell] = [(20, 88)]
    south = [(left, right, door, 62, 24) for left, right, door, _ in _SOUTH]
    north = [(left, right, door, 114, 156) for left, right, door, _ in _NORTH]
    for left, right, door, near, far in sorted(south + north, key=lambda room: room[2]):
        middle, low, high = (door[0] + door[1]) // 2, left + 12, right - 12
        cells += [(middle, 88), (middle, near), (low, near), (low, far), (high, far), (high, near)]
        cells += [(middle, near), (middle, 88)]
    hall = ((313, 88), (313, 25), (342, 25), (342, 150), (370, 150), (370, 25), (396, 25), (396, 150), (313, 150))
    cells += [*hall, (313, 88), (20, 88)]
    return (np.array(cells) + 0.5) * 0.1


WORLDS: dict[str, Callable[[], World]] = {
    'door': door_world,
    'doors': doors_world,
    'corridor': corridor_world,
    'rooms': rooms_world,
    'building': building_world,
}
