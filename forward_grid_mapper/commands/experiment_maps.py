"""The paper's experiments with maps, in simulation: the forward map, and the standard map with its best settings."""

from __future__ import annotations

import argparse
import itertools
import math
from collections.abc import Callable, Iterable
from typing import NamedTuple

import numpy as np

from ..core.common.parameters import CONSTANTS, Parameters
from ..core.common.words import counted
from ..core.mapping import Mapper
from ..core.maps.log_odds_map import LogOddsMap
from ..files.panels import FigureTile
from ..simulation.drive import Recording, corridor_drive, door_drive, passing_drive
from ..simulation.score import SURFACE_DEPTH, Mask, Scores, score_map, threshold, visible_surface
from ..simulation.sonar import NOISE_FREE, NOISY
from .console import Ticker

GAINS = tuple(
    {'live_p_occupied': occupied, 'live_p_free': free, 'live_p_free_no_echo': silent, 'depth': depth}
    for occupied, free, silent, depth in itertools.product(
        (0.55, 0.6, 0.7, 0.8, 0.9, 0.97), (0.1, 0.2, 0.3, 0.4, 0.45, 0.48), (0.3, 0.45, 0.49), (0.05, 0.1)
    )
)
"""Settings of the standard map of which the best is used, although users could not know it; see `standard_map`."""

SEEDS_OF_GAINS = 2
"""Drives along the corridor with which every setting of the standard map is tried: they are long."""

ONE_SUM = {row.name: row.plain for row in CONSTANTS if row.name in ('live_directions', 'live_echo_width')}
"""The standard map as in the paper: one sum over readings of all directions, and complete arcs."""

PAPER = {
    'plain_model': True,
    'p_hit': 0.9,
    'p_rand': 0.05,
    'p_lost': 0.0,
    'sigma': 0.05,
    'prior': 0.5,
    'max_incidence_angle': math.pi / 2,
    'end_cost': 0.0,
    'live_p_occupied': 0.8,
    'live_p_free': 0.25,
}
"""Maximum likelihood without a prior, as printed in the paper, and its standard map."""


class Case(NamedTuple):
    """A recording, and the wall cells that its map should show."""

    recording: Recording
    visible: Mask


class MethodResult(NamedTuple):
    """The scores of one method over several recordings, and its maps of the first.

    `random` is the number of readings of each recording that a maximum likelihood map attributes to chance.
    """

    scores: list[Scores]
    tile: FigureTile
    uncertainty: FigureTile | None = None
    random: tuple[int, ...] = ()

    @property
    def f1(self) -> float:
        """Mean F1."""
        return float(np.mean([s.f1 for s in self.scores]))

    @property
    def door(self) -> str:
        """Smallest and largest open width of the first door, metres."""
        widths = [s.door_widths[0] for s in self.scores]
        return f'{min(widths):.1f}-{max(widths):.1f}'

    @property
    def chance(self) -> str:
        """Smallest and largest number of readings attributed to chance."""
        low, high = min(self.random), max(self.random)
        return str(low) if low == high else f'{low}-{high}'


def forward(cases: Iterable[Case], parameters: Parameters, title: str) -> MethodResult:
    """Score the maximum likelihood map of every case."""
    scores, tiles, uncertain, random = [], [], [], []
    for case in cases:
        maps = Mapper(parameters).run(case.recording.readings)
        scores.append(score_map(maps.ml, maps.grid, case.recording.world, case.visible))
        tiles.append(FigureTile(title, maps.grid, maps.ml))
        uncertain.append(FigureTile(f'uncertainty map, {title}', maps.grid, maps.uncertainty))
        random.append(int(np.count_nonzero(maps.unexplained)))
    return MethodResult(scores, tiles[0], uncertain[0], tuple(random))


def standard_map(gains: dict[str, float]) -> LogOddsMap:
    """Return an empty standard map with these gains; `depth` is half the depth of its arcs, metres."""
    values = {k: v for k, v in gains.items() if k != 'depth'}
    return LogOddsMap(Parameters().varied({**values, **ONE_SUM}), (gains['depth'], gains['depth']))


