"""Quality of refined trajectories: simulated buildings with levels of odometry drift, and recordings.

    python benchmarks/trajectories.py                       # all simulated runs
    python benchmarks/trajectories.py --robot front --level wheels --seeds 2
    python benchmarks/trajectories.py --maps                # with scores of the maps
    python benchmarks/trajectories.py --shared ../shared/data
    python benchmarks/trajectories.py --drawn 12            # buildings of many materials, drawn at random
    python benchmarks/trajectories.py --simulators --maps   # places like the worlds of well-known simulators
    python benchmarks/trajectories.py --bent --level low    # corridors that bend, there and back
    python benchmarks/trajectories.py --slanted --level wheels    # a corner that is not square, twice around
    python benchmarks/trajectories.py --distance 250 500 1000    # growth of time and memory

Each run prints the absolute trajectory error (rms after rigid alignment, metres) of odometry and of the result of
`Refiner`, how much larger than the true path the result is, whether it was accepted, and the time of one core for each
metre; each group ends with a summary. Maps of
recordings are scored as well, by ../shared/tools/score_map.py with --align. With --maps, so are maps of simulated runs,
from exact poses, from odometry, and from the result; the latter two are aligned with the exact poses.
"""

from __future__ import annotations

import argparse
import dataclasses
import math
import resource
import time
from collections.abc import Callable
from pathlib import Path
from types import ModuleType
from typing import Any

import numpy as np
from material_worlds import building_drive
from quality_worlds import scoring_tool
from simulator_worlds import BENT, PLACES, SLANTED

from forward_grid_mapper.core.common.grid import UNKNOWN
from forward_grid_mapper.core.common.parameters import Parameters
from forward_grid_mapper.core.common.readings import Readings
from forward_grid_mapper.core.mapping import Mapper
from forward_grid_mapper.core.trajectory.outcome import replaced
from forward_grid_mapper.core.trajectory.poses import compose, rms_after_alignment
from forward_grid_mapper.core.trajectory.refinement import Refiner
from forward_grid_mapper.core.trajectory.windows import Odometry
from forward_grid_mapper.core.warm_up import warm_up
from forward_grid_mapper.recordings.read_drive import read_drive
from forward_grid_mapper.simulation.drift import LEVELS, drifted, odometry_of, with_drift
from forward_grid_mapper.simulation.drive import Recording, drive
from forward_grid_mapper.simulation.score import SURFACE_DEPTH, score_map, visible_surface
from forward_grid_mapper.simulation.sonar import NoiseModel, SonarArray, front_array, sonar_ring
from forward_grid_mapper.simulation.world import Axis, Floorplan, World, building_tour, building_world


def octagon() -> SonarArray:
    """Return eight sonars at equal angles, none of which points straight ahead or to a side."""
    ring = sonar_ring(8)
    return dataclasses.replace(ring, yaws=tuple(yaw + math.pi / 8 for yaw in ring.yaws))


ROBOTS: dict[str, tuple[Callable[[], SonarArray], float, NoiseModel]] = {
    'ring': (lambda: sonar_ring(16), 0.1, NoiseModel(0.02, 0.01, 0.0)),
    'octagon': (octagon, 0.1, NoiseModel(0.03, 0.04, 0.05)),
    'front': (front_array, 0.1, NoiseModel(0.03, 0.04, 0.05)),
    'cheap': (front_array, 0.15, NoiseModel(0.04, 0.10, 0.3)),
}
"""Sonars, metres between sweeps, and noise."""

SMOOTH = 0.35
"""Fraction of the walls, in pieces of 3 m, that are smooth."""

RECORDINGS = ('building_a', 'building_b', 'building_c', 'office_a', 'office_b')


def in_pieces(world: World, rng: np.random.Generator) -> World:
    """Return a world with walls in pieces of 3 m of one material."""
    segments, smooth = [], []
    for (x0, y0, x1, y1), was in zip(world.segments, world.smooth, strict=True):
        count = max(1, round(math.hypot(x1 - x0, y1 - y0) / 3.0))
        for k in range(count):
            a, b = k / count, (k + 1) / count
            segments.append((x0 + a * (x1 - x0), y0 + a * (y1 - y0), x0 + b * (x1 - x0), y0 + b * (y1 - y0)))
            smooth.append(bool(was) or rng.random() < SMOOTH)
    return dataclasses.replace(world, segments=np.array(segments), smooth=np.array(smooth))


