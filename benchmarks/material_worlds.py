"""Drives through random buildings with walls of many materials, for tuning and evaluation of maps.

Floor plans are one or two corridors with rooms on both sides and a hall, rotated by any angle, so that no wall is
parallel to the lattice. Walls have two faces. Each piece of 3 m has one material, which returns echoes up to its own
largest incidence: rough, smooth, or glass. There are furniture and thin posts; posts return echoes only to near
sensors, or never. A cone without a direct echo may have one by reflection at the wall that its axis hits. Echoes may
be lost, too early, or from another sensor. The truth is the map of a laser on the robot.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, field
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray
from quality_worlds import Case
from scipy import ndimage
from scipy.sparse import coo_matrix
from scipy.sparse.csgraph import dijkstra

from forward_grid_mapper.core.common.readings import Floats, Readings
from forward_grid_mapper.simulation.rays import NOTHING, cast
from forward_grid_mapper.simulation.sonar import SonarArray, front_array, sonar_ring

CELL = 0.1
PIECE = 3.0
"""Length of wall with one material, metres."""
LASER = 8.0
CLEARANCE = 0.33
"""Smallest distance of the robot's centre from objects, metres."""

SENSORS: tuple[tuple[SonarArray, float], ...] = (
    (front_array(), 0.1),
    (sonar_ring(24, max_range=5.0), 0.16),
    (sonar_ring(8, max_range=5.0), 0.1),
    (sonar_ring(16, field_of_view=math.radians(30.0), max_range=5.0), 0.15),
    (front_array(field_of_view=math.radians(20.0)), 0.1),
    (sonar_ring(12, field_of_view=math.radians(25.0), max_range=4.0), 0.12),
    (sonar_ring(8, field_of_view=math.radians(30.0), max_range=4.0), 0.1),
    (sonar_ring(16, max_range=5.0), 0.12),
)
"""Sonars and metres between sweeps, in turn for the seeds."""


