#!/usr/bin/env python3
"""Error of the robot's pose on the map while it drives on after a refinement of the trajectory.

    python benchmarks/following.py                                # the rows of the docs
    python benchmarks/following.py --robot ring --level high --seeds 2

The simulated drives are those of `trajectories.py`. The whole trajectory is refined every 20 m, as in the node with
`refine_every`; in between, the correction is kept constant, or followed. `nothing` is odometry without correction.
Prints the rms of position errors, metres, after the first accepted trajectory; the current map is aligned with the true
one by its whole trajectory. `ms a window` is processor time: mean, 95 %, maximum.
"""

from __future__ import annotations

import argparse
import time

import numpy as np
from trajectories import ROBOTS, worlds

from forward_grid_mapper.core.common.parameters import Parameters
from forward_grid_mapper.core.common.readings import Floats, Readings
from forward_grid_mapper.core.trajectory.correction import Correction
from forward_grid_mapper.core.trajectory.following import Follower
from forward_grid_mapper.core.trajectory.outcome import Refinement
from forward_grid_mapper.core.trajectory.poses import compose, inverse
from forward_grid_mapper.core.trajectory.refinement import Refiner
from forward_grid_mapper.core.trajectory.windows import Odometry
from forward_grid_mapper.core.warm_up import warm_up
from forward_grid_mapper.simulation.drift import LEVELS, odometry_of, with_drift
from forward_grid_mapper.simulation.drive import drive

EVERY, MOST = 20.0, 100.0
"""Metres between two runs, and length of a drive."""

FOLLOW_EVERY = 5
"""Poses of odometry between two calls of the follower."""


def fitted(path: Floats, true: Floats) -> Floats:
    """Return the rigid transform, shape (3,), that aligns a path with the true one; shapes (M, 3)."""
    a, b = path[:, :2] - path[:, :2].mean(0), true[:, :2] - true[:, :2].mean(0)
    turn = np.arctan2((a[:, 0] * b[:, 1] - a[:, 1] * b[:, 0]).sum(), (a * b).sum())
    middle = np.array([*path[:, :2].mean(0), 0.0])
    return compose(np.array([*true[:, :2].mean(0), turn]), inverse(middle))


def off(motion: Floats, path: Floats, true: Floats) -> Floats:
    """Return the position errors of poses on the map, metres, shape (M,)."""
    return np.asarray(np.hypot(*(compose(motion, path) - true)[:, :2].T))


def part_of(path: Odometry, end: int) -> Odometry:
    """Return the first poses of a path."""
    return Odometry(path.stamp[:end], path.pose[:end])


def followed(
    base: Correction, found: Refinement, readings: Readings, odometry: Odometry, end: int
) -> tuple[Floats, list[float]]:
    """Return the online estimate of each pose of odometry after the end of `base`, and ms of each window."""
    first, said, spent = len(base.odometry.stamp), [], []
    follower = Follower(base, found.calibration, Parameters(), found.noise)
    follower.follow(readings.select(readings.stamp <= base.end), base.odometry)
    for k in range(first, end):
        if k % FOLLOW_EVERY == 0:
            so_far = readings.select(slice(0, int(np.searchsorted(readings.stamp, odometry.stamp[k], side='right'))))
            before, began = follower.windows, time.process_time()
            follower.follow(so_far, part_of(odometry, k + 1))
            if follower.windows > before:
                spent.append(1e3 * (time.process_time() - began) / (follower.windows - before))
        said.append(compose(follower.correction.last, odometry.pose[k]))
    return np.array(said), spent


def run(name: str, readings: Readings, odometry: Odometry, true: Odometry) -> tuple[list[Floats], list[float]]:
    """Print a row; return the errors without correction, with a constant and a followed one, and ms of windows."""
    travel, at = odometry.travel, EVERY
    columns: list[list[Floats]] = [[], [], []]
    spent: list[float] = []
    while at < min(travel[-1], MOST):
        first = int(np.searchsorted(travel, at)) + 1
        end = int(np.searchsorted(travel, min(at + EVERY, MOST)))
        begun = part_of(odometry, first)
        found = Refiner(Parameters()).run(readings.select(readings.stamp <= begun.stamp[-1]), begun)
        base = Correction(begun, found.trajectory) if found.accepted else None
        at += EVERY
        if base is None:
            continue
        motion, truth, raw = fitted(base.trajectory.pose, true.pose[:first]), true.pose[first:end], odometry.pose
        said, more = followed(base, found, readings, odometry, end)
        spent += more
        start = compose(true.pose[0], inverse(raw[0]))
        columns[0].append(off(start, raw[first:end], truth))
        columns[1].append(off(motion, compose(base.last, raw[first:end]), truth))
        columns[2].append(off(motion, said, truth))
    each = [np.concatenate(column) if column else np.zeros(0) for column in columns]
    if len(each[0]):
        print(f'{name:36s}{figures(each)}{milliseconds(spent)}', flush=True)
    else:
        print(f'{name:36s} no trajectory was taken', flush=True)
    return each, spent


def figures(each: list[Floats]) -> str:
    """Return the rms of each column, in words."""
    return ''.join(f'{np.sqrt((column**2).mean()):10.2f}' for column in each)


def milliseconds(spent: list[float]) -> str:
    """Return mean, 95 % and maximum, in words."""
    return f'{np.mean(spent):12.0f}{np.percentile(spent, 95):6.0f}{max(spent):6.0f}'


def main() -> None:
    """Run the benchmark."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument('--robot', choices=sorted(ROBOTS), default='front')
    parser.add_argument('--level', choices=sorted(LEVELS), default='wheels')
    parser.add_argument('--seeds', type=int, default=1)
    parser.add_argument('--first-seed', type=int, default=90)
    options = parser.parse_args()
    warm_up()
    print(f'{"":36s}{"nothing":>10s}{"kept":>10s}{"followed":>10s}{"ms a window":>24s}')
    sonars, spacing, noise = ROBOTS[options.robot]
    every: list[list[Floats]] = []
    spent: list[float] = []
    for seed in range(options.first_seed, options.first_seed + options.seeds):
        for name, (world, way) in worlds(seed).items():
            exact = drive(world, way, spacing, sonars(), noise, seed)
            bent = with_drift(exact, LEVELS[options.level], seed)
            title = f'{options.robot}, {options.level}, {name}, seed {seed}'
            each, more = run(title, bent.readings, odometry_of(bent), odometry_of(exact))
            every.append(each)
            spent += more
    if spent:
        together = [np.concatenate([each[k] for each in every]) for k in range(3)]
        print(f'{"all":36s}{figures(together)}{milliseconds(spent)}')


if __name__ == '__main__':
    main()
