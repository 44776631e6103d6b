"""Cross-validation: a trajectory that is nearly accepted is estimated again with other windows held out.

Few held-out windows lie where a drive comes back to places, so a trajectory that is much better than odometry may not
be shown to be. In each fold, other windows are held out, and the drive is solved without their readings. All of them
are then compared together.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import replace

import numpy as np

from ..common.errors import InputError
from ..common.readings import Floats
from .attempt import CONTRADICTED, UNMATCHED, Attempt, Drive, gain_words
from .holding_out import (
    LEAST_SIGMAS,
    OTHERS,
    Gain,
    gain,
    has_revisits,
    held_out,
    held_out_blocks,
    predicted,
    tears_apart,
)
from .judging import SPAN, is_worse_nearby
from .scans import Scans

NEARLY = 1.0
"""Standard errors by which readings must be predicted better for further folds to be tried: each takes as much time as
the first one."""


def accepted_in_folds(drive: Drive, first: Attempt, solve: Callable[[Drive], Attempt]) -> Attempt | None:
    """Return the trajectory of the largest J of all folds; None if they do not show that odometry is wrong.

    Parameters
    ----------
    drive : Drive
    first : Attempt
        The trajectory of the first fold, which does not show it.
    solve : callable
        Returns the attempt at a drive with other windows held out.
    """
    torn = tears_apart(drive.scans, drive.windows.node, first.nodes)
    revisited = has_revisits(drive.scans, first.nodes)
    found, all_visits, nearby = [first], _Compared(np.inf), _Compared(SPAN)
    all_visits.add(drive, first.nodes)
    nearby.add(drive, first.nodes)
    for begin in OTHERS:
        if _decisive(all_visits, nearby, torn).sigmas < NEARLY:
            return None
        other = drive.with_held_out(held_out(len(drive.windows), begin))
        attempt = solve(other)
        if not attempt.refinement.accepted or has_revisits(drive.scans, attempt.nodes) != revisited:
            return None
        all_visits.add(other, attempt.nodes)
        nearby.add(other, attempt.nodes)
        found.append(attempt)
        if is_worse_nearby(nearby.gain, all_visits.gain):
            return None
        better = _decisive(all_visits, nearby, torn)
        if better.sigmas >= LEAST_SIGMAS:
            best = max(found, key=lambda each: _objective(drive.scans, each.nodes))
            return _with_gain(best, better, len(found))
    return None


def _decisive(all_visits: _Compared, nearby: _Compared, torn: bool) -> Gain:
    """Return the gain that decides: on maps of all visits; of a trajectory that `tears_apart`, the less clear one."""
    if not torn:
        return all_visits.gain
    return min(all_visits.gain, nearby.gain, key=lambda each: each.sigmas)


def _objective(scans: Scans, nodes: Floats) -> float:
    """Return J of the map of the whole drive, nats; -inf if the map is too large at the cell size of matching."""
    try:
        return scans.objective(nodes)
    except InputError:
        return -math.inf


class _Compared:
    """Predictions of the held-out windows of several folds, by odometry and by trajectories, on maps within `span`."""

    def __init__(self, span: float) -> None:
        self._span = span
        self._before, self._after = [np.empty(0)], [np.empty(0)]

    def add(self, drive: Drive, nodes: Floats) -> None:
        """Add a fold: its drive, and the nodes of its trajectory, shape (K, 3)."""
        blocks = held_out_blocks(drive.scans, len(nodes))
        self._before.append(predicted(drive.scans, drive.windows.node, blocks, self._span))
        self._after.append(predicted(drive.scans, nodes, blocks, self._span))

    @property
    def gain(self) -> Gain:
        """The gain of the trajectories over odometry."""
        return gain(np.concatenate(self._before), np.concatenate(self._after))


def _with_gain(attempt: Attempt, better: Gain, folds: int) -> Attempt:
    reason = f'with other windows held out in each of {folds} trials, {gain_words(better)}'
    if not attempt.matched:
        reason += UNMATCHED
    if attempt.turns_contradicted:
        reason += CONTRADICTED
    return attempt._replace(refinement=replace(attempt.refinement, reason=reason, gain=better.mean), by_votes=False)
