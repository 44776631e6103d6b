"""The current trajectory: it places readings on the maps, and is published for other nodes.

The associator and the journal keep readings and poses as odometry gives them. The result of `refine_poses` is a
correction, applied to readings on their way to a map; without one, readings are not changed at all.
"""

from __future__ import annotations

import math
import time
from collections.abc import Callable
from typing import Any

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
from ..core.trajectory.refinable import SHORTEST
from ..core.trajectory.windows import Odometry
from ..files.report_text import UNTESTED
from ..files.trajectory_text import calibration_words
from .background import Worker
from .diagnostics import status
from .distance import Distance
from .following import Following
from .pose_publishers import PERIOD, PosePublishers
from .refining import FoundTrajectory, RefinementInput, RefiningMapper, outcome_words

MAP = 'map'
"""Name of the map frame if `map_frame` is empty (REP 105)."""


LASTING = 1.0
"""Seconds after which a stamp of odometry that is far ahead of the one before is used, even if none follows it."""

PATH_EVERY = 0.5
"""Metres of driving between two messages of the path."""

AFTER_JUMP = SHORTEST
"""Metres after a jump of odometry at which the node refines by itself, if `refine_every` is set: enough to find the
pose of the robot."""

LEAST_EVERY = 1.0
"""Shortest distance between two runs that the node begins by itself, metres, so that run_em gets its turn."""

NEW_PART = 0.1
"""Fraction of the drive that must be new before the node refines by itself: a run uses the whole drive, so that at
equal distances runs would cost more and more."""

JUMPED_BACK = 'the clock jumped back'
"""The reason why following ends; after it, stamps are those of an earlier part of the drive."""


