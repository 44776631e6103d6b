"""Checks whether each of several drives fits the map of all: a drive in another frame contradicts the others.

Parts of each drive are mapped by themselves. If a drive fits, the map of all explains the readings of a part as well as
its own map does. If it explains them much worse, readings of the other drives contradict them.
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from .common.readings import Readings
from .mapping import Mapper
from .maps.map_set import MapSet
from .sensor.forward_model import ForwardModel

MOST_STRETCHES, STRETCH_READINGS = 3, 2000
"""Most parts of a drive that are mapped, and readings of each: they limit the cost."""

LEAST_READINGS = 300
"""Fewest readings of a drive that is checked."""

LEAST_MISFIT = 0.15
"""Nats a reading by which the map of all must be worse for a warning. It is at most 0.09 for drives that fit, and more
than 0.2 for an offset of 0.3 m; one of 0.1 m is not found."""

NAMED_FRACTION = 0.5
"""Other drives are named if their misfit is at least this fraction of the largest; those that fit are affected, too."""

MOST_NAMED = 6


def misfits(maps: MapSet, drives: int) -> list[float]:
    """Return how much worse the map of all is than its own map for the worst part of each drive, nats a reading."""
    # these are sorted by time
    readings = maps.readings
    return [_misfit(maps, readings.select(np.flatnonzero(readings.drive == number))) for number in range(drives)]


def _misfit(maps: MapSet, drive: Readings) -> float:
    if len(drive) < LEAST_READINGS:
        return 0.0
    size = min(STRETCH_READINGS, len(drive))
    found = []
    for begin in np.unique(np.linspace(0, len(drive) - size, MOST_STRETCHES).astype(int)):
        stretch = drive.select(slice(begin, begin + size))
        own = Mapper(maps.parameters).run(stretch)
        of_all = ForwardModel(stretch, maps.grid, maps.parameters.model, maps.normals).log_likelihood(maps.ml)
        found.append((own.log_likelihood - of_all) / size)
    return float(max(found))


def fit_warnings(maps: MapSet, names: Sequence[str]) -> list[str]:
    """Return a warning with the drives that do not fit the others; empty if all fit, or there is only one."""
    if len(names) < 2:
        return []
    found = misfits(maps, len(names))
    worst = max(found)
    if worst < LEAST_MISFIT:
        return []
    least = max(NAMED_FRACTION * worst, LEAST_MISFIT)
    odd = sorted((k for k in range(len(names)) if found[k] >= least), key=lambda k: -found[k])
    listed = ', '.join(f'{names[k]} ({found[k]:.2f})' for k in odd[:MOST_NAMED])
    more = f' and {len(odd) - MOST_NAMED} more' if len(odd) > MOST_NAMED else ''
    who = f'{listed}{more} {"does" if len(odd) == 1 else "do"} not fit the map of all drives'
    if len(odd) == len(names):
        who = f'the drives {listed}{more} do not fit each other'
    return [
        f'{who}: a map of each such drive alone explains its readings better, by this number of nats a reading. Is '
        'its odometry in the same frame as that of the others (wheel odometry starts at zero at every start), or was '
        'the place rearranged? Localise all drives in one map, or map such a drive alone'
    ]
