"""Following: online SLAM that continues a refined trajectory, window by window, while the robot drives on.

The last windows make a small pose graph, the *tail*. Its first nodes are fixed (*settled*). The others are determined
by calibrated odometry, yaws and distances of walls, and loop closures with what was mapped before. So a window takes
the same time however long the drive is. Only the path, which is copied with each window, and the readings for loop
closures grow with the drive, up to the bounds of odometry (`MOST_POSES`) and of readings (`max_readings`).

The result is checked. Every few windows, the readings of a block are predicted before they are used, with the followed
correction and with the last proven one. If the followed correction predicts clearly better, it becomes the proven one.
While it predicts worse, the proven one is in force.
"""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import fields
from typing import Any

import numpy as np
from numpy.typing import NDArray

from ..common.parameters import Parameters
from ..common.readings import Floats, Readings, in_canonical_order
from ..messages.message_types import NANOSECONDS
from ..messages.odometry_record import MOST_POSES
from ..messages.thinning import kept
from ..runtime.cancelling import check
from .correction import Correction
from .heading import yaws_of_votes
from .holding_out import LEAST_SIGMAS, gain
from .judging import MOST_WORSE
from .jumps import jumps, since_jump
from .likelihood import scores
from .local_map import at_poses, for_matching, local_map
from .loops import GOOD
from .matching import climbed, grid_around, measure
from .odometry_model import CALIBRATION, Noise, calibrated, covariances, motions
from .passes import BEHIND, BLOCK
from .pose_graph import Edges, Graph, Yaws, joined, no_edges, no_walls, solve
from .poses import compose, relative
from .refinable import SHORTEST
from .scans import FEWEST_ON_MAP, Scans
from .solving import LEAST_YAW, NOISE_FACTOR
from .tail import Tail, continued, edges_from, from_step, window_coordinate
from .wall_distances import Distances
from .walls import DIRECTIONS, votes_for, wall_votes
from .windows import Odometry, Windows, cut

SETTLED, LONGEST, SHIFT = 12, 44, 8
"""Windows at the start of the tail whose nodes are fixed (5 m, from which walls continue); most windows of the tail
(18 m); windows that leave it in one step (3 m)."""

LATE = NANOSECONDS // 5
"""Nanoseconds that a window waits for readings that arrive out of order."""

OF_VOTES = 4
"""Windows before the first one that is not settled whose echoes vote with its echoes."""

SIGMA_SETTLED = np.array([0.02, 0.02, math.radians(0.3)])
"""σ of a settled node: metres, metres, radians."""

RECOGNISING = 2
"""Windows after the judgement of a block at which a loop closure is searched, to spread the load."""

AROUND, MOST_AROUND = 4.0, 1000
"""Metres around the robot, and most readings, of the map for loop closures."""

REACH, STEPS = np.array([0.6, 0.6, math.radians(7.5)]), (0.2, 0.2, math.radians(3.75))
"""Half the size and the steps of the search for loop closures: metres, metres, radians."""

SIGMAS = 2.5
"""`REACH` in σ of the prior."""

EVALUATED, MEASURED = 60, 100
"""Readings that are evaluated in the search, and to measure the best pose."""

JUDGED = 12
"""Most blocks of the judgement: 20 m."""