def corridors(seed: int, legs: int) -> tuple[World, np.ndarray]:
    """Return a building with rooms along a corridor around it, and a path along this many of its sides."""
    rng = np.random.default_rng([seed, 5])
    width, height = (int(side * rng.uniform(0.8, 1.2)) for side in (420, 260))
    deep, across = int(rng.integers(38, 55)), int(rng.integers(17, 24))
    plan = Floorplan(f'corridors {seed}', width + 40, height + 40)
    low, high = (20, 20), (20 + width, 20 + height)
    plan.box(low, high)
    outer = low[0] + deep, low[1] + deep, high[0] - deep, high[1] - deep
    inner = outer[0] + across, outer[1] + across, outer[2] - across, outer[3] - across
    sides: list[tuple[Axis, int, int, int, int]] = [
        ('x', outer[1], outer[0], outer[2], low[1]),
        ('y', outer[2], outer[1], outer[3], high[0]),
        ('x', outer[3], outer[0], outer[2], high[1]),
        ('y', outer[0], outer[1], outer[3], low[0]),
    ]
    for axis, wall, begin, end, back in sides:
        at, doors = begin, []
        while at < end - 30:
            to = min(at + int(rng.integers(35, 75)), end)
            to = end if end - to < 30 else to
            if to - at > 24 and rng.random() < 0.8:
                door = int(rng.integers(at + 6, to - 15))
                doors.append((door, door + int(rng.integers(8, 12))))
            if to < end:
                plan.wall('y' if axis == 'x' else 'x', to, (min(wall, back), max(wall, back)))
            at = to
        plan.wall(axis, wall, (begin, end), tuple(doors))
    plan.box(inner[:2], inner[2:])
    half = across // 2
    corners = [
        (outer[0] + half, outer[1] + half),
        (outer[2] - half, outer[1] + half),
        (outer[2] - half, outer[3] - half),
        (outer[0] + half, outer[3] - half),
    ]
    way = [np.array(corners[k % 4]) + 0.5 + (rng.uniform(-3, 3, 2) if k else 0.0) for k in range(legs + 1)]
    return in_pieces(plan.world(corners[0]), rng), np.array(way) * 0.1


def worlds(seed: int) -> dict[str, tuple[World, np.ndarray]]:
    """Return worlds and paths through them; a seed changes floor plans and materials."""
    rng = np.random.default_rng(seed)
    tour = building_tour() + np.r_[np.zeros((1, 2)), rng.uniform(-0.05, 0.05, (len(building_tour()) - 1, 2))]
    world, way = corridors(seed + 100, 3)
    return {
        'one pass': corridors(seed, 3),
        'around': corridors(seed, 6),
        'to and fro': (world, np.concatenate([way, way[-2::-1]])),
        'rooms': (building_world(), tour),
    }


def size_error(estimate: np.ndarray, true: np.ndarray) -> float:
    """Return how much larger than the true one a path is, percent; both are poses of the same times, shape (N, 3)."""
    a, b = estimate[:, :2] - estimate[:, :2].mean(0), true[:, :2] - true[:, :2].mean(0)
    common = math.hypot((a * b).sum(), (a[:, 0] * b[:, 1] - a[:, 1] * b[:, 0]).sum())
    return 100 * (float((a**2).sum()) / common - 1)


def run(name: str, readings: Readings, odometry: Odometry, true: Odometry) -> dict[str, Any]:
    """Refine one drive, print a row and return its figures."""
    began = time.process_time()
    outcome = Refiner(Parameters()).run(readings, odometry)
    spent = 1e3 * (time.process_time() - began) / odometry.travel[-1]
    before, after = (rms_after_alignment(path.at(true.stamp), true.pose) for path in (odometry, outcome.trajectory))
    larger = size_error(outcome.trajectory.at(true.stamp), true.pose)
    worse = after > before + max(0.02, 0.05 * before)
    taken = 'taken' if outcome.accepted else f'left: {outcome.reason}'
    print(
        f'{name:<34} {before:7.2f} → {after:6.3f} m  {larger:+5.1f} %  {spent:4.0f} ms/m  '
        f'{"WORSE  " if worse else ""}{taken}',
        flush=True,
    )
    return {
        'before': before,
        'after': after,
        'larger': larger,
        'worse': worse,
        'taken': outcome.accepted,
        'ms': spent,
        'readings': outcome.readings,
        'trajectory': outcome.trajectory,
    }


