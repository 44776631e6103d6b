"""Pose association for files: the same as `PoseAssociator`, vectorised for batches of messages.

Readings, their order, counts and the state after each batch are the same, bit for bit. Sines and remainders are those
of the math module, since those of numpy differ in the last bit. Unusual batches, such as odometry out of order, are
processed message by message.
"""

from __future__ import annotations

import heapq
import math
from collections import Counter
from collections.abc import Callable, Iterator
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from ..common.parameters import Parameters
from ..common.readings import Floats, Readings
from .extrinsics import ExtrinsicsLookup, Later, Mount, project_all
from .map_extent import possible
from .message_batch import Ints, MessageBatch, Odometry
from .message_types import Pose2, RangeMessage
from .pose_association import PoseAssociator
from .pose_history import Poses
from .rep117 import LONGEST_NAME, Measurement, Measurements, all_corrected, measure_all
from .stamp_order import JUMP

NEVER = np.iinfo(np.int64).max
"""Stands for the place of a message that is not in the batch."""


class _Waiting(NamedTuple):
    """Readings that wait for a pose, columns of shape (N,): those of `Measurement`, and the place in the batch."""

    place: Ints
    number: Ints
    stamp: Ints
    frame: Ints
    z: Floats
    z_max: Floats
    half_angle: Floats
    sigma: Floats

    def select(self, which: NDArray[Any]) -> _Waiting:
        return _Waiting(*(column[which] for column in self))


