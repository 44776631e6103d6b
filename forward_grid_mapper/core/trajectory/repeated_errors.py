"""Bent walls that were taken for straight ones: odometry then seems to make the same error at the same place.

Wheels do not know where they are. So along the right trajectory, the errors of the yaw of odometry in two visits of a
place are independent, once the constant errors of a metre and of a turn are subtracted. If a bent corridor was taken
for a straight one, odometry seems to turn by the same angle in the same place again: to the left on the way out, to the
right on the way back. Let n stretches be driven twice, with the errors a_i and b_i, radians a metre; those of a visit
from the other side are turned around. There are two tests.

A corridor may bend all along to one side. For the n stretches that were driven in both directions, with
c_i = (a_i + b_i) / 2 and d_i = (a_i − b_i) / 2, which have the same variance if the errors are independent,

    t = c̄ / √(s² / n)        s² = (Σ (c_i − c̄)² + Σ d_i²) / (2n − 1)

A constant error of the wheels has no part in c̄. For all n stretches,

    r = Σ a_i b_i / √(Σ a_i² Σ b_i²)        atanh r ~ N(0, 1 / (n − 2))

if they are independent (Fisher's transformation, for variables of mean 0). Small errors repeat themselves as well, as
where walls are not quite parallel, so there is a smallest bend in both tests.

Other errors repeat themselves, too: those of a compass, or of wheels on a floor that slopes to one side.
"""

from __future__ import annotations

import math
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray
from scipy.spatial import cKDTree

from ..common.readings import Floats
from .holding_out import REVISIT_AFTER
from .poses import wrapped
from .windows import Windows

STRETCH = 3.0
"""Metres over which an error of the yaw is measured."""

MOST_TURN = math.radians(25.0)
"""Stretches in which the robot turns by more are left out: the scale of turns is no error of a place."""

SAME_PLACE, SAME_AXIS = 1.0, math.radians(30.0)
"""Largest distance of the middles of two stretches, metres, and largest angle between them."""

FEWEST_STRETCHES = 4
"""Fewest stretches that were driven twice."""

LEAST_T, LEAST_MEAN_BEND = 3.5, math.radians(0.5)
"""Least t, and least mean bend to one side, radians a metre: a radius of 115 m."""

LEAST_R_SIGMAS, LEAST_BEND = 3.0, math.radians(0.6)
"""Least atanh r in its standard deviations, and least bend √(Σ a_i b_i / n), radians a metre."""

BENT = (
    'walls at right angles do not fit: along them, odometry would make the same error whenever the robot comes to the '
    'same place, so the walls there are probably bent, or at other angles'
)


class RepeatedErrors(NamedTuple):
    """Errors of the yaw of odometry in n stretches that were driven twice, radians a metre.

    Without the errors that are constant for a metre and for a turn.

    Attributes
    ----------
    earlier, later : float64, shape (n,)
        In the direction of the earlier visit.
    opposite : bool, shape (n,)
        Whether the robot came from the other side on the later visit.
    """

    earlier: Floats
    later: Floats
    opposite: NDArray[np.bool_]

    @property
    def mean_bend(self) -> tuple[float, float]:
        """The mean bend to one side, radians a metre, and its t; zeros if too few stretches tell."""
        a, b = self.later[self.opposite], self.earlier[self.opposite]
        n = len(a)
        if n < FEWEST_STRETCHES:
            return 0.0, 0.0
        both, half = (a + b) / 2, (a - b) / 2
        mean = float(both.mean())
        error = math.sqrt((((both - mean) ** 2).sum() + (half**2).sum()) / (2 * n - 1) / n)
        return abs(mean), abs(mean) / max(error, 1e-9)

    @property
    def common_bend(self) -> tuple[float, float]:
        """What both visits have in common, radians a metre, and how significant it is, σ; zeros if too few tell."""
        n = len(self.later)
        together = float((self.later * self.earlier).sum())
        if n < FEWEST_STRETCHES or together <= 0.0:
            return 0.0, 0.0
        r = together / math.sqrt(float((self.later**2).sum() * (self.earlier**2).sum()))
        return math.sqrt(together / n), math.atanh(min(r, 0.999)) * math.sqrt(n - 2)


def are_walls_bent(windows: Windows, nodes: Floats) -> bool:
    """Return whether odometry seems to make the same errors at the same places along nodes of shape (K, 3)."""
    found = repeated_errors(windows, nodes)
    bend, t = found.mean_bend
    if bend >= LEAST_MEAN_BEND and t >= LEAST_T:
        return True
    bend, sigmas = found.common_bend
    return bend >= LEAST_BEND and sigmas >= LEAST_R_SIGMAS


def repeated_errors(windows: Windows, nodes: Floats) -> RepeatedErrors:
    """Return the errors in stretches that were driven twice; no two of them overlap."""
    travel = np.concatenate([[0.0], np.cumsum(np.hypot(*np.diff(nodes[:, :2], axis=0).T))])
    yaw = np.unwrap(nodes[:, 2])
    error, usable = _errors(windows, travel, yaw)
    tree = cKDTree(nodes[:, :2])
    found, left = list[tuple[float, float, bool]](), usable.copy()
    for k in np.flatnonzero(usable).tolist():
        if not left[k]:
            continue
        near = np.sort(np.array(tree.query_ball_point(nodes[k, :2], SAME_PLACE), np.int64))
        near = near[left[near] & (travel[near] < travel[k] - REVISIT_AFTER)]
        angle = np.abs(wrapped(yaw[near] - yaw[k]))
        same = np.minimum(angle, math.pi - angle) < SAME_AXIS
        if not same.any():
            continue
        near, angle = near[same], angle[same]
        closest = int(np.hypot(*(nodes[near, :2] - nodes[k, :2]).T).argmin())
        other, opposite = int(near[closest]), bool(angle[closest] > math.pi / 2)
        found.append((error[other], -error[k] if opposite else error[k], opposite))
        for used in (k, other):
            # travel increases, so nodes less than a stretch away follow each other
            first = np.searchsorted(travel, travel[used] - STRETCH, side='right')
            left[first : np.searchsorted(travel, travel[used] + STRETCH)] = False
    table = np.array(found, np.float64).reshape(-1, 3)
    return RepeatedErrors(table[:, 0], table[:, 1], table[:, 2] > 0.0)


def _errors(windows: Windows, travel: Floats, yaw: Floats) -> tuple[Floats, NDArray[np.bool_]]:
    """Return the error in the stretch around each node, radians a metre, and whether that stretch is used."""
    begin, end = (np.searchsorted(travel, travel + side * STRETCH / 2) for side in (-1.0, 1.0))
    usable = (travel >= STRETCH / 2) & (end < len(travel))
    for k in np.flatnonzero(usable).tolist():
        usable[k] = np.ptp(yaw[begin[k] : end[k] + 1]) <= MOST_TURN
    error, first, last = np.zeros(len(travel)), begin[usable], end[usable]
    length = travel[last] - travel[first]
    off = np.unwrap(windows.node[:, 2] - yaw)
    mean, turned = (off[last] - off[first]) / length, (yaw[last] - yaw[first]) / length
    constant = np.stack([np.ones(len(mean)), turned], axis=1)
    error[usable] = mean - constant @ np.linalg.lstsq(constant, mean, rcond=None)[0]
    return error, usable
