#!/usr/bin/env python3
"""Quality of maps: the default, the paper's plain maximum likelihood map, and the standard map with its best gains.

usage: quality.py [--quick] [--ablate] [--set NAME=VALUE ...] [--runs 5] [--pictures DIR]

On the simulated worlds of the paper, on our own worlds, with cones of 15° and 30°, in cells of 0.1 m and, for two of
them, of half and a quarter of that, on readings drawn from the forward model itself, and on the recordings under
../shared/data, if they exist. Each method has the same parameters everywhere; but the standard map has the gains of
the best F1, or of the best nav_iou, for each world, and for its log loss the gains and the scale with the smallest
loss there, which users could not know.

--quick uses one seed of everything; --ablate also scores the default without each of its parts; --set changes the
default; --runs are those of the timing; --pictures draws maps into a folder.
"""

from __future__ import annotations

import argparse
import itertools
import math
import os
import platform
import statistics
from collections.abc import Iterable, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from types import ModuleType
from typing import Any

import numba
import numpy as np
from measuring import setting
from quality_pictures import draw_pictures
from quality_scores import (
    OFTEN,
    Belief,
    Figures,
    Standard,
    known_cells,
    least_loss,
    nav_of,
    on_truth,
    oracle,
    reliability,
    score,
    together,
)
from quality_worlds import Case, drawn_cases, on_grid, recorded_cases, scoring_tool, simulated_cases

from forward_grid_mapper.core.common.parameters import Parameters
from forward_grid_mapper.core.evidence.evidence import Evidence
from forward_grid_mapper.core.evidence.fixed_point import QUANTUM
from forward_grid_mapper.core.mapping import Mapper
from forward_grid_mapper.core.sensor.cone_table import grid_of
from forward_grid_mapper.core.warm_up import warm_up
from forward_grid_mapper.files.parameter_file import load_parameters
from forward_grid_mapper.simulation.drive import corridor_drive
from forward_grid_mapper.simulation.score import score_map

PAPER = Path(__file__).resolve().parents[1] / 'config' / 'paper.yaml'

NO_WALLS: dict[str, Any] = {'end_cost': 0.0}

PLAIN: dict[str, Any] = {
    **NO_WALLS,
    'surface_offset': 0.0,
    'max_incidence_angle': 1.5708,
    'least_passed': 0.0,
}
"""Only flips and shifts, with the default's sensor model."""

ABLATIONS: dict[str, dict[str, Any]] = {
    'surfaces before the centre': {'surface_offset': 0.0},
    'surface normals': {'max_incidence_angle': 1.5708},
    'incidence angles of their own': {'min_incidence_angle': 1.5708},
    'prior for walls': NO_WALLS,
    'unknown': {'least_passed': 0.0},
    'walls that look any way (unknown)': {'least_noticed': 0.0},
    'lost echoes': {'p_lost': 0.0},
    'all of these but lost echoes': {**PLAIN, 'alpha': 0.8},
}
"""The default without each of its parts."""

RESOLUTIONS = (0.1, 0.05, 0.025)
RESOLUTION_WORLDS = ('doors 15°', 'clutter 15°')
"""Edges of cells, metres, and the drives, with their first seeds, for the table of resolutions."""

DRAWN = {
    'p_hit 0.9, p_rand 0.05, p_lost 0': {'p_hit': 0.9, 'p_rand': 0.05, 'p_lost': 0.0},
    'p_hit 0.9, p_rand 0.05, p_lost 0.1': {'p_hit': 0.9, 'p_rand': 0.05, 'p_lost': 0.1},
    'the default': {},
}

COLUMNS = (
    ('F1', 'f1', '.3f'),
    ('door', 'door', '.1f'),
    ('shut', 'doors_closed', '.0f'),
    ('cover', 'coverage', '.3f'),
    ('gap', 'gap', '.0f'),
    (f'cov {OFTEN}', 'coverage_often', '.3f'),
    (f'gap {OFTEN}', 'gap_often', '.0f'),
    ('smooth', 'smooth', '.2f'),
    ('dots', 'dots', '.0f'),
    ('nav_iou', 'nav_iou', '.3f'),
    ('leak', 'leak', '.3f'),
    ('blocked', 'blocked', '.3f'),
    ('loss', 'loss', '.3f'),
)

