"""The service run_em, and the maps of the latest run."""

from __future__ import annotations

import time
from collections.abc import Callable, Mapping, Sequence
from typing import Any

from ..core.common.parameters import Parameters
from ..core.maps.map_set import MapSet
from ..core.messages.message_types import Pose2
from ..core.messages.pose_association import PoseAssociator
from ..files.quality_warning import quality_warning
from .background import Inbox, Worker, reason
from .consistency_check import ConsistencyCheck
from .deferred import Reply
from .distance import jump_warnings
from .em import EmWorker, Outcome, Run, summary
from .kernels import Kernels
from .map_publishers import MapPublishers
from .nothing_to_map import nothing_to_map
from .online import OnlineWorker
from .refining import FoundTrajectory, RefiningMapper
from .run_input import RunInput
from .sensor_status import SensorWatch
from .trajectory import Trajectory

LOG_PERIOD = 10.0
"""Seconds between two lines of progress in the log while the trajectory is estimated."""

REPLACED = 'the run that the node began by itself (refine_every) was replaced by run_em'
"""The reason why such a run has no maps."""

BY_RESET = 'EM was cancelled by reset'

LONG_WAIT = 0.5
"""Seconds of waiting for kernels from which the answer mentions them."""


def _fail_all(waiting: list[Callable[[Outcome], object]], why: str) -> None:
    """Tell all who wait for a run that it does not begin."""
    callbacks = list(waiting)
    waiting.clear()
    for done in callbacks:
        done(Outcome(None, why))


