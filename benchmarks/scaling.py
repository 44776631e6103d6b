#!/usr/bin/env python3
"""Growth of time and memory with the number of pairs of a cell and a reading, from 1e5 to 1e8.

usage: scaling.py [--runs 5] [--patience 0] [--most 1e8] [--plot scaling.png]

There are more pairs with more readings on the same cells, or with smaller cells for the same readings. Prints medians
of the time from readings in the map frame to maximum likelihood map and uncertainty map, and the peak memory, each in
its own process.
"""

from __future__ import annotations

import argparse
import os
from collections.abc import Callable
from pathlib import Path
from typing import NamedTuple

import numpy as np
from measuring import PATIENCE, PeakMemory, Timing, in_own_process, machine

from forward_grid_mapper.core.common.parameters import Parameters
from forward_grid_mapper.core.common.readings import Readings
from forward_grid_mapper.core.mapping import Mapper
from forward_grid_mapper.core.warm_up import warm_up
from forward_grid_mapper.simulation.drive import corridor_drive

SWEEP = 24


class Point(NamedTuple):
    """Figures of one job; seconds and bytes."""

    readings: int
    cells: int
    pairs: int
    total: float
    build: float
    search: float
    peak: int
    others: float


def measure(readings: Readings, resolution: float, runs: int) -> Point:
    """Return the figures of one job, from its own process."""
    warm_up()
    parameters = Parameters.from_flat({'resolution': resolution})
    peak = PeakMemory()
    Mapper(parameters).run(readings)
    growth = peak.growth
    timing = Timing(parameters, readings, runs)
    pairs, cells = timing.maps.statistics['pairs'], timing.maps.grid.size
    return Point(len(readings), cells, pairs, timing['total'], timing['index'], timing['search'], growth, timing.others)


def every(n: int) -> Readings:
    """Return every n-th sweep of one pass of the corridor."""
    readings = corridor_drive(0).readings
    return readings.select(np.flatnonzero((np.arange(len(readings)) // SWEEP) % n == 0))


def passes(n: int) -> Readings:
    """Return n passes of the corridor."""
    return corridor_drive(0, passes=n).readings


Series = tuple[tuple[Callable[[int], Readings], int, float], ...]

SERIES: dict[str, Series] = {
    'more readings, 10 cm': (
        (every, 13, 0.1),
        (every, 4, 0.1),
        (passes, 1, 0.1),
        (passes, 3, 0.1),
        (passes, 8, 0.1),
        (passes, 24, 0.1),
        (passes, 78, 0.1),
    ),
    'finer cells, 12 000 readings': (
        (passes, 1, 0.3),
        (passes, 1, 0.1),
        (passes, 1, 0.05),
        (passes, 1, 0.025),
        (passes, 1, 0.0125),
    ),
}


def slope(points: list[Point]) -> float:
    """Return the exponent of time as a power of pairs, by least squares of the logarithms."""
    return float(np.polyfit(np.log([p.pairs for p in points]), np.log([p.total for p in points]), 1)[0])


def plot(path: Path, series: dict[str, list[Point]]) -> None:
    """Draw time and memory over pairs."""
    from matplotlib.backends.backend_agg import FigureCanvasAgg
    from matplotlib.figure import Figure

    figure = Figure(figsize=(9.5, 4.2), dpi=120, layout='constrained')
    FigureCanvasAgg(figure)
    left, right = figure.subplots(1, 2)
    ends = [1e5, 1e8]
    for (name, points), color, mark in zip(series.items(), ('#0072b2', '#d55e00'), 'os', strict=True):
        pairs = [p.pairs for p in points]
        left.plot(pairs, [p.total for p in points], mark + '-', color=color, label=name)
        right.plot(pairs, [p.peak / 1e6 for p in points], mark + '-', color=color, label=name)
    left.plot(ends, [e * 100e-9 for e in ends], '--', color='#8b96a3', linewidth=1, label='100 ns a pair')
    right.plot(ends, [e * 12e-6 for e in ends], '--', color='#8b96a3', linewidth=1, label='12 bytes a pair')
    for axes, what in ((left, 'seconds to the maps'), (right, 'growth of peak memory in MB')):
        axes.set(xscale='log', yscale='log', xlabel='pairs of a cell and a reading', title=what)
        axes.grid(color='#e3e7ec', linewidth=0.7)
        axes.legend(frameon=False)
    figure.savefig(path)


def main() -> None:
    """Run the benchmark."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument('--runs', type=int, default=5)
    parser.add_argument('--most', type=float, default=1.2e8, help='leave out what would have more pairs')
    parser.add_argument('--plot', type=Path, help='draw into this file (needs matplotlib)')
    parser.add_argument('--patience', type=float, default=0.0, help='seconds to repeat what others disturb (default 0)')
    options = parser.parse_args()
    os.environ[PATIENCE] = str(options.patience)
    print(f'{machine()}\nmedians of {options.runs} runs')
    found: dict[str, list[Point]] = {}
    for name, jobs in SERIES.items():
        print(f'\n{name}')
        print(
            f'{"readings":>9s}{"cell":>9s}{"cells":>10s}{"pairs":>12s}{"index s":>9s}{"search s":>10s}{"total s":>9s}'
            f'{"ns a pair":>11s}{"peak MB":>9s}{"B a pair":>10s}{"others":>8s}'
        )
        points = found[name] = []
        for drive, count, resolution in jobs:
            # each job has at least about three times the pairs of the one before
            if points and points[-1].pairs * 3.0 > options.most:
                break
            p = in_own_process(measure, drive(count), resolution, options.runs)
            points.append(p)
            print(
                f'{p.readings:9d}{resolution:7.4g} m{p.cells:10d}{p.pairs:12d}{p.build:9.3f}{p.search:10.3f}'
                f'{p.total:9.3f}{p.total / p.pairs * 1e9:11.1f}{p.peak / 1e6:9.1f}{p.peak / p.pairs:10.2f}'
                f'{p.others:8.0%}',
                flush=True,
            )
        print(f'time grows as the {slope(points):.2f}th power of pairs')
    if options.plot:
        plot(options.plot, found)


if __name__ == '__main__':
    main()
