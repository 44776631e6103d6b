"""Diagnostics of all parts of the node, once a second, and warnings in the log."""

from __future__ import annotations

from collections.abc import Iterable, Mapping
from typing import Any

from diagnostic_msgs.msg import DiagnosticArray, DiagnosticStatus

from ..core.messages.extrinsics import STEEP
from ..core.messages.mounts import far_mounts
from ..core.messages.pose_association import PoseAssociator
from ..core.messages.rejections import (
    sensor_rejections,
)
from ..core.messages.rep117 import (
    REASONS,
    REASONS_OUTSIDE_MESSAGE,
)
from ..core.messages.sensor_records import MOST_FRAMES
from . import diagnostics
from .background import Worker
from .em_service import EmService
from .frames import MapFrame, TfExtrinsics, Transforms
from .graph_check import GraphCheck
from .intake import Intake
from .journal_keeper import JournalKeeper
from .kernels import Kernels
from .live import LiveMap
from .sensor_status import unsent_warning
from .trajectory import Trajectory
from .verdict_log import VerdictLog

LONG_SILENT = 60.0
"""Seconds without a message after which a sensor has stopped sending, if sensors pause whenever there is no echo."""


class Reporter:
    """Publishes the diagnostics of all parts of the node."""

    def __init__(
        self,
        node: Any,
        health: diagnostics.Health,
        intake: Intake,
        associator: PoseAssociator,
        frames: tuple[TfExtrinsics, MapFrame, Transforms],
        live: LiveMap,
        em: EmService,
        journal: JournalKeeper,
        trajectory: Trajectory,
        kernels: Kernels,
        workers: Iterable[Worker],
    ) -> None:
        """Prepare; `workers` are all workers in the background."""
        self._node, self._health, self._intake, self._associator = node, health, intake, associator
        self._extrinsics, self._map_frame, transforms = frames
        self._live, self._em, self._journal, self._trajectory = live, em, journal, trajectory
        self._kernels, self._workers = kernels, list(workers)
        self._graph_check = GraphCheck(
            node,
            intake.subscriptions,
            transforms.topics,
            lambda: bool(associator.unknown_frames),
            lambda: trajectory.other_publisher_fault(transforms.latest),
        )
        self._verdicts = VerdictLog(node.get_logger())
        self._reported: set[str] = set()
        self._without_pose: set[str] = set()
        self._silent_before: set[str] = set()
        self._no_map_frame = self._no_name = self._far = self._unsent = False
        self._out = node.create_publisher(DiagnosticArray, '/diagnostics', 10)

    def report(self) -> None:
        """Publish the current diagnostics."""
        self._name_frames()
        name = self._node.get_fully_qualified_name().lstrip('/')
        topics = {'Range': self._em.range_topics, 'Odometry': [self._em.odom_topic]}
        extra: dict[str, Any] = {'map frame': self._trajectory.frame}
        if self._map_frame.dropped:
            extra['odometry without a transform to map_frame'] = self._map_frame.dropped
        statuses = self._health.statuses(
            name,
            self._intake,
            self._associator,
            self._em.current,
            self._em.last_run,
            self._live.grid,
            extra,
            no_map_frame := self._map_frame_fault(),
            lambda kind: self._graph_check.absent(kind, topics[kind]),
        )
        faults = [*self._intake.faults(), *self._graph_check.faults(), *self._no_frame_id()]
        counts = self._associator.buffer.counts()
        limits = [
            *self._associator.message_warnings(),
            *sensor_rejections(self._associator.rejected_by_frame, counts, REASONS_OUTSIDE_MESSAGE),
        ]
        # faults of frames are logged by the functions that detect them
        silent = statuses[0].message == no_map_frame or statuses[0].message.startswith(diagnostics.NO_POSE)
        bad = statuses[0].level != DiagnosticStatus.OK
        trajectory = self._trajectory.statuses(name)
        # after a jump, poses are wrong although all readings are accepted
        jumped = self._intake.clock_jumped or any(each.level != DiagnosticStatus.OK for each in trajectory)
        well = statuses[0].message == diagnostics.MAPPING and not (faults or limits or jumped)
        self._verdicts.update([*([statuses[0].message] if bad and not silent else []), *limits], well)
        diagnostics.add_faults(statuses[0], [*faults, *limits, *self._em.wrong_input])
        statuses += [*self._journal.statuses(name), *trajectory]
        unsent = self._unsent_fault(counts)
        quiet = self._silent(counts, LONG_SILENT if unsent else 0.0)
        statuses.append(self._em.sensors.status(name, counts, quiet, unsent))
        statuses.append(self._background(name))
        self._out.publish(diagnostics.array(statuses, self._node.get_clock().now().to_msg()))

    def _background(self, name: str) -> DiagnosticStatus:
        """Return the status of the work in the background."""
        values, failed = {}, []
        for worker in self._workers:
            # read once, since it may change meanwhile
            trouble, waiting = worker.trouble, worker.waiting
            values[worker.name] = trouble or (f'{waiting} to do' if waiting else 'idle')
            if trouble:
                failed.append(f'{worker.name}: {trouble}')
        stage = self._kernels.stage
        message = '; '.join(failed) or (f'compiling kernels: {stage}' if stage else 'no fault')
        level = DiagnosticStatus.WARN if failed else DiagnosticStatus.OK
        return diagnostics.status(f'{name}: background', level, message, name, values)

    def _unsent_fault(self, counts: Mapping[str, tuple[int, int]]) -> str:
        """Return a warning if a driver seems to send nothing without an echo, or ''; log it once."""
        fault = unsent_warning(self._intake.silence.pauses, counts)
        if fault and not self._unsent:
            self._node.get_logger().warning(fault)
        self._unsent = bool(fault)
        return fault

    def _silent(self, counts: Mapping[str, Any], least: float = 0.0) -> dict[str, float]:
        """Return sensors that are silent for so long, and for how many seconds; log when they stop and return."""
        silent = self._intake.silence.silent()
        found = {frame: seconds for frame, seconds in silent.items() if frame in counts and seconds >= least}
        log = self._node.get_logger()
        if new := found.keys() - self._silent_before:
            log.warning(f'these sensors have stopped sending: {diagnostics.listed(new)}')
        # after a reset, nothing is known of sensors that were silent
        if back := [frame for frame in self._silent_before - silent.keys() if frame in self._intake.silence]:
            log.info(f'these sensors send again: {diagnostics.listed(back)}')
        self._silent_before = set(found) | (self._silent_before & silent.keys())
        return found

    def _map_frame_fault(self) -> str:
        """Return the fault of the transform to the map frame, or ''; log its start and its end."""
        fault = self._map_frame.fault()
        if fault and not self._no_map_frame:
            self._no_map_frame = True
            self._node.get_logger().warning(f'readings are not mapped: {fault}')
        elif self._no_map_frame and self._map_frame.found:
            self._no_map_frame = False
            self._node.get_logger().info('the transform to map_frame is available')
        return fault

    def _no_frame_id(self) -> list[str]:
        """Return a warning if odometry has no frame_id, so that maps have none either; log it once."""
        nameless = bool(len(self._associator.record)) and not self._associator.map_frame
        text = (
            'odometry has no frame_id in its header: RViz and Nav2 cannot use a map in that frame, and TF has no '
            'transform to it; set a frame_id in its driver, such as odom'
        )
        if nameless and not self._no_name:
            self._node.get_logger().warning(text)
        self._no_name = nameless
        return [text] * nameless

    def _name_frames(self) -> None:
        """Log sensors without a pose, each once, and those whose pose became known."""
        unknown = self._associator.unknown_frames
        # a reset also forgets which frames are unknown
        for frame in sorted((self._without_pose - unknown).intersection(self._associator.buffer.counts())):
            self._node.get_logger().info(f'sensor {frame} now has a pose on the robot')
        # also sensors whose readings are rejected, or wait
        sent = {frame.lstrip('/') for frame in self._intake.silence}
        unheard = self._extrinsics.known.keys() - sent
        # logged once for any number of new frames
        named = f'; there are poses for {diagnostics.listed(unheard)}: is it one of these?' if unheard else ''
        for frame in sorted(unknown - self._reported)[: diagnostics.MOST_SHOWN]:
            if len(self._reported) >= MOST_FRAMES:
                break
            self._reported.add(frame)
            why = (
                'its transform is not normalised, or not finite'
                if frame in self._extrinsics.unusable
                else 'neither is known'
            )
            base = self._associator.base_frame
            way = (
                f'publish the transform from {base}'
                if base
                else 'set child_frame_id of odometry to the base frame, which is needed for lookups in TF'
            )
            self._node.get_logger().warning(
                f'no pose on the robot for sensor {frame}: set sensors.{frame}.pose: [x, y, yaw], or {way}; {why}; '
                f'its readings are rejected{named}'
            )
            named = ''
        self._without_pose = unknown & self._reported
        if not self._far and (far := far_mounts(self._extrinsics.fixed)):
            self._far = True
            self._node.get_logger().warning(far[0])
        for frame, counts in list(self._associator.rejected_by_frame.items()):
            if STEEP in counts and frame not in self._reported and len(self._reported) < MOST_FRAMES:
                self._reported.add(frame)
                self._node.get_logger().warning(f'readings of {frame} are rejected: {REASONS[STEEP]}')
