"""`explain`: the evidence for the state of a cell, reading by reading, in words."""

from __future__ import annotations

import argparse
import itertools
import math
import sys
from collections import Counter
from collections.abc import Iterator, Sequence
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from ..core.common.errors import InputError, ParameterError
from ..core.common.readings import Readings
from ..core.common.words import counted
from ..core.maps.cell_evidence import CellEvidence, cell_evidence
from ..core.messages.message_types import NANOSECONDS
from ..files.map_archive import MapArchive, read_npz
from ..files.reading_archive import read_readings
from .console import run
from .options import add_json_option, print_json

COMMAND = 'explain'
ARCHIVE = 'maps.npz'
STATES = {1: 'occupied', 0: 'free', -1: 'not observed'}
MOST_SHOWN = 5
COUNT_OPTIONS = ('-n', '--readings')

LARGEST_COORDINATE = 1e9
"""Metres; no map is larger, and indices of cells remain integers."""

LEAST_TYPICAL = 0.05
"""Smallest evidence of a typical reading, nats, for which the number of further readings is computed."""


def parser() -> argparse.ArgumentParser:
    """Return the parser of the command line."""
    made = argparse.ArgumentParser(
        COMMAND,
        description=(
            'Explain the state of a cell of the maximum likelihood map: the readings for and against an obstacle '
            'there, their evidence, and what would change the cell.'
        ),
        epilog='example: explain MY_BAG_maps 1.75 -0.4',
    )
    made.add_argument('maps', metavar='MAPS', help=f'folder that process_bag or save_maps wrote, or its {ARCHIVE}')
    made.add_argument('x', type=float, help='in the map frame, metres')
    made.add_argument('y', type=float)
    made.add_argument(
        '-n', '--readings', type=int, metavar='N', help=f'readings to list (default {MOST_SHOWN}; as JSON all of them)'
    )
    add_json_option(made)
    return made


def explain(options: argparse.Namespace) -> int:
    """Run the command with its options."""
    if options.readings is not None and options.readings < 0:
        raise ParameterError('--readings must be a positive number or 0')
    given = Path(options.maps)
    folder = given.parent if given.name == ARCHIVE and given.is_file() else given
    maps = read_npz(folder / ARCHIVE)
    readings, normals = read_readings(folder / 'readings.npz', maps)
    left, right, bottom, top = maps.grid.extent
    if not _on_map(maps, options.x, options.y):
        raise InputError(
            f'({options.x:g}, {options.y:g}) is not on the map, which spans x = {left:.2f} … {right:.2f} m and '
            f'y = {bottom:.2f} … {top:.2f} m'
        )
    found = cell_evidence(readings, maps.grid, maps.ml, maps.parameters, normals, (options.x, options.y))
    if options.json:
        print_json(explanation_data(maps, readings, found, options.readings))
    else:
        shown = MOST_SHOWN if options.readings is None else options.readings
        print('\n'.join(explanation(maps, readings, found, shown)))
    return 0


def explanation_data(
    maps: MapArchive, readings: Readings, found: CellEvidence, shown: int | None = None
) -> dict[str, Any]:
    """Return the explanation for programs: nats, metres, and stamps in nanoseconds."""
    cell = found.row, found.column
    state = int(maps.ml[cell])
    x, y = maps.grid.centers()
    rows = [
        {
            'nats': found.nats[k],
            'range': readings.z[i] if readings.echo[i] else None,
            'distance': found.distance[k],
            'ends_here': found.ends_here[k],
            'through_wall': found.through_wall[k],
            'stamp': readings.stamp[i],
            'sensor': _name(readings, i),
        }
        for k, i in enumerate(found.readings[:shown].tolist())
    ]
    return {
        'row': found.row,
        'column': found.column,
        'x': x[found.column],
        'y': y[found.row],
        'state': STATES[state],
        'uncertainty_map': maps.uncertainty[cell],
        'standard_map': maps.live[cell],
        'nats_of_readings': found.data,
        'nats_of_prior': found.prior,
        'nats_of_wall': found.wall,
        'traversed': found.traversed,
        'number_of_readings': len(found.readings),
        'readings': rows,
        'what_decides': _decisive_evidence(maps, found, state),
    }


def _on_map(maps: MapArchive, x: float, y: float) -> bool:
    """Return whether a place is in a cell of the map; decided by the index, since edges are rounded."""
    if not math.isfinite(x) or not math.isfinite(y) or max(abs(x), abs(y)) > LARGEST_COORDINATE:
        return False
    (row,), (column,) = maps.grid.cells_of(np.array([x]), np.array([y]))
    return bool(0 <= row < maps.grid.height and 0 <= column < maps.grid.width)