LEGEND = f"""\
door: least width left open, m; shut: doors that are less than half open, of all; cover: columns of rough
walls with an occupied cell at most one cell across; gap: longest run without, cells; cov {OFTEN}, gap {OFTEN}: the
same over wall cells met by at least {OFTEN} readings; smooth: recall of smooth walls; dots: occupied cells in free
space; nav_iou, leak, blocked: of ../shared/tools/score_map.py; loss: log loss of the uncertainty map, nats a cell.
Means over seeds, but for door, shut, gap and smooth the worst seed. "-": nothing of the kind there."""


@dataclass
class Results:
    """Figures of one method by group, and its uncertainty maps of simulated cells."""

    figures: dict[str, Figures] = field(default_factory=dict)
    beliefs: list[Belief] = field(default_factory=list)
    known: dict[str, list[Any]] = field(default_factory=dict)


def groups_of(cases: Iterable[Case]) -> dict[str, list[Case]]:
    """Return the cases by group."""
    return {name: list(group) for name, group in itertools.groupby(cases, key=lambda case: case.group)}


def belief(uncertainty: Any, case: Case) -> Belief:
    """Return the probabilities of an uncertainty map for a case."""
    known = known_cells(uncertainty, case)
    return Belief(np.asarray(uncertainty[known], np.float64), case.truth[known] > 0.5)


def results(groups: dict[str, list[Case]], parameters: Parameters, tool: ModuleType | None) -> Results:
    """Map and score all cases."""
    out = Results()
    for name, cases in groups.items():
        figures, out.known[name] = [], []
        for case in cases:
            maps = Mapper(parameters).run(case.readings)
            uncertainty = on_truth(maps.uncertainty, maps.grid, case, tool)
            said = belief(uncertainty, case)
            figures.append(score(maps.ml, maps.grid, case, tool, said.loss))
            out.known[name].append(known_cells(uncertainty, case))
            if case.world is not None:
                out.beliefs.append(said)
        out.figures[name] = together(figures)
    return out


def line(f: Figures) -> str:
    """Return the columns of one row of the table."""
    cells = []
    for head, name, form in COLUMNS:
        value = getattr(f, name)
        cells.append(f'{"-" if math.isnan(value) else format(value, form):>{max(len(head), 5) + 1}s}')
    return ''.join(cells)


def print_table(rows: dict[str, Results], groups: dict[str, list[Case]], tool: ModuleType | None) -> None:
    """Print the table, with the standard map last in each group."""
    print(f'{"":24s}' + ''.join(f'{head:>{max(len(head), 5) + 1}s}' for head, *_ in COLUMNS))
    known = next(iter(rows.values())).known
    above = []
    for name, cases in groups.items():
        print(f'{name}, {len(cases)} x {len(cases[0].readings)} readings')
        standard, fit_to_drive = oracle(cases, known[name], tool)
        for title, result in rows.items():
            print(f'  {title:22s}{line(result.figures[name])}')
        print(f'  {"standard, best F1":22s}{line(standard)}')
        print(f'  {"standard, best nav_iou":22s}{line(fit_to_drive)}', flush=True)
        if not next(iter(rows.values())).figures[name].loss < standard.loss:
            above.append(name)
    print(LEGEND)
    print('\nlog loss of the first row is not below that of the standard map on:', ', '.join(above) or 'none')


