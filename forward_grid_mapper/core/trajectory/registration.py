"""Registration: where a drive lies on the map of other drives.

A trajectory that was found for itself begins where its odometry does, and there the yaw of odometry has errors as
everywhere: over the whole drive they swing it about its begin. Three figures for the whole drive, place and yaw of its
begin, are those with which its readings are likeliest given the map of the others. They are searched from coarse to
fine, with steps of the yaw that move the readings as far as those of the place do.
"""

from __future__ import annotations

import math
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from ..common.parameters import Parameters
from ..common.readings import Readings
from ..messages.reading_buffer import bounded
from ..sensor.density import hit_probability
from .holding_out import LEAST_SIGMAS, Gain, gain
from .likelihood import Scan, make_scan, scores
from .local_map import UNKNOWN, LocalMap, at_poses, for_matching, local_map
from .matching import grid_around
from .poses import Floats, compose, relative

SIGMA = np.array([0.1, 0.1, math.radians(4.0)])
"""σ of the begin a priori: metres, and radians."""

SIGMAS = 2.5

STEP, FINER, LEVELS = 0.15, 1 / 3, 3
"""Metres between two places of the first search, what the next is finer by, and how many there are."""

EVALUATED = (150, 600, 2000)
"""Readings that each search asks."""

ON_MAP = 20_000
"""Readings that the map of the others is made of at the most."""

BLOCKS = 40
"""Pieces of the drive, in order of time, whose readings are compared before and after."""

FEWEST = 5
"""Readings of a piece that is compared."""

SILENT = 1e-6
"""Nats a reading of a block that says nothing, since all of it is new."""


class Registration(NamedTuple):
    """Where a drive lies.

    Attributes
    ----------
    begin : float64, shape (3,)
        The pose of its begin, on the map; as it was if nothing better was found.
    gain : Gain
        By how much its readings are predicted better.
    """

    begin: Floats
    gain: Gain


def register(
    readings: Readings, begin: Floats, others: Readings, parameters: Parameters, stop: NDArray[np.uint8]
) -> Registration:
    """Return where a drive lies on the map of others.

    Parameters
    ----------
    readings : Readings
        Of the drive, placed by its trajectory.
    begin : float64, shape (3,)
        The first pose of the trajectory.
    others : Readings
        Placed where they stay.
    parameters : Parameters
    stop : uint8, shape (1,)
        Not 0 to end the work.

    Raises
    ------
    Cancelled
        If `stop` was set.
    """
    around = OnMap(readings, begin, others, parameters, stop)
    found = around.search(begin, SIGMA)
    better = gain(around.predicted(begin, BLOCKS), around.predicted(found, BLOCKS))
    return Registration(found if better.sigmas >= LEAST_SIGMAS else begin, better)


class OnMap:
    """A drive as one scan, to be put on the map of others.

    The parameters are those of `register`; `begin` is where the drive begins as its readings are placed.
    """

    def __init__(
        self, readings: Readings, begin: Floats, others: Readings, parameters: Parameters, stop: NDArray[np.uint8]
    ) -> None:
        parameters = for_matching(parameters)
        model, resolution = parameters.model, parameters.grid.resolution
        self._around = local_map(bounded(others, ON_MAP), parameters, stop)
        readings = readings.select(np.argsort(readings.stamp, kind='stable'))
        sensors = relative(begin, np.stack([readings.x, readings.y, readings.yaw], axis=1))
        self._scan = make_scan(readings, sensors, model, resolution, UNKNOWN * hit_probability(model, resolution))
        self._extent = _extent(sensors[:, :2])

    def search(self, begin: Floats, sigma: Floats, blocks: int = 0) -> Floats:
        """Return the best begin near one, shape (3,), with these σ a priori: metres, metres, radians.

        With `blocks`, readings are asked only of those blocks that lie on the map.
        """
        scan, extent = self._scan, self._extent
        if blocks:
            parts = np.array_split(scan.readings, blocks)
            on_map = [p for p, value in zip(parts, self.predicted(begin, blocks), strict=True) if abs(value) > SILENT]
            if not on_map:
                return begin
            scan = Scan(np.concatenate(on_map), scan.weight)
            extent = _extent(np.stack([scan.readings['x'], scan.readings['y']], axis=1))
        found, reach, steps = begin, SIGMAS * sigma, np.array([STEP, STEP, STEP / extent])
        information = np.diag(sigma**-2.0)
        for count in EVALUATED[:LEVELS]:
            poses = grid_around(found, reach, (steps[0], steps[1], steps[2]))
            found = _best(scan, self._around, poses, begin, information, count)
            reach, steps = steps, FINER * steps
        return found

    def of_each(self, begin: Floats, count: int) -> Floats:
        """Return the log ratio of each of the first `count` readings, in order of time."""
        readings, weight = self._scan.readings[:count], self._scan.weight
        each = [scores(Scan(readings[k : k + 1], weight), self._around, begin[None])[0] for k in range(len(readings))]
        return np.array(each)

    def predicted(self, begin: Floats, blocks: int) -> Floats:
        """Return the mean log ratio of the readings of each of so many blocks, in order of time, shape (blocks,).

        It is NaN where they are few.
        """
        out = np.full(blocks, np.nan)
        for k, part in enumerate(np.array_split(self._scan.readings, blocks)):
            if len(part) >= FEWEST:
                out[k] = scores(Scan(part, self._scan.weight), self._around, begin[None])[0] / len(part)
        return out


def _extent(xy: Floats) -> float:
    """Return how far readings are from the begin of the drive, metres."""
    return max(float(np.sqrt((xy**2).sum(1).mean())), 1.0)


def _best(scan: Scan, around: LocalMap, poses: Floats, begin: Floats, information: Floats, count: int) -> Floats:
    """Return the best of `poses`, given where the drive begins a priori, by about so many readings."""
    off = relative(begin, poses)
    value = scores(scan, around, poses, max(len(scan.readings) // count, 1))
    value -= 0.5 * np.einsum('pi,ij,pj->p', off, information, off)
    best: Floats = poses[int(value.argmax())]
    return best


def moved_to(begin: Floats, poses: Floats) -> Floats:
    """Return poses of a drive, shape (M, 3), with the first one at `begin` and the others moved along."""
    out: Floats = compose(begin, relative(poses[0], poses))
    out[:, 2] = begin[2] + poses[:, 2] - poses[0, 2]
    return out


def readings_moved(readings: Readings, before: Floats, begin: Floats) -> Readings:
    """Return readings of a drive that began at `before`, shape (3,), as they are if it begins at `begin`."""
    sensors = np.stack([readings.x, readings.y, readings.yaw], axis=1)
    return at_poses(readings, compose(begin, relative(before, sensors)))
