"""The scans and local maps of a drive's windows, given the nodes."""

from __future__ import annotations

import itertools

import numpy as np
from numpy.typing import NDArray

from ..common.parameters import Parameters
from ..common.readings import Readings
from ..sensor.density import hit_probability
from .likelihood import Scan, make_scan
from .local_map import UNKNOWN, LocalMap, at_poses, explained, local_map
from .poses import Floats, compose, relative
from .windows import Windows, corrected

FEWEST_ON_MAP = 30
"""Readings that a local map is made from at least."""

MOST_ON_MAP = 800
"""Readings that it is made from at most, drawn from all: more take time, and hardly change the map."""


class Scans:
    """Scans and local maps of windows.

    Attributes
    ----------
    windows : Windows
    scan : list of Scan
        The readings of each window in the frame of its node, in any order.
    count : int64, shape (K,)
        How many of them may be used; none of windows that are held out.
    held_out : bool, shape (K,)
    predictions : dict
        What `holding_out.predicted` found, since the same is asked several times.
    """

    def __init__(
        self, windows: Windows, parameters: Parameters, stop: NDArray[np.uint8], held_out: NDArray[np.bool_]
    ) -> None:
        self.windows, self._parameters, self._stop = windows, parameters, stop
        first, resolution = windows.first, parameters.grid.resolution
        self.resolution = resolution
        self.held_out = held_out
        self.predictions: dict[tuple[bytes, bytes, float], float] = {}
        sensors = compose(windows.robot, windows.mount)
        local = relative(np.repeat(windows.node, np.diff(first), axis=0), sensors)
        unknown = UNKNOWN * hit_probability(parameters.model, resolution)
        whole = make_scan(windows.readings, local, parameters.model, resolution, unknown)
        # in any order, so that every n-th reading is not of the same few sensors
        window = np.repeat(np.arange(len(windows)), np.diff(first))
        mixed = whole.readings[np.lexsort((np.random.default_rng(0).random(len(window)), window))]
        self.count = np.where(held_out, 0, np.diff(first))
        self.scan = [Scan(mixed[begin:end], whole.weight) for begin, end in itertools.pairwise(first.tolist())]

    def joint(self, members: NDArray[np.int64], poses: Floats) -> Scan:
        """Return the readings of several windows as one scan, given their nodes' poses, shape (len(members), 3)."""
        parts = []
        for k, pose in zip(members, poses, strict=True):
            if self.held_out[k]:
                continue
            table = self.scan[k].readings.copy()
            moved = compose(pose, np.stack([table['x'], table['y'], table['yaw']], axis=1))
            table['x'], table['y'], table['yaw'] = moved.T
            parts.append(table)
        return Scan(np.concatenate(parts) if parts else self.scan[0].readings[:0], self.scan[0].weight)

    def map(
        self, members: NDArray[np.int64], origin: Floats, nodes: Floats, most: int = MOST_ON_MAP
    ) -> LocalMap | None:
        """Return the map of some windows in the frame `origin`; None where they have hardly any readings.

        Parameters
        ----------
        members : int64
            Windows.
        origin : float64, shape (3,)
        nodes : float64, shape (n, 3)
            Of the first n windows, all of `members` among them.
        most : int
            Readings that it is made from at most.
        """
        if self.count[members].sum() < FEWEST_ON_MAP:
            return None
        which = self._readings_of(members)
        if len(which) > most:
            # sensors take turns, so every n-th reading may be of a few of them only
            which = np.sort(np.random.default_rng(len(which)).choice(which, most, replace=False))
        return local_map(self._placed(which, nodes, origin), self._parameters, self._stop)

    def objective(self, nodes: Floats) -> float:
        """Return J of the whole drive along nodes, shape (K, 3), nats.

        Readings of windows that are held out have no say.
        """
        return self.explained(nodes)[0]

    def explained(self, nodes: Floats) -> tuple[float, Floats]:
        """Return J of the whole drive along nodes, shape (K, 3), and what the readings of each window have of it.

        Both are in nats; the second has shape (K,), and 0 for windows that are held out.
        """
        which = self._readings_of(np.arange(len(self.windows)))
        value, each = explained(self._placed(which, nodes, np.zeros(3)), self._parameters, self._stop)
        window = np.repeat(np.arange(len(self.windows)), np.diff(self.windows.first))[which]
        windows: Floats = np.bincount(window, each, len(self.windows)).astype(np.float64)
        return value, windows

    def _readings_of(self, members: NDArray[np.int64]) -> NDArray[np.int64]:
        first = self.windows.first
        return np.concatenate([np.arange(first[k], first[k + 1]) for k in members if not self.held_out[k]])

    def _placed(self, which: NDArray[np.int64], nodes: Floats, origin: Floats) -> Readings:
        """Return some readings where the nodes of the first windows have them, in the frame `origin`."""
        w, known = self.windows, len(nodes)
        robot = corrected(w.progress[which], w.robot[which], w.node_progress[:known], w.node[:known], nodes)
        return at_poses(w.readings.select(which), relative(origin, compose(robot, w.mount[which])))
