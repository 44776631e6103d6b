"""Bent walls that were taken for straight ones: odometry then seems to make the same error at the same place.

Wheels do not know where they are. So along the right trajectory, the errors of the yaw of odometry in two visits of a
place are independent, once the mean error is subtracted. If a bent corridor was taken for a straight one, odometry
seems to turn by the same angle in the same place, again and again: to the left on the way out, to the right on the way
back. With errors a_i and b_i of n stretches that were driven twice, b_i turned around if the robot came from the other
side,

    r = Σ a_i b_i / √(Σ a_i² Σ b_i²)        atanh r ~ N(0, 1 / (n − 2))

if they are independent (Fisher's transformation, for variables of mean 0). Small errors repeat themselves as well, as
where walls are not quite parallel; so their root mean square Σ a_i b_i / n counts, too.
"""

from __future__ import annotations

import math

import numpy as np

from ..common.readings import Floats
from .holding_out import REVISIT_AFTER
from .poses import wrapped
from .windows import Windows

STRETCH = 4.0
"""Metres over which an error of the yaw is measured."""

MOST_TURN = math.radians(25.0)
"""Stretches in which the robot turns by more are left out: the scale of turns is no error of a place."""

SAME_PLACE, SAME_AXIS = 1.0, math.radians(30.0)
"""Largest distance of the middles of two stretches, metres, and largest angle between them."""

LEAST_SIGMAS = 3.0
"""Least atanh r in its standard deviations."""

LEAST_BEND = math.radians(0.6)
"""Least bend that counts, radians a metre: a radius of 95 m."""

FEWEST_STRETCHES = 4
"""Fewest stretches that were driven twice."""


def are_walls_bent(windows: Windows, nodes: Floats) -> bool:
    """Return whether odometry seems to make the same error again and again at places along nodes of shape (K, 3)."""
    first, second = repeated_errors(windows, nodes)
    if len(first) < FEWEST_STRETCHES:
        return False
    together = float((first * second).mean())
    if together < (LEAST_BEND * STRETCH) ** 2:
        return False
    r = together / math.sqrt(float((first**2).mean() * (second**2).mean()))
    return math.atanh(min(r, 0.999)) * math.sqrt(len(first) - 2) >= LEAST_SIGMAS


def repeated_errors(windows: Windows, nodes: Floats) -> tuple[Floats, Floats]:
    """Return the errors of the yaw of odometry in stretches that were driven twice, on the later and the earlier visit.

    Shape (n,) each, radians, without the mean error; those of an earlier visit from the other side are turned around.
    Stretches of the later visits do not overlap.
    """
    travel = np.concatenate([[0.0], np.cumsum(np.hypot(*np.diff(nodes[:, :2], axis=0).T))])
    yaw = np.unwrap(nodes[:, 2])
    error = np.unwrap(windows.node[:, 2] - nodes[:, 2])
    begin = np.searchsorted(travel, travel - STRETCH / 2)
    end = np.searchsorted(travel, travel + STRETCH / 2)
    whole = (travel >= STRETCH / 2) & (travel <= travel[-1] - STRETCH / 2)
    straight = np.array(
        [bool(k) and np.ptp(yaw[i : j + 1]) <= MOST_TURN for k, i, j in zip(whole, begin, end, strict=True)], np.bool_
    )
    if not straight.any():
        return np.empty(0), np.empty(0)
    own = np.zeros(len(nodes))
    own[straight] = error[end[straight]] - error[begin[straight]]
    own -= own[straight].mean()
    later, earlier = [], []
    after = 0.0
    for k in np.flatnonzero(straight):
        if travel[k] < after:
            continue
        off = np.hypot(*(nodes[:, :2] - nodes[k, :2]).T)
        angle = np.abs(wrapped(yaw - yaw[k]))
        same = straight & (travel < travel[k] - REVISIT_AFTER) & (off < SAME_PLACE)
        same &= np.minimum(angle, math.pi - angle) < SAME_AXIS
        if not same.any():
            continue
        other = int(np.argmin(np.where(same, off, np.inf)))
        later.append(own[k])
        earlier.append(own[other] if angle[other] < math.pi / 2 else -own[other])
        after = travel[k] + STRETCH
    return np.array(later), np.array(earlier)
