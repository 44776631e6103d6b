"""Jumps of odometry: steps between two poses that no robot drives (`after_jumps` continues the drive after them).

Two kinds of doubtful steps are usually real motions, and are jumps only if readings show that the robot stood still. A
turn that is too fast for a robot is usually that of a simulated robot; otherwise a gyroscope restarted. A step that is
long, but no faster than this robot drives, usually comes from odometry with few messages, or from missing messages.
If the robot moved before messages were missing and moves after that, such a step is not even doubtful: readings could
not tell, since a corridor looks the same some metres further on.
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
"""The usual length and speed of steps are this quantile of all; a step may be this many times as long and as fast;
fewest steps for this quantile."""

FEW_STEPS = 5
"""Fewest steps for the median in place of the quantile, which may be a jump if steps are few. With fewer steps, the
usual length and speed are unknown."""

STANDING = 0.01
"""Metres a second up to which the robot stands still: steps are then noise of a filter, and are ignored."""

LONGEST_GAP, TIMES_GAP = 2.0, 4.0
"""Messages are missing if the time between two poses is more than this many seconds, and this many times the median."""

AT_ZERO = 0.01
"""Metres, and radians: if odometry is so close to zero after missing messages, its driver was restarted."""

MOMENT, MOVED = 1_000_000_000, 0.05
"""The robot moves if it moves by this many metres, or radians, in this many nanoseconds before, or after, missing
messages."""

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
    """Return the indices of the poses after doubtful steps: turns that are too fast, or long steps at usual speed.

    A long step is not doubtful if messages are missing, and the robot moved before and after that.
    """
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
    missing = seconds > max(LONGEST_GAP, TIMES_GAP * apart)
    at_zero = (np.hypot(pose[1:, 0], pose[1:, 1]) <= AT_ZERO) & (np.abs(wrapped(pose[1:, 2])) <= AT_ZERO)
    driven = (far <= fastest * seconds) & ~(missing & at_zero)
    sure = [k for k in found[(missing & driven)[found]].tolist() if _moved_around(odometry, k + 1)]
    found = found[~np.isin(found, sure)]
    return found + 1, ((far <= longest) | driven)[found]


def _moved_around(odometry: Odometry, at: int) -> bool:
    """Return whether the robot moved just before the step to pose `at`, and just after it."""
    stamp, pose = odometry.stamp, odometry.pose
    first = min(int(np.searchsorted(stamp, stamp[at - 1] - MOMENT)), at - 2)
    last = max(int(np.searchsorted(stamp, stamp[at] + MOMENT, side='right')) - 1, at + 1)
    if first < 0 or last >= len(stamp):
        return False
    moved = pose[[at - 1, last]] - pose[[first, at]]
    return bool(np.all(np.maximum(np.hypot(moved[:, 0], moved[:, 1]), np.abs(moved[:, 2])) >= MOVED))


def _turned_too_fast(turn: Any, seconds: Any) -> Any:
    """Return whether a turn, radians, is too fast for a robot in this many seconds."""
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