def explanation(maps: MapArchive, readings: Readings, found: CellEvidence, shown: int = MOST_SHOWN) -> Iterator[str]:
    """Yield the lines of the explanation."""
    cell, state = (found.row, found.column), int(maps.ml[found.row, found.column])
    x, y = (values[k] for values, k in zip(maps.grid.centers(), reversed(cell), strict=True))
    yield f'cell at x = {x:.2f} m, y = {y:.2f} m (row {found.row}, column {found.column}): {STATES[state]}'
    uncertainty, standard = _percent(maps.uncertainty[cell]), _percent(maps.live[cell])
    yield f'  obstacle: {uncertainty} (uncertainty map), {standard} (standard map)'
    count = len(found.readings)
    yield f'  {_nats(found.data)} nats from {counted(count, "reading")}, {_nats(found.prior)} from the prior of walls'
    groups = (
        (('end here', 'ends here'), found.ends_here),
        (
            ('reach farther', 'reaches farther'),
            ~found.ends_here & ~found.silent & (_range(readings, found) > found.distance),
        ),
        (('heard no echo', 'heard no echo'), found.silent),
        (
            ('end before it', 'ends before it'),
            ~found.ends_here & ~found.silent & (_range(readings, found) <= found.distance),
        ),
    )
    for (several, one), mask in groups:
        if mask.any():
            who = _sensors(readings, found.readings[mask])
            said = f'reading {one}' if mask.sum() == 1 else f'readings {several}'
            yield f'    {_nats(found.nats[mask].sum()):>7}  {int(mask.sum())} {said}: {who}'
    if state == 1:
        yield (
            f'  {_nats(found.wall)} nats for the cell together with its occupied neighbours, which share their readings'
        )
    yield f'  {_decisive_evidence(maps, found, state)}'
    if shown and count:
        yield ''
        yield f'  {"nats":>7}  {"range":>8}  {"cell at":>8}  {"stamp":>19}  sensor'
    for k in range(min(shown, count)):
        i = found.readings[k]
        z = 'no echo' if found.silent[k] else f'{readings.z[i]:.2f} m'
        stamp = f'{readings.stamp[i] / NANOSECONDS:.3f} s'
        yield f'  {_nats(found.nats[k], 2):>7}  {z:>8}  {found.distance[k]:6.2f} m  {stamp:>19}  {_name(readings, i)}'


def _range(readings: Readings, found: CellEvidence) -> NDArray[np.float64]:
    return readings.z[found.readings]


def _nats(value: float, digits: int = 1) -> str:
    """Return nats with their sign; without one if they are rounded to 0."""
    return f'{round(float(value), digits) + 0.0:+.{digits}f}'


def _percent(probability: float) -> str:
    return 'unknown' if math.isnan(probability) else f'{probability:.0%}'


def _name(readings: Readings, i: int) -> str:
    return (readings.sensor_names or ('',))[readings.sensor[i]] or 'a sensor without a name'


def _sensors(readings: Readings, which: NDArray[np.int64]) -> str:
    """Return the sensors of readings, those with most readings first."""
    counts = Counter(_name(readings, int(i)) for i in which)
    named = [name if n == 1 else f'{name} ({n})' for name, n in counts.most_common(MOST_SHOWN)]
    more = f' and {len(counts) - MOST_SHOWN} more' if len(counts) > MOST_SHOWN else ''
    return ', '.join(named) + more


def _decisive_evidence(maps: MapArchive, found: CellEvidence, state: int) -> str:
    """Return a sentence on the evidence that determined the cell, and on what would change its state."""
    total = found.data + found.prior
    if found.traversed:
        return 'a sensor traversed it, so it is free, independent of the readings'
    if not len(found.readings):
        return 'no reading gives evidence on it'
    if state < 0:
        blocked, count = int(found.through_wall.sum()), len(found.readings)
        behind = (
            f'a wall blocks {"all" if blocked == count else blocked} of these readings, and their evidence is not '
            'used: an echo that a wall reflects seems to come from behind it'
        )
        if blocked == count:
            return behind
        few = (
            f'there is not enough evidence: fewer than {maps.parameters.search.least_passed:g} readings are expected '
            'to have passed through it, or none that could have detected a wall there, and no evidence makes it '
            'occupied'
        )
        return f'{few}; {behind}' if blocked else few
    if (total > 0) != (state == 1):
        return (
            'its own evidence is for the opposite state: it belongs to a wall that is closed, extended or removed as '
            'a whole, or to an obstacle of which no cell is more likely occupied than free in the uncertainty map'
        )
    against = found.nats[(found.nats < 0) if state == 1 else (found.nats > 0)]
    typical = float(np.abs(against).max(initial=0.0))
    other = STATES[1 - state]
    if typical >= LEAST_TYPICAL:
        more = math.ceil(abs(total) / typical)
        kind = f'the one with the most evidence for {other}'
        return f'to be {other} it takes {abs(total):.1f} nats more: {counted(more, "more reading")} like {kind}'
    none = f'so far no single reading gives {LEAST_TYPICAL:g} nats or more for that'
    return f'to be {other} it takes {abs(total):.1f} nats more; {none}'


def main(arguments: Sequence[str] | None = None) -> int:
    """Run the command; return its exit code."""
    given, made = sys.argv[1:] if arguments is None else arguments, parser()
    words = [word for before, word in itertools.pairwise(('', *given)) if before not in COUNT_OPTIONS and _is_one(word)]
    place = words[1:]
    if len(place) == 2 and (comma := next((word for word in place if ',' in word), '')):
        made.error(f'{comma} has a comma; write numbers with a point: {comma.replace(",", ".")}')
    return run(made, explain, [_positional(part) for word in given for part in _parted(word)])


def _is_one(word: str) -> bool:
    """Return whether a word is an argument, not an option."""
    return not word.startswith('-') or word[1:2].isdigit() or word[1:2] == '.'


def _parted(word: str) -> list[str]:
    """Return the two numbers of a place such as 3.0,1.0, and any other word unchanged."""
    parts = word.split(',')
    try:
        return parts if len([float(part) for part in parts]) == 2 else [word]
    except ValueError:
        return [word]


def _positional(word: str) -> str:
    """Return a word in a form that argparse does not mistake for an option, such as -1e-1."""
    try:
        float(word)
    except ValueError:
        return word
    return f' {word}' if word.startswith('-') else word
