"""The node's report, once a second: diagnostics of all its parts, and warnings in the log."""

from __future__ import annotations

from collections.abc import Iterable
from typing import Any

from diagnostic_msgs.msg import DiagnosticArray, DiagnosticStatus

from ..core.messages.pose_association import MOST_FRAMES, PoseAssociator
from . import diagnostics
from .background import Worker
from .em_service import EmService
from .frames import Extrinsics, MapFrame
from .intake import Intake
from .journal_keeper import JournalKeeper
from .kernels import Kernels
from .live import LiveMap
from .surroundings import Surroundings
from .trajectory import Trajectory


class Reporter:
    """Publishes what the parts of the node say of themselves."""

    def __init__(
        self,
        node: Any,
        health: diagnostics.Health,
        intake: Intake,
        associator: PoseAssociator,
        frames: tuple[Extrinsics, MapFrame],
        live: LiveMap,
        em: EmService,
        journal: JournalKeeper,
        trajectory: Trajectory,
        kernels: Kernels,
        workers: Iterable[Worker],
    ) -> None:
        """Prepare; `workers` are all that work in the background."""
        self._node, self._health, self._intake, self._associator = node, health, intake, associator
        self._extrinsics, self._map_frame = frames
        self._live, self._em, self._journal, self._trajectory = live, em, journal, trajectory
        self._kernels, self._workers = kernels, list(workers)
        self._surroundings = Surroundings(node, intake.subscriptions)
        self._reported: set[str] = set()
        self._out = node.create_publisher(DiagnosticArray, '/diagnostics', 10)

    def report(self) -> None:
        """Publish the diagnostics of now."""
        self._name_frames()
        name = self._node.get_fully_qualified_name().lstrip('/')
        extra = (
            {'odometry without a transform to map_frame': self._map_frame.dropped} if self._map_frame.dropped else {}
        )
        statuses = self._health.statuses(
            name, self._intake, self._associator, self._em.current, self._em.last_run, self._live.grid, extra
        )
        faults = [*self._intake.faults(), *self._surroundings.faults()]
        diagnostics.add_faults(statuses[0], [*faults, *self._associator.limits.warnings(), *self._em.wrong_input])
        statuses += [*self._journal.statuses(name), *self._trajectory.statuses(name)]
        statuses.append(self._em.sensors.status(name, self._associator.buffer.counts()))
        statuses.append(self._background(name))
        self._out.publish(diagnostics.array(statuses, self._node.get_clock().now().to_msg()))

    def _background(self, name: str) -> DiagnosticStatus:
        """Return the status of what works in the background."""
        values, failed = {}, []
        for worker in self._workers:
            # asked once, since it may change meanwhile
            trouble, waiting = worker.trouble, worker.waiting
            values[worker.name] = trouble or (f'{waiting} to do' if waiting else 'idle')
            if trouble:
                failed.append(f'{worker.name}: {trouble}')
        stage = self._kernels.stage
        message = '; '.join(failed) or (f'compiling kernels: {stage}' if stage else 'all is well')
        level = DiagnosticStatus.WARN if failed else DiagnosticStatus.OK
        return diagnostics.status(f'{name}: background', level, message, name, values)

    def _name_frames(self) -> None:
        """Name sensors without a pose in the log, each once."""
        for frame in sorted(self._associator.unknown_frames - self._reported)[: diagnostics.SHOWN]:
            if len(self._reported) >= MOST_FRAMES:
                break
            self._reported.add(frame)
            why = (
                'its transform is not normalised, or its axis leaves the plane by more than 60°'
                if frame in self._extrinsics.unusable
                else 'neither is known'
            )
            self._node.get_logger().warning(
                f'no pose on the robot for sensor {frame}: set sensors.{frame}.pose: [x, y, yaw], or publish the '
                f'transform from {self._associator.base_frame or "the base frame"}; {why}; its readings are rejected'
            )
