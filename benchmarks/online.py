#!/usr/bin/env python3
"""Time and quality of the online map, updated with every sweep of 24 sonars.

usage: online.py [--only latency quality standing] [--seeds 3]

latency   milliseconds a sweep while the robot drives, with 50 000 and 200 000 readings stored. Readings equal to an
          earlier one are merged; also without merging, so that every reading is stored.
quality   F1 and log-likelihood of the online map and of EM on the same readings, with and without merging: simulated
          drives, and the recordings under ../shared/data, if they exist, in steps of 8 readings
standing  a robot does not move for an hour at 20 sweeps a second
"""

from __future__ import annotations

import argparse
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from typing import NamedTuple

import numpy as np
from measuring import in_own_process, machine, memory_in_use
from numpy.typing import NDArray
from quality_scores import score
from quality_worlds import recorded_cases, scoring_tool

from forward_grid_mapper.core import online_map
from forward_grid_mapper.core.common.parameters import Parameters
from forward_grid_mapper.core.common.readings import Readings
from forward_grid_mapper.core.mapping import Mapper
from forward_grid_mapper.core.online_map import OnlineMap
from forward_grid_mapper.core.sensor.forward_model import log_likelihood
from forward_grid_mapper.core.warm_up import warm_up
from forward_grid_mapper.simulation.drive import Recording, building_drive, corridor_drive
from forward_grid_mapper.simulation.score import SURFACE_DEPTH, score_map, visible_surface
from forward_grid_mapper.simulation.sonar import NOISY, measure, sonar_ring
from forward_grid_mapper.simulation.world import corridor_world

SONARS = 24
MEASURED = 500
"""Sweeps that are timed after the readings are stored."""

RECORDED_SONARS = 8
"""Readings of the recordings in each step."""

RATE = 20
"""Rate of sweeps of the robot that does not move, Hz."""


@contextmanager
def merging(on: bool) -> Iterator[None]:
    """Disable merging of equal readings in a context, by treating all as different."""
    before = online_map.SAME_PLACE, online_map.SAME_RANGE
    if not on:
        online_map.SAME_PLACE = online_map.SAME_RANGE = 1e-9
    try:
        yield
    finally:
        online_map.SAME_PLACE, online_map.SAME_RANGE = before


def sweeps(readings: Readings, size: int = SONARS) -> Iterator[Readings]:
    """Yield the readings sweep by sweep."""
    for first in range(0, len(readings), size):
        yield readings.select(slice(first, first + size))


class Times(NamedTuple):
    """Durations of sweeps, milliseconds, shape (N,), and whether the map was refined in them."""

    taken: NDArray[np.float64]
    refined: NDArray[np.bool_]

    @property
    def sweep(self) -> str:
        """Median, 95th and 99th percentile and maximum of all sweeps."""
        return spread(self.taken)

    @property
    def refinement(self) -> str:
        """Median, 95th percentile and maximum of sweeps with a refinement of the map."""
        return spread(self.taken[self.refined], (50, 95, 100))


def feed(online: OnlineMap, readings: Readings, size: int = SONARS) -> Times:
    """Add readings sweep by sweep."""
    taken, refined = [], []
    for sweep in sweeps(readings, size):
        begin = time.perf_counter()
        online.add(sweep)
        taken.append(time.perf_counter() - begin)
        refined.append(online.waiting == 0)
    return Times(1000 * np.array(taken), np.array(refined))


def spread(milliseconds: NDArray[np.float64], percents: tuple[int, ...] = (50, 95, 99, 100)) -> str:
    """Return percentiles; 100 is the maximum."""
    if not len(milliseconds):
        return f'{"-":>8s}' * len(percents)
    return ''.join(f'{np.percentile(milliseconds, percent):8.2f}' for percent in percents)


def corridor(passes: int) -> Readings:
    """Return the readings of the corridor with the ring of 24."""
    return corridor_drive(0, passes=passes).readings


def building(laps: int) -> Readings:
    """Return the readings of the building with the ring of 24."""
    return building_drive(0, laps=laps, sonars=sonar_ring(SONARS)).readings


def latencies(drive: Callable[[int], Readings], rounds: int, stored: int, merge: bool) -> tuple[int, int, str, float]:
    """Return readings given and kept, the durations of later sweeps, and milliseconds to compute both maps."""
    warm_up()
    readings = drive(rounds)
    before = stored - stored % SONARS
    with merging(merge):
        online = OnlineMap(Parameters())
        feed(online, readings.select(slice(0, before)))
        kept = len(online)
        times = feed(online, readings.select(slice(before, before + MEASURED * SONARS)))
    begin = time.perf_counter()
    online.maps()
    return before, kept, times.sweep + times.refinement, 1000 * (time.perf_counter() - begin)


def latency(seeds: int) -> None:
    """Print times a sweep."""
    print(f'\nMilliseconds a sweep of {SONARS} sonars, {MEASURED} sweeps, and of those in which the map was refined;')
    print('maps: to read out both maps once')
    print(
        f'{"":12s}{"merging":>9s}{"given":>9s}{"stored":>9s}{"p50":>8s}{"p95":>8s}{"p99":>8s}{"max":>8s}'
        f'{"refine":>8s}{"p95":>8s}{"max":>8s}{"maps":>8s}   p95 should be at most'
    )
    for name, drive, rounds in (('corridor', corridor, (6, 18)), ('building', building, (2, 6))):
        for merge in (False, True):
            for stored, count, target in ((50_000, rounds[0], 10), (200_000, rounds[1], 25)):
                given, kept, spreads, out = in_own_process(latencies, drive, count, stored, merge)
                on = 'on' if merge else 'off'
                print(f'{name:12s}{on:>9s}{given:9d}{kept:9d}{spreads}{out:8.2f}   {target}', flush=True)


