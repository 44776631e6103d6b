#!/usr/bin/env python3
"""Quality of maps of real places: sonars simulated in buildings that a laser measured, and recordings of a robot.

usage: buildings.py [NAME ...] [--drawn] [--set NAME=VALUE ...]

For the drives under ../shared/data, or those named, with corrected poses: the default's maximum likelihood map and
its live map, the paper's plain maximum likelihood map, and the standard map with the best of 216 gains for each drive,
once for F1 and once for nav_iou, which users could not know. Figures are those of ../shared/tools/score_map.py.

--drawn uses twelve random buildings instead (`material_worlds.py`), which were not used for tuning, and prints means;
--set changes the default.
"""

from __future__ import annotations

import argparse
import sys
from collections.abc import Iterator
from pathlib import Path
from types import ModuleType
from typing import Any, NamedTuple

import numpy as np
import quality_worlds
from material_worlds import building_case
from measuring import setting
from numpy.typing import NDArray
from quality_scores import ROBOT_RADIUS, Standard, on_truth
from quality_worlds import Case, recorded_cases, scoring_tool

from forward_grid_mapper.commands.experiment_maps import GAINS
from forward_grid_mapper.core.common.grid import Grid
from forward_grid_mapper.core.common.parameters import Parameters
from forward_grid_mapper.core.mapping import Mapper
from forward_grid_mapper.files.parameter_file import load_parameters

PAPER = Path(__file__).resolve().parents[1] / 'config' / 'paper.yaml'
NAMES = ('building_a', 'building_b', 'building_c', 'office_a', 'office_b')
DRAWN = range(24, 36)
"""Seeds of buildings that were not used for tuning."""

FLOOR = 'floor'
"""Fraction of the free cells of the reference that the map shows as free; it falls if they are unknown, too."""

FIGURES = ('f1', 'precision', 'recall', 'nav_iou', 'leak', 'blocked', 'beyond', FLOOR)


class Map(NamedTuple):
    """Values are probabilities, NaN where unknown; `probability` is that for the log loss, if there is one."""

    title: str
    grid: Grid
    values: NDArray[Any]
    probability: NDArray[Any] | None = None


def maps_of(case: Case, changes: dict[str, Any], tool: ModuleType) -> Iterator[Map]:
    """Yield the map of each method; `changes` are parameters of the default."""
    maps = Mapper(Parameters().varied(changes)).run(case.readings)
    yield Map('maximum likelihood map', maps.grid, np.where(maps.ml < 0, np.nan, maps.ml), maps.uncertainty)
    yield Map('live map', maps.grid, maps.live, maps.live)
    plain = Mapper(Parameters.from_flat(load_parameters(PAPER).values)).run(case.readings)
    yield Map('paper, plain ML', plain.grid, np.where(plain.ml < 0, np.nan, plain.ml))
    standard = Standard(case, tool)
    for title, goal in (('standard, best F1', standard.f1), ('standard, best nav_iou', standard.nav_iou)):
        grid, ml = standard.map(max(GAINS, key=goal))
        yield Map(title, grid, np.where(ml < 0, np.nan, ml))


def scored(case: Case, changes: dict[str, Any], tool: ModuleType) -> dict[str, list[float]]:
    """Return `FIGURES` and the log loss of each method's map, by its title."""
    path, out = tool.path_cells(case.path_xy, np.array(case.origin), case.resolution, case.truth.shape), {}

    def figures(grid: Grid, values: NDArray[Any]) -> dict[str, float]:
        p = on_truth(values, grid, case, tool)
        floor = case.truth == 0.0
        found = float((p[floor] < 0.5).mean())
        return {**tool.score(p, case.truth, path, case.resolution, ROBOT_RADIUS), FLOOR: found}

    for made in maps_of(case, changes, tool):
        scores = figures(made.grid, made.values)
        loss = np.nan if made.probability is None else figures(made.grid, made.probability)['log_loss']
        out[made.title] = [*(scores[name] for name in FIGURES), loss]
    return out


def main() -> None:
    """Run the benchmark."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument('names', nargs='*', metavar='NAME', help=f'by default {", ".join(NAMES)}')
    parser.add_argument('--set', action='append', default=[], metavar='NAME=VALUE', help='change the default')
    parser.add_argument('--drawn', action='store_true', help='buildings drawn at random, instead')
    options = parser.parse_args()
    if options.drawn and options.names:
        parser.error('--drawn takes the place of names')
    tool = scoring_tool()
    if tool is None:
        sys.exit('without ../shared/tools/score_map.py there are no figures')
    changes = dict(setting(text) for text in options.set)
    quality_worlds.RECORDINGS = tuple(options.names or NAMES)
    print(f'{"":38s}' + ''.join(f'{name:>10s}' for name in (*FIGURES, 'log_loss')))
    groups = (
        [('drawn', [building_case(seed) for seed in DRAWN])]
        if options.drawn
        else ((case.group, [case]) for case in recorded_cases(tool))
    )
    for name, cases in groups:
        rows = [scored(case, changes, tool) for case in cases]
        for title in rows[0]:
            means = np.mean([row[title] for row in rows], axis=0)
            figures = ''.join(f'{"-" if np.isnan(value) else f"{value:.3f}":>10s}' for value in means)
            print(f'{name:14s}{title:24s}{figures}', flush=True)


if __name__ == '__main__':
    main()
