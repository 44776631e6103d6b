#!/usr/bin/env python3
"""The objective that EM reaches, in this and in another checkout, evaluated by the same code.

usage: objective.py [--against DIR] [--seeds 3] [--data ../shared/data]

The paper's two worlds, the building, and the real recordings below --data, if they exist; each with a prior and lost
echoes, and with the paper's plain maximum likelihood, in both cases without the default's extensions of the paper's
model, since objectives would differ. For each map: J(m) = log p(Z | m) + logit(prior) x (occupied cells) in nats, from
the exact forward model of this checkout; F1 in the simulated worlds, with one cell of tolerance.
"""

from __future__ import annotations

import argparse
import json
import math
import os
import statistics
import subprocess
import sys
import tempfile
import time
from collections.abc import Iterator
from pathlib import Path
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

import forward_grid_mapper
from forward_grid_mapper.core.common.grid import Grid
from forward_grid_mapper.core.common.parameters import Parameters
from forward_grid_mapper.core.common.readings import Readings
from forward_grid_mapper.core.mapping import Mapper
from forward_grid_mapper.core.warm_up import warm_up

ROOT = Path(__file__).resolve().parents[1]
COLUMNS = ('x', 'y', 'yaw', 'z', 'z_max', 'half_angle', 'sigma', 'stamp', 'sensor')
SETTINGS: dict[str, dict[str, float]] = {
    'with a prior': {'p_hit': 0.6, 'p_rand': 0.4, 'p_lost': 0.25, 'sigma': 0.1, 'prior': 0.4},
    'as in the paper': {'p_hit': 0.9, 'p_rand': 0.05, 'p_lost': 0.0, 'sigma': 0.05, 'prior': 0.5},
}
RUNS = 3


class Reached(NamedTuple):
    """A map, and the median duration of its search, seconds."""

    grid: Grid
    ml: NDArray[np.int8]
    seconds: float


def save(path: Path, readings: Readings, values: dict[str, float]) -> None:
    """Write readings and parameters for another checkout."""
    columns = {name: getattr(readings, name) for name in COLUMNS}
    np.savez(path, **columns, names=np.array(readings.sensor_names), values=np.array(json.dumps(values)))


def reach(source: Path, target: Path) -> None:
    """Map the data of `save`; only this function runs in the other checkout."""
    with np.load(source) as file:
        values = json.loads(str(file['values']))
        readings = Readings.from_columns(tuple(file['names'].tolist()), **{name: file[name] for name in COLUMNS})
    # parameters that this checkout does not have are left out
    known = Parameters().complete()
    parameters = Parameters.restored({name: value for name, value in values.items() if name in known})
    warm_up()
    seconds = []
    for _ in range(RUNS):
        begin = time.perf_counter()
        maps = Mapper(parameters).run(readings)
        seconds.append(time.perf_counter() - begin - maps.statistics['seconds']['standard map'])
    g = maps.grid
    lattice = np.array([g.resolution, g.column, g.row, g.width, g.height])
    where = np.array(str(Path(forward_grid_mapper.__file__).parent))
    np.savez(target, ml=maps.ml, grid=lattice, seconds=np.array(statistics.median(seconds)), where=where)


def reached_in(checkout: Path, readings: Readings, values: dict[str, float]) -> Reached:
    """Return the map that a checkout makes."""
    with tempfile.TemporaryDirectory() as folder:
        source, target = Path(folder) / 'readings.npz', Path(folder) / 'map.npz'
        save(source, readings, values)
        environment = {**os.environ, 'PYTHONPATH': str(checkout)}
        subprocess.run([sys.executable, __file__, '--reach', str(source), str(target)], check=True, env=environment)
        with np.load(target) as file:
            if not Path(str(file['where'])).is_relative_to(checkout):
                raise RuntimeError(f'Python took the package from {file["where"]} and not from {checkout}')
            resolution, *numbers = file['grid'].tolist()
            grid = Grid(resolution, *(int(number) for number in numbers))
            return Reached(grid, file['ml'], float(file['seconds']))


