"""Scans and local maps of the windows of a drive, for given nodes."""

from __future__ import annotations

import hashlib
import itertools
from copy import copy

import numpy as np
from numpy.typing import NDArray

from ..common.parameters import Parameters
from ..common.readings import Floats, Readings
from ..runtime.threads import cores
from ..sensor.density import hit_probability
from .likelihood import Scan, make_scan
from .local_map import UNKNOWN, LocalMap, at_poses, explained, local_map
from .poses import compose, relative
from .windows import Windows, corrected

FEWEST_ON_MAP = 30
"""Fewest readings that a local map is made from."""

MOST_ON_MAP = 800
"""Usual largest number of readings that a local map is made from, drawn at random: more take time, and hardly change
the map of one visit."""


class Scans:
    """Scans and local maps of windows.

    Attributes
    ----------
    windows : Windows
    scan : list of Scan
        The readings of each window in the frame of its node, in random order.
    count : int64, shape (K,)
        Number of readings that may be used; 0 for held-out windows.
    held_out : bool, shape (K,)
        Windows whose readings are only predicted.
    predictions : dict
        Cache of `holding_out.predicted`.
    threads : int
        Number of blocks that are matched at the same time; results do not depend on it.
    """

    def __init__(
        self, windows: Windows, parameters: Parameters, stop: NDArray[np.uint8], held_out: NDArray[np.bool_]
    ) -> None:
        self.windows, self._parameters, self._stop = windows, parameters, stop
        first, resolution = windows.first, parameters.grid.resolution
        self.resolution = resolution
        self.held_out, self.threads = held_out, parameters.search.threads or cores()
        self.predictions: dict[tuple[bytes, bytes, float], float] = {}
        self._explained: dict[bytes, tuple[float, Floats]] = {}
        sensors = compose(windows.robot, windows.mount)
        local = relative(np.repeat(windows.node, np.diff(first), axis=0), sensors)
        unknown = UNKNOWN * hit_probability(parameters.model, resolution)
        whole = make_scan(windows.readings, local, parameters.model, resolution, unknown)
        # in random order, so that every n-th reading is not of the same few sensors
        window = np.repeat(np.arange(len(windows)), np.diff(first))
        mixed = whole.readings[np.lexsort((np.random.default_rng(0).random(len(window)), window))]
        self.count = np.where(held_out, 0, np.diff(first))
        self.scan = [Scan(mixed[begin:end], whole.weight) for begin, end in itertools.pairwise(first.tolist())]

    def with_held_out(self, held_out: NDArray[np.bool_]) -> Scans:
        """Return the same scans with other windows held out."""
        out = copy(self)
        out.held_out, out.count = held_out, np.where(held_out, 0, np.diff(self.windows.first))
        out.predictions, out._explained = {}, {}
        return out

    def joint(self, members: NDArray[np.int64], poses: Floats) -> Scan:
        """Return the readings of several windows as one scan; `poses` of their nodes have the shape (members, 3)."""
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
        """Return the local map of some windows; None if they have fewer readings than `FEWEST_ON_MAP`.

        Parameters
        ----------
        members : int64
            Windows.
        origin : float64, shape (3,)
            Frame of the map.
        nodes : float64, shape (n, 3)
            Of the first n windows; they include `members`.
        most : int
            Most readings that it is made from.
        """
        if self.count[members].sum() < FEWEST_ON_MAP:
            return None
        which = self._readings_of(members)
        if len(which) > most:
            # sensors take turns, so every n-th reading may be of a few of them only
            which = np.sort(np.random.default_rng(len(which)).choice(which, most, replace=False))
        return local_map(self._placed(which, nodes, origin), self._parameters, self._stop)

    def objective(self, nodes: Floats) -> float:
        """Return J of the map of the whole drive, with nodes of shape (K, 3), nats; without held-out readings."""
        return self.explained(nodes)[0]

    def explained(self, nodes: Floats) -> tuple[float, Floats]:
        """Return `objective`, and what the readings of each window contribute to it, shape (K,), nats."""
        along = hashlib.sha256(nodes.tobytes()).digest()
        if along not in self._explained:
            which = self._readings_of(np.arange(len(self.windows)))
            value, each = explained(self._placed(which, nodes, np.zeros(3)), self._parameters, self._stop, self.threads)
            window = np.repeat(np.arange(len(self.windows)), np.diff(self.windows.first))[which]
            self._explained[along] = value, np.bincount(window, each, len(self.windows)).astype(np.float64)
        return self._explained[along]

    def objective_of(self, members: NDArray[np.int64], origin: Floats, nodes: Floats) -> float:
        """Return J of the map of some windows in the frame `origin`, with nodes of shape (K, 3), nats."""
        which = self._readings_of(members)
        return explained(self._placed(which, nodes, origin), self._parameters, self._stop, 1)[0]

    def _readings_of(self, members: NDArray[np.int64]) -> NDArray[np.int64]:
        first = self.windows.first
        return np.concatenate([np.arange(first[k], first[k + 1]) for k in members if not self.held_out[k]])

    def _placed(self, which: NDArray[np.int64], nodes: Floats, origin: Floats) -> Readings:
        """Return some readings, placed by the nodes of the first windows, in the frame `origin`."""
        w, known = self.windows, len(nodes)
        robot = corrected(w.progress[which], w.robot[which], w.node_progress[:known], w.node[:known], nodes)
        return at_poses(w.readings.select(which), relative(origin, compose(robot, w.mount[which])))
