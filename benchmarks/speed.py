#!/usr/bin/env python3
"""Time and memory from readings to maximum likelihood and uncertainty map, warm, with ratios measured in the same run.

usage: speed.py [--runs 5] [--patience 0] [--only jobs threads memory live table2]

jobs     four drives: medians of every stage and their targets; bytes a pair, stored and at the peak of the process; EM
         relative to building the standard map; time per pair relative to reading the same bytes in sequence
threads  one thread and two, whose maps must be equal
memory   a bound on memory that the pairs exceed, with which the maps must be equal
live     readings a second of the standard map on one core
table2   EM and the loops of the paper's Table 2, which cast every reading again at each flip that they consider
"""

from __future__ import annotations

import argparse
import dataclasses
import math
import os
import statistics
from collections.abc import Callable
from typing import Any, NamedTuple

import numpy as np
import table2
from measuring import PATIENCE, PLAIN, PeakMemory, Timing, in_own_process, machine, stream_seconds, timed

from forward_grid_mapper.core.common.parameters import Parameters
from forward_grid_mapper.core.common.readings import Readings
from forward_grid_mapper.core.evidence.evidence import Evidence
from forward_grid_mapper.core.mapping import Mapper
from forward_grid_mapper.core.maps.log_odds_map import LogOddsMap
from forward_grid_mapper.core.maps.map_set import MapSet
from forward_grid_mapper.core.runtime.threads import cores
from forward_grid_mapper.core.sensor.forward_model import log_likelihood
from forward_grid_mapper.core.warm_up import warm_up
from forward_grid_mapper.simulation.drive import building_drive, corridor_drive
from forward_grid_mapper.simulation.sonar import sonar_ring


class Job(NamedTuple):
    """A drive to map, and its target, seconds."""

    name: str
    drive: Callable[[], Readings]
    resolution: float
    target: float


JOBS = (
    Job('corridor', lambda: corridor_drive(0).readings, 0.1, 0.15),
    Job('corridor, 2.5 cm', lambda: corridor_drive(0).readings, 0.025, 3.0),
    Job('corridor, 17 passes', lambda: corridor_drive(0, passes=17).readings, 0.1, 3.0),
    Job('building, 16 x 30 deg', lambda: building_drive(0).readings, 0.1, 4.0),
)


def measure_job(readings: Readings, resolution: float, runs: int) -> dict[str, float]:
    """Return the figures of one job."""
    warm_up()
    parameters = Parameters().varied({'resolution': resolution})
    peak = PeakMemory()
    Mapper(parameters).run(readings)
    growth = peak.growth
    timing = Timing(parameters, readings, runs)
    maps, pairs = timing.maps, timing.maps.statistics['pairs']
    evidence = Evidence(maps.grid, parameters.model, threads=cores(), start=(maps.ml == 1).astype(np.uint8))
    evidence.extend(readings)
    stored = maps.statistics['bytes_per_pair'] * pairs
    return {
        **timing,
        'others': timing.others,
        'pairs': pairs,
        'cells': maps.grid.size,
        'stored': stored,
        'own': evidence.state.pairs.cell.nbytes + evidence.state.tiles.chunks.nbytes,
        'peak': growth,
        'pass': timed(evidence.rebuild, runs),
        'stream': stream_seconds(stored, runs),
    }


def jobs(runs: int) -> None:
    """Print the table of jobs."""
    print('\nFrom readings to maximum likelihood map and uncertainty map; seconds')
    print(
        f'{"":22s}{"readings":>9s}{"cells":>9s}{"pairs":>12s}{"index":>8s}{"search":>8s}{"uncert.":>8s}'
        f'{"total":>8s}{"target":>8s}{"standard":>10s}{"EM / standard":>15s}{"others":>8s}'
    )
    found = []
    for job in JOBS:
        readings = job.drive()
        f = in_own_process(measure_job, readings, job.resolution, runs)
        found.append((job, len(readings), f))
        print(
            f'{job.name:22s}{len(readings):9d}{f["cells"]:9.0f}{f["pairs"]:12.0f}{f["index"]:8.3f}{f["search"]:8.3f}'
            f'{f["uncertainty"]:8.3f}{f["total"]:8.3f}{job.target:8.2f}{f["standard map"]:10.4f}'
            f'{(f["index"] + f["search"]) / f["standard map"]:9.1f} x{f["others"]:8.0%}',
            flush=True,
        )
    print(
        '\nMemory in bytes a pair: pairs alone, with what is kept for readings and cells, and growth of the process.\n'
        'Time in ns a pair: one stream through the same bytes on one core, all readings evaluated once, all of EM.'
    )
    print(
        f'{"":22s}{"pairs":>8s}{"kept":>8s}{"peak":>8s}{"peak MB":>9s}{"stream":>9s}{"once":>8s}{"EM":>8s}'
        f'{"once / stream":>15s}{"EM / stream":>13s}'
    )
    for job, _, f in found:
        n = f['pairs']
        print(
            f'{job.name:22s}{f["own"] / n:8.2f}{f["stored"] / n:8.2f}{f["peak"] / n:8.2f}{f["peak"] / 1e6:9.1f}'
            f'{f["stream"] / n * 1e9:9.2f}{f["pass"] / n * 1e9:8.2f}{f["total"] / n * 1e9:8.1f}'
            f'{f["pass"] / f["stream"]:13.1f} x{f["total"] / f["stream"]:11.0f} x'
        )


def assert_equal(one: MapSet, other: MapSet) -> None:
    """Check that two runs have the same results, bit for bit."""
    np.testing.assert_array_equal(one.ml, other.ml)
    np.testing.assert_array_equal(one.uncertainty, other.uncertainty)
    assert one.objective == other.objective