class EmService:
    """Runs EM on the accepted readings, publishes the maps and keeps them. The executor owns it.

    Attributes
    ----------
    maps : MapSet or None
        Of the latest run since the last reset.
    found_trajectory : FoundTrajectory or None
        Trajectory of the maps; None if none was estimated.
    accepted_at_run : int
        Number of readings that had been accepted when the run began.
    last_run : str
        How the last run ended.
    wrong_input : list of str
        Faults of the readings of the latest run.
    drive_faults : list of str
        Those of them that are faults of the odometry of the drive.
    sensors : SensorWatch
    online : OnlineWorker or None
        Gives the map to start from, and receives the result.
    range_topics : sequence of str
        Full names, for messages, as is `odom_topic`.
    clock_notes : callable
        Returns warnings about stamps of sensors that differ from those of odometry.
    no_map_frame : callable
        Returns the fault that keeps odometry out of the map frame, in words, or ''.
    extrinsics : callable
        Returns the poses of the sensors that are fixed to the robot, by frame.
    mounts : callable
        The same, including sensors that have not sent yet.
    restored_mounts : callable
        Returns the poses with which the readings of a journal were placed, as far as they are known.
    """

    def __init__(
        self,
        parameters: Callable[[], Parameters],
        associator: PoseAssociator,
        trajectory: Trajectory,
        publishers: MapPublishers,
        inbox: Inbox,
        kernels: Kernels,
        logger: Any,
    ) -> None:
        self.maps: MapSet | None = None
        self.found_trajectory: FoundTrajectory | None = None
        self.accepted_at_run = 0
        self.last_run = 'none yet'
        self.wrong_input: list[str] = []
        self.drive_faults: list[str] = []
        self.sensors = SensorWatch()
        self.online: OnlineWorker | None = None
        self.range_topics: Sequence[str] = ()
        self.odom_topic = ''
        self.clock_notes: Callable[[], list[str]] = list
        self.no_map_frame: Callable[[], str] = str
        self.extrinsics: Callable[[], Mapping[str, Pose2]] = dict
        self.mounts: Callable[[], Mapping[str, Pose2]] = dict
        self.restored_mounts: Callable[[], Mapping[str, Pose2]] = dict
        self._parameters, self._associator, self._publishers = parameters, associator, publishers
        self._trajectory = trajectory
        self._inbox, self._kernels, self._logger = inbox, kernels, logger
        self._watched = self._logged = 0.0
        self._generation = 0
        self.worker = EmWorker(self._watch, logger.error, inbox.put, self._wait_for_kernels)
        # a check takes seconds and cannot be cancelled, and the next run must not wait for it
        self.check_worker = Worker('consistency check', logger.error)
        self._consistency = ConsistencyCheck(self.check_worker, inbox)

    @property
    def current(self) -> Run | None:
        """The current run, or None."""
        return self.worker.current

    def run_em(self, reply: Reply) -> None:
        """Answer the service."""
        begin = time.monotonic()

        def done(outcome: Outcome) -> None:
            if outcome.maps is None:
                reply.send(False, outcome.message)
            else:
                spent = time.monotonic() - begin
                waited = min(outcome.waited, spent)
                compiled = f'after {waited:.0f} s of compiling kernels, as at the first start'
                # the log and /diagnostics have named faults of messages before
                of_messages = [*self._associator.message_warnings(), *self._associator.rejection_warnings()]
                warnings = [*outcome.warnings, *of_messages]
                result = summary(outcome.maps, spent - waited, bool(warnings))
                said = [result, compiled if waited >= LONG_WAIT else '']
                warned = [f'WARNING: {warning}' for warning in warnings]
                reply.send(True, '; '.join(filter(None, [*said, outcome.trajectory, *warned])))

        run = self.current
        if (run is None or run.by_itself) and not all(map(self._kernels.has, self._kernel_steps())):
            self._logger.info('run_em waits for the compilation of kernels, as at the first start')
        if run is None:
            self._start(done)
        elif run.by_itself and run.uses_all_readings() and not run.cancelled:
            # it now has a caller
            run.by_itself = False
            run.callers.append(done)
        elif run.by_itself:
            self._replace(run, done)
        else:
            reply.send(False, f'EM is already running ({run}); call run_em again when it has ended')

    def run_by_itself(self) -> bool:
        """Begin a run without a caller; return False if there is a current run, or if there are no readings."""
        if self.current is not None or not len(self._associator.buffer):
            return False
        run = self._start()
        run.by_itself = True
        run.at_end.append(lambda outcome: self._begin_replacement(run))
        return True

    def _replace(self, run: Run, done: Callable[[Outcome], object]) -> None:
        """Cancel a run without a caller, and begin another one after it."""
        run.by_itself = False
        if not run.cancelled:
            # callers that wait for it, such as save_maps, wait for the other one
            run.next_callers += run.callers
            run.callers.clear()
        run.next_callers.append(done)
        self.worker.cancel()

    def _begin_replacement(self, run: Run) -> None:
        """After a cancelled run, begin the run that replaces it, if any."""
        if not run.next_callers:
            return
        try:
            self._start(*run.next_callers)
        except Exception as error:
            _fail_all(run.next_callers, f'EM cannot begin: {reason(error)}')
            raise
        run.next_callers.clear()

    def cancel(self, reply: Reply) -> None:
        """Cancel the current run, keep readings and maps, and answer after its end."""
        run = self.current
        if run is None:
            reply.send(False, 'EM is not running: there is nothing to cancel')
            return

        def ended(outcome: Outcome) -> None:
            if outcome.maps is not None:
                reply.send(False, 'EM ended before it could be cancelled; its maps are published')
            else:
                rest = 'were deleted' if outcome.message == BY_RESET else 'are kept'
                reply.send(True, f'{outcome.message} (after {run.seconds:.1f} s); readings and earlier maps {rest}')

        run.cancel_requested = True
        run.callers.append(ended)
        _fail_all(run.next_callers, 'EM was cancelled by cancel_em')
        self.worker.cancel()

    def when_there_are_maps(self, done: Callable[[Outcome], object]) -> None:
        """Have `done` called with the latest maps: at once, after the current run, or after a new run."""
        run = self.current
        if run is not None and run.trajectory_adopted:
            # the live map is along its trajectory, the latest maps are not
            run.callers.append(done)
        elif self.maps is not None:
            done(Outcome(self.maps, ''))
        elif run is not None and not run.cancelled:
            run.callers.append(done)
        elif run is not None and run.next_callers:
            run.next_callers.append(done)
        elif run is not None:
            done(Outcome(None, 'EM is being cancelled; call again when it has ended'))
        else:
            self._start(done)

    def reset(self) -> None:
        """Forget the maps, and cancel the current run."""
        self.worker.cancel()
        if self.current is not None:
            _fail_all(self.current.next_callers, BY_RESET)
        self._generation = self._publishers.generation
        self.maps, self.found_trajectory, self.last_run = None, None, 'none since the reset'
        self.wrong_input, self.drive_faults = [], []
        self.sensors.clear()
        self._consistency.forget()

    def close(self, seconds: float) -> None:
        """Cancel the current run, and wait at most this many seconds for its end; a check may go on after that."""
        self.check_worker.close(0.0)
        self.worker.close(seconds)

    def _start(self, *callers: Callable[[Outcome], object]) -> Run:
        """Begin a run, and have callers called with its outcome."""
        generation, parameters = self._publishers.generation, self._parameters()
        compiled = all(map(self._kernels.has, self._kernel_steps()))
        mounts, restored = self.mounts(), self.restored_mounts()
        data = RunInput(self._associator, self._inbox, mounts, compiled, lambda: run.cancelled, restored)

        def on_maps(maps: MapSet) -> None:
            if isinstance(mapper, RefiningMapper) or in_map_frame:
                # the transform from the map frame changes together with the maps
                self._inbox.put(lambda: self._adopt_and_show(run, maps, data.accepted, generation))
            else:
                self._show(maps, generation)

        def finish(outcome: Outcome) -> None:
            # all callers get the same outcome
            if generation != self._publishers.generation:
                outcome.maps, outcome.message = None, BY_RESET
            elif outcome.maps is None:
                why = self._why_no_maps(run, data)
                outcome.message, outcome.replaced = why or outcome.message, why == REPLACED
            if outcome.maps is not None:
                self._keep(outcome, outcome.maps, data.accepted)
                return
            if run.map_shown:
                self._publishers.publish('ml_map', generation, *before)
            self._report_failure(outcome)

        def find_faults() -> list[str]:
            # with a refined trajectory, its own words say what became of jumps
            found = mapper.found_trajectory if isinstance(mapper, RefiningMapper) else None
            return [] if found and found.refinement else jump_warnings(data.odometry)

        mapper = self._trajectory.mapper(parameters, data.drive, data.drive_so_far)
        in_map_frame = self._trajectory.in_map_frame
        start = self.online.so_far() if self.online and self._trajectory.correction is None else None
        # intermediate maps are shown meanwhile; if the run ends without a map, this one is published again
        before = self._publishers.ml_map
        run = Run(mapper, parameters, data.readings, on_maps, start, find_faults=find_faults)
        run.uses_all_readings = lambda: data.uses_all_readings and parameters is self._parameters()
        self._generation = generation
        self.worker.start(run, finish)
        run.callers.extend(callers)
        return run

    def _show(self, maps: MapSet, generation: int) -> None:
        """Publish the maps of a run; may be called from any thread."""
        self._publishers.publish('ml_map', generation, maps.grid, maps.ml)
        self._publishers.publish('uncertainty_map', generation, maps.grid, maps.uncertainty)

    def _adopt_and_show(self, run: Run, maps: MapSet, count: int, generation: int) -> None:
        """Use the trajectory of a run, and publish its maps."""
        if generation == self._publishers.generation:
            run.trajectory_adopted = True
            found = run.mapper.found_trajectory if isinstance(run.mapper, RefiningMapper) else None
            self._trajectory.adopt(found, count)
            self._show(maps, generation)

    def _kernel_steps(self) -> tuple[str, ...]:
        """Return the steps of compilation that a run needs."""
        return ('EM', 'trajectory') if self._parameters().node.refine_poses else ('EM',)

    def _wait_for_kernels(self, stop: Callable[[], bool]) -> None:
        for step in self._kernel_steps():
            self._kernels.wait(step, stop)

    def _why_no_maps(self, run: Run, data: RunInput) -> str:
        """Return the reason why a run ended without maps, if the run itself cannot know it; otherwise ''."""
        if run.cancel_requested:
            return 'EM was cancelled by cancel_em'
        if data.empty:
            return nothing_to_map(self._associator, self.range_topics, self.odom_topic, self.no_map_frame())
        return REPLACED if run.next_callers else ''

    def _report_failure(self, outcome: Outcome) -> None:
        self.last_run = outcome.message
        text = outcome.message if outcome.message.startswith('EM ') else f'EM: {outcome.message}'
        # rclpy raises if one place in the code logs with two severities
        if outcome.replaced:
            # a call that replaces a run of the node itself is no fault
            self._logger.info(text)
        else:
            self._logger.warning(text)
        if self.online:
            # maps that it made during EM were not published
            self.online.show()

    def _keep(self, outcome: Outcome, maps: MapSet, count: int) -> None:
        """Keep the maps of a run, log its result, and begin the checks that take longer."""
        self.maps, self.found_trajectory, self.accepted_at_run = maps, self._trajectory.found_trajectory, count
        outcome.warnings += self.clock_notes()
        self.wrong_input, self.drive_faults = outcome.warnings, outcome.drive_faults
        self.sensors.take(outcome.health)
        if self.online:
            self.online.adopt(maps)
        for warning in filter(None, [*outcome.warnings, quality_warning(maps, bool(outcome.warnings))]):
            self._logger.warning(f'EM: {warning}')
        outcome.trajectory = self._trajectory.outcome()
        spent = sum(maps.statistics['seconds'].values())
        said = filter(None, [summary(maps, spent, bool(outcome.warnings)), outcome.trajectory])
        self.last_run = '; '.join(said)
        self._logger.info(f'EM: {self.last_run}')
        # callers of EM are answered before this
        refined = self._trajectory.correction is not None
        self._add_faults(self._consistency.warnings(maps, dict(self.extrinsics()), refined, self._warn))

    def _warn(self, found: list[str]) -> None:
        self._add_faults(found)
        for warning in found:
            self._logger.warning(f'EM: {warning}')

    def _add_faults(self, found: list[str]) -> None:
        self.wrong_input = [*self.wrong_input, *found]

    def _watch(self, run: Run) -> None:
        """Log progress and publish the map found so far, at most `publish_rate` times a second; in the run's thread."""
        now = time.monotonic()
        rate = self._parameters().node.publish_rate
        if run.progress is None:
            if now - max(self._logged, run.begin) > LOG_PERIOD:
                self._logged = now
                self._logger.info(f'EM: {run}')
            return
        if now - max(self._watched, run.begin) < 1.0 / rate:
            return
        self._watched = now
        generation = self._generation
        if run.cancelled:
            return
        self._logger.info(f'EM: {run}')
        if found := run.mapper.so_far():
            run.map_shown = True
            self._publishers.publish('ml_map', generation, *found)