@dataclass
class Plan:
    """Faces and their reflection: segments in metres, largest incidence in radians, and largest range of echoes."""

    rng: np.random.Generator
    segments: list[tuple[float, float, float, float]] = field(default_factory=list)
    limit: list[float] = field(default_factory=list)
    heard: list[float] = field(default_factory=list)
    floors: list[tuple[float, float, float, float]] = field(default_factory=list)
    rooms: list[tuple[float, float, float, float]] = field(default_factory=list)

    def material(self) -> float:
        """Return a random largest incidence: that of more than half is rough, that of some is glass."""
        kind = self.rng.random()
        low, high = (45, 80) if kind < 0.55 else (20, 45) if kind < 0.85 else (10, 20)
        return math.radians(self.rng.uniform(low, high))

    def face(self, x0: float, y0: float, x1: float, y1: float) -> None:
        """Add a wall's face in pieces."""
        count = max(1, round(math.hypot(x1 - x0, y1 - y0) / PIECE))
        for k in range(count):
            a, b = k / count, (k + 1) / count
            self.segments.append((x0 + a * (x1 - x0), y0 + a * (y1 - y0), x0 + b * (x1 - x0), y0 + b * (y1 - y0)))
            self.limit.append(self.material())
            self.heard.append(math.inf)

    def box(self, x: float, y: float, size: tuple[float, float], heard: float = math.inf) -> None:
        """Add the four sides of an object around a point."""
        w, h = size[0] / 2, size[1] / 2
        limit = self.material() if math.isinf(heard) else math.pi / 2
        corners = ((x - w, y - h), (x + w, y - h), (x + w, y + h), (x - w, y + h))
        for (x0, y0), (x1, y1) in zip(corners, corners[1:] + corners[:1], strict=True):
            self.segments.append((x0, y0, x1, y1))
            self.limit.append(limit)
            self.heard.append(heard)

    def corridor(self, length: float, width: float) -> None:
        """Draw a corridor along x from the origin, with rooms on both sides and a hall at its far end."""
        self.floors.append((0.0, 0.0, length, width))
        self.face(0.0, 0.0, 0.0, width)
        for sign, side in ((-1.0, 0.0), (1.0, width)):
            at = 0.0
            while at < length - 2.5:
                wide = min(self.rng.uniform(2.5, 6.0), length - at)
                self._room(at, at + wide, side, sign)
                at += wide
            self.face(at, side, length, side)
        self._hall(length, width)

    def _room(self, left: float, right: float, side: float, sign: float) -> None:
        rng = self.rng
        thick, deep, door = rng.uniform(0.08, 0.2), rng.uniform(2.5, 6.0), rng.uniform(0.7, 1.1)
        at = rng.uniform(left + 0.4, right - 0.4 - door)
        near, back = side + sign * thick, side + sign * (thick + deep)
        low, high = left + thick / 2, right - thick / 2
        self.face(left, side, at, side)
        self.face(at + door, side, right, side)
        open_door = rng.random() < 0.65
        inside = near if open_door else side + sign * rng.uniform(0.02, 0.08)
        self.face(at, side, at, inside)
        self.face(at + door, side, at + door, inside)
        if not open_door:
            self.face(at, inside, at + door, inside)
            return
        self.face(low, near, at, near)
        self.face(at + door, near, high, near)
        for x in (low, high):
            self.face(x, near, x, back)
        self.face(low, back, high, back)
        bottom, top = min(near, back), max(near, back)
        self.floors += [(low, bottom, high, top), (at, min(side, near), at + door, max(side, near))]
        self.rooms.append((low, bottom, high, top))
        self._furnish((low, bottom, high, top), int(rng.integers(1, 6)))

    def _hall(self, x: float, width: float) -> None:
        """Draw a hall of random width at the end of the corridor."""
        rng = self.rng
        below, above, long = rng.uniform(0.5, 4.0), rng.uniform(0.5, 4.0), rng.uniform(3.0, 8.0)
        low, high = -below, width + above
        for x0, y0, x1, y1 in ((x, low, x, 0.0), (x, width, x, high), (x, low, x + long, low)):
            self.face(x0, y0, x1, y1)
        self.face(x, high, x + long, high)
        self.face(x + long, low, x + long, high)
        self.floors.append((x, low, x + long, high))
        self.rooms.append((x, low, x + long, high))
        self._furnish((x, low, x + long, high), int(rng.integers(2, 7)))

    def _furnish(self, room: tuple[float, float, float, float], count: int) -> None:
        rng = self.rng
        left, bottom, right, top = room
        for _ in range(count):
            x, y = rng.uniform(left + 0.3, right - 0.3), rng.uniform(bottom + 0.3, top - 0.3)
            if rng.random() < 0.5:
                self.box(x, y, (0.06, 0.06), rng.choice([0.0, 1.5, 3.0, 6.0]))
            else:
                self.box(x, y, (rng.uniform(0.3, 1.2), rng.uniform(0.3, 0.8)))


@dataclass(frozen=True)
class Physics:
    """Errors of a building's sonars: fractions of readings, echoes too early per metre, and ghosts without echoes."""

    lost: float
    early: float
    random: float
    ghost: float
    relative: float
    constant: float
    fading: float


def physics_of(rng: np.random.Generator) -> Physics:
    """Return random errors; `fading` is the decrease of the largest incidence towards the edge of the beam."""
    u = rng.uniform
    return Physics(u(0, 0.12), u(0, 0.04), u(0.005, 0.06), u(0.2, 0.8), u(0.003, 0.015), u(0.01, 0.03), u(0, 0.5))


def _rays(plan: Plan, turn: float) -> Floats:
    c, s = math.cos(turn), math.sin(turn)
    ends = np.array(plan.segments).reshape(-1, 2) @ np.array([[c, s], [-s, c]])
    return np.asarray(ends.reshape(-1, 4))


