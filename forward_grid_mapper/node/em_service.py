"""EM as the node's callers see it: the service run_em, and the maps of the latest run."""

from __future__ import annotations

import queue
import threading
import time
from collections.abc import Callable, Mapping, Sequence
from contextlib import suppress
from typing import Any

from ..core.common.errors import Cancelled
from ..core.common.parameters import Parameters
from ..core.common.readings import Readings
from ..core.learning.consistency import consistency_warnings
from ..core.maps.map_set import MapSet
from ..core.messages.message_types import Pose2
from ..core.messages.pose_association import PoseAssociator
from ..core.messages.reading_buffer import bounded
from ..core.trajectory.recovering import recovered
from ..core.trajectory.windows import Odometry
from ..files.quality_warning import quality_warning
from .background import Inbox, reason
from .deferred import Reply
from .em import EmWorker, Outcome, Run, summary
from .kernels import Kernels
from .map_publishers import MapPublishers
from .nothing_to_map import nothing_to_map
from .online import OnlineWorker
from .refining import Drive, Found, RefiningMapper
from .sensor_status import SensorWatch
from .trajectory import Trajectory

ITS_OWN = 2
"""Those who wait for the end of a run on its own account, before all others."""

TELLING = 10.0
"""Seconds between two lines in the log while a trajectory is looked for."""

LONG_WAIT = 0.5
"""Seconds of waiting for kernels that a caller is told of."""

Taken = tuple[int, Readings, Any]
"""Number of readings accepted, those that are held, and stamps and poses of odometry."""


def _waited_for(taken: queue.SimpleQueue[Taken | Exception], run: Run) -> Taken:
    """Return what the executor takes for a run, or raise what it met, unless this is cancelled."""
    while True:
        if run.cancelled:
            raise Cancelled('cancelled before it began')
        with suppress(queue.Empty):
            found = taken.get(timeout=0.1)
            if isinstance(found, Exception):
                raise found
            return found


def _tell_all(waiting: list[Callable[[Outcome], object]], why: str) -> None:
    """Tell those who wait for a run that it does not begin."""
    told = list(waiting)
    waiting.clear()
    for done in told:
        done(Outcome(None, why))


