"""What became of a drive that was to be refined: its trajectory and readings, and why, of a whole drive or of parts."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np

from ..common.readings import Readings
from .jumps import UNKNOWN, Begin, Part, words
from .local_map import at_poses
from .poses import compose, relative
from .registration import moved_to
from .windows import Odometry


@dataclass(frozen=True)
class Refinement:
    """What became of a drive.

    Attributes
    ----------
    accepted : bool
        Whether the trajectory is another one than odometry's.
    reason : str
        Why not, or what it is better by, in words.
    readings : Readings
        Placed by the trajectory; those that were given if it is odometry's.
    trajectory : Odometry
        The pose of the robot at each stamp of the odometry.
    calibration : dict
        `scale`, `heading`, `bias` and `turn_scale` of `odometry_model`; empty if nothing was found.
    moved, turned : float
        Root mean square of how far positions, metres, and yaws, radians, were off, after the best alignment.
    loops : int
        Places that were recognised.
    gain : float
        Nats by which a reading is predicted better.
    lost : bool
        Whether odometry is off by so much that its heading could not be followed: then it stays, but nothing should be
        fitted to it.
    jumps : str
        What became of jumps of odometry, in words; empty where there are none.
    unplaced : bool
        Whether it is not known where the robot was after one of them.
    stretch : tuple of int, optional
        First and last stamp of what `calibration` and `noise` are of; None for the whole drive.
    noise : float
        By how much the yaw of odometry strays, radians a √metre, as walls say; 0 if they say nothing.
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
    """Return what became of a drive whose parts were refined each by itself, and begin where `begins` says."""
    said, unplaced = words(begins, parts), any(begin.how == UNKNOWN for begin in begins[1:])
    taken = [k for k, outcome in enumerate(outcomes) if outcome.accepted]
    best = max(taken, key=lambda k: float(parts[k].odometry.travel[-1]), default=0)
    of, span = outcomes[best], parts[best].odometry.stamp
    reason = said
    if taken:
        reason += f'; in the longest part that was refined, {parts[best].odometry.travel[-1]:.0f} m, {of.reason}'
    same = all(
        np.allclose(begin.pose, part.odometry.pose[0], atol=1e-9) for begin, part in zip(begins, parts, strict=True)
    )
    if not taken and same:
        lost = any(outcome.lost for outcome in outcomes)
        return Refinement(False, reason, readings, odometry, {}, lost=lost, jumps=said, unplaced=unplaced)
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
        jumps=said,
        unplaced=unplaced,
        stretch=(int(span[0]), int(span[-1])),
        right_angles=all(outcome.right_angles for outcome in outcomes),
    )


def with_outliers(found: Refinement, readings: Readings, odometry: Odometry, count: int) -> Refinement:
    """Return what became of a drive from what became of it without so many poses of its odometry."""
    named = (
        f'{count} poses of odometry are outliers (jumps and back)'
        if count > 1
        else 'one pose of odometry is an outlier (a jump and back)'
    )
    reason = f'{found.reason}; {named}'
    if not found.accepted:
        return replace(found, reason=reason, readings=readings, trajectory=odometry)
    trajectory = Odometry.of(odometry.stamp, found.trajectory.at(odometry.stamp))
    return replace(found, reason=reason, trajectory=trajectory)


def replaced(readings: Readings, odometry: Odometry, trajectory: Odometry) -> Readings:
    """Return readings placed by `odometry` as `trajectory` places them."""
    sensors = np.stack([readings.x, readings.y, readings.yaw], axis=1)
    mount = relative(odometry.at(readings.stamp), sensors)
    return at_poses(readings, compose(trajectory.at(readings.stamp), mount))


def differences(odometry: Odometry, trajectory: Odometry) -> tuple[float, float]:
    """Return the rms distance, metres, and the rms turn, radians, between two trajectories after the best alignment."""
    a = odometry.pose[:, :2] - odometry.pose[:, :2].mean(0)
    b = trajectory.pose[:, :2] - trajectory.pose[:, :2].mean(0)
    turn = math.atan2((a[:, 0] * b[:, 1] - a[:, 1] * b[:, 0]).sum(), (a * b).sum())
    c, s = math.cos(turn), math.sin(turn)
    moved = float(np.sqrt(((a @ np.array([[c, s], [-s, c]]) - b) ** 2).sum(1).mean()))
    off = trajectory.pose[:, 2] - odometry.pose[:, 2]
    return moved, float(np.std(off))
