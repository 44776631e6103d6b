"""Pose association: messages in any interleaving → readings in the map frame; each rejection is counted by reason.

The offline tool and the node use the same `PoseAssociator`. The pose of a reading depends on message stamps only, so
the same messages give the same readings however fast they arrive. A clock is used only for time-outs.
"""

from __future__ import annotations

import heapq
import sys
import time
from collections import Counter, deque
from collections.abc import Callable
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from ..common.parameters import Parameters
from ..common.readings import Readings
from .extrinsics import ExtrinsicsLookup, Later, Mount, project
from .limit_watch import LimitWatch
from .map_extent import MapExtent, possible
from .message_account import MessageAccount
from .message_types import NANOSECONDS, OdometryMessage, Pose2, RangeMessage
from .missing_readings import MissingReadings
from .pose_history import PoseHistory
from .reading_buffer import ReadingBuffer
from .rejections import (
    MANY_REJECTED,
    odometry_rejections,
    of_dead_sensors,
    rejection_warnings,
    sensor_rejections,
    swapped_frames,
)
from .rep117 import (
    LONGEST_NAME,
    Measurement,
    measure,
)
from .robot_path import RobotPath
from .stamp_order import JUMP, JUMPED_BACK, WAS_AHEAD, order_of

RETRY = NANOSECONDS // 20
"""Interval, in message time or by the clock, at which a pose that may still become known is looked up again."""

MOST_WAITING = 100_000
"""Most readings that may wait for odometry, so that memory is bounded without odometry."""

LONGEST_LAG = 60.0
"""Longest time that a reading waits for odometry that keeps coming but has not reached its stamp, seconds."""


class _Deadline(NamedTuple):
    """A reading waited too long if both its stamp, nanoseconds, and its arrival by the clock, seconds, are earlier."""

    stamp: int
    arrival: float

    def is_over(self, measured: Measurement) -> bool:
        return measured.stamp < self.stamp and measured.arrival < self.arrival


