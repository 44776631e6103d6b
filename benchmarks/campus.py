#!/usr/bin/env python3
"""A campus mapped by workers: time, memory of a worker, and balance of work, for increasing numbers of drives.

usage: campus.py [--drives 1,10] [--readings 100000] [--workers 2] [--tiles 30] [--compare] [--whole]
                 [--folder DIR] [--plot FILE]

For each number of drives, a campus with as many buildings is simulated (stored in DIR, and reused if it exists), and
`process_bag --workers` maps it, in its own process. Prints readings, area, seconds of the wall clock, CPU seconds of
all tasks, the memory of the largest worker, how often a reading is evaluated, and the efficiency of 1 to 8 workers: the
CPU seconds of all tasks, relative to those of the busiest worker if each worker took the next task as soon as it is
free, and waited at the end of each stage. This is computed from CPU time, which other processes do not change. With
--compare one worker is timed as well; with --whole the map is also made by one process without tiles, and the
differences are printed.
"""

from __future__ import annotations

import argparse
import csv
import heapq
import itertools
import json
import subprocess
import sys
import tempfile
import time
from collections.abc import Sequence
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
from measuring import machine

from forward_grid_mapper.core.common.grid import UNKNOWN
from forward_grid_mapper.files.map_archive import MapArchive, read_npz

ACROSS = range(1, 9)
"""Simulated workers."""


def campus_of(folder: Path, drives: int, readings: int) -> Path:
    """Return the folder of a campus, which is simulated if it does not exist."""
    target = folder / f'campus_{drives}_{readings}'
    if not target.exists():
        begun = time.perf_counter()
        options = ['--drives', drives, '--buildings', drives, '--readings', readings, '-q', '-o', target]
        run('simulate', 'campus', *options)
        print(f'simulated {drives} drives of {readings:,} readings in {time.perf_counter() - begun:.0f} s', flush=True)
    return target


def run(*words: object) -> str:
    """Return the output of a command."""
    command = [sys.executable, '-m', 'forward_grid_mapper', *map(str, words)]
    return subprocess.run(command, check=True, stdout=subprocess.PIPE, text=True).stdout


class Job(NamedTuple):
    """A finished job: its seconds, report, and maps, and the stage and CPU seconds of each task."""

    seconds: float
    report: dict[str, Any]
    maps: MapArchive
    costs: list[tuple[str, float]]


def mapped(campus: Path, *options: object) -> Job:
    """Map all drives of a campus."""
    with tempfile.TemporaryDirectory(dir=campus.parent) as folder:
        begun, out = time.perf_counter(), Path(folder, 'maps')
        run('process_bag', campus / 'drives', '-o', out, '-q', *options)
        seconds = time.perf_counter() - begun
        report: dict[str, Any] = json.loads((out / 'report.json').read_text())
        tasks, costs = out / 'tasks.csv', []
        if tasks.exists():
            with tasks.open() as file:
                costs = [(row['stage'], float(row['cpu_seconds'])) for row in csv.DictReader(file)]
        return Job(seconds, report, read_npz(out / 'maps.npz'), costs)


def print_differences(whole: Job, tiled: Job) -> None:
    """Print the differences between the map of one process and the map in tiles."""
    a, b = (job.report['statistics']['searched_objective'] for job in (whole, tiled))
    differ = np.count_nonzero(whole.maps.ml != tiled.maps.ml)
    known = np.count_nonzero(whole.maps.ml != UNKNOWN)
    print(
        f' whole, one process: {whole.seconds:.0f} s, objective {a:,.1f}, in tiles {b:,.1f} ({b / a - 1:+.5%}); '
        f'{differ} of {known:,} cells differ',
        flush=True,
    )


def efficiency(costs: Sequence[tuple[str, float]], workers: int) -> float:
    """Return the fraction of the workers' time that would be work, with stages one after the other."""
    total = busy = 0.0
    for _, stage in itertools.groupby(costs, key=lambda one: one[0]):
        free = [0.0] * workers
        for _, seconds in stage:
            heapq.heapreplace(free, free[0] + seconds)
            total += seconds
        busy += max(free)
    return total / (workers * busy)


