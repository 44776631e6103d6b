"""Cross-validation: a trajectory that is nearly accepted is estimated again with other windows held out.

Few held-out windows lie where a drive comes back to places, so a trajectory that is much better than odometry may not
be shown to be. In each fold, other windows are held out, and the drive is solved without their readings. All of them
are then compared together.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace

import numpy as np

from ..common.readings import Floats
from .attempt import Attempt, Drive, gain_words
from .holding_out import EVERY, LEAST_SIGMAS, Gain, gain, has_revisits, held_out, held_out_blocks, predicted

OTHERS = (0, 2)
"""The first held-out window of each further fold; in the first fold it is `EVERY` // 2."""

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
    revisited = has_revisits(drive.scans, first.nodes)
    if has_revisits(drive.scans, drive.windows.node) and not revisited:
        # it contradicts itself nowhere, so readings are predicted better along it even if it is wrong
        return None
    before, after = [np.empty(0)], [np.empty(0)]

    def compared(here: Drive, nodes: Floats) -> Gain:
        blocks = held_out_blocks(here.scans, len(nodes))
        before.append(predicted(here.scans, here.windows.node, blocks))
        after.append(predicted(here.scans, nodes, blocks))
        return gain(np.concatenate(before), np.concatenate(after))

    better, found = compared(drive, first.nodes), [first]
    for begin in OTHERS:
        if better.sigmas < NEARLY:
            return None
        other = drive.with_held_out(held_out(len(drive.windows), begin))
        attempt = solve(other)
        if not attempt.refinement.accepted or has_revisits(drive.scans, attempt.nodes) != revisited:
            return None
        better = compared(other, attempt.nodes)
        found.append(attempt)
        if better.sigmas >= LEAST_SIGMAS:
            best = max(found, key=lambda each: drive.scans.objective(each.nodes))
            return _with_gain(best, better, len(found))
    return None


def _with_gain(attempt: Attempt, better: Gain, folds: int) -> Attempt:
    reason = f'with {folds} of {EVERY} windows held out in turn, {gain_words(better)}'
    return attempt._replace(refinement=replace(attempt.refinement, reason=reason, gain=better.mean), by_votes=False)
