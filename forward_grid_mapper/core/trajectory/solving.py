"""Solving a drive: the pose graph of what straight walls say first, then with matches and places seen before.

Straight walls come first, for local maps follow a bend of the drive and say nothing against it. With their help the
nodes are right to some centimetres over some metres, and local maps sharp.
"""

from __future__ import annotations

import math
from collections.abc import Callable

import numpy as np
from numpy.typing import NDArray

from .heading import Heading
from .holding_out import LEAST_SIGMAS, gain, predicted
from .loops import Loop, SearchResults, find_loops, loops_of
from .odometry_model import (
    CALIBRATION,
    CALIBRATION_SIGMA,
    Noise,
    calibrated,
    covariances,
    motions,
    sensitivity,
    with_yaw,
)
from .passes import BLOCK, Matches, Progress, deformation, match_preceding, match_surrounding
from .pose_graph import Edges, Graph, Solution, Walls, Yaws, joined, no_edges, no_walls, no_yaws, solve
from .poses import Floats, rms_after_alignment
from .relocating import MORE_RECOGNISED, displaced, loops_at, recognised, revisits, unsupported, windows_of
from .scans import Scans
from .wall_distances import Distances
from .walls import EVERY, SPAN
from .windows import Odometry, Windows

WALL_ROUNDS = 3
"""Times that distances of walls are measured anew where the nodes have moved to."""

SAMPLES = 40
"""Deviations that are drawn to know how far places may be off."""

MATCH_WEIGHT = 0.2
"""What a match counts: the windows of a block are matched with one map, whose errors they share, and a map of what lies
around is off as the block is."""

LARGEST_RESIDUAL, FIRST_OUT = 5.0 * MATCH_WEIGHT, 0.5
"""σ², in the mean over a loop, from which on it does not agree with the rest; and the part of the largest such mean
from which on loops are taken out at once: what else is far off may be so because of these."""

SETTLED = 0.1
"""Metres, in the root mean square, by which matching must have moved the nodes for it to be done again, and the nodes
around a block or a place, relative to each other, for the block to be looked for there again: a cell."""

NOISE_FACTOR, LEAST_YAW = 2.0, math.radians(1.0)
"""Times that the yaw drifts more than walls say, and radians a √metre at least: an echo votes with all others of three
metres, and what drifts within these is not seen. Wheels that slip now and then keep the yaw well in between."""

YAW_WEIGHT = EVERY / SPAN
"""What the loss of a yaw that votes measure counts: an echo votes at all places that are near, and counts once."""

SCALE_AND_HEADING = np.array([1.0, 1.0, 0.0, 0.0])
"""The part of a calibration that is left where the yaw is known."""


