"""The standard map as it was during the drive: what is shown of the time between the first reading and the last."""

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
        Occupancy probability, NaN where no reading said anything yet, on the grid of the whole drive's maps.
    """

    stamp: int
    live: NDArray[np.float32]


def moments(maps: MapSet, count: int) -> Iterator[Moment]:
    """Yield the standard map after each of `count` equal parts of the readings; the last one is `maps.live`.

    Parts are equal in readings, not in seconds, so that a robot that stands, or a night between two drives, takes none.
    There are fewer where there are fewer readings. One map is held at a time.
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