def threads(runs: int) -> None:
    """Compare one thread with two."""
    print('\nOne thread and two; the maps are equal bit for bit')
    print(f'{"":22s}{"one":>9s}{"two":>9s}{"ratio":>9s}{"others":>8s}')
    for job in JOBS:
        readings = job.drive()
        one, two = (
            Timing(Parameters().varied({'resolution': job.resolution, 'threads': n}), readings, runs) for n in (1, 2)
        )
        assert_equal(one.maps, two.maps)
        ratio, others = one['total'] / two['total'], max(one.others, two.others)
        print(f'{job.name:22s}{one["total"]:9.3f}{two["total"]:9.3f}{ratio:7.2f} x{others:8.0%}', flush=True)


def bounded(readings: Readings, parameters: Parameters, runs: int) -> tuple[Timing, int]:
    """Return times and peak memory."""
    warm_up()
    peak = PeakMemory()
    Mapper(parameters).run(readings)
    growth = peak.growth
    return Timing(parameters, readings, runs), growth


def memory(runs: int) -> None:
    """Bound the memory for pairs."""
    print('\nMemory for pairs bounded (parameter max_memory); the maps are equal bit for bit')
    print(f'{"":22s}{"max_memory":>11s}{"not stored":>12s}{"total":>9s}{"ratio":>9s}{"peak MB":>9s}{"others":>8s}')
    for job, bounds in ((JOBS[0], (4000, 4, 0)), (JOBS[2], (4000, 64, 0)), (JOBS[3], (4000, 64))):
        readings = job.drive()
        first: Timing | None = None
        for bound in bounds:
            parameters = Parameters().varied({'resolution': job.resolution, 'max_memory': bound})
            timing, growth = in_own_process(bounded, readings, parameters, runs)
            first = first or timing
            assert_equal(first.maps, timing.maps)
            print(
                f'{job.name:22s}{bound:8d} MB{timing.maps.statistics["readings_not_stored"] / len(readings):12.1%}'
                f'{timing["total"]:9.3f}{timing["total"] / first["total"]:7.2f} x{growth / 1e6:9.1f}'
                f'{timing.others:8.0%}',
                flush=True,
            )


def measure_live(readings: Readings, runs: int) -> float:
    """Return the readings a second of a live map on one core."""
    if hasattr(os, 'sched_setaffinity'):
        os.sched_setaffinity(0, {min(os.sched_getaffinity(0))})
    warm_up()
    return len(readings) / timed(lambda: LogOddsMap(Parameters()).add(readings), runs)


def live(runs: int) -> None:
    """Measure the live map."""
    print('\nLive map on one core: 10 cm, cones of 15 deg, up to 5 m; the grid grows from nothing')
    print(f'{"":34s}{"readings":>9s}{"mean range":>12s}{"readings/s":>14s}')
    logs = {
        'corridor, 4 passes': corridor_drive(0, passes=4, sonars=sonar_ring(max_range=5.0)).readings,
        'building, one lap': building_drive(0, laps=1, sonars=sonar_ring(max_range=5.0)).readings,
    }
    corridor = logs['corridor, 4 passes']
    logs['the same corridor, never an echo'] = dataclasses.replace(corridor, z=corridor.z_max)
    for name, readings in logs.items():
        rate = in_own_process(measure_live, readings, runs)
        print(f'{name:34s}{len(readings):9d}{readings.z.mean():10.2f} m{rate:14,.0f}', flush=True)


def table_2(runs: int) -> None:
    """Compare with the loops of the paper's Table 2, on as many readings as these can process."""
    print("\nEM against the paper's Table 2, both from the empty map until no cell flips, on one thread, for J")
    print('without what the defaults add: ' + ', '.join(PLAIN))
    parameters = Parameters().varied({**PLAIN, 'threads': 1})
    prior = math.log(parameters.search.prior / (1 - parameters.search.prior))
    readings = corridor_drive(0).readings
    timing = Timing(parameters, readings, runs)
    loops = [table2.search(readings, parameters) for _ in range(runs)]
    seconds, one = statistics.median(loop.seconds for loop in loops), loops[0]
    objective = log_likelihood(readings, one.grid, one.occupied, parameters.model) + prior * int(one.occupied.sum())
    print(f'{"":10s}{"seconds":>9s}{"rounds":>8s}{"flips":>8s}{"casts":>12s}{"us a cast":>11s}{"objective":>11s}')
    print(
        f'{"Table 2":10s}{seconds:9.2f}{one.sweeps:8d}{one.flips:8d}{one.casts:12d}{seconds / one.casts * 1e6:11.2f}'
        f'{objective:11.1f}'
    )
    s: dict[str, Any] = timing.maps.statistics
    print(
        f'{"EM":10s}{timing["total"]:9.3f}{s["iterations"]:8d}{s["flips"]:8d}{"":23s}{timing.maps.objective:11.1f}'
        f'\nratio {seconds / timing["total"]:.0f} x'
    )


def main() -> None:
    """Run the benchmark."""
    parts = {'jobs': jobs, 'threads': threads, 'memory': memory, 'live': live, 'table2': table_2}
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument('--runs', type=int, default=5)
    parser.add_argument('--only', nargs='+', choices=parts, default=list(parts))
    parser.add_argument('--patience', type=float, default=0.0, help='seconds to repeat what others disturb (default 0)')
    options = parser.parse_args()
    os.environ[PATIENCE] = str(options.patience)
    print(f'{machine()}\nmedians of {options.runs} runs; others: what other processes used of the machine meanwhile')
    warm_up()
    for name in options.only:
        parts[name](options.runs)


if __name__ == '__main__':
    main()
