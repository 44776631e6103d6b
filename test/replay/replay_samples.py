"""A short bag, `replay_bag` in a separate process, and a listener to its topics."""

from __future__ import annotations

import os
import signal
import subprocess
import sys
import time
from collections.abc import Callable, Iterator, Mapping
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import pytest
from patience import PATIENCE

import forward_grid_mapper
from forward_grid_mapper.bags.reader import Bag
from forward_grid_mapper.bags.writer import BagWriter
from forward_grid_mapper.core.messages.message_types import (
    NANOSECONDS,
    OdometryMessage,
    Pose2,
    RangeMessage,
    odometry_message,
    range_message,
)
from forward_grid_mapper.replay.ros_messages import message_class

START = 1_700_000_000 * NANOSECONDS
RANGE = 'sensor_msgs/msg/Range'
ODOMETRY = 'nav_msgs/msg/Odometry'
CLOCK = 'rosgraph_msgs/msg/Clock'
SENSORS = {'/sonar': RANGE, '/odom': ODOMETRY}
EXTRINSICS = [('base_link', 'sonar_0', Pose2(0.1, 0.2, 0.5)), ('base_link', 'sonar_1', Pose2(-0.1, 0.0, 1.5))]


def write_bag(
    folder: Path,
    kind: str = 'mcap',
    *,
    count: int = 40,
    period: float = 0.1,
    topic: Callable[[str], str] = lambda frame: '/sonar',
) -> Path:
    """Write ranges of two sensors and odometry alternately, with different stamps; return the path of the bag."""
    path = folder / ('drive.bag' if kind == 'ros1' else 'drive')
    with BagWriter(path, kind) as writer:
        writer.write_static_transforms(EXTRINSICS, START)
        for i in range(count):
            stamp = START + round(i * period * NANOSECONDS)
            writer.write_odometry('/odom', OdometryMessage(stamp, 'odom', 'base_link', Pose2(i / 8, -i / 16, 0.25)))
            distance = float('inf') if i % 5 == 0 else 1.0 + i / 64
            made = RangeMessage(
                stamp + 1000, f'sonar_{i % 2}', distance, 0.125, 5.0, 0.25, 0.5 if kind != 'ros1' else 0
            )
            writer.write_range(topic(made.frame_id), made)
    return path


def messages_in(path: Path, odom_topic: str | None = None) -> list[RangeMessage | OdometryMessage]:
    """The messages that the offline tool reads from a bag."""
    with Bag(path) as bag:
        return list(bag.messages(bag.choose_topics(None, odom_topic)))


class Replay:
    """`replay_bag` in a separate process."""

    def __init__(self, environment: Mapping[str, str], *arguments: object) -> None:
        command = [sys.executable, '-m', 'forward_grid_mapper', 'replay_bag', *map(str, arguments)]
        root = Path(forward_grid_mapper.__file__).parents[1]
        path = os.pathsep.join(filter(None, (str(root), environment.get('PYTHONPATH'))))
        self._process = subprocess.Popen(
            command, env={**environment, 'PYTHONPATH': path}, stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True
        )

    def signal(self, number: signal.Signals) -> None:
        """Send a signal."""
        self._process.send_signal(number)

    @property
    def running(self) -> bool:
        """Whether it is running."""
        return self._process.poll() is None

    def end(self, seconds: float = 120.0) -> tuple[int, str, str]:
        """Wait for the end; return exit code, output and errors."""
        out, err = self._process.communicate(timeout=seconds)
        return self._process.returncode, out, err

    def kill(self) -> None:
        """Kill it if a test has failed before it ended."""
        if self.running:
            self._process.kill()
            self._process.communicate(timeout=PATIENCE)


