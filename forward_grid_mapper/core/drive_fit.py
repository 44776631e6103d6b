"""Whether each of several drives fits the map of all: a drive in another frame contradicts the others.

Stretches of every drive are mapped by themselves. Of drives that fit, the map of all explains the readings of a stretch
as well as its own map does. Where it explains them much worse, the others say that something else stands there.
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from .common.readings import Readings
from .mapping import Mapper
from .maps.map_set import MapSet
from .sensor.forward_model import ForwardModel

STRETCHES, LENGTH = 3, 2000
"""Stretches of a drive that are mapped, and the readings of each: they bound the cost."""

ENOUGH = 300
"""Readings of a drive below which nothing is said of it."""

WORSE = 0.15
"""Nats a reading by which the map of all must be worse. Of drives that fit it is by .09 at the most; an offset of 0.3 m
makes more than .2 of it, one of 0.1 m is not told."""

ALIKE = 0.5
"""Part of the worst drive's misfit from where on a drive is named with it: those that fit are disturbed as well."""

NAMED = 6


def misfits(maps: MapSet, drives: int) -> list[float]:
    """Return by how many nats a reading the map of all is worse for each drive than its own, in its worst stretch."""
    # which are in order of time
    readings = maps.readings
    return [_misfit(maps, readings.select(np.flatnonzero(readings.drive == number))) for number in range(drives)]


def _misfit(maps: MapSet, drive: Readings) -> float:
    if len(drive) < ENOUGH:
        return 0.0
    size = min(LENGTH, len(drive))
    found = []
    for begin in np.unique(np.linspace(0, len(drive) - size, STRETCHES).astype(int)):
        stretch = drive.select(slice(begin, begin + size))
        own = Mapper(maps.parameters).run(stretch)
        of_all = ForwardModel(stretch, maps.grid, maps.parameters.model, maps.normals).log_likelihood(maps.ml)
        found.append((own.log_likelihood - of_all) / size)
    return float(max(found))


def fit_warnings(maps: MapSet, names: Sequence[str]) -> list[str]:
    """Return a warning that names the drives that do not fit the others; empty if all fit, or there is but one."""
    if len(names) < 2:
        return []
    found = misfits(maps, len(names))
    worst = max(found)
    if worst < WORSE:
        return []
    odd = sorted((k for k in range(len(names)) if found[k] >= max(ALIKE * worst, WORSE)), key=lambda k: -found[k])
    listed = ', '.join(f'{names[k]} ({found[k]:.2f})' for k in odd[:NAMED])
    more = f' and {len(odd) - NAMED} more' if len(odd) > NAMED else ''
    who = f'{listed}{more} {"does" if len(odd) == 1 else "do"} not fit the map of all drives'
    if len(odd) == len(names):
        who = f'the drives {listed}{more} do not fit each other'
    return [
        f'{who}: a map of each such drive alone explains its readings better, by this number of nats a reading. Is '
        'its odometry in the same frame as that of the others (wheel odometry starts at zero at every start), or was '
        'the place rearranged? Localise all drives in one map, or map such a drive alone'
    ]