def aligned(readings: Readings, path: Odometry, true: Odometry) -> Readings:
    """Return the readings after the rigid transform that aligns the path with the true one."""
    estimate, truth = path.at(true.stamp), true.pose
    a, b = estimate[:, :2] - estimate[:, :2].mean(0), truth[:, :2] - truth[:, :2].mean(0)
    turn = math.atan2((a[:, 0] * b[:, 1] - a[:, 1] * b[:, 0]).sum(), (a * b).sum())
    middle = compose(np.array([0.0, 0.0, turn]), np.r_[estimate[:, :2].mean(0), 0.0])
    frame = np.r_[truth[:, :2].mean(0) - middle[:2], turn]
    x, y, yaw = compose(frame, np.stack([readings.x, readings.y, readings.yaw], axis=-1)).T
    return dataclasses.replace(readings, x=x, y=y, yaw=yaw)


def add_map_scores(row: dict[str, Any], exact: Recording, drifted: Recording) -> None:
    """Print and store F1 of the maps from exact poses, from odometry and from the result."""
    true, visible = odometry_of(exact), visible_surface(exact.world, exact.readings, SURFACE_DEPTH)
    placed = {
        'exact': exact.readings,
        'odometry': aligned(drifted.readings, odometry_of(drifted), true),
        'refined': aligned(row['readings'], row['trajectory'], true),
    }
    for name, readings in placed.items():
        maps = Mapper(Parameters()).run(readings)
        row[name] = score_map(maps.ml, maps.grid, exact.world, visible).f1
    print(f'{"":<34} F1 ' + ', '.join(f'{name} {row[name]:.3f}' for name in placed), flush=True)


def simulated(
    robot: str, level: str, seeds: range, maps: bool, worlds_of: Callable[[int], dict[str, tuple[World, np.ndarray]]]
) -> list[dict[str, Any]]:
    """Run one robot and level in the worlds of each seed."""
    sonars, spacing, noise = ROBOTS[robot]
    rows = []
    for seed in seeds:
        for name, (world, way) in worlds_of(seed).items():
            exact = drive(world, way, spacing, sonars(), noise, seed)
            recording = with_drift(exact, LEVELS[level], seed) if level != 'none' else exact
            title = f'{robot}, {level}, {name}, seed {seed}'
            rows.append(run(title, recording.readings, odometry_of(recording), odometry_of(exact)))
            if maps:
                add_map_scores(rows[-1], exact, recording)
    return rows


def drawn(level: str, seeds: range) -> list[dict[str, Any]]:
    """Run drives through random buildings of many materials, rotated by any angle, with sensors chosen by the seed."""
    rows = []
    for seed in seeds:
        _, _, poses, stamps, readings = building_drive(seed, there_and_back=True)
        true = Odometry.of(stamps, poses)
        odometry = Odometry.of(stamps, drifted(true.pose, LEVELS[level], seed) if level != 'none' else poses)
        count = len(readings.sensor_names)
        angle = 2 * math.degrees(readings.half_angle[0])
        title = f'drawn, {level}, {count} x {angle:.0f}°, {true.travel[-1]:.0f} m, seed {seed}'
        rows.append(run(title, replaced(readings, true, odometry), odometry, true))
    return rows


def far(robot: str, level: str, distances: list[float], seed: int) -> None:
    """Run drives around one building, of increasing length, and print time and the peak memory so far."""
    sonars, spacing, noise = ROBOTS[robot]
    for distance in sorted(distances):
        legs = 4
        while np.hypot(*np.diff(corridors(seed, legs)[1], axis=0).T).sum() < distance:
            legs += 1
        world, way = corridors(seed, legs)
        exact = drive(world, way, spacing, sonars(), noise, seed)
        recording = with_drift(exact, LEVELS[level], seed)
        true, before = odometry_of(exact), resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 1024
        run(f'{robot}, {level}, {true.travel[-1]:.0f} m', recording.readings, odometry_of(recording), true)
        peak = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 1024
        print(f'{"":<34} {len(exact.readings)} readings; {before:.0f} MB before, {peak:.0f} MB at the peak', flush=True)


def recorded(folder: Path) -> list[dict[str, Any]]:
    """Run the recordings that have corrected odometry in addition to the raw one."""
    rows, tool = [], scoring_tool()
    for name in RECORDINGS:
        if not (folder / name).exists():
            continue
        raw, right = (
            read_drive(folder / name / 'bag', Parameters(), {}, None, topic) for topic in ('/odom', '/odom_corrected')
        )
        odometry, true = (Odometry.of(*each.associator.odometry) for each in (raw, right))
        rows.append(run(name, raw.associator.readings, odometry, true))
        if tool is not None:
            print_map_score(rows[-1]['readings'], folder / name, tool)
    return rows