def way_through(plan: Plan, rng: np.random.Generator) -> Floats:
    """Return a path through most rooms, a point every few centimetres, shape (P, 2), in the plan's own frame."""
    segments = np.array(plan.segments)
    low = np.minimum(segments[:, :2], segments[:, 2:]).min(0) - 0.5
    high = np.maximum(segments[:, :2], segments[:, 2:]).max(0) + 0.5
    step = 0.05
    shape = tuple(np.ceil((high - low) / step).astype(int)[::-1])
    floor, walls = np.zeros(shape, bool), np.zeros(shape, bool)
    for x0, y0, x1, y1 in plan.floors:
        a, b = ((np.array([x0, y0, x1, y1]).reshape(2, 2) - low) / step).round().astype(int)
        floor[a[1] : b[1] + 1, a[0] : b[0] + 1] = True
    for x0, y0, x1, y1 in segments:
        t = np.linspace(0, 1, 2 + int(math.hypot(x1 - x0, y1 - y0) / 0.02))
        walls[
            ((y0 + t * (y1 - y0) - low[1]) / step).astype(int), ((x0 + t * (x1 - x0) - low[0]) / step).astype(int)
        ] = 1
    room = floor & (ndimage.distance_transform_edt(~walls) * step > CLEARANCE)
    index = np.full(shape, -1)
    index[room] = np.arange(room.sum())
    rows, columns, costs = [], [], []
    away = ndimage.distance_transform_edt(~walls) * step
    for dy, dx in ((0, 1), (1, 0), (1, 1), (1, -1)):
        a = index[: shape[0] - dy, max(0, -dx) : shape[1] - max(0, dx)]
        b = index[dy:, max(0, dx) : shape[1] + min(0, dx)]
        d = away[: shape[0] - dy, max(0, -dx) : shape[1] - max(0, dx)]
        both = (a >= 0) & (b >= 0)
        rows.append(a[both])
        columns.append(b[both])
        costs.append(math.hypot(dy, dx) * (1 + 0.3 / d[both]))
    n = int(room.sum())
    graph = coo_matrix((np.concatenate(costs), (np.concatenate(rows), np.concatenate(columns))), (n, n)).tocsr()
    cells = np.argwhere(room)

    def nearest(x: float, y: float) -> int:
        return int(np.abs(cells - [(y - low[1]) / step, (x - low[0]) / step]).sum(1).argmin())

    left, bottom, _, top = plan.floors[0]
    at = nearest(left + 0.8, (bottom + top) / 2)
    path = [at]
    for k in rng.permutation(len(plan.rooms)):
        x0, y0, x1, y1 = plan.rooms[k]
        if rng.random() < 0.25:
            continue
        for _ in range(rng.integers(1, 3)):
            goal = nearest(rng.uniform(x0 + 0.4, x1 - 0.4), rng.uniform(y0 + 0.4, y1 - 0.4))
            length, before = dijkstra(graph, directed=False, indices=at, return_predecessors=True)
            if not np.isfinite(length[goal]):
                continue
            part = [goal]
            while part[-1] != at:
                part.append(before[part[-1]])
            path += part[-2::-1]
            at = goal
    points = cells[path][:, ::-1] * step + low + step / 2
    return np.asarray(ndimage.gaussian_filter1d(points, 4.0, axis=0, mode='nearest'))


def poses_along(points: Floats, spacing: float) -> Floats:
    """Return poses every `spacing` metres, heading along the path, shape (T, 3)."""
    away = np.r_[0.0, np.cumsum(np.hypot(*np.diff(points, axis=0).T))]
    at = np.arange(0.0, away[-1], spacing)
    x, y = (np.interp(at, away, points[:, k]) for k in range(2))
    ahead = [np.interp(at + 0.15, away, points[:, k]) - np.interp(at - 0.15, away, points[:, k]) for k in range(2)]
    return np.stack([x, y, np.arctan2(ahead[1], ahead[0])], axis=1)


def sound(
    plan: Plan, segments: Floats, origins: Floats, angles: Floats, off: Floats, reach: float, physics: Physics
) -> tuple[Floats, Floats, NDArray[np.int64]]:
    """Return the length of each ray if it returns (else inf), its length, and the index of what it hits."""
    distance, hit = cast(origins, angles, segments, reach)
    normal = np.arctan2(segments[:, 3] - segments[:, 1], segments[:, 2] - segments[:, 0]) + math.pi / 2
    incidence = np.arccos(np.clip(np.abs(np.cos(angles - normal[hit])), 0, 1))
    limit = np.array(plan.limit)[hit] * (1.0 - physics.fading * off**2)
    back = (hit != NOTHING) & (incidence <= limit) & (distance <= np.array(plan.heard)[hit])
    return np.where(back, distance, np.inf), distance, hit


