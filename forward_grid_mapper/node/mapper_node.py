"""The node: subscriptions feed the associator, timers publish, services call the core."""

from __future__ import annotations

import threading
import time
from pathlib import Path
from typing import Any

import numpy as np
from diagnostic_msgs.msg import DiagnosticArray
from nav_msgs.msg import OccupancyGrid, Odometry
from nav_msgs.srv import GetMap
from numpy.typing import NDArray
from rclpy.clock import Clock, ClockType
from rclpy.node import Node
from rclpy.qos import DurabilityPolicy, QoSProfile, ReliabilityPolicy
from sensor_msgs.msg import Range
from std_srvs.srv import SetBool, Trigger

from ..core.common.errors import MapperError
from ..core.common.grid import Grid
from ..core.common.parameters import Parameters
from ..core.maps.log_odds_map import LogOddsMap
from ..core.maps.map_set import MapSet
from ..core.messages.message_types import NANOSECONDS, odometry_message, range_message
from ..core.messages.pose_association import MOST_FRAMES, PoseAssociator
from ..files.output_folder import free_name
from ..files.quality_warning import quality_warning, thinned
from ..files.results import write_results
from . import diagnostics, ros_parameters
from .deferred import DeferredService, Reply
from .em import EmWorker, Outcome, Run, summary
from .frames import Extrinsics, MapFrame, Transforms
from .grid_message import grid_message
from .journal_keeper import JournalKeeper
from .online import OnlineWorker
from .sensor_status import SensorWatch
from .surroundings import Surroundings

NAME = 'forward_grid_mapper'
ONLINE_PERIOD = 0.02
"""Seconds between hand-overs of readings to the online map."""

QUEUE = 2000
"""Messages that may wait for the node, so that a pause of a second loses none."""

LATCHED = QoSProfile(depth=1, reliability=ReliabilityPolicy.RELIABLE, durability=DurabilityPolicy.TRANSIENT_LOCAL)
MAPS = ('live_map', 'ml_map', 'uncertainty_map')