class Follower:
    """Extends the trajectory of a whole drive while the robot drives on.

    The result depends on odometry and readings only, not on when `follow` is called, as long as a reading arrives
    within `LATE` of those of later stamps.

    Parameters
    ----------
    correction : Correction
        Of the whole drive.
    calibration : mapping of str to float
        Of its odometry, by the names of `odometry_model`; missing values are 0.
    parameters : Parameters
        If `odometry_noise` is set, it replaces `noise`.
    noise : float
        σ of the yaw error of odometry, radians a √metre, as estimated from the whole drive; 0 if unknown.
    right_angles : bool
        Whether walls stand at right angles to each other; if not, only odometry and loop closures are used.

    Attributes
    ----------
    correction : Correction
        The one in force.
    kept : bool
        Whether this is the proven one, because the followed one predicts readings worse.
    windows : int
        Number of windows followed so far.
    places : int
        Number of loop closures so far.
    obstacle : str
        Why following ended, in words; empty until then.
    """

    def __init__(
        self,
        correction: Correction,
        calibration: Mapping[str, float],
        parameters: Parameters,
        noise: float = 0.0,
        right_angles: bool = True,
    ) -> None:
        self._right_angles = right_angles
        self.correction = self._settled = self._proven = self._followed = correction
        self.kept, self.windows, self.places, self.obstacle = False, 0, 0, ''
        self._parameters, self._stop = for_matching(parameters), np.zeros(1, np.uint8)
        self._calibration = np.array([calibration.get(name, 0.0) for name in CALIBRATION])
        known = parameters.association.odometry_noise or noise
        self._noise = Noise(yaw=max(LEAST_YAW, NOISE_FACTOR * known)) if known else Noise()
        self._tail: Tail | None = None
        self._axes = np.zeros(3)
        self._past = Readings.from_columns(z=[], x=[], y=[], yaw=[], z_max=[], half_angle=[])
        self._gains: list[float] = []
        self._score, self._scored = 0.0, 0

    def cancel(self) -> None:
        """Make `follow` raise `Cancelled`, soon and in all later calls; may be called from any thread."""
        self._stop[0] = 1

    def follow(self, readings: Readings, odometry: Odometry) -> bool:
        """Continue up to the last window that is complete, with its readings; return whether `correction` has changed.

        Parameters
        ----------
        readings : Readings
            Of the drive so far, placed by odometry. After the first call, those since the last complete window are
            enough.
        odometry : Odometry
            Of the same time.

        Raises
        ------
        Cancelled
            If `cancel` was called.
        """
        was, newest = self.correction, readings.stamp.max(initial=0)
        if self._tail is None and not self.obstacle:
            self._tail = self._first_tail(readings)
        tail = self._tail
        while tail is not None and not self.obstacle:
            check(self._stop)
            if not tail.moves_on(odometry):
                break
            whole = continued(tail.odometry, odometry)
            u = window_coordinate(whole)
            end = int(np.searchsorted(u, len(tail.nodes) + 1))
            if end == len(u) or whole.stamp[end] + LATE > newest:
                break
            part = Odometry(whole.stamp[: end + 1], whole.pose[: end + 1])
            if len(at := jumps(part)):
                far = math.dist(*part.pose[at[0] - 1 : at[0] + 1, :2].tolist())
                self.obstacle = f'odometry jumped by {far:.1f} m'
                break
            tail = self._tail = self._step(tail, readings, part)
        return self.correction is not was

    def _first_tail(self, readings: Readings) -> Tail | None:
        """Return the tail at the end of the whole drive, and store the readings before it."""
        path, whole = self.correction.trajectory, self.correction.odometry
        odometry = since_jump(whole)
        if odometry is not whole and odometry.travel[-1] < SHORTEST:
            self.obstacle = f'odometry jumped, and the robot drove only {odometry.travel[-1]:.1f} m after it'
            return None
        early = readings.stamp < odometry.stamp[0]
        driven = (readings.stamp <= self.correction.end) & ~early
        windows = cut(in_canonical_order(readings.select(driven)), odometry)
        nodes = path.at(windows.node_stamp)
        self._axes = np.array([0.0, 0.0, direction_of_walls(windows, nodes)])
        begin = max(len(windows) - SETTLED, 0)
        sensors = compose(path.at(windows.readings.stamp), windows.mount)
        past = at_poses(windows.readings, relative(self._axes, sensors))
        self._past = past.select(slice(0, windows.first[begin]))
        if early.any():
            before = self.correction.apply(in_canonical_order(readings.select(early)))
            sensors = np.stack([before.x, before.y, before.yaw], axis=1)
            self._past = _concatenated(at_poses(before, relative(self._axes, sensors)), self._past)
        nodes = relative(self._axes, nodes[begin:])
        nodes[:, 2] = np.unwrap(nodes[:, 2])
        rest = windows.readings.select(slice(windows.first[begin], None))
        return Tail.of(from_step(odometry, begin), rest, nodes, len(nodes), no_edges())

    def _step(self, tail: Tail, readings: Readings, odometry: Odometry) -> Tail:
        """Return the tail extended by the rest of `odometry`, whose last window has just become complete."""
        new = (readings.stamp > tail.odometry.stamp[-1]) & (readings.stamp <= odometry.stamp[-1])
        windows = cut(_concatenated(tail.readings, in_canonical_order(readings.select(new))), odometry)
        before, count = len(tail.nodes), len(windows)
        motion = motions(calibrated(odometry, self._calibration), windows)
        nodes, places = _extrapolated(tail.nodes, motion), tail.places
        # a step of sparse odometry may complete several windows
        judged = count // BLOCK > before // BLOCK
        recognised = (count - RECOGNISING) // BLOCK > (before - RECOGNISING) // BLOCK
        if count >= 2 * BLOCK and (judged or recognised):
            scans = Scans(windows, self._parameters, self._stop, np.zeros(count, np.bool_))
            block = np.arange(count - BLOCK, count)
            if judged:
                self._judge(scans, _extrapolated(tail.nodes[: block[0]], motion), block)
            if recognised:
                places = joined(places, self._recognised(scans, nodes, block))
        solution = solve(self._graph(windows, motion, nodes, tail._replace(places=places)), nodes, np.zeros(0))
        self.windows += count - before
        tail = Tail.of(odometry, windows.readings, solution.nodes, tail.settled, places)
        self._put_in_force(tail, windows)
        return self._shifted(tail, windows) if count >= LONGEST else tail

    def _graph(self, windows: Windows, motion: Floats, nodes: Floats, tail: Tail) -> Graph:
        """Return the pose graph of the tail; `motion` is that of calibrated odometry, shape (K − 1, 3)."""
        count, none = np.arange(len(windows)), np.zeros(len(windows), np.bool_)
        information = np.asarray(np.linalg.inv(covariances(windows, self._noise)), np.float64)
        steps = Edges(count[:-1], count[1:], motion, information)
        settled = count[: tail.settled]
        sure = np.broadcast_to(np.diag(SIGMA_SETTLED**-2.0), (len(settled), 3, 3))
        stay = Edges(np.zeros_like(settled), settled, relative(nodes[0], nodes[settled]), sure)
        at, votes = wall_votes(windows, (count < tail.settled - OF_VOTES) | (not self._right_angles))
        at, votes = at[at >= tail.settled], votes[at >= tail.settled]
        off, of_votes = yaws_of_votes(votes, windows.node[at, 2], nodes[at, 2] - windows.node[at, 2])
        yaws = Yaws(
            np.concatenate([settled, at]),
            np.concatenate([nodes[settled, 2], windows.node[at, 2] + off]),
            np.concatenate([np.full(len(settled), SIGMA_SETTLED[2] ** -2.0), of_votes]),
        )
        walls = Distances(windows, none, nodes).walls(True) if self._right_angles else no_walls()
        # the calibration is no unknown here
        known = np.zeros((len(motion), 3, 0)), np.zeros(0)
        return Graph(steps, *known, joined(stay, tail.places), yaws, walls)

    def _recognised(self, scans: Scans, nodes: Floats, block: NDArray[np.int64]) -> Edges:
        """Return the loop closure of a block with the map of earlier visits before the tail, if it fits as usual."""
        past, guess = self._past, nodes[block[-1]]
        joint = scans.joint(block, relative(guess, nodes[block]))
        near = np.flatnonzero(np.hypot(past.x - guess[0], past.y - guess[1]) < AROUND)
        if not self._scored or min(len(near), len(joint.readings)) < FEWEST_ON_MAP:
            return no_edges()
        near = near[:: -(-len(near) // MOST_AROUND)]
        sensors = np.stack([past.x[near], past.y[near], past.yaw[near]], axis=1)
        placed = at_poses(past.select(near), relative(nodes[0], sensors))
        around = local_map(placed, self._parameters, self._stop)
        at = relative(nodes[0], guess)
        poses = grid_around(at, REACH, STEPS)
        values = scores(joint, around, poses, max(len(joint.readings) // EVALUATED, 1))
        off = relative(at, poses) * SIGMAS / REACH
        best = poses[int((values - 0.5 * (off**2).sum(1)).argmax())]
        best = climbed(joint, around, best, MEASURED)
        match = measure(joint, around, best, MEASURED)
        if match.score < GOOD * self._score / self._scored * len(joint.readings):
            return no_edges()
        self.places += 1
        return Edges(np.zeros(1, np.int64), block[-1:], match.pose[None], match.information[None])

    def _judge(self, scans: Scans, followed: Floats, block: NDArray[np.int64]) -> None:
        """Compare the predictions of a block by the followed nodes, shape (K, 3), and by the proven correction."""
        w, proven = scans.windows, self._proven
        kept = relative(self._axes, compose(proven.last, w.node))
        early = w.node_stamp <= proven.end
        kept[early] = followed[early]
        members = np.flatnonzero(w.node_progress[block[0]] - w.node_progress[: block[0]] < BEHIND)
        count, place, block_scores = int(scans.count[block].sum()), int(members[-1]), []
        for nodes in (followed, kept):
            around = scans.map(members, nodes[place], nodes)
            if around is None or not count:
                return
            at = relative(nodes[place], nodes)
            block_scores.append(sum(float(scores(scans.scan[k], around, at[k : k + 1])[0]) for k in block))
        self._score, self._scored = self._score + block_scores[0], self._scored + count
        self._gains = [*self._gains[1 - JUDGED :], (block_scores[0] - block_scores[1]) / count]

    def _put_in_force(self, tail: Tail, windows: Windows) -> None:
        """Put the correction of the tail in force, or the proven one if that predicts readings better."""
        odometry = tail.odometry
        pose = windows.corrected(odometry.progress, odometry.pose, tail.nodes)
        # the first pose is interpolated at the start of a window
        stamp, path = odometry.stamp[1:], compose(self._axes, pose[1:])
        now = self._settled.continued(Odometry(stamp, odometry.pose[1:]), Odometry(stamp, path))
        better = gain(np.zeros(len(self._gains)), np.array(self._gains)).sigmas
        if better > LEAST_SIGMAS:
            self._proven, self._gains = now, []
        self.kept = better < (0.0 if self.kept else -MOST_WORSE)
        self.correction, self._followed = (self._proven if self.kept else now), now

    def _shifted(self, tail: Tail, windows: Windows) -> Tail:
        """Return the tail without its first windows; their readings become part of the map for loop closures."""
        w, end = windows, windows.first[SHIFT]
        robot = w.corrected(w.progress[:end], w.robot[:end], tail.nodes)
        leaving = at_poses(w.readings.select(slice(0, end)), compose(robot, w.mount[:end]))
        self._past = self._bounded(_concatenated(self._past, leaving))
        odometry = from_step(tail.odometry, SHIFT)
        self._settled = self._followed.until(max(int(odometry.stamp[0]), self._settled.end))
        self._settled = self._settled.bounded(MOST_POSES)
        places = edges_from(tail.places, relative(tail.nodes[SHIFT], tail.nodes[0]), SHIFT, SHIFT + SETTLED)
        stay = w.readings.select(slice(end, None))
        return Tail.of(odometry, stay, tail.nodes[SHIFT:], SETTLED, places)

    def _bounded(self, past: Readings) -> Readings:
        """Return readings thinned to `max_readings`; not at each step, since thinning once for many costs the same."""
        bound = self._parameters.association.max_readings
        return past if not bound or len(past) <= bound + bound // 8 else past.select(kept(past, bound))


def direction_of_walls(windows: Windows, nodes: Floats) -> float:
    """Return the direction of walls in the frame of the nodes, shape (K, 3), radians modulo a right angle."""
    at, votes = wall_votes(windows, np.zeros(len(windows), np.bool_))
    rows = votes_for(votes, np.arange(DIRECTIONS) - np.degrees(nodes[at, 2])[:, None])
    direction = math.radians(float(rows.sum(0).argmax()))
    off, sure = yaws_of_votes(votes, nodes[at, 2] - direction, np.zeros(len(at)))
    return direction - float((off * sure).sum() / max(sure.sum(), 1e-9))


def _extrapolated(nodes: Floats, motion: Floats) -> Floats:
    """Return the nodes, extrapolated by the motions after them, shape (K, 3)."""
    out = list(nodes)
    for step in motion[len(nodes) - 1 :]:
        out.append(compose(out[-1], step))
    return np.array(out)


def _concatenated(one: Readings, other: Readings) -> Readings:
    """Return readings, followed by later ones of the same drive."""
    columns: dict[str, Any] = {
        column.name: np.concatenate([getattr(one, column.name), getattr(other, column.name)])
        for column in fields(Readings)
        if column.name != 'sensor_names'
    }
    return Readings(**columns, sensor_names=other.sensor_names)
