"""Keeping the trajectory of an earlier run if a later run does not accept one.

That a run does not accept a trajectory does not show that odometry is better: the readings may not tell. So held-out
windows decide between the earlier trajectory and odometry.
"""

from __future__ import annotations

from dataclasses import replace

import numpy as np
from numpy.typing import NDArray

from ..common.parameters import Parameters
from ..common.readings import Readings
from .correction import Correction
from .holding_out import LEAST_SIGMAS, Gain, gain, held_out, held_out_blocks, predicted
from .judging import HELD_OUT
from .local_map import for_matching
from .outcome import Refinement, differences, replaced
from .refinable import without_times
from .scans import Scans
from .windows import Odometry, cut

SAME = 1e-3
"""Largest difference of two poses of the same stamp in the same odometry, metres and radians."""


def keep_if_not_worse(
    before: Refinement,
    correction: Correction,
    refused: Refinement,
    parameters: Parameters,
    stop: NDArray[np.uint8],
) -> Refinement:
    """Return an earlier trajectory, continued to the end of the drive, or `refused` if odometry is better.

    Parameters
    ----------
    before : Refinement
        Result of the earlier run.
    correction : Correction
        The one in force since then.
    refused : Refinement
        Result of the later run, which kept odometry.
    parameters : Parameters
    stop : uint8, shape (1,)
        Not 0 to end the work.

    Raises
    ------
    Cancelled
        If `stop` was set.
    """
    readings, odometry = refused.readings, refused.trajectory
    if without_times(readings, odometry) or not _same_odometry(correction, odometry):
        return refused
    path = correction.along(odometry)
    better = _gain_of_odometry(readings, odometry, path, for_matching(parameters), stop)
    if better.sigmas >= LEAST_SIGMAS:
        reason = f'{refused.reason}; and it predicts the readings better than the trajectory of the previous run'
        return replace(refused, reason=reason)
    moved, turned = differences(odometry, path)
    return Refinement(
        True,
        'the readings do not show that odometry is better than the trajectory of an earlier run',
        replaced(readings, odometry, path),
        path,
        before.calibration,
        moved,
        turned,
        before.loops,
        before.gain,
        noise=before.noise,
        jumps=refused.jumps,
        unplaced=refused.unplaced,
        stretch=before.stretch,
        right_angles=before.right_angles,
    )


def _same_odometry(correction: Correction, odometry: Odometry) -> bool:
    """Return whether a correction was made from the start of this odometry."""
    first, known = odometry.stamp[:1], correction.odometry
    if not known.stamp[0] <= first[0] <= known.stamp[-1]:
        return False
    off = known.at(first)[0] - odometry.pose[0]
    off[2] = np.remainder(off[2] + np.pi, 2 * np.pi) - np.pi
    return bool(np.abs(off).max() < SAME)


def _gain_of_odometry(
    readings: Readings, odometry: Odometry, path: Odometry, parameters: Parameters, stop: NDArray[np.uint8]
) -> Gain:
    """Return the gain of odometry over a path in predicting held-out windows."""
    windows = cut(readings, odometry)
    scans = Scans(windows, parameters, stop, held_out(len(windows)))
    blocks = held_out_blocks(scans, HELD_OUT) if scans.held_out.any() else []
    return gain(predicted(scans, path.at(windows.node_stamp), blocks), predicted(scans, windows.node, blocks))
