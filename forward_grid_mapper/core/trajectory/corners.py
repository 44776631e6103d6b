"""Whether corners have the angles that a trajectory gives them.

If odometry turns too far at a corner that is not square, walls at right angles look as if they explained it, and the
trajectory is bent there. Nothing contradicts it before the corner or after it. The readings at the corner do: there the
robot hears the walls before and after it, so their map is sharp for the true angle only. So the turn is made smaller
and larger, and J of the map of these metres is compared.
"""

from __future__ import annotations

import math
from collections.abc import Sequence

import numpy as np

from ..common.readings import Floats
from .poses import compose, relative, wrapped
from .scans import FEWEST_ON_MAP, Scans
from .windows import Windows

WITHIN, SPAN = 3.0, 4.0
"""Metres of progress before and after the middle of a turn: in which it is made, and whose windows make the map."""

LEAST_TURN, MOST_TURN = math.radians(25.0), math.radians(155.0)
"""Turns that are examined. With a smaller one, the map is bent as the trajectory is, and as sharp. With a larger one,
the robot passes the same walls again."""

LEAST_EXCESS = math.radians(5.0)
"""Least difference between the turn of the trajectory and that of odometry: a corner that is wrongly taken for a right
angle looks like an error of odometry."""

MOST_TURNS = 60
"""Most turns that are examined."""

CHANGES, FINER = tuple(math.radians(degrees) for degrees in (-30.0, -20.0, -10.0, 10.0, 20.0, 30.0)), math.radians(5.0)
"""Changes of a turn that are tried, and the step around the best one, radians."""

LEAST_GAIN = 10.0
"""A turn is wrong if another one gives a J that is larger by this many nats."""


def turns_supported(scans: Scans, nodes: Floats) -> bool:
    """Return whether readings support the turns of a trajectory that odometry does not have, nodes of shape (K, 3)."""
    return all(gain_of_other_turn(scans, nodes, middle) < LEAST_GAIN for middle in turns_of(scans.windows, nodes))


def with_likeliest_turns(scans: Scans, nodes: Floats) -> Floats:
    """Return the nodes with each turn changed to the one of the largest J."""
    for middle in turns_of(scans.windows, nodes, 0.0):
        nodes = with_turn(scans.windows, nodes, middle, _likeliest_change(scans, nodes, middle))
    return nodes


def turns_of(windows: Windows, nodes: Floats, least_excess: float = LEAST_EXCESS) -> list[int]:
    """Return the middle nodes of the turns to examine, those that differ most from odometry first."""
    progress = windows.node_progress
    begin = np.searchsorted(progress, progress - WITHIN)
    end = np.searchsorted(progress, progress + WITHIN, side='right') - 1
    yaw, measured = np.unwrap(nodes[:, 2]), np.unwrap(windows.node[:, 2])
    turned = np.abs(yaw[end] - yaw[begin])
    excess = np.abs(yaw[end] - yaw[begin] - measured[end] + measured[begin])
    left, out = turned > LEAST_TURN, list[int]()
    for most in np.argsort(-turned, kind='stable').tolist():
        if not left[most]:
            continue
        # the whole turn is within reach of all nodes around its middle
        steps = np.abs(np.diff(yaw[begin[most] : end[most] + 1]))
        middle = int(begin[most] + np.searchsorted(np.cumsum(steps), steps.sum() / 2))
        left &= np.abs(progress - progress[middle]) > 2 * WITHIN
        if turned[most] < MOST_TURN:
            out.append(middle)
    out.sort(key=lambda node: -float(excess[node]))
    return [node for node in out if excess[node] >= least_excess][:MOST_TURNS]


def gain_of_other_turn(scans: Scans, nodes: Floats, middle: int) -> float:
    """Return by how much J of the map around a node is larger with the best other turn there, nats.

    J depends a little on where surfaces lie in their cells. So it is the mean of two maps, along different axes. If no
    other turn is better in the first one, it is half of what that one gives.
    """
    gains = np.zeros(len(CHANGES))
    for frame in (np.zeros(3), nodes[middle]):
        here, *others = _objectives(scans, nodes, middle, (0.0, *CHANGES), frame)
        gains += (np.array(others) - here) / 2
        if gains.max() < 0.0:
            break
    return float(gains.max())


def _likeliest_change(scans: Scans, nodes: Floats, middle: int) -> float:
    """Return the change of a turn that gives the largest J of the map around, radians."""
    tried = (0.0, *CHANGES)
    best = tried[int(np.argmax(_objectives(scans, nodes, middle, tried, nodes[middle])))]
    before, here, after = _objectives(scans, nodes, middle, (best - FINER, best, best + FINER), nodes[middle])
    curvature = 2.0 * here - before - after
    if curvature <= 0.0:
        return best
    return best + FINER * float(np.clip(0.5 * (after - before) / curvature, -1.0, 1.0))


def _objectives(scans: Scans, nodes: Floats, middle: int, changes: Sequence[float], frame: Floats) -> list[float]:
    """Return J of the map around a node in a frame, with each change of the turn there, nats."""
    progress = scans.windows.node_progress
    near = np.flatnonzero(np.abs(progress - progress[middle]) <= SPAN)
    if scans.count[near].sum() < FEWEST_ON_MAP:
        return [0.0] * len(changes)
    return [scans.objective_of(near, frame, with_turn(scans.windows, nodes, middle, change)) for change in changes]


def with_turn(windows: Windows, nodes: Floats, middle: int, change: float) -> Floats:
    """Return the nodes with the turn around a node larger by `change`, radians; what follows is turned with it."""
    progress = windows.node_progress
    turning = np.flatnonzero(np.abs(progress[:-1] - progress[middle]) <= WITHIN)
    motion = relative(nodes[turning], nodes[turning + 1])
    # where the robot turned most, odometry is most wrong
    share = np.abs(wrapped(motion[:, 2])) + 1e-3
    out = nodes.copy()
    for k, step, more in zip(turning.tolist(), motion, change * share / share.sum(), strict=True):
        half = np.array([0.0, 0.0, more / 2])
        out[k + 1] = compose(compose(compose(out[k], half), step), half)
    last = int(turning[-1]) + 1
    out[last + 1 :] = compose(out[last], relative(nodes[last], nodes[last + 1 :]))
    return out