def quality(seeds: int) -> None:
    """Print the quality of the online map."""
    parameters = Parameters()
    print(f'\nThe map after all sweeps, one by one, against EM on the same readings; means of {seeds} drives;')
    print('logp: mean log-likelihood of a reading, nats')
    print(
        f'{"":22s}{"readings":>9s}{"stored":>9s}{"F1 EM":>8s}{"online":>8s}{"logp EM":>9s}{"online":>8s}'
        f'{"sweep p95 ms":>14s}'
    )
    drives: tuple[tuple[str, Callable[[int], Recording]], ...] = (
        ('corridor, 1 pass', corridor_drive),
        ('corridor, 4 passes', lambda seed: corridor_drive(seed, passes=4)),
        ('building, 1 lap', lambda seed: building_drive(seed, laps=1, sonars=sonar_ring(SONARS))),
    )
    for name, drive in drives:
        for merge in (True, False):
            rows = []
            for seed in range(seeds):
                recording = drive(seed)
                readings, world = recording.readings, recording.world
                visible = visible_surface(world, readings, SURFACE_DEPTH)
                batch = Mapper(parameters).run(readings)
                with merging(merge):
                    online = OnlineMap(parameters)
                    times = feed(online, readings)
                grid, ml, _ = online.maps()
                rows.append(
                    (
                        len(readings),
                        len(online),
                        score_map(batch.ml, batch.grid, world, visible).f1,
                        score_map(ml, grid, world, visible).f1,
                        log_likelihood(readings, batch.grid, batch.ml, parameters.model) / len(readings),
                        log_likelihood(readings, grid, ml, parameters.model) / len(readings),
                        np.percentile(times.taken, 95),
                    )
                )
            given, kept, f1, online_f1, j, online_j, p95 = np.mean(rows, axis=0)
            print(
                f'{name + ("" if merge else ", all"):22s}{given:9.0f}{kept:9.0f}{f1:8.3f}{online_f1:8.3f}'
                f'{j:9.4f}{online_j:8.4f}{p95:14.2f}',
                flush=True,
            )
    tool = scoring_tool()
    for case in recorded_cases(tool) if tool else ():
        batch = Mapper(parameters).run(case.readings)
        for merge in (True, False):
            with merging(merge):
                online = OnlineMap(parameters)
                times = feed(online, case.readings, RECORDED_SONARS)
            grid, ml, _ = online.maps()
            likelihoods = (
                log_likelihood(case.readings, *found, parameters.model) / len(case.readings)
                for found in ((batch.grid, batch.ml), (grid, ml))
            )
            print(
                f'{case.group + ("" if merge else ", all"):22s}{len(case.readings):9d}{len(online):9d}'
                f'{score(batch.ml, batch.grid, case, tool).f1:8.3f}{score(ml, grid, case, tool).f1:8.3f}'
                + ''.join(f'{value:{width}.4f}' for value, width in zip(likelihoods, (9, 8), strict=True))
                + f'{np.percentile(times.taken, 95):14.2f}',
                flush=True,
            )


def standing(seeds: int) -> None:
    """Print the cost of an hour without motion."""
    warm_up()
    world, sonars = corridor_world(), sonar_ring(SONARS)
    online, drive = OnlineMap(Parameters()), corridor_drive(0)
    feed(online, drive.readings)
    before, here = int((online.maps()[1] == 1).sum()), drive.robot[250]
    rng = np.random.default_rng(0)
    print(f'\nAfter one pass of the corridor ({len(online)} readings stored), standing at {RATE} sweeps a second')
    print(f'{"minutes":>9s}{"sweeps":>9s}{"stored":>9s}{"p50":>8s}{"p95":>8s}{"p99":>8s}{"max":>8s}{"process MB":>12s}')
    minutes = 0
    for span in (1, 4, 5, 10, 10, 10, 10, 10):
        ranges = np.concatenate(
            [measure(world, sonars, np.tile(here, (60 * RATE, 1)), NOISY, rng) for _ in range(span)]
        ).ravel()
        x, y, yaw = sonars.poses(np.tile(here, (len(ranges) // SONARS, 1))).reshape(-1, 3).T
        minutes += span
        readings = Readings.from_columns(
            sonars.names,
            x=x,
            y=y,
            yaw=yaw,
            z=np.minimum(ranges, sonars.max_range),
            z_max=sonars.max_range,
            half_angle=sonars.field_of_view / 2,
            sensor=np.tile(np.arange(SONARS), len(ranges) // SONARS),
        )
        times = feed(online, readings)
        print(
            f'{minutes:9d}{60 * RATE * minutes:9d}{len(online):9d}{times.sweep}{memory_in_use() / 1e6:12.1f}',
            flush=True,
        )
    occupied = int((online.maps()[1] == 1).sum())
    print(f'{occupied} cells are occupied in the end, {before} were before')


def main() -> None:
    """Run the benchmark."""
    parts = {'latency': latency, 'quality': quality, 'standing': standing}
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument('--seeds', type=int, default=3)
    parser.add_argument('--only', nargs='+', choices=parts, default=list(parts))
    options = parser.parse_args()
    print(machine())
    warm_up()
    for name in options.only:
        parts[name](options.seeds)


if __name__ == '__main__':
    main()
