"""The standard map at several times during the drive."""

from __future__ import annotations

from collections.abc import Iterator
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from .log_odds_map import LogOddsMap
from .map_set import MapSet


class Moment(NamedTuple):
    """The standard map of all readings up to and with one.

    Attributes
    ----------
    stamp : int
        Of the last of these readings, nanoseconds.
    live : float32
        Occupancy probability, NaN for cells in no cone so far, on the grid of the maps of the whole drive.
    """

    stamp: int
    live: NDArray[np.float32]


def moments(maps: MapSet, count: int) -> Iterator[Moment]:
    """Yield the standard map after each of `count` parts of the readings; the last one is `maps.live`.

    Parts have equal numbers of readings, not equal times, so that pauses and nights between drives take none. There are
    fewer parts if there are fewer readings. Only one map is in memory at a time.
    """
    readings = maps.readings
    order = np.argsort(readings.stamp, kind='stable')
    parts = [part for part in np.array_split(order, count) if len(part)]
    live = LogOddsMap(maps.parameters)
    for part in parts[:-1]:
        live.add(readings.select(part))
        yield Moment(int(readings.stamp[part[-1]]), live.probability(maps.grid))
    if parts:
        yield Moment(int(readings.stamp[order[-1]]), maps.live)