class Trajectory:
    """The state of the trajectory. The executor owns it.

    Attributes
    ----------
    in_map_frame : bool
        Whether maps are in the map frame, and the transform from map to odometry is published.
    correction : Correction or None
        Places readings in the map frame; None if odometry is used.
    found_trajectory : FoundTrajectory or None
        Trajectory of the latest maps; None if none was estimated.
    publishing_worker : Worker
        Makes long messages.
    on_change : callable
        Called when maps must be made again: with the live map, None if only the frame has changed, and the number of
        readings in it.
    request_run : callable
        Called when the drive has grown by `refine_every`; returns whether a run began.
    listening : callable
        Returns whether the node is active: an inactive node leaves the transform to others, such as AMCL.
    following : Following or None
        Continues the trajectory while the robot drives; None if this is not wanted.
    distance : Distance
        Driven since the start of the drive.
    """

    def __init__(self, node: Any, associator: PoseAssociator, clock: Any) -> None:
        """Prepare for `begin`; `clock` is the clock of timers."""
        self._node, self._associator, self._clock = node, associator, clock
        self.publishing_worker: Worker | None = None
        # created when they are first needed
        self._publishers: PosePublishers | None = None
        # of `PoseAssociator.time_jumps`: those that `_tick` has handled, those before the latest run began, and those
        # before the drive whose trajectory a run has found
        self._jumps_handled = self._jumps_before_run = self._jumps_explained = 0
        self.in_map_frame = self._parameters.node.refine_poses
        self.correction: Correction | None = None
        self.found_trajectory: FoundTrajectory | None = None
        self.on_change: Callable[[LogOddsMap | None, int], object] = lambda live, count: None
        self.request_run: Callable[[], bool] = lambda: False
        self.listening: Callable[[], bool] = lambda: True
        self.following: Following | None = None
        self.distance = Distance(associator.record)
        # distance driven at the start of the latest run, and when the path was last published, metres
        self._driven_at_run = self._driven_at_path = 0.0
        # a stamp that may be wrong, and when it arrived, monotonic seconds
        self._stamp_ahead: tuple[int, float] | None = None
        # the path begins after this stamp, nanoseconds
        self._path_after = -1
        self._path_pending = False
        # of the transform of another publisher at the last check, nanoseconds
        self._foreign_stamp: int | None = None

    @property
    def obstacle(self) -> str:
        """The reason why odometry must be used as the trajectory, in words; '' if there is none."""
        if self._associator.map_frame.lstrip('/') != self._map_frame:
            return ''
        return (
            f'odometry is in frame {self._map_frame}, the frame of localised poses without drift (REP 105): if it '
            'drifts, set map_frame to another name for the frame of the maps'
        )

    @property
    def frame(self) -> str:
        """The frame of the maps; '' if neither odometry nor a parameter has named one."""
        if self.in_map_frame and not self.obstacle:
            return self._map_frame
        return self._associator.map_frame or str(self._parameters.node.map_frame)

    @property
    def _jumped_back(self) -> bool:
        """Whether the clock jumped back in this drive, and no run has found a trajectory since then."""
        return self._associator.time_jumps > max(self._jumps_explained, self._associator.jumps_before_begin)

    @property
    def place(self) -> Callable[[Readings], Readings] | None:
        """The function that places readings in the map frame; None if they are not moved."""
        return None if self.correction is None else self.correction.apply

    @property
    def _parameters(self) -> Parameters:
        parameters: Parameters = self._node.parameters
        return parameters

    @property
    def _map_frame(self) -> str:
        return (self._parameters.node.map_frame or MAP).lstrip('/')

    def begin(self) -> None:
        """Begin a drive, with odometry as the trajectory."""
        self.correction = self.found_trajectory = None
        if self.following is not None:
            self.following.begin(None)
        self.distance = Distance(self._associator.record)
        self._driven_at_run = self._driven_at_path = 0.0
        newest = self._associator.record.newest
        # the path begins with the drive
        self._path_after = -1 if newest is None else newest[0]
        self._jumps_handled, self._jumps_explained = self._associator.time_jumps, 0
        self._use_map_frame(self._parameters.node.refine_poses)
        self._publish_path()

    def mapper(
        self, parameters: Parameters, drive: Callable[[], RefinementInput], now: Callable[[], RefinementInput]
    ) -> RefiningMapper | Mapper:
        """Return a mapper for a run; `drive` returns the drive at its start, `now` the drive so far."""
        self._driven_at_run, self._jumps_before_run = self.distance.driven, self._associator.time_jumps
        refine, before = parameters.node.refine_poses and not self.obstacle, None
        if self.found_trajectory is not None and self.correction is not None:
            before = self.found_trajectory._replace(correction=self.correction)
        if not refine and before is None:
            return Mapper(parameters)
        return RefiningMapper(parameters, drive, refine, before, None if self.following is None else now)

    def adopt(self, found: FoundTrajectory | None, count: int) -> None:
        """Use the trajectory of a run for the maps of the first `count` readings; None if that is odometry."""
        before, live = self.frame, found.live if found else None
        self.correction = found.correction if found else None
        # the live map and the follower have other owners
        self.found_trajectory = found._replace(live=None, follower=None) if found and found.refinement else None
        refinement = found.refinement if found else None
        if refinement and len(refinement.trajectory.stamp):
            self.distance.explain(int(refinement.trajectory.stamp[-1]))
        if self.correction is not None:
            self._jumps_explained = self._jumps_before_run
        if self.following is not None:
            follower = found.follower if found else None
            if follower is not None and self._jumped_back:
                # during the run
                follower.obstacle = JUMPED_BACK
            self.following.begin(follower)
            if self.following.follower is not None:
                self.correction = self.following.follower.correction
        self._use_map_frame(self.found_trajectory is not None)
        self._publish_path()
        if live is not None or self.frame != before:
            self.on_change(live, count)

    def follow(self, correction: Correction) -> None:
        """Use a correction that continues the adopted one."""
        self.correction = correction

    def outcome(self) -> str:
        """Return a description of the trajectory of the latest maps, in words; '' if odometry is used anyway."""
        if self._parameters.node.refine_poses and self.obstacle:
            return f'odometry is used as the trajectory: {self.obstacle}'
        return outcome_words(self.found_trajectory) if self.found_trajectory else ''

    def statuses(self, name: str) -> list[DiagnosticStatus]:
        """Return the status of the trajectory; none if it is not refined."""
        if not (self.in_map_frame or self._parameters.node.refine_poses):
            return []
        values: dict[str, Any] = {
            'map frame': self.frame,
            'transform': self._transform(),
            'poses of odometry kept': self._associator.record.since_anew,
            'driven since the latest run (m)': f'{self.distance.driven - self._driven_at_run:.1f}',
        }
        refinement = self.found_trajectory.refinement if self.found_trajectory else None
        if refinement is not None and self.correction is not None:
            x, y, yaw = self.correction.last.tolist()
            wheels = calibration_words(refinement.calibration)
            values |= {
                'odometry off (m, root mean square)': f'{refinement.moved:.2f}',
                'odometry off (deg, standard deviation)': f'{math.degrees(refinement.turned):.1f}',
                'moved at the end of the drive (m)': f'{self.correction.moved:.2f}',
                'places recognised': refinement.loops,
                'correction (x m, y m, yaw deg)': f'{x:.2f}, {y:.2f}, {math.degrees(yaw):.1f}',
                'wheels': f'{wheels}; {UNTESTED}' if wheels else 'no systematic error found',
            }
        if self.following is not None:
            values |= self.following.values()
        message = self.outcome() or 'odometry is used until run_em is called'
        if self.distance.jump is not None:
            message = f'{message}; {self.distance.jump}'
        if self._jumped_back:
            message = (
                f'{message}; {JUMPED_BACK}, and the odometry before it is gone: call reset to begin a new map, or, if '
                'a bag loops, call run_em once it has been played again'
            )
        troubled = (
            self.obstacle
            or (self.following is not None and self.following.obstacle)
            or self.distance.jump is not None
            or self._jumped_back
            or (refinement is not None and refinement.unplaced)
        )
        level = DiagnosticStatus.WARN if troubled else DiagnosticStatus.OK
        return [status(f'{name}: trajectory', level, message, name, values)]

    def other_publisher_fault(self, latest: Callable[[str, str], int | None]) -> str:
        """Return the fault of another publisher of the transform from map to odometry, in words, or ''.

        `latest` returns the stamp of the newest transform on TF, given the target and the source frame, or None.
        """
        before, self._foreign_stamp = self._foreign_stamp, None
        if self._publishers is None or not self.in_map_frame or self.obstacle or not self.listening():
            return ''
        frames = self.frame.lstrip('/'), self._associator.map_frame.lstrip('/')
        stamp = latest(*frames) if all(frames) else None
        if stamp is None or self._publishers.sent_at(stamp):
            return ''
        self._foreign_stamp = stamp
        # the last transform of a node that has ended may be the newest for a while; a static one has the stamp 0
        if before is None or (stamp and stamp == before):
            return ''
        return (
            f'another node publishes the transform from {frames[0]} to {frames[1]} as well, so the pose of the robot '
            'jumps between both: stop it (a static_transform_publisher, AMCL, another SLAM node, or a bag with this '
            'transform) and start all nodes anew, or set refine_poses to false'
        )

    def _transform(self) -> str:
        """Return where the transform from map to odometry is published, in words."""
        if self._publishers is None or not self.in_map_frame or self.obstacle:
            return 'none: the maps are in the frame of odometry'
        if not self._publishers.by_tf:
            return 'none: tf2_ros is not installed'
        nameless = self._associator.record.newest is not None and not self._associator.map_frame.strip('/')
        return 'none: odometry has no frame_id' if nameless else 'on TF'

    def _use_map_frame(self, on: bool) -> None:
        self.in_map_frame = on
        if on and self._publishers is None:
            self._publishers = PosePublishers(self._node)
            self._node.create_timer(PERIOD, self._tick, clock=self._clock)

    def _tick(self) -> None:
        """Send the transform; called by a timer."""
        associator, newest = self._associator, self._associator.record.newest
        if self._publishers is None or not self.in_map_frame or self.obstacle or newest is None:
            return
        if associator.time_jumps != self._jumps_handled:
            self._jumps_handled, self._path_after = associator.time_jumps, -1
            self.distance.forget()
            self._publishers.forget()
            if self.following is not None and self._jumped_back:
                self.following.end(JUMPED_BACK)
        if associator.odometry_ahead and not self._has_lasted(newest[0]):
            return
        frames = self.frame, associator.map_frame
        self._publishers.send(frames, self._correction_at(newest[0]), newest, self.listening())
        self._on_new_pose(*newest)

    def _has_lasted(self, stamp: int) -> bool:
        """Return whether a stamp has been the newest for a while: TF would keep a wrong one, far ahead, for ever."""
        if self._stamp_ahead is None or self._stamp_ahead[0] != stamp:
            self._stamp_ahead = stamp, time.monotonic()
        return time.monotonic() - self._stamp_ahead[1] > LASTING

    def _correction_at(self, stamp: int) -> NDArray[np.float64]:
        """Return the pose of the odometry frame in the map frame at a stamp, shape (3,)."""
        if self.correction is None:
            return np.zeros(3)
        # stamps before the end occur after the clock jumped back, as when a bag is played repeatedly
        return (self.correction if stamp >= self.correction.end else self.correction.until(stamp)).last

    def _on_new_pose(self, stamp: int, pose: Pose2) -> None:
        """Update the distance driven, and do the work that is due."""
        jump = self.distance.add(stamp, pose)
        if jump is not None and self._parameters.node.refine_poses:
            self._node.get_logger().warning(str(jump))
        if self.following is not None:
            self.following.offer(pose, lambda: (self._associator.buffer.snapshot(), self._associator.record.snapshot()))
        if self.distance.driven - self._driven_at_path >= PATH_EVERY and not self._path_pending:
            self._publish_path()
        every = self._parameters.node.refine_every
        if not every or not self._parameters.node.refine_poses:
            return
        due = max(every, LEAST_EVERY, NEW_PART * self.distance.driven) <= self.distance.driven - self._driven_at_run
        jump = self.distance.jump
        if jump is not None and jump.driven >= self._driven_at_run:
            due = due or self.distance.driven - jump.driven >= AFTER_JUMP
        if due and self.request_run():
            self._driven_at_run = self.distance.driven

    def _publish_path(self) -> None:
        """Have the trajectory published, continued by poses of odometry in the map frame."""
        out, frame, correction, since = self._publishers, self.frame, self.correction, self._path_after
        if out is None or self.publishing_worker is None:
            return
        stamp = self._node.get_clock().now().to_msg()
        if not self.in_map_frame:
            self.publishing_worker.put(lambda: out.publish_path(frame, None, stamp))
            return
        # snapshots are immutable
        stamps, poses = self._associator.record.snapshot()
        self._driven_at_path, self._path_pending = self.distance.driven, True

        def publish() -> None:
            self._path_pending = False
            first = int(np.searchsorted(stamps, since, side='right'))
            path = Odometry(stamps[first:], poses[first:])
            if correction is not None:
                path = correction.extended(path.stamp, path.pose)
            out.publish_path(frame, path, stamp)

        self.publishing_worker.put(publish, self._path_not_published)

    def _path_not_published(self, why: str) -> None:
        self._path_pending = False
