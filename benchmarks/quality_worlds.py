"""Data of `quality.py`: simulated drives, readings drawn from the forward model itself, and real recordings."""

from __future__ import annotations

import dataclasses
import importlib.util
import math
import sys
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path
from types import ModuleType

import numpy as np
from numpy.typing import NDArray

from forward_grid_mapper.core.common.grid import Grid
from forward_grid_mapper.core.common.parameters import Parameters
from forward_grid_mapper.core.common.readings import Floats, Readings
from forward_grid_mapper.core.sensor.cone_table import cone_table, grid_of, walk_resized
from forward_grid_mapper.recordings.read_drive import read_drive
from forward_grid_mapper.simulation.drive import Recording, corridor_drive, door_drive, drive
from forward_grid_mapper.simulation.rays import NOTHING, cast
from forward_grid_mapper.simulation.score import VISIBLE_RAYS
from forward_grid_mapper.simulation.sonar import NOISY, NoiseModel, SonarArray, sonar_ring
from forward_grid_mapper.simulation.world import Floorplan, World, rooms_world

SHARED = Path(__file__).resolve().parents[2] / 'shared'
RECORDINGS: tuple[str, ...] = ('office_a', 'office_b')
ODOMETRY = '/odom_corrected'
DEPTH = 0.2
"""Metres behind the nearest wall of a cone beyond which a wall is not visible."""

ROUGHER = NoiseModel(sigma=0.08, p_random=0.1, p_lost=0.1)


@dataclass(frozen=True)
class Case:
    """Readings to map, and the truth for scores.

    Attributes
    ----------
    group : str
        Cases of one group differ only by their seeds; they are scored together.
    readings : Readings
    path_xy : float64, shape (P, 2)
        Path of the robot, metres.
    truth : float64, shape `grid.shape`
        1 occupied, 0 free, NaN unknown.
    Corner, and edge of a cell, of the truth, metres.
        Corner and cell of the truth, metres.
    world : World, optional
        The simulated world; None for a recording.
    met : int64, shape `truth.shape`
        Number of readings with a ray that hits each wall cell; of shape (0, 0) for a recording.
    """

    group: str
    readings: Readings
    path_xy: Floats
    truth: Floats
    origin: tuple[float, float]
    resolution: float
    world: World | None
    met: NDArray[np.int64]


def doors_world() -> World:
    """Return a flat whose rooms are joined by doors of 0.6, 0.7, 0.8 and 0.9 m."""
    plan = Floorplan('doors', 130, 100)
    plan.box((8, 8), (121, 91))
    plan.wall('y', 50, (8, 91), doors=((20, 25), (70, 77)))
    plan.wall('x', 48, (8, 50), doors=((28, 34),))
    plan.wall('x', 40, (50, 121), doors=((84, 92),))
    plan.box((20, 18), (26, 22))
    plan.box((90, 60), (98, 66))
    plan.line((100, 8), (121, 26))
    plan.box((66, 56), (69, 58))
    return plan.world(inside=(14, 30))


def clutter_world() -> World:
    """Return two rooms full of furniture, from posts of 0.3 m to a table, joined by a door of 0.9 m."""
    plan = Floorplan('clutter', 120, 90)
    plan.box((8, 8), (111, 81))
    plan.wall('y', 60, (8, 81), doors=((36, 44),))
    left = ((20, 16, 34, 22), (20, 60, 26, 72), (42, 30, 46, 34), (44, 64, 52, 70), (30, 44, 33, 47))
    right = ((72, 24, 74, 26), (80, 30, 82, 32), (90, 20, 98, 26), (76, 56, 90, 62), (100, 44, 104, 56))
    for x0, y0, x1, y1 in (*left, *right, (68, 70, 70, 72)):
        plan.box((x0, y0), (x1, y1))
    plan.line((96, 81), (111, 66))
    return plan.world(inside=(14, 30))


def hall_world() -> World:
    """Return a hall of 13 x 10 m with six pillars of 0.5 m."""
    plan = Floorplan('hall', 150, 120)
    plan.box((8, 8), (141, 111))
    for x in (40, 75, 110):
        for y in (35, 80):
            plan.box((x, y), (x + 4, y + 4))
    plan.line((8, 95), (24, 111))
    plan.box((60, 8), (72, 14))
    return plan.world(inside=(30, 60))