def measure(
    plan: Plan, segments: Floats, sonars: SonarArray, poses: Floats, physics: Physics, rng: np.random.Generator
) -> Floats:
    """Return the ranges of all sonars at all poses, shape (N,), +inf without echo."""
    half, z_max = sonars.field_of_view / 2, sonars.max_range
    at = sonars.poses(poses).reshape(-1, 3)
    off = np.linspace(-1.0, 1.0, 2 * round(math.degrees(half)) + 1)
    angles = at[:, 2:] + off * half
    back, distance, hit = sound(plan, segments, at[:, :2], angles, off[None, :], z_max, physics)
    z = back.min(axis=1)
    axis = len(off) // 2
    ghost = np.flatnonzero(np.isinf(z) & (hit[:, axis] != NOTHING) & (rng.random(len(z)) < physics.ghost))
    x0, y0, x1, y1 = segments[hit[ghost, axis]].T
    heading, leg = angles[ghost, axis], distance[ghost, axis]
    start = at[ghost, :2] + (leg - 1e-3)[:, None] * np.stack([np.cos(heading), np.sin(heading)], axis=1)
    fan = (2 * np.arctan2(y1 - y0, x1 - x0) - heading)[:, None] + off * half
    rest = sound(plan, segments, start, fan, off[None, :], z_max, physics)[0].min(axis=1)
    z[ghost] = rest + leg
    z = z + (physics.relative * np.where(np.isfinite(z), z, 0.0) + physics.constant) * rng.standard_normal(len(z))
    u = rng.random((4, len(z)))
    early = np.isfinite(z) & (u[0] < physics.early * np.where(np.isfinite(z), z, 0.0))
    z = np.where(early, z * rng.uniform(0.3, 1.0, len(z)), z)
    z = np.where(u[1] < physics.lost, np.inf, z)
    z = np.where(u[2] < physics.random, sonars.min_range + u[3] * (z_max - sonars.min_range), z)
    z = np.where(z >= z_max, np.inf, np.maximum(z, sonars.min_range))
    return np.asarray(z)


def seen_by_laser(segments: Floats, poses: Floats, mostly: bool) -> tuple[Floats, tuple[float, float]]:
    """Return the map of a laser along the path (1 occupied, 0 free, NaN unknown), and its lower left corner.

    A cell is occupied if a ray ended in it, or, with `mostly`, if three rays or more ended in it, and more than passed.
    """
    angles = np.linspace(-math.pi, math.pi, 720, endpoint=False)
    low = np.floor((np.minimum(segments[:, :2], segments[:, 2:]).min(0) - 0.5) / CELL) * CELL
    high = np.maximum(segments[:, :2], segments[:, 2:]).max(0) + 0.5
    shape = tuple(np.ceil((high - low) / CELL).astype(int)[::-1])
    free, hits, passed = np.zeros(shape, bool), np.zeros(shape, np.int64), np.zeros(shape, np.int64)
    for pose in poses[::3]:
        distance, hit = cast(pose[None, :2], angles[None, :], segments, LASER)
        met = hit[0] != NOTHING
        far = np.where(met, distance[0], LASER)
        along = np.arange(0.0, LASER, CELL / 2)
        inside = along[None, :] < far[:, None] - CELL / 2
        for s, target in ((along, inside),):
            x = pose[0] + np.cos(angles)[:, None] * s
            y = pose[1] + np.sin(angles)[:, None] * s
            rows = ((y[target] - low[1]) / CELL).astype(int)
            columns = ((x[target] - low[0]) / CELL).astype(int)
            ok = (rows >= 0) & (rows < shape[0]) & (columns >= 0) & (columns < shape[1])
            free[rows[ok], columns[ok]] = True
        x, y = pose[0] + np.cos(angles[met]) * far[met], pose[1] + np.sin(angles[met]) * far[met]
        end = ((y - low[1]) / CELL).astype(int), ((x - low[0]) / CELL).astype(int)
        np.add.at(hits, end, 1)
        if mostly:
            _count_passes(pose, angles, far, np.where(met, far, np.inf), low, passed)
    truth = np.where(free | (hits > 0), 0.0, np.nan)
    truth[(hits > np.maximum(passed, 2)) if mostly else hits > 0] = 1.0
    return truth, (float(low[0]), float(low[1]))


