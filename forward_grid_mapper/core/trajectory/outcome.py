"""The result of refining a drive, as a whole or in parts: its trajectory, its readings, and the reason."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import NamedTuple

import numpy as np

from ..common.readings import Readings
from .after_jumps import UNKNOWN, Begin, Part, jump_words
from .local_map import at_poses
from .poses import compose, relative, rms_after_alignment
from .registration import moved_to
from .windows import Odometry


@dataclass(frozen=True)
class Refinement:
    """The result of refining a drive.

    Attributes
    ----------
    accepted : bool
        Whether a refined trajectory was accepted; otherwise `trajectory` is the odometry.
    reason : str
        Why it was not, or how much better it is, in words.
    readings : Readings
        Placed by the trajectory; unchanged if this is the odometry.
    trajectory : Odometry
        The pose of the robot at each stamp of the odometry.
    calibration : dict
        `scale`, `heading`, `bias` and `turn_scale` of `odometry_model`; empty if none was estimated.
    moved, turned : float
        Errors of the odometry, rms after rigid alignment with the trajectory: metres and radians.
    loops : int
        Number of loop closures.
    gain : float
        How much better readings are predicted than with odometry, nats a reading.
    lost : bool
        Whether the heading was lost: then odometry is kept, but the drive must not take part in registration.
    jumps : str
        What was done about jumps of odometry, in words; empty without jumps.
    unplaced : bool
        Whether the pose of the robot after one of the jumps is unknown.
    stretch : tuple of int, optional
        First and last stamp of the part that `calibration` and `noise` were estimated from; None for the whole drive.
    noise : float
        σ of the yaw error of odometry, radians a √metre, as estimated from walls; 0 if unknown.
    right_angles : bool
        Whether walls are taken to stand at right angles to each other.
    """

    accepted: bool
    reason: str
    readings: Readings
    trajectory: Odometry
    calibration: dict[str, float]
    moved: float = 0.0
    turned: float = 0.0
    loops: int = 0
    gain: float = 0.0
    lost: bool = False
    noise: float = 0.0
    jumps: str = ''
    unplaced: bool = False
    stretch: tuple[int, int] | None = None
    right_angles: bool = True


def joined_parts(
    readings: Readings,
    odometry: Odometry,
    parts: Sequence[Part],
    outcomes: Sequence[Refinement],
    begins: Sequence[Begin],
) -> Refinement:
    """Return the result for a drive from those of its parts, each moved so that it begins at the pose in `begins`."""
    jump_text, unplaced = jump_words(begins, parts), any(begin.how == UNKNOWN for begin in begins[1:])
    taken = [k for k, outcome in enumerate(outcomes) if outcome.accepted]
    best = max(taken, key=lambda k: float(parts[k].odometry.travel[-1]), default=0)
    of, span = outcomes[best], parts[best].odometry.stamp
    reason = jump_text
    if taken:
        reason += f'; in the longest part that was refined, {parts[best].odometry.travel[-1]:.0f} m, {of.reason}'
    same = all(
        np.allclose(begin.pose, part.odometry.pose[0], atol=1e-9) for begin, part in zip(begins, parts, strict=True)
    )
    if not taken and same:
        lost = any(outcome.lost for outcome in outcomes)
        return Refinement(False, reason, readings, odometry, {}, lost=lost, jumps=jump_text, unplaced=unplaced)
    pose = np.concatenate([moved_to(begin.pose, part.path.pose) for begin, part in zip(begins, parts, strict=True)])
    pose[:, 2] = np.unwrap(pose[:, 2])
    trajectory = Odometry(odometry.stamp, pose)
    moved, turned = differences(odometry, trajectory)
    loops = sum(outcome.loops for outcome in outcomes)
    return Refinement(
        True,
        reason,
        replaced(readings, odometry, trajectory),
        trajectory,
        of.calibration if taken else {},
        moved,
        turned,
        loops,
        of.gain,
        noise=of.noise,
        jumps=jump_text,
        unplaced=unplaced,
        stretch=(int(span[0]), int(span[-1])),
        right_angles=all(outcome.right_angles for outcome in outcomes),
    )


def with_outliers(found: Refinement, readings: Readings, odometry: Odometry, count: int) -> Refinement:
    """Return the result for a drive from the one for its odometry without outliers; `count` is their number."""
    named = (
        f'{count} poses of odometry are outliers (jumps and back)'
        if count > 1
        else 'one pose of odometry is an outlier (a jump and back)'
    )
    return with_all_poses(replace(found, reason=f'{found.reason}; {named}'), readings, odometry)


def with_all_poses(found: Refinement, readings: Readings, odometry: Odometry) -> Refinement:
    """Return the result for a drive from the one for some poses of its odometry."""
    if not found.accepted:
        return replace(found, readings=readings, trajectory=odometry)
    return replace(found, trajectory=Odometry.of(odometry.stamp, found.trajectory.at(odometry.stamp)))


def replaced(readings: Readings, odometry: Odometry, trajectory: Odometry) -> Readings:
    """Return readings placed by `odometry` as `trajectory` places them."""
    sensors = np.stack([readings.x, readings.y, readings.yaw], axis=1)
    mount = relative(odometry.at(readings.stamp), sensors)
    return at_poses(readings, compose(trajectory.at(readings.stamp), mount))


class Differences(NamedTuple):
    """Rms differences of positions, metres, and yaws, radians, of two trajectories after rigid alignment."""

    moved: float
    turned: float

    def within(self, largest: Differences) -> bool:
        """Whether both differences are smaller than these."""
        return self.moved < largest.moved and self.turned < largest.turned


def differences(odometry: Odometry, trajectory: Odometry) -> Differences:
    """Return the differences of two trajectories."""
    turned = float(np.std(trajectory.pose[:, 2] - odometry.pose[:, 2]))
    return Differences(rms_after_alignment(odometry.pose, trajectory.pose), turned)
