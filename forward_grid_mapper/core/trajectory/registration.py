"""Registration of a drive with the map of other drives.

A trajectory begins at the first pose of its odometry. An error of the yaw there turns the whole drive about its start.
So the drive is moved as a rigid body: the pose of its start (x, y, yaw) is the one for which its readings are likeliest
on the map of the others. It is searched from coarse to fine; a step of the yaw moves the readings, in the rms, as far
as a step of the position.
"""

from __future__ import annotations

import math
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from ..common.parameters import Parameters
from ..common.readings import Floats, Readings
from ..messages.reading_buffer import bounded
from ..runtime.cancelling import check
from ..sensor.density import hit_probability
from .holding_out import LEAST_SIGMAS, Gain, gain
from .likelihood import LANES, Scan, make_scan, scores
from .local_map import UNKNOWN, at_poses, for_matching, local_map
from .matching import grid_around
from .poses import compose, relative

SIGMA = np.array([0.1, 0.1, math.radians(4.0)])
"""σ of the prior of the start: metres, metres, radians."""

SIGMAS = 2.5
"""Half the size of the first grid, σ; the finer grids may leave it, by up to one of their steps before."""

STEP, FINER, LEVELS = 0.15, 1 / 3, 3
"""Step of the first grid, metres; factor of the steps from one grid to the next; number of grids."""

EVALUATED = (150, 600, 2000)
"""Readings that are evaluated at each pose, of each grid."""

ON_MAP = 20_000
"""Most readings that the map of the others is made from."""

BLOCKS = 40
"""Blocks of the drive, in order of time, whose predictions before and after are compared."""

FEWEST = 5
"""Fewest readings of a block that is compared."""

SILENT = 1e-6
"""Nats: a log-likelihood ratio up to this is 0, since the map is unknown there."""


class Registration(NamedTuple):
    """The pose of a drive on the map.

    Attributes
    ----------
    begin : float64, shape (3,)
        The pose of its start; unchanged if no better one was found.
    gain : Gain
        How much better its readings are predicted there.
    """

    begin: Floats
    gain: Gain


def register(
    readings: Readings, begin: Floats, others: Readings, parameters: Parameters, stop: NDArray[np.uint8]
) -> Registration:
    """Return the pose of a drive on the map of others.

    Parameters
    ----------
    readings : Readings
        Of the drive, placed by its trajectory.
    begin : float64, shape (3,)
        The first pose of the trajectory.
    others : Readings
        Readings of the other drives, which are not moved.
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
    """A drive as one scan, and the map of others.

    The parameters are those of `register`. All methods raise `Cancelled` if `stop` was set.
    """

    def __init__(
        self, readings: Readings, begin: Floats, others: Readings, parameters: Parameters, stop: NDArray[np.uint8]
    ) -> None:
        parameters = for_matching(parameters)
        model, resolution = parameters.model, parameters.grid.resolution
        self._stop = stop
        self._around = local_map(bounded(others, ON_MAP), parameters, stop)
        readings = readings.select(np.argsort(readings.stamp, kind='stable'))
        sensors = relative(begin, np.stack([readings.x, readings.y, readings.yaw], axis=1))
        self._scan = make_scan(readings, sensors, model, resolution, UNKNOWN * hit_probability(model, resolution))
        self._extent = _extent(sensors[:, :2])

    def search(self, begin: Floats, sigma: Floats, blocks: int = 0) -> Floats:
        """Return the best pose of the start near `begin`, shape (3,); `sigma` of the prior is in metres and radians.

        If `blocks` is not 0, the drive is divided into this many blocks, and those that are not on the map are ignored.
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
            found = self._best(scan, poses, begin, information, count)
            reach, steps = steps, FINER * steps
        return found

    def _best(self, scan: Scan, poses: Floats, begin: Floats, information: Floats, count: int) -> Floats:
        """Return the pose of the largest posterior, by about `count` readings; the prior is around `begin`."""
        off, stride, value = relative(begin, poses), max(len(scan.readings) // count, 1), np.empty(len(poses))
        # a whole grid takes seconds, without a check of `stop`; poses of the same yaw are fastest together
        order = np.argsort(poses[:, 2], kind='stable')
        for part in np.array_split(order, -(-len(poses) // LANES)):
            check(self._stop)
            value[part] = scores(scan, self._around, poses[part], stride)
        value -= 0.5 * np.einsum('pi,ij,pj->p', off, information, off)
        best: Floats = poses[int(value.argmax())]
        return best

    def of_each(self, begin: Floats, count: int) -> Floats:
        """Return the log-likelihood ratio of each of the first `count` readings, in order of time, nats."""
        check(self._stop)
        readings, weight = self._scan.readings[:count], self._scan.weight
        each = [scores(Scan(readings[k : k + 1], weight), self._around, begin[None])[0] for k in range(len(readings))]
        return np.array(each)

    def predicted(self, begin: Floats, blocks: int) -> Floats:
        """Return the mean log-likelihood ratio of the readings of each block, in order of time, shape (blocks,), nats.

        It is NaN for blocks with fewer than `FEWEST` readings.
        """
        check(self._stop)
        out = np.full(blocks, np.nan)
        for k, part in enumerate(np.array_split(self._scan.readings, blocks)):
            if len(part) >= FEWEST:
                out[k] = scores(Scan(part, self._scan.weight), self._around, begin[None])[0] / len(part)
        return out


def _extent(xy: Floats) -> float:
    """Return the rms distance of readings from the start of the drive, at least 1 m."""
    return max(float(np.sqrt((xy**2).sum(1).mean())), 1.0)


def moved_to(begin: Floats, poses: Floats) -> Floats:
    """Return the poses of a drive, shape (M, 3), moved as a rigid body so that the first one is at `begin`."""
    out: Floats = compose(begin, relative(poses[0], poses))
    out[:, 2] = begin[2] + poses[:, 2] - poses[0, 2]
    return out


def readings_moved(readings: Readings, before: Floats, begin: Floats) -> Readings:
    """Return the readings of a drive, moved as a rigid body so that its start goes from `before` to `begin`."""
    sensors = np.stack([readings.x, readings.y, readings.yaw], axis=1)
    return at_poses(readings, compose(begin, relative(before, sensors)))