def main() -> None:
    """Print a row for each number of drives."""
    options = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    options.add_argument('--drives', default='1,10', help='numbers of drives, and of buildings')
    options.add_argument('--readings', type=int, default=100_000, help='of a drive')
    options.add_argument('--workers', type=int, default=2)
    options.add_argument('--tiles', type=float, default=30.0)
    options.add_argument('--compare', action='store_true', help='time one worker, too')
    options.add_argument('--whole', action='store_true', help='make the map in one process without tiles, too')
    options.add_argument('--folder', type=Path, default=Path(tempfile.gettempdir()) / 'campus')
    options.add_argument('--plot', type=Path, help='write CPU seconds against readings into this picture')
    chosen = options.parse_args()
    chosen.folder.mkdir(parents=True, exist_ok=True)
    print(machine())
    rows = []
    heads = ('drives', 'readings', 'km2', 'wall s', 'CPU s', 'us each', 'GB', 'tiles', 'searches', 'evaluated')
    print(''.join(f'{head:>11}' for head in heads))
    for drives in map(int, chosen.drives.split(',')):
        campus = campus_of(chosen.folder, drives, chosen.readings)
        tiles = '--tiles', chosen.tiles
        job = mapped(campus, '--workers', chosen.workers, *tiles)
        seconds, report, _, costs = job
        s, grid = report['statistics'], report['map']
        readings, area = report['result']['readings'], grid['width'] * grid['height'] * grid['resolution'] ** 2 / 1e6
        rows.append((readings, s['cpu_seconds']))
        print(
            f'{drives:11}{readings:11,}{area:11.3f}{seconds:11.0f}{s["cpu_seconds"]:11.0f}'
            f'{1e6 * s["cpu_seconds"] / readings:11.1f}{s["peak_memory_of_a_worker"] / 1e9:11.2f}{s["tiles"]:11}'
            f'{s["searches_of_tiles"]:11}{s["evaluations_of_a_reading"]:11.2f}'
        )
        print(' CPU seconds by stage: ' + ', '.join(f'{name} {cpu:.0f}' for name, cpu in by_stage(costs).items()))
        shares = ', '.join(f'{n}: {efficiency(costs, n):.2f}' for n in ACROSS)
        print(f' efficiency of simulated workers: {shares}', flush=True)
        if chosen.compare:
            alone = mapped(campus, '--workers', 1, *tiles).seconds
            print(
                f' one worker {alone:.0f} s, {chosen.workers} workers {seconds:.0f} s: {alone / seconds:.2f}x',
                flush=True,
            )
        if chosen.whole:
            print_differences(mapped(campus, '--set', 'max_readings=0'), job)
    if chosen.plot:
        draw(chosen.plot, rows)


def by_stage(costs: Sequence[tuple[str, float]]) -> dict[str, float]:
    """Return the CPU seconds of each stage; all rounds of the search are one stage."""
    out: dict[str, float] = {}
    for name, seconds in costs:
        stage = name.partition(',')[0]
        out[stage] = out.get(stage, 0.0) + seconds
    return out


def draw(path: Path, rows: Sequence[tuple[int, float]]) -> None:
    """Draw CPU seconds against readings, with the line through the origin and the largest point."""
    from matplotlib.backends.backend_agg import FigureCanvasAgg
    from matplotlib.figure import Figure

    figure = Figure(figsize=(5, 4), dpi=120, layout='constrained')
    FigureCanvasAgg(figure)
    axes = figure.add_subplot()
    x, y = zip(*rows, strict=True)
    axes.loglog(x, y, 'o', color='#0072b2', label='measured')
    axes.loglog(x, [y[-1] * n / x[-1] for n in x], '--', color='#8b96a3', label='linear')
    axes.set(xlabel='readings', ylabel='CPU seconds')
    axes.legend(frameon=False)
    figure.savefig(path)


if __name__ == '__main__':
    main()
