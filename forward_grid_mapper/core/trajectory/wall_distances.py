"""Straight walls as landmarks: distances of nodes from them, and data association of distances and walls.

An echo of range z from p touches a wall of normal n whose offset is n · p + z, if n is inside the cone. Once the yaw is
known, the echoes of a metre of driving give the distance of a wall along an axis to a centimetre or two. Successive
distances that put a wall in the same place belong to one wall. Such walls keep the trajectory straight. Local maps do
not, since a map that is bent as the trajectory is explains the readings just as well.
"""

from __future__ import annotations

import math

import numpy as np
from numpy.typing import NDArray

from ..common.readings import Floats
from .pose_graph import Walls
from .poses import compose, wrapped
from .walls import beside
from .windows import Windows

BLOCK = 3
"""Windows whose echoes measure a distance together."""

WIDTH = 0.06
"""Metres by which offsets by the echoes of one wall may differ."""

FEWEST = 3
"""Fewest echoes of a distance."""

LEAST_TRAVEL = 0.25
"""Metres of progress that these must span: from a single place, a corner cannot be told from a wall."""

LONGEST_RANGE = 5.0
"""Longest range that is used, metres; longer ones are seldom of a wall."""

PEAKS = 2
"""Most distances of a block along one direction."""

MARGIN = math.radians(0.5)
"""Tolerance of the yaw when it is tested whether a normal is inside a cone, radians."""

AHEAD, BESIDE = 0.3, math.radians(3.0)
"""If no sensor looks straight ahead, the normal of a wall within `AHEAD` radians of the yaw of the robot may lie up to
`BESIDE` radians beside a cone: rough walls ahead are still detected, and they give the scale of odometry. For walls to
the sides, this makes real drives worse if a sensor looks straight to a side; otherwise `walls.beside` has the angle."""

GATE, GATE_OF_SCALE = (0.08, 0.06), (0.04, 0.02)
"""Gates of the data association, each for rough and for good estimates of the nodes: metres by which the offset of a
wall may differ from the last one, and the same for each metre that the robot moved along the normal, because of the
scale of odometry."""

GATE_PER_METRE = 0.03
"""The same for each metre of progress without a measurement of the wall."""

STEP, LONGEST_GAP = 1.2, 3.7
"""Metres of progress between blocks; after this many without a measurement, a wall is a new one."""

LEAST_SIGMA, FIRST_SIGMA = 0.015, 0.04
"""Smallest σ of a distance, metres, because of cells and small objects at the wall; and for rough nodes."""


