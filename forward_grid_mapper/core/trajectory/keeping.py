"""What was found before is the one to beat: a trajectory stays when a later run leaves odometry as it is.

That a run finds nothing better than odometry does not say that odometry is better: little may speak for either. So the
readings of windows that are held out from every match decide between the two, as they do within a run.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from ..common.parameters import Parameters
from ..common.readings import Readings
from .correction import Correction
from .holding_out import LEAST_SIGMAS, Gain, gain, held_out, held_out_blocks, predicted
from .judging import HELD_OUT
from .local_map import for_matching
from .outcome import Refinement, differences, replaced
from .refinement import without_times
from .scans import Scans
from .windows import Odometry, cut

SAME = 1e-3
"""Metres, and radians, between poses of one stamp, if they are of the same odometry."""


def kept(
    before: Refinement,
    correction: Correction,
    refused: Refinement,
    parameters: Parameters,
    stop: NDArray[np.uint8],
) -> Refinement:
    """Return an earlier trajectory that goes on to the end of a drive, or `refused` if odometry is better.

    Parameters
    ----------
    before : Refinement
        Of the earlier run.
    correction : Correction
        In force since then.
    refused : Refinement
        Of the run that leaves odometry as it is.
    parameters : Parameters
    stop : uint8, shape (1,)
        Not 0 to end the work.

    Raises
    ------
    Cancelled
        If `stop` was set.
    """
    readings, odometry = refused.readings, refused.trajectory
    if without_times(readings, odometry) or not _begins(correction, odometry):
        return refused
    path = correction.along(odometry)
    better = _odometry_better(readings, odometry, path, for_matching(parameters), stop)
    if better.sigmas >= LEAST_SIGMAS:
        return refused
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


def _begins(correction: Correction, odometry: Odometry) -> bool:
    """Return whether a correction is of the begin of this odometry."""
    first, known = odometry.stamp[:1], correction.odometry
    if not known.stamp[0] <= first[0] <= known.stamp[-1]:
        return False
    off = known.at(first)[0] - odometry.pose[0]
    off[2] = np.remainder(off[2] + np.pi, 2 * np.pi) - np.pi
    return bool(np.abs(off).max() < SAME)


def _odometry_better(
    readings: Readings, odometry: Odometry, path: Odometry, parameters: Parameters, stop: NDArray[np.uint8]
) -> Gain:
    """Return by how much odometry predicts the readings that are held out better than a path does."""
    windows = cut(readings, odometry)
    scans = Scans(windows, parameters, stop, held_out(len(windows)))
    blocks = held_out_blocks(scans, HELD_OUT) if scans.held_out.any() else []
    return gain(predicted(scans, path.at(windows.node_stamp), blocks), predicted(scans, windows.node, blocks))
