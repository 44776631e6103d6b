"""The node: connects subscriptions, the associator, the maps, EM and files.

The executor's thread owns the state, and does only short work: long work, on all readings or on a whole map, is done by
workers (`background`), which return their results through an inbox.
"""

from __future__ import annotations

import gc
from collections.abc import Callable
from functools import partial
from typing import Any

from rclpy.clock import Clock, ClockType
from std_srvs.srv import SetBool, Trigger

from ..core.common.errors import MapperError, ParameterError
from ..core.common.parameters import Parameters
from ..core.common.words import counted
from ..core.messages.message_types import NANOSECONDS
from ..core.messages.pose_association import PoseAssociator
from ..files.output_folder import unwritable
from ..files.parameter_file import NODE_NAME
from . import ros_parameters
from .background import Inbox, Worker
from .deferred import DeferredService, Reply, answered
from .diagnostics import Health
from .em_service import EmService
from .error_explanations import explain_ros_error
from .feeding import Feed
from .following import Following
from .frames import MapFrame, TfExtrinsics, Transforms
from .intake import AT_ONCE, Intake
from .journal_keeper import JournalKeeper
from .kernels import Kernels
from .managed import CLEANED_UP, ManagedNode
from .map_publishers import MapPublishers
from .reporter import Reporter
from .saver import Account, Saver
from .trajectory import Trajectory

FEED_PERIOD = 0.1
"""Longest time between two transfers of readings to the maps, seconds. Each wakes the executor, which takes time even
if there is nothing to do."""