def _count_passes(pose: Floats, angles: Floats, far: Floats, end: Floats, low: Floats, passed: Any) -> None:
    """Add to each cell the number of rays of a scan that passed it without ending in it."""
    along = np.arange(0.0, LASER, CELL / 2)

    def cell_at(length: Floats) -> NDArray[np.int64]:
        x, y = pose[0] + np.cos(angles)[:, None] * length, pose[1] + np.sin(angles)[:, None] * length
        rows, columns = ((y - low[1]) / CELL).astype(np.int64), ((x - low[0]) / CELL).astype(np.int64)
        inside = (rows >= 0) & (rows < passed.shape[0]) & (columns >= 0) & (columns < passed.shape[1])
        return np.where(inside, rows * passed.shape[1] + columns, -1)

    cells = cell_at(along[None, :])
    last = cell_at(np.where(np.isfinite(end), end, 0.0)[:, None])
    on = (along < far[:, None]) & (cells >= 0) & ((cells != last) | np.isinf(end)[:, None])
    # once for each ray
    on[:, 1:] &= ~(on[:, :-1] & (cells[:, 1:] == cells[:, :-1]))
    passed += np.bincount(cells[on], minlength=passed.size).reshape(passed.shape)


class BuildingDrive(NamedTuple):
    """A drive through a random building: sensors, faces (world frame), exact poses and readings."""

    sonars: SonarArray
    segments: Floats
    poses: Floats
    stamps: NDArray[np.int64]
    readings: Readings


def building_drive(seed: int, sensors: int | None = None, there_and_back: bool = False) -> BuildingDrive:
    """Return the drive of a seed.

    Parameters
    ----------
    seed : int
    sensors : int, optional
        Index in `SENSORS`; by default, the seed chooses.
    there_and_back : bool
        Whether the robot drives back as well, and then another path through the building.
    """
    rng = np.random.default_rng([seed, 77])
    sonars, spacing = SENSORS[(seed if sensors is None else sensors) % len(SENSORS)]
    plan = Plan(rng)
    plan.corridor(rng.uniform(9.0, 20.0), rng.uniform(1.5, 2.6))
    physics, turn = physics_of(rng), rng.uniform(-math.pi, math.pi)
    points = way_through(plan, rng)
    if there_and_back:
        points = np.concatenate([points, points[::-1], way_through(plan, rng)])
    c, s = math.cos(turn), math.sin(turn)
    poses = poses_along(points @ np.array([[c, s], [-s, c]]), spacing)
    segments = _rays(plan, turn)
    z = measure(plan, segments, sonars, poses, physics, rng)
    x, y, yaw = sonars.poses(poses).reshape(-1, 3).T
    count, stamps = len(sonars.yaws), np.arange(len(poses)) * int(spacing * 2e9)
    readings = Readings.from_columns(
        sonars.names,
        x=x,
        y=y,
        yaw=yaw,
        z=np.minimum(z, sonars.max_range),
        z_max=sonars.max_range,
        half_angle=sonars.field_of_view / 2,
        stamp=np.repeat(stamps, count),
        sensor=np.tile(np.arange(count), len(poses)),
    )
    return BuildingDrive(sonars, segments, poses, stamps, readings)


def building_case(seed: int, sensors: int | None = None, mostly: bool = False) -> Case:
    """Return the drive of a seed, and the map of a laser.

    Parameters
    ----------
    seed, sensors
        As in `building_drive`.
    mostly : bool
        Definition of occupied cells, see `seen_by_laser`.
    """
    driven = building_drive(seed, sensors)
    truth, origin = seen_by_laser(driven.segments, driven.poses, mostly)
    nobody = np.zeros((0, 0), np.int64)
    return Case(f'materials {seed}', driven.readings, driven.poses[:, :2], truth, origin, CELL, None, nobody)