class Distances:
    """Measured distances of nodes from walls along the axes of the map, before data association.

    Parameters
    ----------
    windows : Windows
    held_out : bool, shape (K,)
        Windows whose echoes are not used.
    nodes : float64, shape (K, 3)
        In a map whose axes are parallel to the walls.
    wall_angle : float64, shape (K,), optional
        Angle of the walls around each node to the axes, radians.

    Attributes
    ----------
    node, direction : int64, shape (D,)
        Node, and direction of the normal: number of right angles from the x axis turned by `wall_angle`.
    normal : float64, shape (D, 2)
        The direction as a unit vector.
    distance, lever, yaw : float64, shape (D,)
        As in `pose_graph.Walls`.
    """

    def __init__(
        self, windows: Windows, held_out: NDArray[np.bool_], nodes: Floats, wall_angle: Floats | None = None
    ) -> None:
        self._windows, self._nodes = windows, nodes
        self._wall_angle = np.zeros(len(windows)) if wall_angle is None else wall_angle
        readings, first = windows.readings, windows.first
        self._usable = readings.echo & (readings.z < LONGEST_RANGE) & ~np.repeat(held_out, np.diff(first))
        self._looks_past = not (np.abs(wrapped(windows.mount[:, 2])) <= readings.half_angle).any()
        self._beside = beside(windows.mount[:, 2], readings.half_angle)
        rows = [row for k in range(0, len(windows), BLOCK) for row in self._measured(k)]
        table = np.array(rows, np.float64).reshape(-1, 5)
        self.node, self.direction = table[:, 0].astype(np.int64), table[:, 1].astype(np.int64)
        self.distance, self.lever, self.yaw = table[:, 2], table[:, 3], table[:, 4]
        self.normal = normals_of(self.direction, self._wall_angle[self.node])

    def _measured(self, k: int) -> list[tuple[float, ...]]:
        """Return the distances of the block that begins at window k: node, direction, distance, lever, yaw."""
        w = self._windows
        end = min(k + BLOCK, len(w))
        middle = k + (end - k) // 2
        of_block = np.arange(w.first[k], w.first[end])
        usable = self._usable[of_block]
        if usable.sum() < FEWEST:
            return []
        sensor = compose(w.corrected(w.progress[of_block], w.robot[of_block], self._nodes), w.mount[of_block])
        at = self._nodes[middle]
        rows: list[tuple[float, ...]] = []
        half, z = w.readings.half_angle[of_block], w.readings.z[of_block]
        right, left = self._beside[of_block].T
        for direction in range(4):
            angle = direction * math.pi / 2 + self._wall_angle[middle]
            off = wrapped(sensor[:, 2] - angle)
            in_cone, slant, sides = np.abs(off) <= half + MARGIN, np.zeros(len(off)), 0
            if (in_cone & usable).sum() < FEWEST:
                # the edge of the cone meets a wall whose normal lies beside it
                ahead = self._looks_past and abs(wrapped(at[2] - angle)) < AHEAD
                beside_it = np.where(off > 0.0, right, left)
                far = np.maximum(beside_it, BESIDE if ahead else 0.0)
                if far.any():
                    in_cone, slant = np.abs(off) <= half + far, off - np.clip(off, -half, half)
                    sides = _sides(slant[in_cone & (beside_it > 0.0)])
            heard = in_cone & usable
            arm, slant, ranges = sensor[heard, :2] - at[:2], slant[heard], z[heard]
            c, s = math.cos(angle), math.sin(angle)
            distance, lever = arm @ (c, s) + ranges * np.cos(slant), arm @ (s, -c) - ranges * np.sin(slant)
            for same in agreeing(distance, w.progress[of_block[heard]]):
                # the frame of a door is detected by cones on one side only
                if (slant[same] == 0.0).any() or _sides(slant[same]) >= sides:
                    rows.append((middle, direction, distance[same].mean(), lever[same].mean(), at[2]))
        return rows

    def tracked(self, strict: bool) -> NDArray[np.int64]:
        """Return the number of the wall of each distance, shape (D,); `strict` is for good estimates of the nodes."""
        gate, of_scale = GATE[strict], GATE_OF_SCALE[strict]
        progress = self._windows.node_progress[self.node]
        robot = (self.normal * self._nodes[self.node, :2]).sum(1)
        place = robot + self.distance
        out, count = np.zeros(len(place), np.int64), 0
        last: dict[tuple[int, float], dict[int, int]] = {}
        for i, direction in enumerate(zip(self.direction.tolist(), self._wall_angle[self.node].tolist(), strict=True)):
            open_walls = last.setdefault(direction, {})
            for wall in [wall for wall, j in open_walls.items() if progress[i] - progress[j] > LONGEST_GAP]:
                del open_walls[wall]
            before = {wall: j for wall, j in open_walls.items() if self.node[j] < self.node[i]}
            wall = min(before, key=lambda wall: abs(place[before[wall]] - place[i]), default=count)
            if wall in before:
                j = before[wall]
                allowed = gate + GATE_PER_METRE * max(progress[i] - progress[j] - STEP, 0.0)
                if abs(place[j] - place[i]) > allowed + of_scale * abs(robot[j] - robot[i]):
                    wall = count
            count += wall == count
            out[i], open_walls[wall] = wall, i
        return out

    def walls(self, strict: bool) -> Walls:
        """Return the walls that were measured more than once."""
        wall = self.tracked(strict)
        kept = np.bincount(wall, minlength=1)[wall] > 1
        wall = np.unique(wall[kept], return_inverse=True)[1].astype(np.int64)
        node, normal = self.node[kept], self.normal[kept]
        place = self._nodes[node, :2]
        along = place[:, 1] * normal[:, 0] - place[:, 0] * normal[:, 1]
        if len(wall):
            along = along - (np.bincount(wall, along) / np.bincount(wall))[wall]
        sigma = max(noise_of(wall, (normal * place).sum(1) + self.distance[kept]), 0.0 if strict else FIRST_SIGMA)
        information = np.full(len(wall), sigma**-2)
        return Walls(node, wall, normal, self.distance[kept], self.lever[kept], self.yaw[kept], along, information)


def _sides(slant: Floats) -> int:
    """Return the number of signs among slants, 0 to 2: on how many sides of cones the wall lies."""
    return int((slant > 0.0).any()) + int((slant < 0.0).any())


def normals_of(direction: NDArray[np.int64], wall_angle: Floats) -> Floats:
    """Return the unit vectors of directions, in right angles, each turned by `wall_angle` radians, shape (D, 2)."""
    x, y = np.array([(1.0, 0.0), (0.0, 1.0), (-1.0, 0.0), (0.0, -1.0)])[direction].T
    c, s = np.cos(wall_angle), np.sin(wall_angle)
    return np.stack([c * x - s * y, s * x + c * y], axis=1)


def agreeing(distance: Floats, progress: Floats) -> list[NDArray[np.int64]]:
    """Return the indices of the echoes of each distance on which enough of them agree; the most echoes come first."""
    remaining, out = np.arange(len(distance)), []
    for _ in range(PEAKS):
        ordered = np.sort(distance[remaining])
        counts = np.searchsorted(ordered, ordered + WIDTH, side='right') - np.arange(len(ordered))
        if counts.max(initial=0) < FEWEST:
            break
        begin = ordered[counts.argmax()]
        same = remaining[(distance[remaining] >= begin) & (distance[remaining] <= begin + WIDTH)]
        remaining = remaining[np.abs(distance[remaining] - distance[same].mean()) >= WIDTH]
        if np.ptp(progress[same]) >= LEAST_TRAVEL:
            out.append(same)
    return out


def noise_of(wall: NDArray[np.int64], place: Floats) -> float:
    """Return the robust σ of the offsets of walls, metres, from the wall and the offset of each distance, (D,)."""
    off = []
    for number in np.flatnonzero(np.bincount(wall, minlength=1) > 2):
        mine = place[wall == number]
        off.append(np.abs(mine - np.median(mine)) * math.sqrt(len(mine) / (len(mine) - 1)))
    return max(LEAST_SIGMA, 1.48 * float(np.median(np.concatenate(off)))) if off else FIRST_SIGMA