class EmService:
    """Runs EM on what was accepted so far, and publishes and keeps what it finds. The executor owns it.

    Attributes
    ----------
    maps : MapSet or None
        Of the latest run since the last reset.
    found : Found or None
        What became of their trajectory; None where none was looked for.
    explained : int
        Readings that had been accepted when it began.
    last_run : str
        How the last run ended.
    wrong_input : list of str
        What is wrong with its readings.
    sensors : SensorWatch
    online : OnlineWorker or None
        Gives the map to start from, and takes what was found.
    range_topics : sequence of str
        Full names, for what is said where nothing has come, as `odom_topic`.
    no_map_frame : callable
        Returns what keeps odometry out of the map frame, in words, or ''.
    extrinsics : callable
        Returns the poses of the sensors that are fixed to the robot, by frame.
    mounts : callable
        The same, with those of sensors that were not heard of yet.
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
        self.found: Found | None = None
        self.explained = 0
        self.last_run = 'none yet'
        self.wrong_input: list[str] = []
        self.sensors = SensorWatch()
        self.online: OnlineWorker | None = None
        self.range_topics: Sequence[str] = ()
        self.odom_topic = ''
        self.no_map_frame: Callable[[], str] = str
        self.extrinsics: Callable[[], Mapping[str, Pose2]] = dict
        self.mounts: Callable[[], Mapping[str, Pose2]] = dict
        self._parameters, self._associator, self._publishers = parameters, associator, publishers
        self._trajectory = trajectory
        self._inbox, self._kernels, self._logger = inbox, kernels, logger
        self._watched = self._told = 0.0
        self._generation = 0
        self.worker = EmWorker(self._watch, logger.error, inbox.put, self._wait_for_kernels)

    @property
    def current(self) -> Run | None:
        """The run that goes on, or None."""
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
                said = [summary(outcome.maps, spent - waited), compiled if waited >= LONG_WAIT else '']
                warned = [f'WARNING: {warning}' for warning in outcome.warnings]
                reply.send(True, '; '.join(filter(None, [*said, outcome.trajectory, *warned])))

        run = self.current
        if (run is None or run.by_itself) and not all(map(self._kernels.has, self._needed())):
            self._logger.info('run_em waits for the compilation of kernels, as at the first start')
        if run is None:
            self._start(done)
        elif run.by_itself and run.fresh() and not run.cancelled:
            # from here on it is one that was asked for
            run.by_itself = False
            run.waiting.append(done)
        elif run.by_itself:
            self._give_way(run, done)
        else:
            reply.send(False, f'EM is already running ({run}); call run_em again when it has ended')

    def run_by_itself(self) -> bool:
        """Begin a run that nobody asked for; return whether it began: not while one goes on, nor without readings."""
        if self.current is not None or not len(self._associator.buffer):
            return False
        run = self._start(lambda outcome: self._go_on(run))
        run.by_itself = True
        return True

    def _give_way(self, run: Run, done: Callable[[Outcome], object]) -> None:
        """End a run that nobody asked for, and have another one begin then."""
        run.by_itself = False
        if not run.cancelled:
            # who waited for it, as save_maps does, waits for the other one
            run.then += run.waiting[ITS_OWN:]
            del run.waiting[ITS_OWN:]
        run.then.append(done)
        self.worker.cancel()

    def _go_on(self, run: Run) -> None:
        """Begin the run that one which has ended gave way to, if it did."""
        if not run.then:
            return
        first, *others = run.then
        try:
            self._start(first).waiting.extend(others)
        except Exception as error:
            _tell_all(run.then, f'EM cannot begin: {reason(error)}')
            raise
        run.then.clear()

    def cancel(self, reply: Reply) -> None:
        """Cancel the run that goes on, forget nothing, and answer when it has ended."""
        run = self.current
        if run is None:
            reply.send(False, 'EM is not running: there is nothing to cancel')
            return

        def ended(outcome: Outcome) -> None:
            if outcome.maps is not None:
                reply.send(False, 'EM ended before it could be cancelled; its maps are published')
            else:
                reply.send(True, f'{outcome.message} (after {run.seconds:.1f} s); readings and earlier maps are kept')

        run.asked = True
        run.waiting.append(ended)
        _tell_all(run.then, 'EM was cancelled by cancel_em')
        self.worker.cancel()

    def when_there_are_maps(self, done: Callable[[Outcome], object]) -> None:
        """Have `done` called with the latest maps: at once, when the run that goes on has ended, or after a new one."""
        run = self.current
        if self.maps is not None:
            done(Outcome(self.maps, ''))
        elif run is not None and not run.cancelled:
            run.waiting.append(done)
        elif run is not None and run.then:
            run.then.append(done)
        elif run is not None:
            done(Outcome(None, 'EM is being cancelled; call again when it has ended'))
        else:
            self._start(done)

    def reset(self) -> None:
        """Forget the maps, and cancel the run that goes on."""
        self.worker.cancel()
        if self.current is not None:
            _tell_all(self.current.then, 'EM was cancelled by reset')
        self._generation = self._publishers.generation
        self.maps, self.found, self.wrong_input, self.last_run = None, None, [], 'none since the reset'
        self.sensors.clear()

    def close(self, seconds: float) -> None:
        """Cancel the run that goes on, and wait so long for its end."""
        self.worker.close(seconds)

    def _start(self, done: Callable[[Outcome], object]) -> Run:
        """Begin a run; `done` is called with how it ended, before others who come to wait for it."""
        generation, bound = self._publishers.generation, self._associator.buffer.bound
        # what comes while kernels are compiled is mapped as well
        early = not all(map(self._kernels.has, self._needed()))
        taken, begun = [self._take()], threading.Event()

        def take_now() -> Taken:
            asked = queue.SimpleQueue[Taken | Exception]()

            def take() -> None:
                try:
                    asked.put(self._take())
                except Exception as error:
                    # the run would wait for ever
                    asked.put(error)

            self._inbox.put(take)
            return _waited_for(asked, run)

        def readings() -> Readings:
            begun.set()
            if early:
                taken[0] = take_now()
            return bounded(taken[0][1], bound)

        def found(maps: MapSet) -> None:
            if isinstance(mapper, RefiningMapper) or moved:
                # the transform to the map changes together with the maps
                self._inbox.put(lambda: self._show_moved(maps, mapper, taken[0][0], generation))
            else:
                self._show(maps, generation)

        def finish(outcome: Outcome) -> None:
            # whoever waits is told the same
            if generation != self._publishers.generation:
                outcome.maps, outcome.message = None, 'EM was cancelled by reset'
            elif outcome.maps is None and run.asked:
                outcome.message = 'EM was cancelled by cancel_em'
            elif outcome.maps is None and not len(taken[0][1]):
                lack = self.no_map_frame()
                outcome.message = nothing_to_map(self._associator, self.range_topics, self.odom_topic, lack)
            elif outcome.maps is None and run.then:
                outcome.message = 'the run that the node began by itself (refine_every) was replaced by run_em'
            self._finish(outcome, taken[0][0])
            if outcome.maps is None and run.shown:
                self._publishers.publish('ml_map', generation, *before)

        parameters = self._parameters()
        mounts = dict(self.mounts())

        def fresh() -> bool:
            waits = early and not begun.is_set()
            return parameters is self._parameters() and (waits or taken[0][0] == len(self._associator.buffer))

        def drive() -> Drive:
            _, held, odometry = taken[0]
            # after a restart the journal's readings are all there is of the odometry before
            return Drive(recovered(Odometry.of(*odometry), held, mounts), held)

        def now() -> Drive:
            _, held, odometry = take_now()
            return Drive(Odometry.of(*odometry), held)

        mapper, moved = self._trajectory.mapper(parameters, drive, now), self._trajectory.on
        start = self.online.so_far() if self.online and self._trajectory.correction is None else None
        # it comes back if the run ends without a map, since the map so far is shown meanwhile
        before = self._publishers.ml_map
        run = Run(mapper, parameters, readings, found, start, fresh=fresh)
        self._generation = generation
        self.worker.start(run, finish)
        run.waiting.append(done)
        return run

    def _take(self) -> Taken:
        buffer = self._associator.buffer
        return len(buffer), buffer.snapshot(), self._associator.odometry

    def _show(self, maps: MapSet, generation: int) -> None:
        """Publish the maps of a run; any thread."""
        self._publishers.publish('ml_map', generation, maps.grid, maps.ml)
        self._publishers.publish('uncertainty_map', generation, maps.grid, maps.uncertainty)

    def _show_moved(self, maps: MapSet, mapper: Any, count: int, generation: int) -> None:
        """Go on with the trajectory of a run, and publish its maps."""
        if generation == self._publishers.generation:
            self._trajectory.adopt(mapper.found if isinstance(mapper, RefiningMapper) else None, count)
            self._show(maps, generation)

    def _needed(self) -> tuple[str, ...]:
        """Return the steps of compilation that a run waits for."""
        return ('EM', 'trajectory') if self._parameters().node.refine_poses else ('EM',)

    def _wait_for_kernels(self, stop: Callable[[], bool]) -> None:
        for step in self._needed():
            self._kernels.wait(step, stop)

    def _finish(self, outcome: Outcome, count: int) -> None:
        maps = outcome.maps
        if maps is None:
            self.last_run = outcome.message
            self._logger.warning(outcome.message if outcome.message.startswith('EM ') else f'EM: {outcome.message}')
            if self.online:
                # what it showed while EM ran was not published
                self.online.show()
            return
        self.maps, self.found, self.explained = maps, self._trajectory.found, count
        self.wrong_input = outcome.warnings
        self.sensors.take(outcome.health)
        if self.online:
            self.online.adopt(maps)
        for warning in filter(None, [*outcome.warnings, quality_warning(maps)]):
            self._logger.warning(f'EM: {warning}')
        outcome.trajectory = self._trajectory.outcome()
        said = filter(None, [summary(maps, sum(maps.statistics['seconds'].values())), outcome.trajectory])
        self.last_run = '; '.join(said)
        self._logger.info(f'EM: {self.last_run}')
        # whoever called EM has his answer before this
        fixed, generation = dict(self.extrinsics()), self._publishers.generation
        self.worker.worker.put(lambda: self._check_consistency(maps, fixed, generation))

    def _check_consistency(self, maps: MapSet, fixed: Mapping[str, Pose2], generation: int) -> None:
        """Look for poses and stamps that contradict the readings; in the worker's thread."""
        found = consistency_warnings(maps.readings, fixed, maps.parameters)

        def take() -> None:
            if generation == self._publishers.generation and maps is self.maps:
                self.wrong_input = [*self.wrong_input, *found]
                for warning in found:
                    self._logger.warning(f'EM: {warning}')

        if found:
            self._inbox.put(take)

    def _watch(self, run: Run) -> None:
        """Show the map found so far, and the progress, at most `publish_rate` times a second; in the run's thread."""
        now = time.monotonic()
        rate = self._parameters().node.publish_rate
        if run.progress is None:
            if now - max(self._told, run.begin) > TELLING:
                self._told = now
                self._logger.info(f'EM: {run}')
            return
        if now - max(self._watched, run.begin) < 1.0 / rate:
            return
        self._watched = now
        generation = self._generation
        found = run.mapper.so_far()
        if found is not None and not run.cancelled:
            self._logger.info(f'EM: {run}')
            run.shown = True
            self._publishers.publish('ml_map', generation, *found)