class MapperNode(Node):
    """Maps what it receives. All callbacks run in one thread; EM and saving run in others and publish by themselves."""

    def __init__(self, **options: Any) -> None:
        """Declare the parameters; `start` begins to listen.

        Raises
        ------
        ParameterError
            If a parameter given at start is not admitted.
        """
        super().__init__(NAME, automatically_declare_parameters_from_overrides=True, **options)
        self.parameters, extrinsics, warnings = ros_parameters.declare(self)
        for warning in warnings:
            self.get_logger().warning(warning)
        self.add_on_set_parameters_callback(ros_parameters.validator(lambda: self.parameters, self._accept))
        self._given_extrinsics = extrinsics
        self._maps: MapSet | None = None
        self._live = LogOddsMap(self.parameters)
        self._live_count = self._published = self._explained = 0
        self._paused = False
        self._last_run = 'none yet'
        self._wrong_input: list[str] = []
        self._reported: set[str] = set()
        # EM's results count only if nothing was reset since it began; both are published under the lock, so that
        # maps that were forgotten cannot come after the empty ones
        self._generation = self._run_generation = 0
        self._lock = threading.Lock()
        self._saving = threading.Lock()
        self._health = diagnostics.Health()
        self._sensors = SensorWatch()
        self._steady = Clock(clock_type=ClockType.STEADY_TIME)
        self._watched = 0.0
        self._em = EmWorker(self._watch, self.get_logger().error)
        self._online: OnlineWorker | None = None
        self._offered = 0

    def start(self) -> None:
        """Create topics and services; from here on messages are taken."""
        node = self.parameters.node
        transforms = Transforms.of(self)
        self._extrinsics = Extrinsics(self._given_extrinsics, transforms)
        self._map_frame = MapFrame(node.map_frame, transforms, self.parameters.association.pose_timeout)
        if node.map_frame and not transforms.available:
            raise MapperError(f'map_frame is {node.map_frame}, but tf2_ros is not installed to look it up')
        self._associator = PoseAssociator(self._extrinsics, self.parameters)
        # the live map has every reading, also those that max_readings drops
        self._associator.buffer.before_thinning.append(self._update_live)
        self._journal = JournalKeeper(self, node.journal, self._associator, self._steady)
        self._maps_out = {name: self.create_publisher(OccupancyGrid, f'~/{name}', LATCHED) for name in MAPS}
        self._latest = {name: self._message(Grid(self.parameters.grid.resolution, 0, 0, 0, 0), None) for name in MAPS}
        self._diagnostics_out = self.create_publisher(DiagnosticArray, '/diagnostics', 10)
        DeferredService(self, Trigger, '~/run_em', self._run_em)
        DeferredService(self, Trigger, '~/save_maps', self._save_maps)
        self.create_service(Trigger, '~/reset', self._reset)
        self.create_service(SetBool, '~/pause', self._pause)
        for name in MAPS:
            self.create_service(GetMap, f'~/get_{name}', self._getter(name))
        self.create_subscription(Odometry, node.odom_topic, self._on_odometry, self._quality(node.odom_reliability))
        quality = self._quality(node.range_reliability)
        for topic in dict.fromkeys(node.range_topics):
            self.create_subscription(Range, topic, self._on_range, quality)
        received = {self.resolve_topic_name(topic): quality for topic in node.range_topics}
        received[self.resolve_topic_name(node.odom_topic)] = self._quality(node.odom_reliability)
        self._surroundings = Surroundings(self, received)
        self.create_timer(1.0, self._report, clock=self._steady)
        if node.online:
            self._online = OnlineWorker(self.parameters, self._publish_online, self.get_logger().error)
            self.create_timer(ONLINE_PERIOD, self._offer, clock=self._steady)
            self._associator.buffer.before_thinning.append(self._offer)
        self._live_timer = self.create_timer(1.0 / node.publish_rate, self._publish_live, clock=self._steady)
        topics = ', '.join(self.resolve_topic_name(topic) for topic in node.range_topics)
        self.get_logger().info(
            f'ready: Range from {topics} ({node.range_reliability}), odometry from '
            f'{self.resolve_topic_name(node.odom_topic)}, sensor poses from '
            f'{"parameters and TF" if transforms.available else "parameters (tf2_ros is not installed)"}'
        )

    def close(self) -> None:
        """Cancel what goes on in the background."""
        self._em.cancel(wait=2.0)
        if self._online:
            self._online.close()
        if hasattr(self, '_journal'):
            self._journal.close()

    @staticmethod
    def _quality(reliability: str) -> QoSProfile:
        return QoSProfile(depth=QUEUE, reliability=ReliabilityPolicy[reliability.upper()])

    # messages

    def _on_range(self, message: Range, info: dict[str, int]) -> None:
        self._health.taken(info['source_timestamp'])
        if self._paused:
            self._associator.reject(range_message(message), 'paused')
        else:
            self._associator.add_range(range_message(message))

    def _on_odometry(self, message: Odometry) -> None:
        jumps = self._associator.time_jumps
        for converted in self._map_frame.convert(odometry_message(message)):
            self._associator.add_odometry(converted)
        if self._associator.time_jumps != jumps:
            self.get_logger().warning('the clock jumped back: readings that waited were dropped, the map is kept')

    # parameters

    def _accept(self, parameters: Parameters) -> None:
        before = self.parameters
        rate_changed = parameters.node.publish_rate != self.parameters.node.publish_rate
        self.parameters = parameters
        if hasattr(self, '_associator'):
            self._associator.parameters = parameters.association
            if self._online:
                self._online.parameters = parameters
                if (parameters.model, parameters.search) != (before.model, before.search):
                    self._restart_online()
            if rate_changed:
                self._live_timer.timer_period_ns = round(NANOSECONDS / parameters.node.publish_rate)

    # maps

    def _message(self, grid: Grid, values: Any) -> OccupancyGrid:
        values = np.zeros(grid.shape, np.int8) if values is None else values
        # tf2 refuses the leading slash that ROS 1 had
        frame = (self._associator.map_frame or self.parameters.node.map_frame).lstrip('/')
        return grid_message(grid, values, frame, self.get_clock().now().to_msg())

    def _publish(self, name: str, grid: Grid, values: Any) -> None:
        message = self._message(grid, values)
        self._latest[name] = message
        self._maps_out[name].publish(message)

    def _update_live(self) -> None:
        """Bring the live map up to date; readings are added in batches, which costs a hundredth of one by one."""
        count = len(self._associator.buffer)
        if count > self._live_count:
            new = self._associator.buffer.snapshot(self._live_count)
            self._live_count = count
            try:
                self._live.add(new)
            except MapperError as error:
                # a timer that raises would end the node
                self.get_logger().error(f'{len(new)} readings are not in the live map: {error}')

    def _publish_live(self) -> None:
        self._update_live()
        if self._live_count != self._published:
            self._published = self._live_count
            self._publish('live_map', self._live.grid, self._live.probability())

    # the online map

    def _offer(self) -> None:
        """Hand the readings that came to the online map."""
        buffer = self._associator.buffer
        if not self._online or len(buffer) <= self._offered:
            return
        if buffer.bound and self._online.kept > buffer.bound + buffer.bound // 4:
            self._restart_online()
        else:
            self._online.offer(buffer.snapshot(self._offered))
            self._offered = len(buffer)

    def _restart_online(self) -> None:
        """Begin the online map anew, from the readings that are kept."""
        if self._online:
            self._offered = len(self._associator.buffer)
            self._online.restart(self.parameters, self._associator.buffer.bounded() if self._offered else None)

    def _publish_online(
        self, generation: int, grid: Grid, ml: NDArray[np.int8], uncertainty: NDArray[np.float32]
    ) -> None:
        with self._lock:
            # EM shows its own map while it runs
            if self._online and generation == self._online.generation and self._em.current is None:
                self._publish('ml_map', grid, ml)
                self._publish('uncertainty_map', grid, uncertainty)

    # EM

    def _run_em(self, reply: Reply) -> None:
        begin = time.monotonic()

        def done(outcome: Outcome) -> None:
            if outcome.maps is None:
                reply.send(False, outcome.message)
            else:
                reply.send(True, summary(outcome.maps, time.monotonic() - begin))

        if not self._start_em(done):
            run = self._em.current
            reply.send(False, f'EM runs already ({run or "about to end"}); call again when it has ended')

    def _start_em(self, done: Any) -> bool:
        with self._lock:
            generation = self._generation
        count = len(self._associator.buffer)

        def finish(outcome: Outcome) -> None:
            self._sensors.judge(outcome.maps, lambda: generation == self._generation)
            with self._lock:
                if generation != self._generation:
                    outcome = Outcome(None, 'EM was cancelled by reset')
                elif outcome.maps is not None:
                    self._maps, self._explained = outcome.maps, count
                    self._publish('ml_map', outcome.maps.grid, outcome.maps.ml)
                    self._publish('uncertainty_map', outcome.maps.grid, outcome.maps.uncertainty)
                    if self._online:
                        self._online.adopt(outcome.maps)
            if outcome.maps is None:
                self._last_run = outcome.message
                self.get_logger().warning(f'EM: {outcome.message}')
            else:
                maps = outcome.maps
                self._wrong_input = outcome.warnings
                for warning in filter(None, [*outcome.warnings, quality_warning(maps)]):
                    self.get_logger().warning(f'EM: {warning}')
                self._last_run = summary(maps, sum(maps.statistics['seconds'].values()))
                self.get_logger().info(f'EM: {self._last_run}')
            done(outcome)

        start = self._online.so_far() if self._online else None
        if self._em.start(self._associator.readings, self.parameters, finish, start) is None:
            return False
        self._run_generation = generation
        return True

    def _watch(self, run: Run) -> None:
        """Show the map found so far, and the progress, at most `publish_rate` times a second."""
        now = time.monotonic()
        if run.progress is None or now - max(self._watched, run.begin) < 1.0 / self.parameters.node.publish_rate:
            return
        self._watched = now
        found = run.mapper.so_far()
        if found is None:
            return
        self.get_logger().info(f'EM: {run}')
        with self._lock:
            if self._run_generation == self._generation:
                self._publish('ml_map', *found)

    # services

    def _reset(self, request: Trigger.Request, response: Trigger.Response) -> Trigger.Response:
        self._em.cancel()
        forgotten = len(self._associator.buffer)
        # also what came since it last looked
        self._journal.take()
        self._associator.clear(self.parameters)
        kept = self._journal.reset()
        self._live = LogOddsMap(self.parameters)
        self._live_count = self._published = 0
        self._last_run = 'none since the reset'
        self._wrong_input = []
        self._sensors.clear()
        # late subscribers must not get the maps that were forgotten
        nothing = Grid(self.parameters.grid.resolution, 0, 0, 1, 1)
        with self._lock:
            self._generation += 1
            self._maps = None
            self._restart_online()
            for name in MAPS:
                self._publish(name, nothing, np.full(nothing.shape, -1, np.int8))
        response.success, response.message = True, f'{forgotten} readings and all maps were forgotten{kept}'
        return response

    def _pause(self, request: SetBool.Request, response: SetBool.Response) -> SetBool.Response:
        self._paused = bool(request.data)
        response.success = True
        response.message = 'readings are not taken until pause is called with false' if self._paused else 'mapping'
        return response

    def _getter(self, name: str) -> Any:
        def get(request: GetMap.Request, response: GetMap.Response) -> GetMap.Response:
            if name == 'live_map':
                self._publish_live()
            response.map = self._latest[name]
            return response

        return get

    def _save_maps(self, reply: Reply) -> None:
        # taken here, in the thread that adds to it
        self._update_live()
        live = self._live.grid, self._live.probability()
        threading.Thread(target=self._save, args=(reply, live), name='save', daemon=True).start()

    def _save(self, reply: Reply, live: tuple[Grid, NDArray[np.float32]]) -> None:
        try:
            maps = self._maps_to_save()
            # one after the other, so that each finds a name of its own
            with self._saving:
                answer = self._write(maps.with_live(*live), self._explained)
            reply.send(True, answer)
        except MapperError as error:
            reply.send(False, str(error))
        except Exception as error:
            self.get_logger().error(f'save_maps failed: {error!r}')
            reply.send(False, f'save_maps failed: {error!r}')

    def _maps_to_save(self) -> MapSet:
        """Return the latest maps; where EM has not run, run it now."""
        run = self._em.current
        if self._maps is None and run is not None:
            run.finished.wait()
        maps = self._maps
        if maps is None:
            ended = threading.Event()
            outcomes: list[Outcome] = []

            def done(outcome: Outcome) -> None:
                outcomes.append(outcome)
                ended.set()

            if not self._start_em(done):
                raise MapperError('EM runs; call again when it has ended')
            ended.wait()
            if outcomes[0].maps is None:
                raise MapperError(f'there is no map to save: {outcomes[0].message}')
            return outcomes[0].maps
        return maps

    def _write(self, maps: MapSet, explained: int) -> str:
        associator = self._associator
        newer = len(associator.buffer) - explained
        warnings = self._associator.limits.warnings()
        if newer > 0:
            warnings.append(f'{newer} readings came after EM: only the live map has them; call run_em before save_maps')
        if note := thinned(len(maps.readings), explained):
            warnings.append(note)
        parent = Path(self.parameters.node.save_directory).expanduser().resolve()
        stamp = time.strftime('%Y-%m-%d_%H-%M-%S')
        node = self.parameters.node
        source = {
            'node': self.get_fully_qualified_name(),
            'range_topics': [self.resolve_topic_name(topic) for topic in node.range_topics],
            'odom_topic': self.resolve_topic_name(node.odom_topic),
            'odom_frame': associator.map_frame,
            'map_frame': associator.map_frame,
            'base_frame': associator.base_frame,
            'counts': {
                'received': associator.received,
                'accepted': len(associator.buffer),
                'waiting': associator.waiting,
                'rejected': dict(associator.rejected),
            },
            'warnings': warnings,
        }
        folder = free_name(parent, f'maps_{stamp}')
        path_xy = np.array(list(associator.path), np.float64).reshape(-1, 2)
        report = write_results(folder, maps, source, path_xy, f'Maps of {self.get_fully_qualified_name()}')
        for warning in report['warnings']:
            self.get_logger().warning(f'save_maps: {warning}')
        return ', '.join(str(folder / name) for name in sorted(path.name for path in folder.iterdir()))

    # diagnostics

    def _report(self) -> None:
        associator = self._associator
        for frame in sorted(associator.unknown_frames - self._reported)[: diagnostics.SHOWN]:
            if len(self._reported) >= MOST_FRAMES:
                break
            self._reported.add(frame)
            why = (
                'its transform is not normalised, or its axis leaves the plane by more than 60°'
                if frame in self._extrinsics.unusable
                else 'neither is known'
            )
            self.get_logger().warning(
                f'no pose on the robot for sensor {frame}: set sensors.{frame}.pose: [x, y, yaw], or publish the '
                f'transform from {associator.base_frame or "the base frame"}; {why}; its readings are rejected'
            )
        extra = (
            {'odometry without a transform to map_frame': self._map_frame.dropped} if self._map_frame.dropped else {}
        )
        statuses = self._health.statuses(
            self.get_fully_qualified_name().lstrip('/'),
            associator,
            self._em.current,
            self._last_run,
            self._live.grid,
            self._paused,
            extra,
        )
        wrong = [*associator.limits.warnings(), *self._wrong_input]
        diagnostics.add_faults(statuses[0], [*self._surroundings.faults(), *wrong])
        statuses += self._journal.statuses(self.get_fully_qualified_name().lstrip('/'))
        statuses.append(self._sensors.status(self.get_fully_qualified_name().lstrip('/'), associator.readings))
        self._diagnostics_out.publish(diagnostics.array(statuses, self.get_clock().now().to_msg()))