def standard(cases: Iterable[Case], gains: dict[str, float], title: str) -> MethodResult:
    """Score the standard map of every case."""
    scores, tiles = [], []
    for case in cases:
        live = standard_map(gains)
        live.add(case.recording.readings)
        decided = threshold(live.probability())
        scores.append(score_map(decided, live.grid, case.recording.world, case.visible))
        tiles.append(FigureTile(title, live.grid, decided))
    return MethodResult(scores, tiles[0])


def best(outcomes: Iterable[MethodResult], worth: Callable[[MethodResult], float]) -> MethodResult:
    """Return the outcome with the largest `worth`."""
    return max(outcomes, key=worth)


def seen(recording: Recording) -> Case:
    """Return the recording with the surface that is visible to its readings."""
    return Case(recording, visible_surface(recording.world, recording.readings, SURFACE_DEPTH))


def raw_data(case: Case, title: str) -> FigureTile:
    """Return the measured cones of a recording over the walls."""
    world = case.recording.world
    return FigureTile(title, world.grid, np.where(world.reference == 1, 1.0, 0.0), case.recording.readings)


def door(options: argparse.Namespace, parameters: Parameters, ticker: Ticker) -> tuple[str, list[list[FigureTile]]]:
    """Return table and figure of the experiment with a door that is seen n times."""
    lines = [
        'A 0.6 m door seen by n sweeps; F1 with one cell of tolerance, the open width of the door in metres',
        f'(smallest - largest over {counted(options.seeds, "seed")}), and how many readings the map attributes to',
        f'chance. The standard map has the best gains of {len(GAINS)}.',
        '',
        f'{"":18s}{"forward map":>16s}{"chance":>8s}{"as in the paper":>18s}{"chance":>8s}{"standard, best F1":>20s}'
        f'{"standard, best door":>22s}',
    ]
    rows = []
    for noise, name in ((NOISE_FREE, 'noise-free'), (NOISY, 'noisy')):
        for n in (1, 3, 16):
            ticker.say(f'{name}, n = {n}')
            cases = [seen(door_drive(n, noise, seed)) for seed in range(options.seeds if noise is NOISY else 1)]
            ours = forward(cases, parameters, 'ours')
            paper = forward(cases, Parameters.from_flat(PAPER), "maximum likelihood map, the paper's")
            tried = [standard(cases, gains, 'standard map, best F1') for gains in GAINS]
            top = best(tried, lambda outcome: outcome.f1)
            # a map with all cells free has a wide door as well
            fair = [outcome for outcome in tried if outcome.f1 >= ours.f1 - 0.05] or [top]
            wide = best(fair, lambda outcome: min(s.door_widths[0] for s in outcome.scores) + outcome.f1 / 100)
            cells = [f'{o.f1:.3f}  {o.door}' for o in (ours, paper, top, wide)]
            lines.append(
                f'{name:12s}n = {n:<2d}{cells[0]:>16s}{ours.chance:>8s}{cells[1]:>18s}{paper.chance:>8s}{cells[2]:>20s}'
                f'{cells[3]:>22s}'
            )
            raw = raw_data(cases[0], f'raw data, {name}, n = {n}')
            mine = ours.tile._replace(title='maximum likelihood map, ours')
            rows.append([raw, top.tile, paper.tile, mine, *filter(None, [ours.uncertainty])])
    return '\n'.join(lines), rows