def print_map_score(readings: Readings, folder: Path, tool: ModuleType) -> None:
    """Print scores of the map of readings, aligned with the reference."""
    maps = Mapper(Parameters()).run(readings)
    probability = np.where(maps.ml == UNKNOWN, np.nan, maps.ml)
    truth, corner, cell = tool.load(folder / 'reference.yaml')
    origin, resolution = np.array(maps.grid.origin), maps.grid.resolution
    motion = tool.rigid(probability, origin, resolution, truth, corner, cell)
    moved = tool.resample_moved(probability, origin, resolution, motion, truth.shape, corner, cell)
    path = tool.path_cells(np.loadtxt(folder / 'trajectory.csv', delimiter=',', ndmin=2), corner, cell, truth.shape)
    said = tool.score(moved, truth, path, cell)
    print(f'{"":<34} F1 of the map {said["f1"]:.3f}, nav_iou {said["nav_iou"]:.3f}', flush=True)


def summary(title: str, rows: list[dict[str, Any]]) -> None:
    """Print a summary of a group of runs."""
    before, after, spent = (np.array([row[key] for row in rows], float) for key in ('before', 'after', 'ms'))
    taken, worse = (sum(bool(row[key]) for row in rows) for key in ('taken', 'worse'))
    larger = [row['larger'] for row in rows if row['taken']] or [math.nan]
    print(
        f'{title:<34} {np.median(before):7.2f} → {np.median(after):6.3f} m in the median, {after.max():.2f} m at '
        f'worst; {taken} of {len(rows)} taken, {worse} worse; {np.median(larger):+.1f} % in size; '
        f'{np.median(spent):.0f} ms/m'
    )
    if rows and 'exact' in rows[0]:
        exact, odometry, refined = (np.array([row[key] for row in rows]) for key in ('exact', 'odometry', 'refined'))
        print(
            f'{"":<34} F1 exact {np.median(exact):.3f}, odometry {np.median(odometry):.3f}, refined '
            f'{np.median(refined):.3f}; refined below exact by {np.median(exact - refined):.3f} in the median, '
            f'{(exact - refined).max():.3f} at worst'
        )
    print()


def main() -> None:
    """Run the benchmark."""
    parser = argparse.ArgumentParser(description=__doc__.split('\n\n')[0])
    parser.add_argument('--robot', choices=[*ROBOTS], action='append')
    parser.add_argument('--level', choices=['none', *LEVELS], action='append')
    parser.add_argument('--seeds', type=int, default=5)
    parser.add_argument('--first-seed', type=int, default=0, help='0 to 9, 20 and 21 were tuned on')
    parser.add_argument('--maps', action='store_true', help='score the maps of simulated runs, too')
    parser.add_argument('--shared', type=Path, help='folder of recordings with corrected odometry, instead')
    parser.add_argument('--drawn', type=int, help='this many buildings drawn at random, instead')
    parser.add_argument('--simulators', action='store_true', help='places like the worlds of simulators, instead')
    parser.add_argument('--bent', action='store_true', help='corridors that bend, instead')
    parser.add_argument('--slanted', action='store_true', help='corridors with a corner that is not square, instead')
    parser.add_argument('--distance', type=float, nargs='+', help='metres of longer and longer drives, instead')
    options = parser.parse_args()
    warm_up()
    if options.distance:
        for robot in options.robot or ['front']:
            for level in options.level or ['middle']:
                far(robot, level, options.distance, options.first_seed)
        return
    if options.shared:
        summary('recordings', recorded(options.shared))
        return
    if options.drawn:
        for level in options.level or ['wheels']:
            rows = drawn(level, range(options.first_seed, options.first_seed + options.drawn))
            summary(f'drawn, {level}', rows)
        return
    seeds = range(options.first_seed, options.first_seed + options.seeds)
    places = BENT if options.bent else SLANTED if options.slanted else PLACES if options.simulators else None
    worlds_of = worlds if places is None else lambda seed: {name: place() for name, place in places.items()}
    for robot in options.robot or ROBOTS:
        for level in options.level or ('none', *LEVELS):
            rows = simulated(robot, level, seeds, options.maps, worlds_of)
            summary(f'{robot}, {level}', rows)


if __name__ == '__main__':
    main()