class MapperNode(ManagedNode):
    """Maps readings. All callbacks run in one thread, and none does long work.

    Attributes
    ----------
    parameters : Parameters
        The current ones.
    mapping : bool
        Whether readings are mapped; before, those of an earlier run are restored, and messages are held back.
    workers : list of Worker
        All that work in the background.
    failure : str
        The reason why the node cannot continue; '' while it can.
    when_failed : callable
        Called by the executor when `failure` is set.
    """

    def __init__(self, **options: Any) -> None:
        """Declare the parameters; `start`, or a lifecycle manager, configures and activates the node.

        Raises
        ------
        ParameterError
            If a parameter given at start is not valid.
        """
        # undeclared ones for poses of further sensors; the validator refuses all others
        super().__init__(
            NODE_NAME,
            automatically_declare_parameters_from_overrides=True,
            allow_undeclared_parameters=True,
            **options,
        )
        self.parameters, _, warnings = ros_parameters.declare(self)
        for warning in warnings:
            self.get_logger().warning(warning)
        self.add_pre_set_parameters_callback(ros_parameters.with_points)
        self.add_on_set_parameters_callback(self._validator())
        self.failure = ''
        self.when_failed: Callable[[], object] = lambda: None
        self._steady = Clock(clock_type=ClockType.STEADY_TIME)
        self._begin_anew()
        self._own = frozenset(vars(self))

    def _begin_anew(self) -> None:
        self._started = self.mapping = False
        self._when_ready: list[Callable[[], None]] = []
        self._missing = {'journal', 'kernels'}
        self.workers: list[Worker] = []
        self._calls: list[DeferredService] = []
        self._ends: list[Callable[[], object]] = []

    def configure(self) -> None:
        """Create topics and services, restore the journal, and compile; messages are received once the node is active.

        Raises
        ------
        MapperError
            If a parameter is not valid for the system, or the journal cannot be opened.
        """
        self._begin_anew()
        ranges, odometry = self._topics()
        self._make_frames()
        self._make_maps()
        self._make_em(ranges, odometry)
        self._make_intake()
        self._offer_services()
        self._begin()

    def _topics(self) -> tuple[list[str], str]:
        """Return the full names of the topics of Range and odometry."""
        node, log = self.parameters.node, self.get_logger()
        odometry = self._resolved('odom_topic', node.odom_topic)
        ranges = [self._resolved('range_topics', topic) for topic in node.range_topics]
        for topic in {topic for topic in ranges if ranges.count(topic) > 1}:
            log.warning(f'range_topics has {topic} {ranges.count(topic)} times; its readings are used once')
        if not ranges:
            raise MapperError('range_topics is empty; set it to one or more topics of sensor_msgs/Range')
        if odometry in ranges:
            raise MapperError(
                f'{odometry} cannot be a topic of both Range and odometry: set range_topics or odom_topic'
            )
        return list(dict.fromkeys(ranges)), odometry

    def _make_frames(self) -> None:
        node, transforms = self.parameters.node, Transforms.of(self)
        # with refine_poses this node publishes the transform
        looked_up = '' if node.refine_poses else node.map_frame
        if looked_up and not transforms.available:
            raise MapperError(f'map_frame is {node.map_frame}, but tf2_ros is not installed to look it up')
        self._transforms, self._extrinsics = transforms, TfExtrinsics(ros_parameters.mounts(self), transforms)
        self._map_frame = MapFrame(looked_up, transforms, self.parameters.association.pose_timeout)
        self._poses_from = 'parameters and TF' if transforms.available else 'parameters (tf2_ros is not installed)'

    def _make_maps(self) -> None:
        """Make what maps each reading: the associator, the trajectory and the maps that are always up to date."""
        node, log = self.parameters.node, self.get_logger()
        self.associator = PoseAssociator(self._extrinsics, self.parameters, at_once=AT_ONCE)
        inbox = self.inbox = Inbox(self)
        kernels = self.kernels = Kernels(log.info, log.error, node.online, node.refine_poses)
        self.trajectory = trajectory = Trajectory(self, self.associator, self._steady)
        self.maps = MapPublishers(self, self.parameters.grid.resolution, lambda: trajectory.frame, self._up_to_date)
        self._ends.append(partial(self.maps.worker.close, 0.5))
        trajectory.publishing_worker = self.maps.worker
        if node.online:
            trajectory.following = Following(log, inbox, trajectory.follow)
            self._ends.append(partial(trajectory.following.close, 2.0))
        trajectory.begin()
        feed = self.feed = Feed(lambda: self.parameters, self.associator, trajectory, self.maps, inbox, kernels, log)
        # the maps wait for kernels
        self._ends += [feed.close, kernels.release]
        trajectory.on_change = feed.replace
        self.live, self.online = feed.live, feed.online

    def _make_em(self, ranges: list[str], odometry: str) -> None:
        log, trajectory, extrinsics = self.get_logger(), self.trajectory, self._extrinsics
        em = self.em = EmService(
            lambda: self.parameters, self.associator, trajectory, self.maps, self.inbox, self.kernels, log
        )
        self._ends.append(partial(em.close, 2.0))
        # during EM, its intermediate maps are shown
        self.feed.shows_online = lambda: em.current is None
        trajectory.request_run = lambda: self.mapping and em.run_by_itself()
        em.range_topics, em.odom_topic = ranges, odometry
        em.no_map_frame = lambda: self._map_frame.lack
        em.extrinsics, em.mounts = lambda: extrinsics.fixed, lambda: extrinsics.known
        em.online = self.online
        folder = self.parameters.node.save_directory
        if why := unwritable(folder):
            log.warning(f'save_maps will fail: {why}; set save_directory to a folder that can be written')
        self.saver = Saver(em, self.live, self._account, log)

    def _make_intake(self) -> None:
        """Make what receives readings and keeps them, and the reporter, which watches all parts."""
        following = self.trajectory.following
        self._readings_worker = Worker('readings', self.get_logger().error)
        self._ends += [partial(part.close, 0.5) for part in (self.saver, self._readings_worker)]
        extrinsics = self._extrinsics
        self.journal = JournalKeeper(self, self.parameters.node.journal, self.associator, lambda: extrinsics.used)
        self.em.restored_mounts = lambda: self.journal.restored_mounts
        em = self.em
        self.workers = [self._readings_worker, self.live.worker, self.maps.worker, em.worker.worker, em.check_worker]
        self.workers += [part.worker for part in (self.saver, self.online, following, self.kernels) if part]
        health = Health()
        self.intake = Intake(self, self.parameters, self.associator, self._map_frame, health.taken)
        self.em.clock_notes = self.intake.clock_notes
        self.trajectory.listening = lambda: self.intake.listening
        self.reporter = Reporter(
            self,
            health,
            self.intake,
            self.associator,
            (self._extrinsics, self._map_frame, self._transforms),
            self.live,
            self.em,
            self.journal,
            self.trajectory,
            self.kernels,
            self.workers,
        )

    def _offer_services(self) -> None:
        for name, handler in (
            ('~/run_em', self.em.run_em),
            ('~/cancel_em', self.em.cancel),
            ('~/save_maps', self.saver.save_maps),
            ('~/reset', self.reset),
        ):
            self._calls.append(DeferredService(self, Trigger, name, partial(self._answer_when_ready, handler)))
        self._calls += [DeferredService(self, SetBool, '~/pause', self.pause), *self.maps.services]
        self.create_timer(1.0, self.reporter.report, clock=self._steady)
        rate = self.parameters.node.publish_rate
        self._live_timer = self.create_timer(1.0 / rate, self.publish_live, clock=self._steady)

    def _begin(self) -> None:
        """Restore the journal, and compile, in the background."""
        inbox, before_thinning = self.inbox, self.associator.buffer.before_thinning
        # a journal that is still being read must not add readings to the next configuration
        self._ends.append(before_thinning.clear)
        # closed first, since other work may take as long as `stopping.GRACE`
        self._ends.append(self.journal.close)
        self.journal.open()
        self._started = True
        # the live map contains every reading, also those that max_readings removes
        before_thinning.append(self.feed.feed)
        self.kernels.begin(lambda: inbox.put(lambda: self._step_done('kernels')))
        self._readings_worker.put(
            partial(self._restore, self.journal, inbox), lambda why: inbox.put(lambda: self._fail(why))
        )

    def _resolved(self, parameter: str, topic: str) -> str:
        """Return the full name of a topic given as a parameter."""
        try:
            return str(self.resolve_topic_name(topic))
        except Exception as error:  # a class of rclpy's C extension
            raise MapperError(f'{parameter}: {topic!r} is not a valid topic name: {explain_ros_error(error)}') from None

    def activate(self) -> None:
        """Receive messages; they are mapped as soon as the node is ready."""
        self.intake.subscribe()
        node = self.parameters.node
        self.get_logger().info(
            f'listening: Range from {", ".join(self.em.range_topics)} ({node.range_reliability}), odometry from '
            f'{self.resolve_topic_name(node.odom_topic)}, sensor poses from {self._poses_from}'
        )

    def deactivate(self) -> None:
        """Stop receiving messages; maps and services remain."""
        self.intake.unsubscribe()
        self.get_logger().info('inactive: nothing is received; maps and services stay')

    def close(self, why: str = CLEANED_UP) -> None:
        """End the work in the background, also of a configuration that failed; failures are logged."""
        self._started = self.mapping = False
        calls, ends = self._calls, self._ends
        self._calls, self._ends = [], []
        self._when_ready.clear()
        # the last one first; compilation is finished in any case, for the next configuration
        for end in reversed(ends):
            self._attempt(end)
        # calls that wait will get no result
        for service in calls:
            self._attempt(partial(service.end, why))

    def _undo(self, why: str = CLEANED_UP) -> None:
        super()._undo(why)
        for name in vars(self).keys() - self._own - {'_own'}:
            delattr(self, name)
        # `Kernels` froze the existing objects, and the collector ignores frozen ones
        gc.unfreeze()
        gc.collect()

    # the start

    def _restore(self, journal: JournalKeeper, inbox: Inbox) -> None:
        journal.restore()
        inbox.put(lambda: self._step_done('journal'))

    def _fail(self, why: str) -> None:
        self.failure = why
        self.when_failed()

    def _step_done(self, what: str) -> None:
        """Begin to map once the earlier readings are restored; log it once the live map has its kernels as well."""
        if what == 'journal':
            self.associator.buffer.run_in_background = self._thin_in_background
            self.journal.begin(self._steady)
            self.create_timer(FEED_PERIOD, self.feed.feed, clock=self._steady)
            self.intake.begin()
            self._map()
        self._missing.discard(what)
        if not self._missing:
            then = '' if self.intake.listening else '; activate the node to receive them'
            self.get_logger().info(f'ready: the live map is updated with the readings{then}')

    def _map(self) -> None:
        """Answer waiting calls after the messages held back are processed."""
        if self.intake.busy:
            self.inbox.put(self._map)
            return
        self.mapping = True
        for work in self._when_ready:
            # if one fails, the others are still answered
            self.inbox.put(work)
        self._when_ready.clear()

    def _answer_when_ready(self, handler: Callable[[Reply], None], reply: Reply) -> None:
        """Answer a service once the earlier readings are restored."""
        if self.mapping:
            handler(reply)
        else:
            self._when_ready.append(lambda: answered(handler, reply, self.get_logger().error))

    def _thin_in_background(self, thin: Callable[[], Any], done: Callable[[Any], None]) -> None:
        # that of this configuration, which may have ended when the work is done
        inbox = self.inbox

        def work() -> None:
            thinned = thin()
            inbox.put(lambda: done(thinned))

        self._readings_worker.put(work, lambda why: inbox.put(lambda: done(None)))

    # parameters

    def _validator(self) -> Callable[[Any], Any]:
        return ros_parameters.validator(
            lambda: self.parameters, self._accept, lambda: self._started, self.has_parameter
        )

    def _accept(self, parameters: Parameters) -> None:
        refine = self.parameters.node.refine_poses, parameters.node.refine_poses
        if self._started and parameters.node.map_frame and refine[0] != refine[1]:
            raise ParameterError(
                'map_frame is set, and refine_poses decides which node publishes its transform: restart the node to '
                'change refine_poses'
            )
        before, self.parameters = self.parameters, parameters
        if not self._started:
            return
        self.associator.change(parameters)
        self._map_frame.timeout = parameters.association.pose_timeout
        self.live.change(parameters)
        if self.online:
            self.online.change(parameters)
            if (parameters.model, parameters.search) != (before.model, before.search):
                if self.mapping:
                    self.feed.restart_online()
                else:
                    self._when_ready.append(self.feed.restart_online)
        if parameters.node.publish_rate != before.node.publish_rate:
            self._live_timer.timer_period_ns = round(NANOSECONDS / parameters.node.publish_rate)
            # otherwise the old period ends first
            self._live_timer.reset()

    # maps

    def publish_live(self) -> None:
        """Have the live map published if it has changed."""
        if self.mapping:
            self.feed.publish()
            self.maps.refresh()

    def _up_to_date(self, name: str, answer: Callable[[], None], failed: Callable[[str], object]) -> None:
        """Call `answer` once a map contains all readings, if it is the live map; otherwise at once."""
        if name == 'live_map' and self.mapping:
            self.feed.when_up_to_date(answer, failed)
        else:
            answer()

    # services

    def reset(self, reply: Reply) -> None:
        """Forget readings and maps; answer the service."""
        forgotten = len(self.associator.buffer)
        # also readings since its last check
        self.journal.take()
        self.associator.clear(self.parameters)
        self._extrinsics.forget()
        self.intake.forget()
        kept = self.journal.reset()
        # late subscribers must not get maps that were forgotten
        self.trajectory.begin()
        self.maps.clear()
        self.em.reset()
        self.feed.reset()
        reply.send(True, f'{counted(forgotten, "reading")} and all maps were deleted{kept}')

    def pause(self, reply: Reply) -> None:
        """Pause or continue mapping; answer the service."""
        self.intake.paused = paused = bool(reply.request.data)
        reply.send(True, 'readings are ignored until pause is called with false' if paused else 'mapping')

    def _account(self) -> Account:
        """Return the state of the node for a report."""
        associator, node, name = self.associator, self.parameters.node, self.get_fully_qualified_name()
        self.feed.feed()
        source = {
            'node': name,
            'range_topics': list(self.em.range_topics),
            'odom_topic': self.resolve_topic_name(node.odom_topic),
            'odom_frame': associator.map_frame,
            'map_frame': self.trajectory.frame,
            'base_frame': associator.base_frame,
            'extrinsics': self._extrinsics.fixed,
            'counts': {
                'received': self.intake.received,
                'accepted': len(associator.buffer),
                'waiting': self.intake.waiting,
                'rejected': dict(associator.rejected),
                'lost': self.intake.lost,
            },
            'warnings': [
                *associator.message_warnings(),
                *self.intake.loss_note(),
                *self.intake.repeated(),
                *self.intake.clock_notes(),
                *self.em.drive_faults,
                *associator.rejection_warnings(),
            ],
        }
        path, odometry = list(associator.path), associator.odometry
        return Account(source, len(associator.buffer), path, odometry, node.save_directory, f'Maps of {name}')