def main() -> None:
    """Run the benchmark."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument('--against', type=Path, help='the other checkout')
    parser.add_argument('--seeds', type=int, default=3, help='noises of each simulated drive (default 3)')
    parser.add_argument('--data', type=Path, default=ROOT.parent / 'shared' / 'data')
    parser.add_argument('--reach', nargs=2, type=Path, help=argparse.SUPPRESS)
    options = parser.parse_args()
    if options.reach:
        reach(*options.reach)
    else:
        compare(options)


def compare(options: argparse.Namespace) -> None:
    """Print the table."""
    # not imported in another checkout, which may lack some of it
    from measuring import PLAIN, machine

    from forward_grid_mapper.core.sensor.forward_model import log_likelihood
    from forward_grid_mapper.recordings.read_drive import read_drive
    from forward_grid_mapper.simulation import drive
    from forward_grid_mapper.simulation.score import SURFACE_DEPTH, score_map, visible_surface
    from forward_grid_mapper.simulation.sonar import NOISY

    def cases() -> Iterator[tuple[str, Readings, drive.Recording | None]]:
        recordings: list[tuple[str, drive.Recording]] = [('door, noise-free, n=1', drive.door_drive(1))]
        for seed in range(options.seeds):
            recordings += [(f'door, noisy, n={n}, {seed}', drive.door_drive(n, NOISY, seed)) for n in (1, 16)]
        recordings += [(f'corridor, {seed}', drive.corridor_drive(seed)) for seed in range(options.seeds)]
        recordings += [('corridor, 4 passes', drive.corridor_drive(0, passes=4))]
        recordings += [('building, 1 lap', drive.building_drive(0, laps=1))]
        for name, recording in recordings:
            yield name, recording.readings, recording
        for name in ('office_a', 'office_b'):
            bag = options.data / name / 'bag'
            if bag.is_dir():
                yield name, read_drive(bag, Parameters(), {}, odom_topic='/odom_corrected').associator.readings, None
            else:
                print(f'{name} is left out: there is no {bag}')

    print(machine())
    checkouts = [options.against.resolve(), ROOT] if options.against else [ROOT]
    heads = ('before', 'now') if options.against else ('now',)
    found = list(cases())
    for setting, changes in SETTINGS.items():
        values = {**PLAIN, **changes}
        print(f'\n{setting}: {", ".join(f"{k} {v}" for k, v in changes.items())}')
        wide = 11 * len(heads)
        print(f'{"":24s}{"readings":>9s}{"J":>{wide}s}{"":11s}{"occupied":>{wide}s}{"F1":>{wide}s}{"seconds":>{wide}s}')
        print(f'{"":33s}', *(f'{h:>10s}' for h in (*heads, 'more', *heads, *heads, *heads)))
        parameters = Parameters().varied(values)
        prior = math.log(parameters.search.prior / (1 - parameters.search.prior))
        for name, readings, recording in found:
            reached = [reached_in(checkout, readings, values) for checkout in checkouts]
            j = [
                log_likelihood(readings, r.grid, r.ml == 1, parameters.model) + prior * int((r.ml == 1).sum())
                for r in reached
            ]
            f1 = [math.nan] * len(reached)
            if recording is not None:
                visible = visible_surface(recording.world, readings, SURFACE_DEPTH)
                f1 = [score_map(r.ml, r.grid, recording.world, visible).f1 for r in reached]
            print(
                f'{name:24s}{len(readings):9d}',
                *(f'{value:10.1f}' for value in (*j, j[-1] - j[0])),
                *(f'{int((r.ml == 1).sum()):10d}' for r in reached),
                *(f'{"-":>10s}' if math.isnan(value) else f'{value:10.3f}' for value in f1),
                *(f'{r.seconds:10.3f}' for r in reached),
                flush=True,
            )


if __name__ == '__main__':
    main()