class PoseAssociator(MessageAccount):
    """Takes Range and Odometry messages one by one, in any interleaving, and stores the readings that get a pose.

    ``received == len(buffer) + waiting + sum(rejected.values())``, always, as long as the buffer is not cleared.

    Attributes
    ----------
    map_frame, base_frame : str
        The frames of the first odometry message; empty before it.
    behind : bool
        Whether more than `at_once` readings can be placed now; then call `settle` before the next message.
    settled : int
        Number of readings placed, rejected or looked up again so far, as a measure of the work.
    record : OdometryRecord
        Of all poses of odometry.
    limits : LimitWatch
        Looks for ranges and limits in different units.
    missing : MissingReadings
        Looks for readings without an echo that the driver leaves out.
    """

    def __init__(
        self,
        extrinsics: ExtrinsicsLookup,
        parameters: Parameters | None = None,
        patient: bool = False,
        clock: Callable[[], float] = time.monotonic,
        at_once: int = 0,
    ) -> None:
        """Prepare for messages.

        Parameters
        ----------
        extrinsics : callable
            Returns the pose of a sensor on the robot (`extrinsics`).
        parameters : Parameters, optional
        patient : bool
            For files: keep all odometry, and let readings wait for it without limit. Then the accepted readings do not
            depend on how the two streams interleave.
        clock : callable
            Returns seconds. A reading times out when `pose_timeout` has passed both by later stamps and by this clock:
            so none is lost if a bag is replayed fast or a simulation is paused. While stamps of odometry increase, a
            reading that only overtook it does not time out.
        at_once : int
            Most readings that one call places or rejects, so that odometry after a long pause blocks nothing; 0 is no
            bound.
        """
        super().__init__()
        self._clock = clock
        self._extrinsics = extrinsics
        self.parameters = (parameters or Parameters()).association
        self._all_parameters = parameters or Parameters()
        self._extent = MapExtent()
        self._patient = patient
        self.buffer = ReadingBuffer(self.parameters.max_readings)
        self.limits, self.missing = LimitWatch(), MissingReadings()
        self.map_frame = self.base_frame = ''
        # readings that wait for odometry, a heap by stamp
        self._without_pose: list[Measurement] = []
        self._path, self._history = RobotPath(), PoseHistory(patient)
        self.record = self._history.record
        self._newest_range: int | None = None
        self._restored_until: int | None = None
        # readings with the pose of the robot, which wait for that of their sensor on it
        self._without_extrinsics: deque[tuple[Measurement, Pose2, Later]] = deque()
        # look-ups that remain in the present pass over them
        self._lookups_left = 0
        # in message time, nanoseconds
        self._next_lookup = self._next_future_check = 0
        self._at_once = at_once or sys.maxsize
        self._odometry_arrival = self._odometry_sent = self._next_lookup_by_clock = 0.0
        self.behind = self._other_frame = self._frames_forgettable = False
        self.settled = 0

    @property
    def waiting(self) -> int:
        """Number of readings that wait for odometry, or for the pose of their sensor on the robot."""
        return len(self._without_pose) + len(self._without_extrinsics)

    @property
    def odometry_stamp(self) -> int | None:
        """The newest stamp of odometry, nanoseconds; None before the first."""
        return self._history.newest

    @property
    def odometry_ahead(self) -> bool:
        """Whether the newest stamp of odometry is far after the one before, so that it may be wrong."""
        newest, before = self._history.newest, self._history.before
        return newest is not None and before is not None and newest - before > JUMP

    @property
    def path(self) -> list[tuple[float, float]]:
        """The path of the robot, (x, y) in metres (`robot_path`)."""
        return self._path.points

    @property
    def readings(self) -> Readings:
        """The readings for mapping: all accepted ones, thinned to `max_readings`."""
        return self.buffer.bounded()

    def change(self, parameters: Parameters) -> None:
        """Use other parameters from here on; those of the grid and of the buffer must be the same."""
        self.parameters, self._all_parameters = parameters.association, parameters

    @property
    def odometry(self) -> tuple[NDArray[np.int64], NDArray[np.float64]]:
        """The poses of the drive by odometry: stamps, ns, shape (M,), and x, y, yaw, shape (M, 3)."""
        stamps = self.buffer.snapshot().stamp
        return self.record.snapshot(int(stamps.min()) if len(stamps) else None)

    def message_warnings(self) -> list[str]:
        """Return warnings about the messages so far; empty if there is no suspicion."""
        return [*swapped_frames(self.map_frame, self.base_frame), *self.limits.warnings(), *self.missing.warnings()]

    def rejection_warnings(self) -> list[str]:
        """Return warnings about the readings and poses that were rejected so far; empty if they are few."""
        by_frame, counts = self.rejected_by_frame, self.buffer.counts()
        return [
            *odometry_rejections(self.odometry_rejected, self.odometry_received, MANY_REJECTED),
            *rejection_warnings(self.rejected, self.received, dead=of_dead_sensors(by_frame, counts)),
            *sensor_rejections(by_frame, counts),
        ]

    def add_range(self, message: RangeMessage, sent: int = 0) -> None:
        """Take one Range message; `sent` is when it was published, nanoseconds of the system's clock, 0 if unknown."""
        self.received += 1
        self.limits.add(message, self.parameters.max_range)
        self.missing.add(message)
        measured = measure(message, self.parameters)
        if isinstance(measured, str):
            self._reject(message.frame_id, measured)
            return
        measured.newest = self._history.newest
        if self.waiting >= MOST_WAITING and not self._patient:
            self._reject(message.frame_id, 'too_many_waiting')
            return
        measured.number, measured.arrival, measured.sent = self.received, self._clock(), sent
        heapq.heappush(self._without_pose, measured)
        self._newest_range = max(measured.stamp, self._newest_range or measured.stamp)
        self._settle()

    def clear(self, parameters: Parameters | None = None) -> None:
        """Remove readings, counts and path; the last second of odometry is kept, so that the next reading gets a pose.

        `parameters` are those of the new maps.
        """
        self._all_parameters = parameters or self._all_parameters
        # that of the next drive may have others, if its driver starts after the reset
        self._frames_forgettable = True
        if self._other_frame:
            self._forget_frames()
        elif self._history.newest is not None:
            # the clock may begin anew, and the next reading may have a stamp of the drive that is forgotten
            self._history.forget_before(self._history.newest - JUMP)
        self.record.begin_anew()
        self.buffer.clear()
        self.limits.clear()
        self.missing.clear()
        self.begin_account()
        self._without_pose.clear()
        self._without_extrinsics.clear()
        self._lookups_left, self.behind = 0, False
        self._newest_range, self._next_lookup, self._next_future_check = None, 0, 0
        self._restored_until = None
        self._path.clear()
        self._extent.clear()

    def add_odometry(self, message: OdometryMessage, sent: int = 0) -> None:
        """Take one Odometry message; `sent` is as in `add_range`."""
        self.odometry_received += 1
        if message.pose is None or not possible(message.pose):
            self.odometry_rejected['bad_pose'] += 1
            return
        if max(len(message.frame_id), len(message.child_frame_id)) > LONGEST_NAME:
            self.odometry_rejected['long_frame_id'] += 1
            return
        if not (message.frame_id + message.child_frame_id).isprintable():
            self.odometry_rejected['unprintable_frame_id'] += 1
            return
        known = self.map_frame.lstrip('/'), self.base_frame.lstrip('/')
        other = (message.frame_id.lstrip('/'), message.child_frame_id.lstrip('/')) != known
        if other and self._frames_forgettable:
            self._forget_frames()
            self.record.begin_anew()
        if not self.map_frame and not self.base_frame:
            self.map_frame, self.base_frame = message.frame_id, message.child_frame_id
        elif other:
            self.odometry_rejected['other_frame'] += 1
            self._other_frame = True
            return
        self._other_frame = self._frames_forgettable = False
        self.extend_path(message.pose[:2])
        order = order_of(message.stamp, self._history.newest, self._history.before)
        if order == WAS_AHEAD:
            self._drop_stamp_ahead()
        elif order == JUMPED_BACK:
            self._begin_after_jump_back()
        elif self._history.newest is None and self._restored_until is not None:
            # the clock of an earlier run may have been ahead, as that of a simulation which began again
            self.time_jumps += message.stamp < self._restored_until - JUMP
            self._restored_until = None
        newest = self._history.newest
        self._history.add(message.stamp, message.pose)
        if self._history.newest != newest:
            self._odometry_arrival = self._clock()
        self._odometry_sent = max(self._odometry_sent, sent)
        self._settle()
        if not self._patient:
            self._history.trim()

    def finish(self) -> None:
        """Settle all waiting readings after the last message: each gets a pose if there is one, or is rejected."""
        newest = self._history.newest
        if newest is not None:
            self._settle_up_to(newest)
        for measured in sorted(self._without_pose):
            self._reject(measured.frame_id, 'no_odometry' if newest is None else 'after_odometry')
        self._without_pose.clear()
        for measured, _, why in self._without_extrinsics:
            self._reject_unplaced(measured.frame_id, why.reason)
        self._without_extrinsics.clear()

    def restore(self, readings: Readings) -> int:
        """Add readings that an earlier run accepted; those that the map cannot contain are rejected.

        Returns
        -------
        int
            Number of rejected readings.
        """
        self.received += len(readings)
        rejected = self._extent.restore(readings, self._all_parameters)
        admitted = np.ones(len(readings), bool)
        for reason, mask in rejected.items():
            if count := int(np.count_nonzero(mask)):
                self.rejected[reason] += count
                admitted &= ~mask
        count = int(np.count_nonzero(admitted))
        if count:
            self.buffer.extend(readings if count == len(readings) else readings.select(admitted))
            self._restored_until = max(int(readings.stamp[admitted].max()), self._restored_until or 0)
        return len(readings) - count

    def extend_path(self, point: tuple[float, float]) -> None:
        """Add a point to the path of the robot, if it is far enough from the last one."""
        self._path.extend(point)

    def _forget_frames(self) -> None:
        """Forget the frames of odometry, and the poses in them."""
        self.map_frame = self.base_frame = ''
        self._history.clear()

    def _drop_stamp_ahead(self) -> None:
        """Drop the newest pose, whose stamp was ahead of those before and after it; readings placed by it stay."""
        self._history.drop_newest()
        self.odometry_rejected['ahead_of_others'] += 1
        # time is that of the remaining stamps
        self._next_lookup = self._next_future_check = 0

    def _begin_after_jump_back(self) -> None:
        """Place what can be placed, reject the other readings that wait, and forget poses, whose stamps are ahead."""
        assert self._history.newest is not None
        self._settle_up_to(self._history.newest)
        self.time_jumps += 1
        # as after a reset between two drives: the poses that are forgotten are those of the drive before
        first = self.odometry_received - self.odometry_rejected.total() == 1
        self.jumps_before_begin += first and not len(self.buffer)
        waiting = [*sorted(self._without_pose), *(measured for measured, _, _ in self._without_extrinsics)]
        for frame_id, count in Counter(measured.frame_id for measured in waiting).items():
            self._reject(frame_id, 'time_jump', count)
        self._without_pose.clear()
        self._without_extrinsics.clear()
        self._lookups_left, self.behind = 0, False
        self._next_lookup = self._next_future_check = 0
        self._history.clear()
        self._newest_range = None

    def settle(self) -> None:
        """Place more readings, if `behind`."""
        self._settle()

    def _settle(self) -> None:
        """Place or reject waiting readings as far as possible, at most `at_once`."""
        newest, left = self._history.newest, self._at_once
        if newest is not None:
            # odometry may be late by up to JUMP, and a file can wait for it
            left = self._settle_up_to(newest - JUMP if self._patient else newest, left)
        if not self._patient:
            left = self._time_out(newest, left) if left else 0
            self.behind = not left
            self.settled += self._at_once - left

    def _time_out(self, newest: int | None, left: int) -> int:
        """Reject readings that waited too long, and look up poses again; at most `left`; return what remains of it."""
        now = max(self._newest_range or 0, newest or 0)
        # a gap that would be bridged must not time out first, nor a reading that is placed later than it is stamped
        times = self.parameters
        patience = max(times.pose_timeout, times.max_pose_gap) + max(times.range_time_offset, 0.0)
        limit = now - round(patience * NANOSECONDS)
        if newest is not None and self._without_pose and newest >= self._next_future_check:
            self._next_future_check = newest + NANOSECONDS
            self._reject_from_the_future(newest, patience)
        if not ((self._without_pose and self._without_pose[0].stamp < limit) or self._without_extrinsics):
            return left
        clock = self._clock()
        deadline = _Deadline(limit, clock - patience)
        # odometry whose stamps increase is only late; otherwise `_reject_from_the_future` rejects the readings
        if newest is None or self._odometry_arrival < deadline.arrival:
            left = self._reject_without_pose(deadline, left)
        # a stamp from the future must not end it
        if self._without_extrinsics and (now >= self._next_lookup or clock >= self._next_lookup_by_clock):
            self._next_lookup, self._next_lookup_by_clock = now + RETRY, clock + RETRY / NANOSECONDS
            self._lookups_left = len(self._without_extrinsics)
        return self._look_up_again(deadline, left)

    def _reject_without_pose(self, deadline: _Deadline, left: int) -> int:
        """Reject overdue readings that wait for odometry, at most `left`; return what remains of it."""
        while left and self._without_pose and deadline.is_over(self._without_pose[0]):
            self._reject(heapq.heappop(self._without_pose).frame_id, 'no_odometry')
            left -= 1
        return left

    def _look_up_again(self, deadline: _Deadline, left: int) -> int:
        """Reject overdue readings that wait for the pose of their sensor, and look up that of the others again.

        At most `left` readings; return what remains of it.
        """
        while left and self._lookups_left:
            self._lookups_left -= 1
            left -= 1
            measured, pose, why = self._without_extrinsics.popleft()
            if deadline.is_over(measured):
                self._reject_unplaced(measured.frame_id, why.reason)
            else:
                self._add_extrinsics(measured, pose)
        return left

    def _reject_from_the_future(self, newest: int, patience: float) -> None:
        """Reject readings whose stamps odometry should have reached by now, by its own stamps and by the clock.

        Odometry that was published before a reading, and was overtaken by it, does not show that the clock is wrong.
        """
        clock = self._clock()
        oldest, published = clock - patience, self._odometry_sent and self._odometry_sent - patience * NANOSECONDS
        stay = []
        for measured in self._without_pose:
            if measured.newest is None:
                measured.newest = newest
            overtook = measured.sent > published > 0 and measured.arrival > clock - LONGEST_LAG
            if measured.arrival < oldest and newest - measured.newest > patience * NANOSECONDS and not overtook:
                self._reject(measured.frame_id, 'from_the_future')
            else:
                stay.append(measured)
        if len(stay) < len(self._without_pose):
            self._without_pose = stay
            heapq.heapify(self._without_pose)
            # time is that of the remaining stamps
            self._newest_range, self._next_lookup = max((measured.stamp for measured in stay), default=None), 0

    def _settle_up_to(self, stamp: int, left: int = sys.maxsize) -> int:
        """Place the readings up to a stamp, at most `left`; return what remains of `left`."""
        while left and self._without_pose and self._without_pose[0].stamp <= stamp:
            self._place(heapq.heappop(self._without_pose))
            left -= 1
        return left

    def _place(self, measured: Measurement) -> None:
        """Store a reading at its pose by odometry, or reject it."""
        pose = self._history.at(measured.stamp, self.parameters.max_pose_gap)
        if isinstance(pose, str):
            self._reject(measured.frame_id, pose)
            return
        self._add_extrinsics(measured, pose)

    def _add_extrinsics(self, measured: Measurement, pose: Pose2) -> None:
        """Compose the poses of robot and sensor, and store the reading."""
        extrinsic = self._extrinsics(self.base_frame, measured.frame_id, measured.stamp)
        if isinstance(extrinsic, Later):
            if extrinsic.reason != 'unknown_extrinsics':
                self.unknown_frames.discard(measured.frame_id)
            self._without_extrinsics.append((measured, pose, extrinsic))
            return
        if extrinsic is None:
            self._reject_unplaced(measured.frame_id, 'unknown_extrinsics')
            return
        self.unknown_frames.discard(measured.frame_id)
        if isinstance(extrinsic, str):
            self._reject(measured.frame_id, extrinsic)
            return
        sensor = pose.compose(extrinsic)
        reason = project(measured, extrinsic.elevation) if isinstance(extrinsic, Mount) else ''
        reason = reason or self._extent.admit(sensor, measured, self._all_parameters)
        if reason:
            self._reject(measured.frame_id, reason)
            return
        self.buffer.append(
            measured.frame_id,
            x=sensor.x,
            y=sensor.y,
            yaw=sensor.yaw,
            z=measured.z,
            z_max=measured.z_max,
            half_angle=measured.half_angle,
            sigma=measured.sigma,
            stamp=measured.stamp,
        )
