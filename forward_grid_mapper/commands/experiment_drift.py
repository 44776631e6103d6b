"""Maps with drifting wheel odometry: at true poses, at those of odometry, and at those of the refined trajectory."""

from __future__ import annotations

import argparse
import math
from collections.abc import Callable, Sequence
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from ..core.common.grid import UNKNOWN, Grid
from ..core.common.parameters import Parameters
from ..core.common.readings import Floats, Readings
from ..core.common.words import counted
from ..core.mapping import Mapper
from ..core.trajectory.local_map import at_poses
from ..core.trajectory.poses import compose, rms_after_alignment
from ..core.trajectory.refinement import Refiner
from ..core.trajectory.windows import Odometry
from ..files.panels import Box, FigureTile
from ..simulation.drift import LEVELS, odometry_of, with_drift
from ..simulation.drive import Recording, corridor_drive, drive
from ..simulation.score import SURFACE_DEPTH, score_map, visible_surface
from ..simulation.sonar import NOISY, sonar_ring
from ..simulation.world import World, building_tour, building_world
from .console import Ticker

WORLDS: dict[str, Callable[[int], Recording]] = {
    'corridor': lambda seed: corridor_drive(seed, 2),
    'building': lambda seed: drive(building_world(), building_tour(), 0.15, sonar_ring(16), NOISY, seed),
}
"""The paper's corridor in both directions, and our worlds of rooms and corridors; by seed."""

LEVEL = 'high'

RADIUS = 0.2
"""Radius of a robot for navigation on the map, metres."""

MARGIN = 0.5

WIDE = 2.6
"""Ratio of width to height from which a map has its own row."""

POSES = {'true': 'true poses', 'odometry': 'odometry', 'refined': 'refined'}

Figure = tuple[list[list[FigureTile]], Box]
"""Rows of maps, and the box that they show."""


class Row(NamedTuple):
    """Scores of one drive with one trajectory: absolute trajectory error in metres, F1, and navigable IoU."""

    ate: float
    f1: float
    iou: float


def navigable(free: NDArray[np.bool_], resolution: float) -> NDArray[np.bool_]:
    """Return the cells whose surroundings within `RADIUS` are all free; cells outside of the map are not free."""
    reach = math.ceil(RADIUS / resolution)
    padded = np.pad(free, reach)
    out = np.ones(free.shape, np.bool_)
    height, width = free.shape
    for dy in range(-reach, reach + 1):
        for dx in range(-reach, reach + 1):
            if math.hypot(dx, dy) * resolution <= RADIUS:
                out &= padded[reach + dy : reach + dy + height, reach + dx : reach + dx + width]
    return out


def on_world(ml: NDArray[np.int8], grid: Grid, world: World) -> NDArray[np.int8]:
    """Return a map resampled to the cells of the world, -1 outside."""
    x, y = world.grid.centers()
    rows, _ = grid.cells_of(np.zeros(len(y)), y)
    _, columns = grid.cells_of(x, np.zeros(len(x)))
    inside = ((rows >= 0) & (rows < grid.height))[:, None] & ((columns >= 0) & (columns < grid.width))
    values = ml[np.clip(rows, 0, grid.height - 1)[:, None], np.clip(columns, 0, grid.width - 1)]
    return np.where(inside, values, -1).astype(np.int8)


def aligned(poses: Floats, true: Floats) -> Floats:
    """Return the rigid transform, shape (3,), that aligns poses with the true ones."""
    a, b = poses[:, :2] - poses[:, :2].mean(0), true[:, :2] - true[:, :2].mean(0)
    turn = math.atan2((a[:, 0] * b[:, 1] - a[:, 1] * b[:, 0]).sum(), (a * b).sum())
    c, s = math.cos(turn), math.sin(turn)
    x, y = true[:, :2].mean(0) - np.array([[c, -s], [s, c]]) @ poses[:, :2].mean(0)
    return np.array([x, y, turn])