class MatchSolver:
    """What odometry and matches know about a drive, and its solutions.

    Parameters
    ----------
    windows : Windows
    scans : Scans
    start_stage : callable
        Receives a stage, and returns what receives how much of it is done.
    motion : float64, shape (K − 1, 3)
        From each node to the next one, in the frame of the first of the two.
    noise : float
        Of its yaw, radians a √metre.
    change : float64, shape (K − 1, 3, C)
        How `motion` changes with the calibration.
    """

    def __init__(
        self,
        windows: Windows,
        scans: Scans,
        start_stage: Callable[[str], Progress],
        motion: Floats,
        noise: float,
        change: Floats,
    ) -> None:
        self._windows, self._scans, self._start_stage, self._change = windows, scans, start_stage, change
        self._tried_stretches: set[int] = set()
        information = np.asarray(np.linalg.inv(covariances(windows, Noise(yaw=noise))), np.float64)
        count = np.arange(len(windows))
        self._steps = Edges(count[:-1], count[1:], motion, information)
        self._yaws = no_yaws()

    def with_matches(self, solution: Solution) -> tuple[Solution, list[Loop]]:
        """Return what matches with local maps say as well, and the loops among them."""
        known, loops = SearchResults(), list[Loop]()
        for match, stage in ((match_preceding, 'matching'), (match_surrounding, 'matching again')):
            before = solution.nodes
            found = match(self._scans, solution.nodes, self._start_stage(stage))
            edges = _edges_of(found)
            walls = self._walls(solution.nodes, True)
            both = joined(edges, *(_edges_of(loop.matches) for loop in loops_of(known)))
            solution = solve(self._graph(both, walls), solution.nodes, solution.calibration, SAMPLES)
            watch, searched = self._start_stage('places seen before'), solution.nodes
            results = find_loops(self._scans, searched, solution.samples, found.mean_score, watch, known)
            walls = self._walls(searched, True)
            first, loops = self._with_loops(walls, edges, loops_of(results), solution)
            solution, loops = self._with_stretches_relocated(edges, loops, first, found.mean_score)
            # maps from nodes that hardly moved are the same again
            if rms_after_alignment(before, solution.nodes) < SETTLED:
                break
            # blocks that were carried to another place are to be looked for anew
            known = self._unchanged(results, searched, solution.nodes) if solution is first else SearchResults()
        return solution, loops

    def _with_stretches_relocated(
        self, matches: Edges, loops: list[Loop], solution: Solution, usual: float
    ) -> tuple[Solution, list[Loop]]:
        """Return the solution with stretches that fit where they are no more put where they belong."""
        begin = 0
        while True:
            blocks = unsupported(revisits(self._scans, solution.nodes), recognised(loops), begin)
            if blocks is None:
                return solution, loops
            begin = int(blocks[len(blocks) // 2])
            if int(blocks[0]) not in self._tried_stretches:
                self._start_stage('places seen before')
                self._tried_stretches.add(int(blocks[0]))
                solution, loops = self._relocated(blocks, matches, loops, solution, usual)

    def _relocated(
        self, blocks: NDArray[np.int64], matches: Edges, loops: list[Loop], solution: Solution, usual: float
    ) -> tuple[Solution, list[Loop]]:
        """Return the solution with some blocks in another place, if their readings are predicted better there."""
        scans, nodes = self._scans, solution.nodes
        stretch = windows_of(blocks, len(nodes))
        moved = displaced(scans, nodes, stretch)
        if moved is None:
            return solution, loops
        found, first = loops_at(scans, moved, stretch, usual), int(stretch[0])
        if len(found) < len(recognised(loops).intersection(blocks.tolist())) + MORE_RECOGNISED:
            return solution, loops
        # those with which the rest was led astray lead all that comes after it
        across = [min(loop.block, loop.place) < first <= max(loop.block, loop.place) for loop in loops]
        rest = [loop for loop, out in zip(loops, across, strict=True) if not out]
        tried, kept = self._with_loops(self._walls(nodes, True), matches, [*rest, *found], solution)
        parts = [stretch[k : k + BLOCK] for k in range(0, len(stretch), BLOCK)]
        if gain(predicted(scans, nodes, parts), predicted(scans, tried.nodes, parts)).sigmas < LEAST_SIGMAS:
            return solution, loops
        return tried, kept

    def _unchanged(self, results: SearchResults, before: Floats, after: Floats) -> SearchResults:
        """Return what would come out the same: where neither the map of the place nor the block was bent."""
        at = np.unique(np.array([*results], np.int64))
        deformed = deformation(self._windows.node_progress, before, after, at)
        same = set(at[deformed < SETTLED].tolist())
        return {key: loop for key, loop in results.items() if same.issuperset(key)}

    def _walls(self, nodes: Floats, strict: bool) -> Walls:
        return no_walls()

    def _graph(self, matches: Edges, walls: Walls) -> Graph:
        return Graph(self._steps, self._change, CALIBRATION_SIGMA, matches, self._yaws, walls)

    def _with_loops(
        self, walls: Walls, matches: Edges, loops: list[Loop], start: Solution
    ) -> tuple[Solution, list[Loop]]:
        """Return the solution with those loops that agree with each other and with the rest."""
        while True:
            parts = [_edges_of(loop.matches) for loop in loops]
            solution = solve(self._graph(joined(matches, *parts), walls), start.nodes, start.calibration)
            ends = len(matches.first) + np.cumsum([len(part.first) for part in parts], dtype=np.int64)
            each = np.split(solution.squared, ends - [len(part.first) for part in parts])[1:]
            off = np.array([squared.mean() for squared in each])
            if off.max(initial=0.0) <= LARGEST_RESIDUAL:
                return solution, loops
            most = max(LARGEST_RESIDUAL, FIRST_OUT * float(off.max()))
            loops = [loop for loop, mean in zip(loops, off.tolist(), strict=True) if mean <= most]


class Solver(MatchSolver):
    """The same, and what walls say that stand at right angles.

    Parameters
    ----------
    odometry : Odometry
    windows : Windows
    scans : Scans
    heading : Heading
    start_stage : callable
        Receives a stage, and returns what receives how much of it is done.
    """

    def __init__(
        self,
        odometry: Odometry,
        windows: Windows,
        scans: Scans,
        heading: Heading,
        start_stage: Callable[[str], Progress],
    ) -> None:
        self._odometry, self._heading = odometry, heading
        drifts = heading.drifts
        self.first_calibration = np.array([0.0, 0.0, drifts.bias, drifts.turn_scale])
        change = sensitivity(odometry, windows)
        motion = motions(odometry, windows) + change @ self.first_calibration
        super().__init__(windows, scans, start_stage, motion, max(LEAST_YAW, NOISE_FACTOR * drifts.noise), change)
        count = np.arange(len(windows))
        yaw = windows.node[heading.at, 2] + heading.measured
        self._yaws = Yaws(heading.at, yaw, heading.information, YAW_WEIGHT)
        middles = (heading.at[1:] + heading.at[:-1]) / 2
        self._askew = heading.askew[np.searchsorted(middles, count)]

    def calibration_of(self, solution: Solution) -> Floats:
        """Return the whole calibration of the odometry, shape (4,)."""
        return self.first_calibration + solution.calibration

    def simple(self, calibration: Floats) -> Floats:
        """Return the nodes of odometry with the heading of walls and a calibration, shape (K, 3)."""
        w = self._windows
        turned = with_yaw(self._odometry, w.node_progress[self._heading.at], self._heading.correction)
        return calibrated(turned, calibration * SCALE_AND_HEADING).at(w.node_stamp)

    def along_walls(self) -> Solution:
        """Return what odometry and straight walls say."""
        self._start_stage('straight walls')
        nodes, calibration = self.simple(np.zeros(len(CALIBRATION))), np.zeros(len(CALIBRATION))
        for k in range(WALL_ROUNDS):
            walls = self._walls(nodes, k == WALL_ROUNDS - 1)
            solution = solve(self._graph(no_edges(), walls), nodes, calibration)
            nodes, calibration = solution.nodes, solution.calibration
        return solution

    def _walls(self, nodes: Floats, strict: bool) -> Walls:
        return Distances(self._windows, self._scans.held_out, nodes, self._askew).walls(strict)


def _edges_of(found: Matches) -> Edges:
    """Return matches as edges of the graph, for what they count."""
    edges = found.edges()
    return edges._replace(information=MATCH_WEIGHT * edges.information)