def passer_by(
    options: argparse.Namespace, parameters: Parameters, ticker: Ticker
) -> tuple[str, list[list[FigureTile]]]:
    """Return table and figure of the experiment with two doors on each side and a person who walks by."""
    cases = [seen(passing_drive(seed)) for seed in range(options.seeds)]
    ticker.say('the forward map')
    ours = forward(cases, parameters, 'ours')
    paper = forward(cases, Parameters.from_flat(PAPER), "maximum likelihood map, the paper's")
    tried = []
    for k, gains in enumerate(GAINS):
        ticker.say(f'the standard map, gains {k + 1} of {len(GAINS)}')
        tried.append(standard(cases, gains, 'standard map, best F1'))
    top = best(tried, lambda outcome: outcome.f1)
    wide = best(tried, lambda outcome: fewest_doors(outcome) + outcome.f1)
    count = len(cases[0].recording.world.doors)
    named = {
        'forward map': ours,
        'forward, as in the paper': paper,
        'standard, best F1': top,
        'standard, most doors': wide,
    }
    lines = [
        f'A corridor with {count} narrow open doors, two on either side, and a person who walks by;',
        f'smallest numbers of open doors and widths in metres of {counted(options.seeds, "seed")}. Chance is how many',
        'readings are attributed to it.',
        '',
        f'{"":26s}{"F1":>7s}{"doors open":>12s}  {"widths":18s}{"false dots":>12s}{"chance":>10s}',
    ]
    for name, o in named.items():
        dots = float(np.mean([s.false_dots for s in o.scores]))
        widths = ' '.join(f'{min(s.door_widths[k] for s in o.scores):.1f}' for k in range(count))
        chance = o.chance if o.random else '-'
        lines.append(f'{name:26s}{o.f1:7.3f}{fewest_doors(o):10d}/{count}  {widths:18s}{dots:12.0f}{chance:>10s}')
    mine = ours.tile._replace(title='maximum likelihood map, ours')
    raw = raw_data(cases[0], 'raw data')
    return '\n'.join(lines), [[raw, top.tile, paper.tile], [mine, *filter(None, [ours.uncertainty])]]


def fewest_doors(outcome: MethodResult) -> int:
    """Return the smallest number of open doors of all recordings."""
    return min(s.doors_open for s in outcome.scores)


def corridor(options: argparse.Namespace, parameters: Parameters, ticker: Ticker) -> tuple[str, list[list[FigureTile]]]:
    """Return table and figure of the experiment with a long corridor."""
    cases = [seen(corridor_drive(seed)) for seed in range(options.seeds)]
    ticker.say('the forward map')
    ours = forward(cases, parameters, 'forward map')
    paper = forward(cases, Parameters.from_flat(PAPER), 'forward map as in the paper')
    tried = []
    for k, gains in enumerate(GAINS):
        ticker.say(f'the standard map, gains {k + 1} of {len(GAINS)}')
        tried.append(standard(cases[:SEEDS_OF_GAINS], gains, 'standard map'))

    def wall(outcome: MethodResult) -> float:
        return float(np.mean([s.smooth_recall for s in outcome.scores]))

    top = best(tried, lambda outcome: outcome.f1)
    open_doors = best(tried, lambda outcome: fewest_doors(outcome) + wall(outcome) / 2)
    closed_wall = best(tried, lambda outcome: wall(outcome) + fewest_doors(outcome) / 100)
    named = {
        'forward map': ours,
        'forward, as in the paper': paper,
        'standard, best F1': top,
        'standard, most doors': open_doors,
        'standard, most wall': closed_wall,
    }
    both = [o for o in tried if fewest_doors(o) == 6 and wall(o) >= 0.5]
    lines = [
        f'A corridor of 62 m with six doors and 18 m of smooth wall, 12 000 readings, {counted(options.seeds, "seed")} '
        f'(standard map: {min(options.seeds, SEEDS_OF_GAINS)}).',
        '',
        f'{"":26s}{"F1":>7s}{"doors open":>12s}{"smooth wall":>13s}{"false dots":>12s}{"coverage":>10s}{"gap":>5s}',
    ]
    for name, o in named.items():
        dots, cover = np.mean([s.false_dots for s in o.scores]), np.mean([s.column_coverage for s in o.scores])
        gap = max(s.longest_gap for s in o.scores)
        lines.append(f'{name:26s}{o.f1:7.3f}{fewest_doors(o):10d}/6{wall(o):13.2f}{dots:12.0f}{cover:10.2f}{gap:5d}')
    lines.append('')
    good = [o for o in both if o.f1 >= 0.8]
    lines.append(
        f'Of {len(tried)} gains of the standard map, {len(both)} show 6/6 doors and half of the smooth wall; '
        f'with an F1 of at least 0.80: {len(good)}.'
    )
    world = cases[0].recording.world
    truth = FigureTile('truth, with the smooth wall marked', world.grid, world.reference, marked=world.smooth_cells)
    tiles = [o.tile._replace(title=f'{name}, F1 {o.f1:.2f}, {fewest_doors(o)}/6 doors') for name, o in named.items()]
    return '\n'.join(lines), [[truth], *([tile] for tile in tiles)]
