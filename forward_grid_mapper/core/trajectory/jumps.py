"""Jumps of odometry: steps between two poses that no robot drives (`after_jumps` continues the drive after them).

Two kinds of doubtful steps are usually real motions, and are jumps only if readings show that the robot stood still. A
turn that is too fast for a robot is usually that of a simulated robot; otherwise a gyroscope restarted. A step that is
long, but no faster than this robot drives, usually comes from odometry with few messages.
"""

from __future__ import annotations

import itertools
import math
from typing import Any

import numpy as np
from numpy.typing import NDArray

from .poses import wrapped
from .windows import Odometry

LONGEST_STEP = 1.0
"""Metres between two poses of odometry up to which a step is no jump."""

USUAL, TIMES_USUAL, FEWEST_STEPS = 0.9, 2.0, 20
"""The usual length and speed of steps are this quantile of all; a step may be so many times as long and as fast; fewest
steps for this quantile."""

FEW_STEPS = 5
"""Fewest steps for the median in place of the quantile, which may be a jump if steps are few. With fewer steps, the
usual length and speed are unknown."""

STANDING = 0.01
"""Metres a second up to which the robot stands still: steps are then noise of a filter, and are ignored."""

LONGEST_GAP, TIMES_GAP = 2.0, 4.0
"""A driver was not restarted if the time between two poses is at most so many seconds, or so many times the median."""

LONGEST_TURN, FASTEST_TURN = 0.5, 2 * math.pi
"""Radians between two poses, and radians a second: no robot turns by more than both."""

LONGEST_OUTLIER = 0.5
"""Longest time between the poses before and after outliers, seconds."""

FASTEST = 3.0
"""Metres a second that a robot can drive at most."""

MOST_JUMPS = 20
"""Most jumps of wheel odometry; with more, a drive is not refined."""


def jumps(odometry: Odometry) -> NDArray[np.int64]:
    """Return the indices of the poses after jumps; without doubtful steps."""
    found, doubtful = _found(odometry)
    return found[~doubtful]


def doubtful_steps(odometry: Odometry) -> NDArray[np.int64]:
    """Return the indices of the poses after doubtful steps: turns that are too fast, or long steps at usual speed."""
    found, doubtful = _found(odometry)
    return found[doubtful]


def may_jump(odometry: Odometry) -> bool:
    """Return whether a step may be a jump; it is quick, since it does not ask which steps are usual."""
    pose = odometry.pose
    far = np.hypot(*np.diff(pose[:, :2], axis=0).T)
    return bool(((far > LONGEST_STEP) | _turned_too_fast(np.diff(pose[:, 2]), np.diff(odometry.stamp) * 1e-9)).any())


def _found(odometry: Odometry) -> tuple[NDArray[np.int64], NDArray[np.bool_]]:
    """Return the indices of the poses after jumps and doubtful steps, and which of them are doubtful."""
    seconds, pose = np.diff(odometry.stamp) * 1e-9, odometry.pose
    far = np.hypot(*np.diff(pose[:, :2], axis=0).T)
    moved = (far > STANDING * seconds) & (seconds > 0.0)
    longest, fastest, count = LONGEST_STEP, 0.0, np.count_nonzero(moved)
    apart = float(np.median(seconds)) if len(seconds) else 0.0
    if count >= FEW_STEPS:
        usual = USUAL if count >= FEWEST_STEPS else 0.5
        longest = max(longest, TIMES_USUAL * float(np.quantile(far[moved], usual)))
        fastest = min(TIMES_USUAL * float(np.quantile(far[moved] / seconds[moved], usual)), FASTEST)
    elif FASTEST * apart > LONGEST_STEP:
        # with so few messages, a robot can drive more than the longest step between two
        fastest = FASTEST
    found = np.flatnonzero((far > longest) | _turned_too_fast(np.diff(pose[:, 2]), seconds))
    gap = max(LONGEST_GAP, TIMES_GAP * apart)
    driven = (far <= fastest * seconds) & (seconds <= gap)
    return found + 1, ((far <= longest) | driven)[found]


def _turned_too_fast(turn: Any, seconds: Any) -> Any:
    """Return whether a turn, radians, is too fast for a robot in so many seconds."""
    turn = np.abs(wrapped(turn))
    return (turn > LONGEST_TURN) & (turn > FASTEST_TURN * np.asarray(seconds))


def too_far(metres: Any, seconds: Any) -> Any:
    """Return whether a distance is too far for a robot in that time, even if messages are missing."""
    return metres > LONGEST_STEP + FASTEST * seconds


def since_jump(odometry: Odometry) -> Odometry:
    """Return the odometry from the last jump on; all of it if there is none."""
    found = jumps(odometry)
    first = int(found[-1]) if len(found) else 0
    return Odometry(odometry.stamp[first:], odometry.pose[first:]) if first else odometry


def without_outliers(odometry: Odometry) -> Odometry:
    """Return the odometry without outliers: poses that it jumps to, and soon back from to where it continues.

    The same object if there are none.
    """
    stay, found = np.ones(len(odometry.stamp), np.bool_), _found(odometry)[0].tolist()
    for begin, end in itertools.pairwise(found):
        around = [begin - 1, end]
        seconds = float(np.diff(odometry.stamp[around])[0]) * 1e-9
        x, y, turn = np.diff(odometry.pose[around], axis=0)[0].tolist()
        back = math.hypot(x, y) <= LONGEST_STEP and not _turned_too_fast(turn, seconds)
        if stay[begin - 1] and seconds <= LONGEST_OUTLIER and back:
            stay[begin:end] = False
    return odometry if stay.all() else Odometry.of(odometry.stamp[stay], odometry.pose[stay])