class BatchAssociator(PoseAssociator):
    """A patient associator, for files, that takes messages in batches or one at a time.

    In a batch, a result `Later` of `extrinsics` is final.
    """

    def __init__(
        self,
        extrinsics: ExtrinsicsLookup,
        parameters: Parameters | None = None,
        moves: Callable[[str, str], bool] = lambda base_frame, frame: False,
    ) -> None:
        """Prepare for messages.

        Parameters
        ----------
        extrinsics, parameters
            As of `PoseAssociator`.
        moves : callable
            Returns whether `extrinsics` depends on the stamp, for the frames of the robot and of a sensor.
        """
        super().__init__(extrinsics, parameters, patient=True)
        self._moves = moves

    def add_batch(self, batch: MessageBatch) -> None:
        """Take messages in the order in which they were recorded."""
        if self._is_usual(batch.odometry):
            self._add_in_order(batch)
            return
        for message in batch.one_by_one():
            if isinstance(message, RangeMessage):
                self.add_range(message)
            else:
                self.add_odometry(message)

    def _is_usual(self, odometry: Odometry) -> bool:
        """Return whether all odometry is valid, in one frame and sorted by time."""
        if not len(odometry.stamp):
            return True
        pairs = {odometry.frames[k] for k in np.unique(odometry.frame).tolist()}
        known = (self.map_frame, self.base_frame)
        if len(pairs) > 1 or (any(known) and pairs != {known}):
            return False
        names = next(iter(pairs))
        if max(map(len, names)) > LONGEST_NAME or not ''.join(names).isprintable() or not any(names):
            return False
        newest = self._history.newest
        in_order = bool((np.diff(odometry.stamp) > 0).all()) and (newest is None or odometry.stamp[0] > newest)
        return in_order and all(possible(Pose2(*pose)) for pose in odometry.pose.tolist())

    def _add_in_order(self, batch: MessageBatch) -> None:
        """Process a batch with usual odometry."""
        ranges, odometry = batch
        newest = self._history.newest
        self._take_odometry(odometry)
        self.limits.add_all(ranges, self.parameters.max_range)
        self.missing.add_all(ranges)
        measured = measure_all(ranges, self.parameters)
        frames = list(ranges.frames)
        good = measured.reason == ''
        numbers = self.received + 1 + np.arange(len(good))
        stamp = all_corrected(ranges, self.parameters)
        new = _Waiting(ranges.place, numbers, stamp, ranges.frame, *measured[1:]).select(good)
        self.received += len(good)
        if len(new.stamp):
            self._newest_range = max(int(new.stamp.max()), self._newest_range or int(new.stamp.max()))
        waiting = self._with_earlier(new, frames)
        # a reading is placed when odometry has passed it by JUMP, or as it arrives
        placed = np.maximum(_first_after(waiting.stamp, odometry, newest), waiting.place)
        settled = placed < NEVER
        self._wait(waiting.select(~settled), frames)
        waiting, placed = waiting.select(settled), placed[settled]
        order = np.lexsort((waiting.number, waiting.stamp, placed))
        why = self._place_all(waiting.select(order), frames)
        # count rejections in the same order as message by message; reports list them so
        bad = ~good
        places = np.concatenate([ranges.place[bad], placed[order]])
        reasons = np.concatenate([measured.reason[bad], why])
        of = np.concatenate([ranges.frame[bad], waiting.frame[order]])
        self._reject_all(places, reasons, [frames[k] for k in of.tolist()])

    def _take_odometry(self, odometry: Odometry) -> None:
        if not len(odometry.stamp):
            return
        self.odometry_received += len(odometry.stamp)
        self.map_frame, self.base_frame = odometry.frames[odometry.frame[0]]
        self._other_frame = False
        poses = [Pose2(*pose) for pose in odometry.pose.tolist()]
        for pose in poses:
            self.extend_path(pose[:2])
        self._history.extend(odometry.stamp.tolist(), poses)

    def _with_earlier(self, new: _Waiting, frames: list[str]) -> _Waiting:
        """Return the new readings, and those of earlier batches that can be settled now."""
        newest, earlier = self._history.newest, []
        while newest is not None and self._without_pose and self._without_pose[0].stamp <= newest - JUMP:
            earlier.append(heapq.heappop(self._without_pose))
        if not earlier:
            return new
        names = {name: k for k, name in enumerate(frames)}
        for m in earlier:
            if m.frame_id not in names:
                names[m.frame_id] = len(frames)
                frames.append(m.frame_id)
        rows = [(-1, m.number, m.stamp, names[m.frame_id]) for m in earlier]
        values = np.array([(m.z, m.z_max, m.half_angle, m.sigma) for m in earlier])
        held = _Waiting(*np.array(rows, np.int64).T, *values.T)
        return _Waiting(*(np.concatenate(pair) for pair in zip(held, new, strict=True)))

    def _wait(self, waiting: _Waiting, frames: list[str]) -> None:
        """Keep readings until there is more odometry."""
        columns = (column.tolist() for column in waiting[1:])
        for number, stamp, frame, z, z_max, half_angle, sigma in zip(*columns, strict=True):
            message = RangeMessage(stamp, frames[frame], z, 0.0, z_max, 2 * half_angle)
            held = Measurement(message, z, z_max, half_angle, sigma)
            held.number = number
            heapq.heappush(self._without_pose, held)

    def _place_all(self, waiting: _Waiting, frames: list[str]) -> NDArray[np.str_]:
        """Place readings in order, and store those that are accepted; return the reasons for rejection, or ''."""
        poses = self._history.at_all(waiting.stamp, self.parameters.max_pose_gap)
        measured = Measurements(poses.reason, *waiting[4:])
        sensors = np.zeros((len(poses.reason), 3))
        known = np.flatnonzero(poses.reason == '')
        # look up sensors in the order of their first readings, which is that of reports
        numbers, first = np.unique(waiting.frame[known], return_index=True)
        for number in numbers[np.argsort(first)].tolist():
            which = known[waiting.frame[known] == number]
            for part, mount in self._mounts(frames[number], which, waiting.stamp):
                if isinstance(mount, str):
                    measured.reason[part] = mount
                    continue
                if isinstance(mount, Mount) and mount.elevation:
                    projected = project_all(measured.select(part), mount.elevation)
                    for column, values in zip(measured, projected, strict=True):
                        column[part] = values
                sensors[part] = _composed(poses, part, mount)
        kept = np.flatnonzero(measured.reason == '')
        measured.reason[kept] = self._extent.admit_all(sensors[kept], measured.select(kept), self._all_parameters)
        kept = np.flatnonzero(measured.reason == '')
        self._append(waiting.select(kept), sensors[kept], measured.select(kept), frames)
        return measured.reason

    def _mounts(self, frame_id: str, which: Ints, stamp: Ints) -> Iterator[tuple[Ints, Pose2 | str]]:
        """Yield readings of a sensor, and what `_mount` returns for all of them."""
        mount = self._mount(frame_id, int(stamp[which[0]]))
        if not self._moves(self.base_frame, frame_id):
            yield which, mount
            return
        for k in which:
            yield np.array([k]), self._mount(frame_id, int(stamp[k]))

    def _mount(self, frame_id: str, stamp: int) -> Pose2 | str:
        """Return the pose of a sensor on the robot, or the reason why its readings are rejected."""
        mount = self._extrinsics(self.base_frame, frame_id, stamp)
        if mount is None or isinstance(mount, Later):
            return 'unknown_extrinsics' if mount is None else mount.reason
        self.unknown_frames.discard(frame_id)
        return mount

    def _append(self, kept: _Waiting, sensors: Floats, measured: Measurements, frames: list[str]) -> None:
        """Append readings to the buffer; it is thinned at the same readings as if they came one by one."""
        numbers, first, of = np.unique(kept.frame, return_index=True, return_inverse=True)
        order = np.argsort(first)
        names = tuple(frames[number] for number in numbers[order].tolist())
        sensor = np.argsort(order).astype(np.int32)[of]
        (x, y, yaw), (_, z, z_max, half_angle, sigma) = sensors.T, measured
        readings = Readings(x, y, yaw, z, z_max, half_angle, sigma, kept.stamp, sensor, names)
        while len(readings):
            room = self.buffer.room
            self.buffer.extend(readings.select(slice(room)))
            readings = readings.select(slice(room, None))

    def _reject_all(self, places: Ints, reasons: NDArray[np.str_], frames: list[str]) -> None:
        """Count rejections by frame and reason, in the order of the first of each."""
        bad = np.flatnonzero(reasons != '')
        kinds = Counter((frames[k], str(reasons[k])) for k in bad[np.argsort(places[bad], kind='stable')].tolist())
        for (frame, reason), count in kinds.items():
            self._reject_unplaced(frame, reason, count)


def _first_after(stamp: Ints, odometry: Odometry, newest: int | None) -> Ints:
    """Return the place at which odometry is JUMP ahead of each stamp, (N,): -1 if before the batch, or `NEVER`."""
    places = np.append(odometry.place, NEVER)[np.searchsorted(odometry.stamp, stamp + JUMP)]
    return places if newest is None else np.where(stamp + JUMP <= newest, -1, places)


def _composed(poses: Poses, which: NDArray[np.int64], mount: Pose2) -> Floats:
    """Return `Pose2.compose` of many poses and that of a sensor, shape (N, 3)."""
    yaw = poses.yaw[which]
    c, s = (np.array([turned(v) for v in yaw.tolist()]) for turned in (math.cos, math.sin))
    x, y = poses.x[which] + c * mount.x - s * mount.y, poses.y[which] + s * mount.x + c * mount.y
    return np.stack([x, y, yaw + mount.yaw], axis=1)
