#!/usr/bin/env python3
"""Maps in tiles and whole maps: figures, seams, time and memory.

usage: tiles.py [--sizes 5,10,20,40] [--seeds 3] [--memory]

For the simulated corridor and building, and the recordings beside the checkout, if they exist: the objective of the
searched map, F1 and nav_iou of the ML map, relative to the whole map, and the number of cells of the ML map that differ
near seams (within 0.5 m) and elsewhere. With --memory: peak memory and time of one job, whole and in tiles, each in its
own process.
"""

from __future__ import annotations

import argparse
import time
from collections.abc import Iterator

import numpy as np
from measuring import PeakMemory, in_own_process, machine
from quality_scores import score
from quality_worlds import Case, recorded_cases, scoring_tool, simulated

from forward_grid_mapper.core.common.parameters import Parameters
from forward_grid_mapper.core.common.readings import Readings, of_drives
from forward_grid_mapper.core.mapping import Mapper
from forward_grid_mapper.core.maps.map_set import MapSet
from forward_grid_mapper.core.tiled_mapping import TiledMapper
from forward_grid_mapper.core.warm_up import warm_up
from forward_grid_mapper.simulation.drive import building_drive, corridor_drive

NEAR = 0.5
"""Largest distance from a seam that counts as near, metres."""

DRIVES = 4
"""Drives through the building in the job for memory."""


def cases(seeds: int) -> Iterator[tuple[str, Case]]:
    """Yield the cases with their names."""
    for seed in range(seeds):
        made = corridor_drive(seed)
        yield f'corridor {seed}', simulated('corridor', made.world, made.readings, made.robot[:, :2])
    made = building_drive(0)
    yield 'building', simulated('building', made.world, made.readings, made.robot[:, :2])
    tool = scoring_tool()
    if tool is not None:
        for case in recorded_cases(tool):
            yield case.group, case


def by_seams(one: MapSet, other: MapSet, size: float) -> tuple[float, float]:
    """Return the fraction of the known cells that differ between two maps, near seams and elsewhere."""
    x, y = one.grid.centers()
    off = [np.abs((c + size / 2) % size - size / 2) for c in (x, y)]
    near = (off[0][None, :] < NEAR) | (off[1][:, None] < NEAR)
    known, differ = (one.ml >= 0) | (other.ml >= 0), one.ml != other.ml
    return tuple(float(differ[known & side].mean()) for side in (near, ~near))  # type: ignore[return-value]


def print_figures(sizes: list[float], seeds: int) -> None:
    """Print the figures of all cases."""
    parameters, tool = Parameters(), scoring_tool()
    print(
        f'{"":22}{"objective":>11}{"F1":>8}{"nav_iou":>9}{"seam":>8}{"else":>8}{"tiles":>7}{"searches":>10}{"each":>6}'
    )
    for name, case in cases(seeds):
        whole = Mapper(parameters).run(case.readings)
        best, figures = whole.statistics['searched_objective'], score(whole.ml, whole.grid, case, tool)
        print(f'{name:22}{best:11.1f}{figures.f1:8.4f}{figures.nav_iou:9.4f}', flush=True)
        for size in sizes:
            maps = TiledMapper(parameters, size).run(case.readings)
            s, found = maps.statistics, score(maps.ml, maps.grid, case, tool)
            change = 100 * (s['searched_objective'] - best) / abs(best)
            near, away = by_seams(whole, maps, size)
            print(
                f'{size:20g} m{change:+10.3f}%{found.f1 - figures.f1:+8.4f}{found.nav_iou - figures.nav_iou:+9.4f}'
                f'{near:8.2%}{away:8.2%}{s["tiles"]:7}{s["searches_of_tiles"]:10}{s["evaluations_of_a_reading"]:6.2f}',
                flush=True,
            )


def many() -> Readings:
    """Return drives through the building."""
    return of_drives([building_drive(seed).readings for seed in range(DRIVES)])


def job(size: float) -> tuple[int, float, int]:
    """Return readings, CPU seconds and peak memory, bytes, of one job; a size of 0 is without tiles."""
    warm_up()
    readings, parameters = many(), Parameters()
    TiledMapper(parameters, 5.0).run(corridor_drive(0).readings.select(slice(0, 2000)))
    peak, begun = PeakMemory(), time.process_time()
    (TiledMapper(parameters, size) if size else Mapper(parameters)).run(readings)
    return len(readings), time.process_time() - begun, peak.growth


def main() -> None:
    """Run the benchmark."""
    options = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    options.add_argument('--sizes', default='5,10,20,40')
    options.add_argument('--seeds', type=int, default=3)
    options.add_argument('--memory', action='store_true')
    chosen = options.parse_args()
    sizes = [float(word) for word in chosen.sizes.split(',')]
    print(machine())
    if not chosen.memory:
        print_figures(sizes, chosen.seeds)
        return
    print(f'{"tiles":>10}{"readings":>10}{"CPU":>10}{"memory":>12}')
    for size in [0.0, *sizes]:
        count, seconds, peak = in_own_process(job, size)
        print(f'{f"{size:g} m" if size else "none":>10}{count:10,}{seconds:8.1f} s{peak / 1e6:9.0f} MB', flush=True)


if __name__ == '__main__':
    main()
