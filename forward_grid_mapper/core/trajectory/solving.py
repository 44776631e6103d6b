"""Solving a drive: the pose graph with yaws and distances of straight walls, then with matches and loop closures.

Walls come first because local maps are bent as the trajectory is, and matches then confirm the bend. With walls, nodes
are accurate to some centimetres over some metres, and local maps are sharp.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence

import numpy as np
from numpy.typing import NDArray

from ..common.readings import Floats
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
from .poses import rms_after_alignment
from .relocating import MORE_RECOGNISED, displaced, loops_at, recognised, revisits, unsupported, windows_of
from .scans import Scans
from .wall_distances import Distances
from .walls import EVERY, SPAN
from .windows import Odometry, Windows

WALL_ROUNDS = 3
"""Times that distances of walls are measured, each time from the nodes of the solution before."""

SAMPLES = 40
"""Samples of the posterior that give the size of loop closure searches."""

MATCH_WEIGHT = 0.2
"""Factor of the information of matches: the windows of a block share the errors of one map, and a map of what lies
around has the errors of the block itself."""

LARGEST_RESIDUAL, FIRST_OUT = 5.0 * MATCH_WEIGHT, 0.5
"""Loop closures whose mean squared residual, σ², is larger than this are removed. In one step only those go that have
more than this fraction of the largest: the others may be far off because of these."""

SETTLED = 0.1
"""Metres (rms), one cell. Matching is repeated if it moved the nodes by more. A block is searched at a place again if
the nodes around either moved by more relative to each other."""

NOISE_FACTOR, LEAST_YAW = 2.0, math.radians(1.0)
"""Factor of the noise of the yaw that walls give, and its smallest value, radians a √metre. Votes average over three
metres, so faster drift is not seen. With wheels that slip now and then, the yaw is accurate in between."""

YAW_WEIGHT = EVERY / SPAN
"""Factor of the loss of measured yaws: each echo votes at this many places, and should count once."""

SCALE_AND_HEADING = np.array([1.0, 1.0, 0.0, 0.0])
"""Selects the parts of a calibration that do not change the yaw, if this is measured."""


class MatchSolver:
    """Solves a drive by odometry and matches.

    Parameters
    ----------
    windows : Windows
    scans : Scans
    start_stage : callable
        Receives the name of a stage, and returns the callable that receives its progress.
    motion : float64, shape (K − 1, 3)
        Odometry from each node to the next one, in the frame of the first of the two.
    noise : float
        σ of its yaw, radians a √metre.
    change : float64, shape (K − 1, 3, C)
        Derivative of `motion` with respect to the calibration.
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

    def with_matches(self, solution: Solution, found_before: Sequence[Loop] = ()) -> tuple[Solution, list[Loop]]:
        """Return the solution with matches and loop closures, starting from `solution`, and the loop closures.

        `found_before` are loop closures of an earlier solution. The first search is near the poses that these give, and
        narrower than without them. They are no part of the result.
        """
        known, loops = SearchResults(), list[Loop]()
        for match, stage in ((match_preceding, 'matching'), (match_surrounding, 'matching again')):
            before = solution.nodes
            found = match(self._scans, solution.nodes, self._start_stage(stage))
            edges = _edges_of(found)
            walls = self._walls(solution.nodes, True)
            both = joined(edges, *(_edges_of(loop.matches) for loop in (*found_before, *loops_of(known))))
            solution = solve(self._graph(both, walls), solution.nodes, solution.calibration, SAMPLES)
            watch, searched = self._start_stage('places seen before'), solution.nodes
            results = find_loops(self._scans, searched, solution.samples, found.mean_score, watch, known)
            walls = self._walls(searched, True)
            first, loops = self._with_loops(walls, edges, loops_of(results), solution)
            solution, loops = self._with_stretches_relocated(edges, loops, first, found.mean_score)
            # if nodes hardly moved, local maps and matches would be the same
            if rms_after_alignment(before, solution.nodes) < SETTLED:
                break
            # blocks of a stretch that was moved must be searched again
            known = self._unchanged(results, searched, solution.nodes) if solution is first else SearchResults()
            if found_before:
                # the next search is wider
                known, found_before = {key: loop for key, loop in known.items() if loop is not None}, ()
        return solution, loops

    def _with_stretches_relocated(
        self, matches: Edges, loops: list[Loop], solution: Solution, usual: float
    ) -> tuple[Solution, list[Loop]]:
        """Return the solution after moving stretches that lie in a wrong place to where they fit better."""
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
        """Return the solution with a stretch moved to another place, if its readings are predicted better there."""
        scans, nodes = self._scans, solution.nodes
        stretch = windows_of(blocks, len(nodes))
        moved = displaced(scans, nodes, stretch)
        if moved is None:
            return solution, loops
        found, first = loops_at(scans, moved, stretch, usual), int(stretch[0])
        if len(found) < len(recognised(loops).intersection(blocks.tolist())) + MORE_RECOGNISED:
            return solution, loops
        # without the loop closures that tie what comes after the start of the stretch to what lies before it
        across = [min(loop.block, loop.place) < first <= max(loop.block, loop.place) for loop in loops]
        rest = [loop for loop, out in zip(loops, across, strict=True) if not out]
        tried, kept = self._with_loops(self._walls(nodes, True), matches, [*rest, *found], solution)
        parts = [stretch[k : k + BLOCK] for k in range(0, len(stretch), BLOCK)]
        if gain(predicted(scans, nodes, parts), predicted(scans, tried.nodes, parts)).sigmas < LEAST_SIGMAS:
            return solution, loops
        return tried, kept

    def _unchanged(self, results: SearchResults, before: Floats, after: Floats) -> SearchResults:
        """Return the results that a new search would repeat, because neither block nor place changed its shape."""
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
        """Return the solution with the loop closures that agree with each other and with the rest, and these."""
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
    """Solves a drive by odometry, matches, and walls at right angles.

    Parameters
    ----------
    odometry : Odometry
    windows : Windows
    scans : Scans
    heading : Heading
    start_stage : callable
        Receives the name of a stage, and returns the callable that receives its progress.
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
        self._wall_angle = heading.wall_direction[np.searchsorted(middles, count)]

    def calibration_of(self, solution: Solution) -> Floats:
        """Return the whole calibration of the odometry, shape (4,)."""
        return self.first_calibration + solution.calibration

    def simple(self, calibration: Floats) -> Floats:
        """Return the nodes of odometry with the yaw of walls, and scale and heading of a calibration, shape (K, 3)."""
        w = self._windows
        turned = with_yaw(self._odometry, w.node_progress[self._heading.at], self._heading.correction)
        return calibrated(turned, calibration * SCALE_AND_HEADING).at(w.node_stamp)

    def along_walls(self) -> Solution:
        """Return the solution by odometry and straight walls, without matches."""
        self._start_stage('straight walls')
        nodes, calibration = self.simple(np.zeros(len(CALIBRATION))), np.zeros(len(CALIBRATION))
        for k in range(WALL_ROUNDS):
            walls = self._walls(nodes, k == WALL_ROUNDS - 1)
            solution = solve(self._graph(no_edges(), walls), nodes, calibration)
            nodes, calibration = solution.nodes, solution.calibration
        return solution

    def _walls(self, nodes: Floats, strict: bool) -> Walls:
        return Distances(self._windows, self._scans.held_out, nodes, self._wall_angle).walls(strict)


def _edges_of(found: Matches) -> Edges:
    """Return matches as edges of the graph, weighted by `MATCH_WEIGHT`."""
    edges = found.edges()
    return edges._replace(information=MATCH_WEIGHT * edges.information)