def office_world() -> World:
    """Return a corridor with rooms on both sides, doors of 0.6 to 0.8 m, and 2.6 m of smooth wall."""
    plan = Floorplan('office', 160, 90)
    plan.wall('x', 40, (8, 151), doors=((30, 35), (80, 86), (128, 135)), smooth=(45, 70))
    plan.wall('x', 58, (8, 151), doors=((52, 57), (104, 111)))
    plan.wall('y', 8, (40, 58))
    plan.wall('y', 151, (40, 58))
    for columns, row, end in (((20, 48), 40, 12), ((70, 100), 40, 10), ((118, 145), 40, 14)):
        plan.alcove(columns, row, end)
    for columns, row, end in (((40, 72), 58, 82), ((92, 124), 58, 84)):
        plan.alcove(columns, row, end)
    return plan.world(inside=(20, 50))


# fmt: off
OWN = {
    'doors': (doors_world, ((1.4, 3.2), (4.0, 3.4), (4.0, 2.3), (5.0, 2.3), (8.0, 2.2), (8.8, 2.2), (8.8, 6.0),
                            (5.1, 7.4), (3.0, 7.4), (3.1, 5.5), (3.1, 4.0))),
    'clutter': (clutter_world, ((1.4, 1.2), (5.2, 1.2), (5.2, 5.6), (3.8, 5.6), (3.8, 7.6), (1.4, 7.6), (1.4, 5.4),
                                (5.2, 5.4), (5.2, 4.05), (6.8, 4.05), (6.7, 1.5), (10.5, 1.4), (10.5, 3.6), (9.3, 4.6),
                                (7.0, 4.9), (7.2, 6.5), (8.0, 7.0), (9.6, 6.9))),
    'hall': (hall_world, ((2.0, 6.0), (6.0, 6.0), (9.4, 6.0), (12.8, 6.0), (12.8, 9.8), (9.6, 10.0), (9.4, 2.5),
                          (6.0, 2.3), (2.0, 2.5))),
    'office': (office_world, ((1.5, 4.9), (3.25, 4.9), (3.25, 3.2), (3.25, 4.9), (8.3, 4.9), (8.3, 3.0), (8.3, 4.9),
                              (10.8, 4.9), (10.8, 6.8), (10.8, 4.9), (14.5, 4.9))),
}
"""Our own worlds, and the paths through them."""
# fmt: on


def readings_that_meet(world: World, readings: Readings) -> NDArray[np.int64]:
    """Return the number of readings with a ray that hits each wall cell, see `visible_surface`, shape `grid.shape`."""
    count = np.zeros(world.grid.size, np.int64)
    fan = np.linspace(-1.0, 1.0, VISIBLE_RAYS)
    for start in range(0, len(readings), 10_000):
        part = readings.select(slice(start, start + 10_000))
        angles = part.yaw[:, None] + part.half_angle[:, None] * fan
        origins = np.stack([part.x, part.y], axis=1)
        distance, hit = cast(origins, angles, world.segments, float(part.z_max.max()))
        bound = np.minimum(part.z_max, distance.min(axis=1) + DEPTH)
        met = (hit != NOTHING) & (distance <= bound[:, None])
        reading, _ = np.nonzero(met)
        x = part.x[reading] + distance[met] * np.cos(angles[met])
        y = part.y[reading] + distance[met] * np.sin(angles[met])
        rows, columns = world.grid.cells_of(x, y)
        cells = np.unique(np.stack([reading, rows * world.grid.width + columns]), axis=1)[1]
        count += np.bincount(cells, minlength=world.grid.size)
    return np.asarray(np.where(world.reference == 1, count.reshape(world.grid.shape), 0))


def simulated(group: str, world: World, readings: Readings, path_xy: Floats) -> Case:
    """Return the case of simulated readings."""
    truth = np.where(world.reference < 0, np.nan, world.reference).astype(np.float64)
    met = readings_that_meet(world, readings)
    return Case(group, readings, path_xy, truth, world.grid.origin, world.grid.resolution, world, met)


def _of(group: str, recording: Recording) -> Case:
    return simulated(group, recording.world, recording.readings, recording.robot[:, :2])


def ring(degrees: int) -> SonarArray:
    """Return the sonars of the drives through `OWN`."""
    return sonar_ring(count=16, field_of_view=math.radians(degrees), max_range=5.0)


