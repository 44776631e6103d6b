#!/usr/bin/env python3
"""Time and memory from placed readings to all three maps, warm, and ratios measured in the same run.

usage: speed.py [--runs 5] [--large]

Worlds: one pass of the simulated corridor (12 000 readings at 10 cm); with --large also 17 passes (204 000). For each:
medians over the runs of every stage, EM against building the standard map of the same readings, bytes a pair.
"""

from __future__ import annotations

import argparse
import os
import platform
import statistics

import numba
import numpy as np

from forward_grid_mapper.core.mapping import Mapper
from forward_grid_mapper.core.parameters import Parameters
from forward_grid_mapper.core.warm_up import warm_up
from forward_grid_mapper.simulation.drive import corridor_drive


def main() -> None:
    """Run the benchmark."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument('--runs', type=int, default=5)
    parser.add_argument('--large', action='store_true', help='also 204 000 readings, which takes a minute')
    options = parser.parse_args()
    print(f'{platform.machine()}, {os.cpu_count()} cores, Python {platform.python_version()}, ', end='')
    print(f'numpy {np.__version__}, numba {numba.__version__}; medians of {options.runs} runs, seconds')
    warm_up()
    stages = ('index', 'search', 'live map', 'uncertainty')
    print(f'{"readings":>9s}{"pairs":>12s}{"B/pair":>8s}', *(f'{s:>12s}' for s in stages), f'{"all":>8s}  EM/live')
    for passes in (1, 17) if options.large else (1,):
        readings = corridor_drive(0, passes=passes).readings
        runs = [Mapper(Parameters()).run(readings).statistics for _ in range(options.runs)]
        seconds = {stage: statistics.median(run['seconds'][stage] for run in runs) for stage in stages}
        total = statistics.median(sum(run['seconds'].values()) for run in runs)
        ratio = (seconds['index'] + seconds['search']) / seconds['live map']
        print(f'{len(readings):9d}{runs[0]["pairs"]:12d}{runs[0]["bytes_per_pair"]:8.1f}', end=' ')
        print(*(f'{seconds[stage]:12.3f}' for stage in stages), f'{total:8.3f}  {ratio:.1f} x')


if __name__ == '__main__':
    main()
