"""The trajectory in force: what readings are moved by on their way to the maps, and what others are told of it.

The associator keeps readings and poses as odometry gives them, and so does the journal. What `refine_poses` finds is a
correction, applied wherever they go to a map; without one they go there as they are, to the bit.
"""

from __future__ import annotations

import math
import time
from collections.abc import Callable
from typing import Any, NamedTuple

import numpy as np
from diagnostic_msgs.msg import DiagnosticStatus
from numpy.typing import NDArray

from ..core.common.parameters import Parameters
from ..core.common.readings import Readings
from ..core.mapping import Mapper
from ..core.maps.log_odds_map import LogOddsMap
from ..core.messages.message_types import Pose2
from ..core.messages.pose_association import PoseAssociator
from ..core.trajectory.correction import Correction
from ..core.trajectory.jumps import jumps
from ..core.trajectory.refinement import SHORTEST
from ..core.trajectory.windows import Odometry
from ..files.trajectory_text import calibration_words
from .background import Worker
from .diagnostics import status
from .following import Following
from .pose_publishers import PERIOD, PosePublishers
from .refining import Drive, Found, RefiningMapper, outcome_words

MAP = 'map'
"""Name of the map frame where `map_frame` gives none (REP 105)."""


LASTING = 1.0
"""Seconds after which a stamp of odometry that is far ahead of the one before counts, though none has followed it."""

GROWS = 0.5
"""Metres of driving after which the path is published again."""

RECENT = 60_000_000_000
"""Nanoseconds of odometry before the last look, which say how far apart its poses are."""

AFTER_JUMP = SHORTEST
"""Metres after a jump of odometry from which on the node refines by itself, if it does at all: then there is something
to tell by where the robot is."""

LEAST_EVERY = 1.0
"""Metres between two runs that the node begins by itself, so that there is time for run_em between them."""

GROWN = 0.1
"""Part of the drive that must be new for the node to refine by itself: a run looks at all of it, so that runs after
equal ways would cost more and more."""


class _Jump(NamedTuple):
    """A jump of odometry: the stamp after it, nanoseconds, by how far, and after which way of the drive, metres."""

    stamp: int
    far: float
    driven: float

    def __str__(self) -> str:
        return (
            f'odometry jumped by {self.far:.1f} m: the pose of the robot on the map is unknown until run_em has found '
            'it, and new readings are mapped with wrong poses; if the robot was carried away (kidnapped), call reset'
        )