def simulated_cases(quick: bool) -> Iterator[Case]:
    """Yield the simulated drives, group by group; only one seed of each if `quick`."""
    seeds = range(1 if quick else 5)
    wide = sonar_ring(field_of_view=math.radians(30.0))
    for n in (1, 3, 16):
        yield from (_of(f'door n={n} 15°', door_drive(n, NOISY, seed)) for seed in seeds)
    yield from (_of('door n=3 30°', door_drive(3, NOISY, seed, wide)) for seed in seeds)
    yield from (_of('corridor 15°', corridor_drive(seed)) for seed in range(1 if quick else 3))
    yield from (_of('corridor 30°', corridor_drive(seed, sonars=wide)) for seed in range(1 if quick else 2))
    for name, (make, way) in OWN.items():
        for degrees, spacing in ((15, 0.08), (30, 0.15)):
            for seed in range(1 if quick else 2):
                noise = ROUGHER if seed else NOISY
                made = drive(make(), np.array(way), spacing, ring(degrees), noise, seed + 10, person=bool(seed))
                yield _of(f'{name} {degrees}°', made)


def drawn_cases(model: dict[str, float], quick: bool) -> Iterator[Case]:
    """Yield drives whose readings are drawn from the forward model with these parameters, given the true map."""
    way = ((1.3, 3.45), (4.8, 3.45), (4.8, 5.5), (4.8, 3.45), (7.0, 3.45), (7.0, 5.8), (7.0, 1.6), (7.0, 3.45))
    for degrees in (15, 30):
        made = drive(rooms_world(), np.array(way), 0.05, ring(degrees), NOISY, 0)
        yield drawn(f'rooms {degrees}°', made, model)
    if not quick:
        yield drawn('door n=16 15°', door_drive(16, NOISY, 0), model)
        yield drawn('corridor 15°', corridor_drive(0), model)


def drawn(group: str, recording: Recording, model: dict[str, float], seed: int = 0) -> Case:
    """Return the drive with its ranges replaced by draws from the forward model, given the world's true map."""
    rng = np.random.default_rng(seed)
    p = Parameters().varied(dict(model))
    old = recording.readings
    far = dataclasses.replace(old, z=old.z_max.copy())
    grid = grid_of(far, p.model, p.grid)
    table, occupied = cone_table(far, grid, p.model), on_grid(recording.world, grid).ravel()
    z = np.empty(len(old))
    cells, distances = np.empty(4096, np.int32), np.empty(4096)
    for t in range(len(old)):
        n, cells, distances = walk_resized(table, t, grid.shape, cells, distances)
        hits = (np.sort(distances[:n][occupied[cells[:n]]]) - p.model.surface_offset) * grid.resolution
        cause, z_max = rng.random(), old.z_max[t]
        if cause < p.model.p_rand:
            z[t] = rng.random() * z_max
            continue
        found = np.flatnonzero(rng.random(len(hits)) < p.model.p_hit)
        echo = len(found) > 0 and cause >= p.model.p_rand + p.model.p_lost
        z[t] = min(max(hits[found[0]] + p.model.sigma * rng.standard_normal(), 0.02), z_max) if echo else z_max
    return simulated(group, recording.world, dataclasses.replace(old, z=z), recording.robot[:, :2])


def on_grid(world: World, grid: Grid) -> NDArray[np.bool_]:
    """Return the wall cells of a world on a grid of its lattice."""
    whole = grid.union(world.grid)
    walls = np.zeros(whole.shape, np.bool_)
    walls[whole.window(world.grid)] = world.reference == 1
    return np.array(walls[whole.window(grid)])


def scoring_tool() -> ModuleType | None:
    """Return ../shared/tools/score_map.py as a module; None if it, scipy or pillow is missing."""
    path = SHARED / 'tools' / 'score_map.py'
    spec = importlib.util.spec_from_file_location('score_map', path)
    if spec is None or spec.loader is None:
        return None
    module = importlib.util.module_from_spec(spec)
    try:
        spec.loader.exec_module(module)
    except (ImportError, OSError) as error:
        print(f'no nav_iou, leak, blocked, and no recordings: {path} cannot be used ({error})', file=sys.stderr)
        return None
    return module


def recorded_cases(tool: ModuleType) -> Iterator[Case]:
    """Yield the recordings that exist."""
    for name in RECORDINGS:
        folder = SHARED / 'data' / name
        if not folder.is_dir():
            print(f'no recording {name}: {folder} is absent', file=sys.stderr)
            continue
        drive = read_drive(folder / 'bag', Parameters(), {}, odom_topic=ODOMETRY)
        truth, origin, resolution = tool.load(folder / 'reference.yaml')
        decided = np.where(truth > 0.65, 1.0, np.where(truth < 0.35, 0.0, np.nan))
        path_xy = np.loadtxt(folder / 'trajectory.csv', delimiter=',', ndmin=2)
        nobody = np.zeros((0, 0), np.int64)
        corner = (float(origin[0]), float(origin[1]))
        yield Case(name, drive.associator.readings, path_xy, decided, corner, resolution, None, nobody)