class Listener:
    """Keeps all messages of some topics in the order of arrival, as (topic, message)."""

    def __init__(self, domain: int, topics: Mapping[str, str], *, reliable: bool = True, latched: bool = False) -> None:
        import rclpy
        from rclpy.executors import SingleThreadedExecutor
        from rclpy.qos import DurabilityPolicy, QoSProfile, ReliabilityPolicy

        self.got: list[tuple[str, Any]] = []
        self._context = rclpy.Context()
        rclpy.init(context=self._context, domain_id=domain)
        self._node = rclpy.create_node('listener', context=self._context)
        self._executor = SingleThreadedExecutor(context=self._context)
        self._executor.add_node(self._node)
        quality = QoSProfile(
            depth=5000,
            reliability=ReliabilityPolicy.RELIABLE if reliable else ReliabilityPolicy.BEST_EFFORT,
            durability=DurabilityPolicy.TRANSIENT_LOCAL if latched else DurabilityPolicy.VOLATILE,
        )
        for topic, kind in topics.items():
            self._node.create_subscription(message_class(kind), topic, self._keeper(topic), quality)

    def _keeper(self, topic: str) -> Callable[[Any], None]:
        return lambda message: self.got.append((topic, message))

    def spin(self, *, until: Callable[[], bool], seconds: float = 120.0) -> None:
        """Receive messages until the condition holds, which must happen."""
        deadline = time.monotonic() + seconds
        while not until():
            assert time.monotonic() < deadline, f'{len(self.got)} messages came, then none'
            self._executor.spin_once(timeout_sec=0.05)

    def publisher_of(self, topic: str) -> bool:
        """Whether a topic has a publisher."""
        return bool(self._node.count_publishers(topic))

    def receive(self, replay: Replay) -> tuple[int, str, str]:
        """Receive messages until a replay has ended; return its exit code, output and errors."""
        self.spin(until=lambda: not replay.running)
        self.spin(until=lambda: True)
        return replay.end()

    def on(self, topic: str) -> list[Any]:
        """Messages of one topic."""
        return [message for name, message in self.got if name == topic]

    @property
    def plain(self) -> list[RangeMessage | OdometryMessage]:
        """Ranges and odometry by stamp, since the order between two topics may differ."""
        made: list[RangeMessage | OdometryMessage] = []
        for _, message in self.got:
            if hasattr(message, 'child_frame_id'):
                made.append(odometry_message(message))
            elif hasattr(message, 'field_of_view'):
                made.append(range_message(message))
        return sorted(made, key=lambda message: message.stamp)

    def close(self) -> None:
        """Close the node."""
        self._executor.shutdown()
        self._node.destroy_node()
        self._context.try_shutdown()


class Wire:
    """A separate DDS domain, in which replays and listeners end with the test."""

    def __init__(self, domain: int, environment: Mapping[str, str]) -> None:
        self._domain = domain
        self._environment = environment
        self._open: list[Replay | Listener] = []

    def replay(self, *arguments: object) -> Replay:
        """Start a replay."""
        made = Replay(self._environment, *arguments)
        self._open.append(made)
        return made

    def listen(self, topics: Mapping[str, str] = SENSORS, **quality: bool) -> Listener:
        """Start a listener."""
        made = Listener(self._domain, topics, **quality)
        self._open.append(made)
        return made

    def close(self) -> None:
        """End all replays and listeners that are still open."""
        for thing in self._open:
            thing.kill() if isinstance(thing, Replay) else thing.close()


@contextmanager
def wire(domain: int) -> Iterator[Wire]:
    """Yield a `Wire`; skip the test if ROS is not installed."""
    pytest.importorskip('rclpy', reason='rclpy is not installed (the extra ros, or a sourced ROS 2)')
    with pytest.MonkeyPatch.context() as patch:
        patch.setenv('ROS_DOMAIN_ID', str(domain))
        patch.setenv('ROS_AUTOMATIC_DISCOVERY_RANGE', 'LOCALHOST')
        made = Wire(domain, dict(os.environ))
        try:
            yield made
        finally:
            made.close()
