#!/usr/bin/env python3
"""A campus by workers: time, memory a worker, and how well work is shared, as drives become more.

usage: campus.py [--drives 1,10] [--readings 100000] [--workers 2] [--tiles 30] [--compare] [--folder DIR] [--plot FILE]

For each number of drives: a campus with as many buildings is simulated (kept in DIR, and taken from there if it is
there), and `process_bag --workers` maps it, in a process of its own. Printed are readings, area, seconds of the wall
clock, CPU seconds of all tasks, the memory of the largest worker, how often a reading is evaluated, and what would come
of 1 to 8 workers: the CPU seconds of all tasks, by those that the busiest worker would have if each worker took the
next task as soon as it is free, and waited at the end of each stage. That is counted work, which other processes on the
machine do not change. With --compare one worker is timed as well.
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
from typing import Any

from measuring import machine

ACROSS = range(1, 9)
"""Simulated workers."""


def campus_of(folder: Path, drives: int, readings: int) -> Path:
    """Return the folder of a campus, which is made if it is not there."""
    target = folder / f'campus_{drives}_{readings}'
    if not target.exists():
        begun = time.perf_counter()
        options = ['--drives', drives, '--buildings', drives, '--readings', readings, '-q', '-o', target]
        run('simulate', 'campus', *options)
        print(f'simulated {drives} drives of {readings:,} readings in {time.perf_counter() - begun:.0f} s', flush=True)
    return target


def run(*words: object) -> str:
    """Return what a command prints."""
    command = [sys.executable, '-m', 'forward_grid_mapper', *map(str, words)]
    return subprocess.run(command, check=True, stdout=subprocess.PIPE, text=True).stdout


def mapped(campus: Path, workers: int, tiles: float) -> tuple[float, dict[str, Any], list[tuple[str, float]]]:
    """Return the seconds of a job, its report, and the stage and CPU seconds of each task."""
    with tempfile.TemporaryDirectory(dir=campus.parent) as folder:
        begun = time.perf_counter()
        run('process_bag', campus / 'drives', '-o', f'{folder}/maps', '--workers', workers, '--tiles', tiles, '-q')
        seconds = time.perf_counter() - begun
        report: dict[str, Any] = json.loads(Path(folder, 'maps', 'report.json').read_text())
        with Path(folder, 'maps', 'tasks.csv').open() as file:
            costs = [(row['stage'], float(row['cpu_seconds'])) for row in csv.DictReader(file)]
    return seconds, report, costs


def efficiency(costs: Sequence[tuple[str, float]], workers: int) -> float:
    """Return how much of so many workers' time would be work, where stages follow one another."""
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
        seconds, report, costs = mapped(campus, chosen.workers, chosen.tiles)
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
            alone, *_ = mapped(campus, 1, chosen.tiles)
            print(
                f' one worker {alone:.0f} s, {chosen.workers} workers {seconds:.0f} s: {alone / seconds:.2f}x',
                flush=True,
            )
    if chosen.plot:
        draw(chosen.plot, rows)


def by_stage(costs: Sequence[tuple[str, float]]) -> dict[str, float]:
    """Return the CPU seconds of each stage; all rounds of the search are one."""
    out: dict[str, float] = {}
    for name, seconds in costs:
        stage = name.partition(',')[0]
        out[stage] = out.get(stage, 0.0) + seconds
    return out


def draw(path: Path, rows: Sequence[tuple[int, float]]) -> None:
    """Draw CPU seconds against readings, with the line through the largest."""
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