class Trajectory:
    """Owned by the executor.

    Attributes
    ----------
    on : bool
        Whether maps are in the map frame, and the transform from there to odometry's is published.
    correction : Correction or None
        What readings are moved by.
    found : Found or None
        What became of the trajectory of the latest maps; None where none was looked for.
    publishing : Worker
        Makes long messages.
    changed : callable
        Called when maps are to be made anew: with the live map, None if only the frame changed, and with the number of
        readings in it.
    refine : callable
        Called when the drive has grown by `refine_every`; returns whether a run was begun.
    listening : callable
        Returns whether the node is active: one that is not leaves the transform to others, such as AMCL.
    following : Following or None
        Goes on with what was found while the robot drives; None where this is not wanted.
    driven : float
        Metres since the drive began, as far as they were looked at.
    """

    def __init__(self, node: Any, associator: PoseAssociator, clock: Any) -> None:
        """Prepare for `begin`; `clock` is that of timers."""
        self._node, self._associator, self._clock = node, associator, clock
        self.publishing: Worker | None = None
        self._out: PosePublishers | None = None
        self._jumps = 0
        self.on = self._parameters.node.refine_poses
        self.correction: Correction | None = None
        self.found: Found | None = None
        self.changed: Callable[[LogOddsMap | None, int], object] = lambda live, count: None
        self.refine: Callable[[], bool] = lambda: False
        self.listening: Callable[[], bool] = lambda: True
        self.following: Following | None = None
        self.driven = self._refined_at = self._shown_at = 0.0
        self._at: tuple[int, Pose2] | None = None
        self._ahead: tuple[int, float] | None = None
        self._jump: _Jump | None = None
        self._since = -1
        self._showing = False

    @property
    def obstacle(self) -> str:
        """Why there can be no other trajectory than odometry's, in words; empty if there can."""
        if self._associator.map_frame.lstrip('/') != self._map_frame:
            return ''
        return (
            f'odometry is in frame {self._map_frame}, the frame of localised poses without drift (REP 105): if it '
            'drifts, set map_frame to another name for the frame of the maps'
        )

    @property
    def frame(self) -> str:
        """The frame of the maps; empty while odometry has named none and no parameter does."""
        if self.on and not self.obstacle:
            return self._map_frame
        return self._associator.map_frame or str(self._parameters.node.map_frame)

    @property
    def place(self) -> Callable[[Readings], Readings] | None:
        """What readings are moved by on their way to a map; None if they stay."""
        return None if self.correction is None else self.correction.apply

    @property
    def _parameters(self) -> Parameters:
        parameters: Parameters = self._node.parameters
        return parameters

    @property
    def _map_frame(self) -> str:
        return (self._parameters.node.map_frame or MAP).lstrip('/')

    def begin(self) -> None:
        """Begin a drive, with the trajectory of odometry."""
        self.correction = self.found = None
        if self.following is not None:
            self.following.begin(None)
        self.driven = self._refined_at = self._shown_at = 0.0
        self._at, self._jump, newest = None, None, self._associator.record.newest
        # the path begins with the drive
        self._since = -1 if newest is None else newest[0]
        self._jumps = self._associator.time_jumps
        self._switch(self._parameters.node.refine_poses)
        if self._out is not None:
            self._out.forget()
        self._show_path()

    def mapper(
        self, parameters: Parameters, drive: Callable[[], Drive], now: Callable[[], Drive]
    ) -> RefiningMapper | Mapper:
        """Return what makes the maps of a run; `drive` returns what it was begun with, `now` what there is by then."""
        self._refined_at = self.driven
        refine, before = parameters.node.refine_poses and not self.obstacle, None
        if self.found is not None and self.correction is not None:
            before = self.found._replace(correction=self.correction)
        if not refine and before is None:
            return Mapper(parameters)
        return RefiningMapper(parameters, drive, refine, before, None if self.following is None else now)

    def adopt(self, found: Found | None, count: int) -> None:
        """Take what was found for the maps of the first `count` readings; None if they are as odometry has it."""
        before, live = self.frame, found.live if found else None
        self.correction = found.correction if found else None
        # the live map belongs to the one who shows it
        self.found = found._replace(live=None, follower=None) if found and found.refinement else None
        refinement = found.refinement if found else None
        looked_at = refinement.trajectory.stamp[-1:] if refinement else np.zeros(0, np.int64)
        if self._jump is not None and (looked_at >= self._jump.stamp).any():
            self._jump = None
        if self.following is not None:
            self.following.begin(found.follower if found else None)
            if self.following.follower is not None:
                self.correction = self.following.follower.correction
        self._switch(self.found is not None)
        self._show_path()
        if live is not None or self.frame != before:
            self.changed(live, count)

    def follow(self, correction: Correction) -> None:
        """Take the correction that goes on from the one that was adopted."""
        self.correction = correction

    def outcome(self) -> str:
        """Return what became of the trajectory of the latest maps, in words; empty if it is odometry's anyway."""
        if self._parameters.node.refine_poses and self.obstacle:
            return f'odometry is used as the trajectory: {self.obstacle}'
        return outcome_words(self.found) if self.found else ''

    def statuses(self, name: str) -> list[DiagnosticStatus]:
        """Return the status of the trajectory, if it is to be refined."""
        if not (self.on or self._parameters.node.refine_poses):
            return []
        values: dict[str, Any] = {
            'map frame': self.frame,
            'transform': 'on TF' if self._out is None or self._out.by_tf else 'none: tf2_ros is not installed',
            'poses of odometry kept': self._associator.record.since_anew,
            'driven since the latest run (m)': f'{self.driven - self._refined_at:.1f}',
        }
        refinement = self.found.refinement if self.found else None
        if refinement is not None and self.correction is not None:
            x, y, yaw = self.correction.last.tolist()
            values |= {
                'odometry off (m, root mean square)': f'{refinement.moved:.2f}',
                'odometry off (deg, standard deviation)': f'{math.degrees(refinement.turned):.1f}',
                'moved at the end of the drive (m)': f'{self.correction.moved:.2f}',
                'places recognised': refinement.loops,
                'correction (x m, y m, yaw deg)': f'{x:.2f}, {y:.2f}, {math.degrees(yaw):.1f}',
                'wheels': calibration_words(refinement.calibration) or 'no systematic error found',
            }
        if self.following is not None:
            values |= self.following.values()
        message = self.outcome() or 'odometry is used until run_em is called'
        if self._jump is not None:
            message = f'{message}; {self._jump}'
        troubled = (
            self.obstacle
            or (self.following is not None and self.following.obstacle)
            or self._jump is not None
            or (refinement is not None and refinement.unplaced)
        )
        level = DiagnosticStatus.WARN if troubled else DiagnosticStatus.OK
        return [status(f'{name}: trajectory', level, message, name, values)]

    def _switch(self, on: bool) -> None:
        self.on = on
        if on and self._out is None:
            self._out = PosePublishers(self._node)
            self._node.create_timer(PERIOD, self._tick, clock=self._clock)

    def _tick(self) -> None:
        """Send the transform; called by a timer."""
        associator, newest = self._associator, self._associator.record.newest
        if self._out is None or not self.on or self.obstacle or newest is None:
            return
        if associator.time_jumps != self._jumps:
            self._jumps, self._since = associator.time_jumps, -1
            self._at = self._jump = None
            self._out.forget()
        if associator.odometry_ahead and not self._lasts(newest[0]):
            return
        frames = self.frame, associator.map_frame, associator.base_frame
        self._out.send(frames, self._correction_at(newest[0]), newest, self.listening())
        self._drive_on(*newest)

    def _lasts(self, stamp: int) -> bool:
        """Return whether a stamp has been the newest for a while: TF never forgets one that was wrong and far ahead."""
        if self._ahead is None or self._ahead[0] != stamp:
            self._ahead = stamp, time.monotonic()
        return time.monotonic() - self._ahead[1] > LASTING

    def _correction_at(self, stamp: int) -> NDArray[np.float64]:
        """Return the pose of odometry's frame on the map, shape (3,), as readings of a stamp are moved."""
        if self.correction is None:
            return np.zeros(3)
        # earlier than the end is what comes after the clock jumped back, as where a bag is played again and again
        return (self.correction if stamp >= self.correction.end else self.correction.until(stamp)).last

    def _drive_on(self, stamp: int, pose: Pose2) -> None:
        """Count the way, and do what is due after it."""
        before, self._at = self._at or (stamp, pose), (stamp, pose)
        self._count(before, stamp, pose)
        if self.following is not None and self._parameters.node.refine_poses:
            self.following.offer(pose, lambda: (self._associator.buffer.snapshot(), self._associator.record.snapshot()))
        if self.driven - self._shown_at >= GROWS and not self._showing:
            self._show_path()
        every = self._parameters.node.refine_every
        if not every or not self._parameters.node.refine_poses:
            return
        due = max(every, LEAST_EVERY, GROWN * self.driven) <= self.driven - self._refined_at
        if self._jump is not None and self._jump.driven >= self._refined_at:
            due = due or self.driven - self._jump.driven >= AFTER_JUMP
        if due and self.refine():
            self._refined_at = self.driven

    def _count(self, before: tuple[int, Pose2], stamp: int, pose: Pose2) -> None:
        """Add the way since the last look, which may be long ago where messages come fast, without jumps."""
        recent = Odometry(*self._associator.record.since(before[0] - RECENT))
        first, at = int(np.searchsorted(recent.stamp, before[0])), jumps(recent)
        at = at[at > first]
        if not len(at):
            self.driven += math.dist(before[1][:2], pose[:2])
            return
        steps = np.hypot(*np.diff(recent.pose[:, :2], axis=0).T)
        far, last = float(steps[at[-1] - 1]), int(at[-1])
        steps[:first], steps[at - 1] = 0.0, 0.0
        begin, self.driven = self.driven + float(steps[:last].sum()), self.driven + float(steps.sum())
        known, self._jump = self._jump is not None, _Jump(int(recent.stamp[last]), far, begin)
        if self._parameters.node.refine_poses and not known:
            self._node.get_logger().warning(str(self._jump))

    def _show_path(self) -> None:
        """Have the trajectory published, and behind its end the poses of odometry as they are on the map."""
        out, frame, correction, since = self._out, self.frame, self.correction, self._since
        if out is None or self.publishing is None:
            return
        stamp = self._node.get_clock().now().to_msg()
        if not self.on:
            self.publishing.put(lambda: out.publish_path(frame, None, stamp))
            return
        # snapshots never change
        stamps, poses = self._associator.record.snapshot()
        self._shown_at, self._showing = self.driven, True

        def publish() -> None:
            self._showing = False
            first = int(np.searchsorted(stamps, since, side='right'))
            path = Odometry(stamps[first:], poses[first:])
            if correction is not None:
                path = correction.extended(path.stamp, path.pose)
            out.publish_path(frame, path, stamp)

        self.publishing.put(publish, self._not_shown)

    def _not_shown(self, why: str) -> None:
        self._showing = False