def print_ablations(groups: dict[str, list[Case]], base: dict[str, Any], whole: Results, tool: Any) -> None:
    """Print one row for the default without each of its parts."""
    names = list(groups)
    own = [n for n in names if groups[n][0].world is not None and not n.startswith(('door n', 'corridor'))]
    doors = [n for n in names if n.startswith('door n')]
    hall = [n for n in names if n.startswith('corridor')][:1]
    recordings = [n for n in names if groups[n][0].world is None]

    def mean(r: Results, which: Sequence[str], name: str) -> float:
        return float(np.mean([getattr(r.figures[n], name) for n in which])) if which else math.nan

    print('\nthe default without                   door n=…        corridor 15°                 own worlds', end='')
    print(''.join(f'{n:>13s}' for n in recordings), '   simulated')
    print(f'{"":34s}{"F1":>7s}{"open":>6s}{"F1":>8s}{"dots":>6s}{"cover":>7s}{"smooth":>8s}', end='')
    print(f'{"F1":>7s}{"nav":>7s}{"cover":>7s}' + f'{"F1":>7s}{"nav":>6s}' * len(recordings) + f'{"loss":>9s}')
    for title, changes in {'nothing': None, **ABLATIONS}.items():
        r = whole if changes is None else results(groups, Parameters().varied({**base, **changes}), tool)
        least = min(r.figures[n].door for n in doors)
        row = (
            f'{title:34s}{mean(r, doors, "f1"):7.3f}{least:6.1f}{mean(r, hall, "f1"):8.3f}{mean(r, hall, "dots"):6.0f}'
        )
        row += f'{mean(r, hall, "coverage"):7.3f}{mean(r, hall, "smooth"):8.2f}'
        row += ''.join(f'{mean(r, own, key):7.3f}' for key in ('f1', 'nav_iou', 'coverage'))
        row += ''.join(f'{r.figures[n].f1:7.3f}{r.figures[n].nav_iou:6.3f}' for n in recordings)
        print(row + f'{mean(r, own + doors + hall, "loss"):9.3f}', flush=True)


def with_true_rest(case: Case, model: dict[str, Any], known: Any) -> float:
    """Return the log loss at the cells `known` of (43) given all other cells of the true map, at its best prior."""
    assert case.world is not None
    p = Parameters().varied({**model, 'max_incidence_angle': math.pi / 2})
    grid = grid_of(case.readings, p.model, p.grid)
    walls = on_grid(case.world, grid)
    evidence = Evidence(grid, p.model, start=walls.astype(np.uint8))
    evidence.extend(case.readings)
    gains = evidence.state.maps.evidence.reshape(grid.shape) * QUANTUM
    odds = np.nan_to_num(on_truth(np.where(walls, -gains, gains), grid, case, None))[known].clip(-50, 50)
    occupied = case.truth[known] > 0.5
    return min(Belief(1 / (1 + np.exp(-odds - prior)), occupied).loss for prior in np.arange(-3.0, 1.1, 0.5))


def print_drawn(base: dict[str, Any], quick: bool) -> None:
    """Print log losses on readings drawn from the forward model, with the default's and with the true parameters."""
    print('\nReadings drawn from the forward model on the true map: log loss, nats a cell')
    print(f'{"drawn with":38s}{"world":16s}{"constant":>9s}{"standard":>9s}{"default":>9s}', end='')
    print(f'{"true":>8s}{"mapped":>8s}{"rest":>7s}')
    for title, model in DRAWN.items():
        for case in drawn_cases(model, quick):
            losses = []
            for changes in ({}, model):
                maps = Mapper(Parameters().varied({**base, **changes})).run(case.readings)
                uncertainty = on_truth(maps.uncertainty, maps.grid, case, None)
                said = belief(uncertainty, case)
                losses.append(said.loss)
                if not changes:
                    mapped = belief(np.where(on_truth(maps.ml, maps.grid, case, None) >= 0, uncertainty, np.nan), case)
            standard = least_loss([Standard(case, None)], [known_cells(uncertainty, case)])
            print(f'{title:38s}{case.group:16s}{said.base:9.3f}{standard:9.3f}{losses[0]:9.3f}', end='')
            rest = with_true_rest(case, {**base, **model}, known_cells(uncertainty, case))
            print(f'{losses[1]:8.3f}{mapped.loss:8.3f}{rest:7.3f}')
    print(
        'constant: the fraction of occupied cells everywhere; standard: the standard map at its best gains and scale;'
    )
    print('true: the default but with the parameters of the sensor model that the readings were drawn with;')
    print('mapped: the default, over cells that its map knows as free or occupied; rest: (43) with these')
    print('parameters, the best prior, and every cell but the one asked for taken from the true map')