def drift(options: argparse.Namespace, parameters: Parameters, ticker: Ticker) -> tuple[str, dict[str, Figure]]:
    """Return the table, and for each world the maps of its first drive with the box shown."""
    lines = [
        f'Wheel odometry that drifts (simulate --drift {LEVEL}), {counted(options.seeds, "drive")} of each world:',
        'absolute trajectory error after rigid alignment, F1 with one cell of tolerance, and of the floor that a robot',
        f'of {RADIUS:g} m radius may use the part that map and truth share (IoU); means, and the largest error.',
        '',
        f'{"":12s}{"poses":12s}{"ATE, m":>8s}{"largest":>9s}{"F1":>7s}{"IoU":>7s}{"refined":>9s}',
    ]
    figures = {}
    for name, made in WORLDS.items():
        rows: dict[str, list[Row]] = {kind: [] for kind in POSES}
        taken = 0
        for seed in range(options.seeds):
            ticker.say(f'{name}, drive {seed + 1} of {options.seeds}')
            tiles, found, accepted = one(made(seed), seed, parameters)
            taken += accepted
            for kind, row in found.items():
                rows[kind].append(row)
            if not seed:
                figures[name] = tiles
        for kind, of in rows.items():
            ate, f1, iou = np.mean(of, axis=0)
            count = f'{taken}/{options.seeds}' if kind == 'refined' else ''
            worst = max(row.ate for row in of)
            lines.append(f'{name:12s}{kind:12s}{ate:8.2f}{worst:9.2f}{f1:7.3f}{iou:7.3f}{count:>9s}'.rstrip())
    return '\n'.join(lines), figures


def one(exact: Recording, seed: int, parameters: Parameters) -> tuple[Figure, dict[str, Row], bool]:
    """Return the maps of a drive, their scores, and whether the trajectory was refined."""
    bent, true = with_drift(exact, LEVELS[LEVEL], seed), odometry_of(exact)
    odometry, world = odometry_of(bent), exact.world
    outcome = Refiner(parameters).run(bent.readings, odometry)
    cases: dict[str, tuple[Readings, Odometry]] = {
        'true': (exact.readings, true),
        'odometry': (bent.readings, odometry),
        'refined': (outcome.readings, outcome.trajectory),
    }
    visible = visible_surface(world, exact.readings, SURFACE_DEPTH)
    rows, tiles, ways = {}, [], {}
    floor = np.zeros(world.grid.shape, np.bool_)
    for kind, (readings, path) in cases.items():
        home = aligned(path.pose, true.pose)
        sensors = np.stack([readings.x, readings.y, readings.yaw], axis=1)
        maps = Mapper(parameters).run(at_poses(readings, compose(home, sensors)))
        there = on_world(maps.ml, maps.grid, world)
        if kind == 'true':
            # the navigable floor among the known cells
            floor = navigable((world.reference == 0) & (there >= 0), world.grid.resolution)
        free = navigable(there == 0, world.grid.resolution)
        ate = rms_after_alignment(path.pose, true.pose)
        iou = float((free & floor).sum() / max((free | floor).sum(), 1))
        rows[kind] = Row(ate, score_map(maps.ml, maps.grid, world, visible).f1, iou)
        ways[kind] = compose(home, path.pose)[:, :2]
        title = f'{POSES[kind]}: ATE {ate:.2f} m, F1 {rows[kind].f1:.2f}, IoU {iou:.2f}'
        tiles.append(FigureTile(title, maps.grid, maps.ml, path_xy=ways[kind]))
    tiles[2] = tiles[2]._replace(odometry_xy=ways['odometry'])
    truth = FigureTile('truth', world.grid, world.reference, path_xy=ways['true'])
    view = box_of([*ways.values(), *map(known_corners, tiles)], world.grid.extent)
    # the layout of figures: wide maps are stacked
    wide = (view[1] - view[0]) > WIDE * (view[3] - view[2])
    shown = [truth, *tiles]
    return ([[tile] for tile in shown] if wide else [shown[:2], shown[2:]], view), rows, outcome.accepted


def known_corners(tile: FigureTile) -> NDArray[np.float64]:
    """Return two opposite corners of the known part of a map, shape (2, 2), metres."""
    x, y = tile.grid.centers()
    row, column = np.nonzero(tile.values != UNKNOWN)
    return np.array([[x[column.min()], y[row.min()]], [x[column.max()], y[row.max()]]])


def box_of(ways: Sequence[NDArray[np.float64]], extent: Box) -> Box:
    """Return the box around paths and a world, with a margin."""
    points = np.concatenate([*ways, [[extent[0], extent[2]], [extent[1], extent[3]]]])
    (left, bottom), (right, top) = points.min(0) - MARGIN, points.max(0) + MARGIN
    return float(left), float(right), float(bottom), float(top)