def print_resolutions(groups: dict[str, list[Case]], base: dict[str, Any], tool: ModuleType | None) -> None:
    """Print the figures of drives mapped in cells of several sizes, all scored at the cells of the world, 0.1 m."""
    print('\nThe same drive in cells of other sizes: a wall counts as found, and a cell as right, within 0.1 m')
    print(f'{"":16s}{"cells":>8s}{"F1":>8s}{"cover":>8s}{"dots":>6s}{"door":>6s}{"nav_iou":>9s}{"seconds":>9s}')
    for name in RESOLUTION_WORLDS:
        case = groups[name][0]
        assert case.world is not None
        for resolution in RESOLUTIONS:
            maps = Mapper(Parameters().varied({**base, 'resolution': resolution})).run(case.readings)
            s = score_map(maps.ml, maps.grid, case.world, case.met > 0)
            nav = nav_of(maps.ml, maps.grid, case, tool)
            spent = sum(maps.statistics['seconds'].values())
            door = min(s.door_widths, default=math.nan)
            print(f'{name:16s}{100 * resolution:5g} cm{s.f1:8.3f}{s.column_coverage:8.3f}{s.false_dots:6d}', end='')
            print(f'{door:6.1f}{nav:9.3f}{spent:9.1f}', flush=True)


def print_cost(base: dict[str, Any], paper: dict[str, Any], runs: int) -> None:
    """Print the cost of the default and of plain EM, run alternately."""
    variants = {
        'default': base,
        "plain EM, the default's model": {**base, **PLAIN},
        'plain EM, config/paper.yaml': paper,
    }
    readings = corridor_drive(0).readings
    seconds: dict[str, list[float]] = {name: [] for name in variants}
    for _ in range(runs):
        for name, flat in variants.items():
            spent = Mapper(Parameters().varied(flat)).run(readings).statistics['seconds']
            seconds[name].append(sum(spent[stage] for stage in ('index', 'search', 'uncertainty')))
    print(
        f'\nSeconds for the corridor, {len(readings)} readings: index, search and uncertainty; medians of {runs} runs'
    )
    ours = statistics.median(seconds['default'])
    for name, spent in seconds.items():
        middle = statistics.median(spent)
        print(f'  {name:32s}{middle:7.2f} s   the default takes {ours / middle:.2f} times as long')


def main() -> None:
    """Run the benchmark."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument('--quick', action='store_true', help='one seed of everything')
    parser.add_argument('--ablate', action='store_true', help='also the default without each of its parts')
    parser.add_argument('--set', action='append', default=[], metavar='NAME=VALUE', help='change the default')
    parser.add_argument('--runs', type=int, default=5, help='runs of the timing')
    parser.add_argument('--pictures', type=Path, metavar='DIR', help='draw maps into this folder')
    options = parser.parse_args()
    base = dict(setting(text) for text in options.set)
    paper = dict(load_parameters(PAPER).values)
    print(f'{platform.machine()}, {os.cpu_count()} cores, Python {platform.python_version()}, ', end='')
    print(f'numpy {np.__version__}, numba {numba.__version__}' + (f'; changed: {base}' if base else ''))
    warm_up()
    tool = scoring_tool()
    groups = groups_of(simulated_cases(options.quick))
    if tool is not None:
        groups |= groups_of(recorded_cases(tool))
    variants = {'default': base, 'paper, plain ML': paper}
    rows = {title: results(groups, Parameters().varied(flat), tool) for title, flat in variants.items()}
    print_table(rows, groups, tool)
    for title, result in rows.items():
        print(f'\nReliability of the uncertainty map, all simulated worlds: {title}')
        print('\n'.join(reliability(result.beliefs)))
    if options.ablate:
        print_ablations(groups, base, rows['default'], tool)
    print_resolutions(groups, base, tool)
    print_drawn(base, options.quick)
    print_cost(base, paper, options.runs)
    if options.pictures:
        draw_pictures(options.pictures, groups, base, paper, tool)


if __name__ == '__main__':
    main()
