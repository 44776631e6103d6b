"""A robot for the tests of the node: it starts the node in a second process and communicates with it over DDS."""

from __future__ import annotations

import math
import os
import signal
import subprocess
import sys
import time
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any

import pytest

pytest.importorskip('rclpy', reason='the tests of the node need rclpy')

import rclpy
from diagnostic_msgs.msg import DiagnosticArray
from nav_msgs.msg import OccupancyGrid, Odometry
from nav_msgs.srv import GetMap
from rcl_interfaces.msg import Parameter, ParameterValue
from rcl_interfaces.srv import GetParameters, SetParameters
from rclpy.context import Context
from rclpy.executors import SingleThreadedExecutor
from rclpy.qos import DurabilityPolicy, QoSProfile, ReliabilityPolicy
from sensor_msgs.msg import Range
from std_srvs.srv import SetBool, Trigger

from forward_grid_mapper.core.messages.message_types import NANOSECONDS, OdometryMessage, RangeMessage

LATCHED = QoSProfile(depth=1, reliability=ReliabilityPolicy.RELIABLE, durability=DurabilityPolicy.TRANSIENT_LOCAL)
RELIABLE = QoSProfile(depth=100_000, reliability=ReliabilityPolicy.RELIABLE)
MAPS = ('live_map', 'ml_map', 'uncertainty_map')
KEPT = 1500
"""Most readings in transit; the middleware keeps only 2000 messages of a topic."""

START_TIME = 500.0
"""Seconds; the first start compiles all kernels, on a machine that may be busy."""


def environment(domain: int, **changes: str) -> dict[str, str]:
    return {
        **os.environ,
        'ROS_DOMAIN_ID': str(domain),
        'ROS_AUTOMATIC_DISCOVERY_RANGE': 'LOCALHOST',
        'PYTHONUNBUFFERED': '1',
        **changes,
    }


class NodeProcess:
    """The node in a separate process, with its output in a file."""

    def __init__(self, domain: int, log: Path, arguments: Sequence[str] = (), **changes: str) -> None:
        self.log = log
        self._file = log.open('w')
        command = [sys.executable, '-m', 'forward_grid_mapper.node.main', '--ros-args', *arguments]
        self.process = subprocess.Popen(
            command, env=environment(domain, **changes), stdout=self._file, stderr=subprocess.STDOUT
        )

    @property
    def output(self) -> str:
        return self.log.read_text()

    def wait_for(self, text: str, seconds: float = START_TIME) -> None:
        end = time.monotonic() + seconds
        while text not in self.output:
            assert self.process.poll() is None, f'the node ended: {self.output}'
            assert time.monotonic() < end, f'{text!r} did not come: {self.output}'
            time.sleep(0.02)

    def stop(self, number: signal.Signals = signal.SIGINT, times: int = 1, seconds: float = 8.0) -> int:
        for _ in range(times):
            if self.process.poll() is None:
                self.process.send_signal(number)
                time.sleep(0.05)
        try:
            return self.process.wait(seconds)
        finally:
            self.process.kill()
            self._file.close()


def ros_message(message: RangeMessage | OdometryMessage) -> Any:
    """Return the message as a ROS message."""
    out: Any
    if isinstance(message, RangeMessage):
        out = Range(
            range=message.range,
            min_range=message.min_range,
            max_range=message.max_range,
            field_of_view=message.field_of_view,
            variance=message.variance,
        )
    else:
        out = Odometry(child_frame_id=message.child_frame_id)
        assert message.pose is not None
        out.pose.pose.position.x, out.pose.pose.position.y = message.pose.x, message.pose.y
        half = message.pose.yaw / 2
        out.pose.pose.orientation.z, out.pose.pose.orientation.w = math.sin(half), math.cos(half)
    out.header.frame_id = message.frame_id
    out.header.stamp.sec, out.header.stamp.nanosec = divmod(message.stamp, NANOSECONDS)
    return out


class Robot:
    """Publishes ranges and odometry, calls services, and keeps the messages of the node."""

    def __init__(self, domain: int, node: str = '/forward_grid_mapper', prefix: str = '/') -> None:
        os.environ['ROS_AUTOMATIC_DISCOVERY_RANGE'] = 'LOCALHOST'
        self.context = Context()
        rclpy.init(context=self.context, domain_id=domain)
        self.node = rclpy.create_node('robot', context=self.context)
        self.executor = SingleThreadedExecutor(context=self.context)
        self.executor.add_node(self.node)
        self.name = node
        self.range_out = self.node.create_publisher(Range, f'{prefix}sonar', RELIABLE)
        self.odom_out = self.node.create_publisher(Odometry, f'{prefix}odom', RELIABLE)
        self.maps: dict[str, list[OccupancyGrid]] = {name: [] for name in MAPS}
        self.diagnostics: dict[str, Any] = {}
        # seconds of the clock of the node, as in its diagnostics
        self.time = -1
        self.node.create_subscription(DiagnosticArray, '/diagnostics', self._on_diagnostics, 10)

    def listen(self) -> None:
        """Subscribe to the maps, as RViz would, at any time."""
        for name in MAPS:
            self.node.create_subscription(OccupancyGrid, f'{self.name}/{name}', self.maps[name].append, LATCHED)

    def _on_diagnostics(self, message: DiagnosticArray) -> None:
        for status in message.status:
            if status.name.startswith(self.name.lstrip('/') + ':'):
                part = status.name.rpartition(': ')[2]
                self.diagnostics[part] = {pair.key: pair.value for pair in status.values}
                self.diagnostics[part] |= {'message': status.message, 'level': status.level}
                self.time = message.header.stamp.sec

    def spin(self, seconds: float) -> None:
        end = time.monotonic() + seconds
        while time.monotonic() < end:
            self.executor.spin_once(timeout_sec=0.02)

    def until(self, condition: Callable[[], Any], seconds: float = 500.0, what: str = '') -> Any:
        end = time.monotonic() + seconds
        while not (value := condition()):
            assert time.monotonic() < end, f'it did not happen: {what or condition}'
            self.executor.spin_once(timeout_sec=0.02)
        return value

    def meet(self) -> None:
        """Wait until the node has subscribed to the topics of the robot."""
        both = (self.range_out, self.odom_out)
        self.until(lambda: all(p.get_subscription_count() for p in both), what='the node subscribes')

    def send(self, message: RangeMessage | OdometryMessage) -> None:
        publisher = self.range_out if isinstance(message, RangeMessage) else self.odom_out
        publisher.publish(ros_message(message))

    @property
    def received(self) -> int:
        """Number of received readings in the diagnostics, -1 before the first diagnostics."""
        return int(self.diagnostics.get('readings', {}).get('readings received', -1))

    def play(self, messages: Sequence[RangeMessage | OdometryMessage], rate: float = 1500.0) -> None:
        """Send messages at a steady rate, at most as many as the middleware keeps, until the node has received all."""
        self.sent = getattr(self, 'sent', 0)
        begin = time.monotonic()
        for k, message in enumerate(messages):
            if self.sent >= self.received + KEPT:
                self.until(lambda: self.sent < self.received + KEPT, what=f'{self.sent - KEPT} readings received')
            self.send(message)
            self.sent += isinstance(message, RangeMessage)
            ahead = k / rate - (time.monotonic() - begin)
            if ahead > 0.002:
                time.sleep(ahead)
        self.until(lambda: self.received >= self.sent, what=f'{self.sent} readings received')

    def call(self, service: str, kind: Any = Trigger, seconds: float = 500.0, **fields: Any) -> Any:
        return self.until(self.ask(service, kind, **fields).result, seconds, f'{service} answers')

    def ask(self, service: str, kind: Any = Trigger, **fields: Any) -> Any:
        # each client receives the responses to all clients, and keeps the last 10 by default
        client = self.node.create_client(kind, f'{self.name}/{service}', qos_profile=QoSProfile(depth=100))
        self.until(client.service_is_ready, what=f'{service} is there')
        return client.call_async(kind.Request(**fields))

    def get_map(self, name: str) -> OccupancyGrid:
        return self.call(f'get_{name}', GetMap).map

    def pause(self, value: bool) -> Any:
        return self.call('pause', SetBool, data=value)

    def set_parameter(self, name: str, value: Any) -> Any:
        kinds = {
            float: ('double_value', 3),
            int: ('integer_value', 2),
            bool: ('bool_value', 1),
            str: ('string_value', 4),
        }
        field, kind = kinds[type(value)]
        request = Parameter(name=name, value=ParameterValue(type=kind, **{field: value}))
        return self.call('set_parameters', SetParameters, parameters=[request]).results[0]

    def get_parameter(self, name: str) -> ParameterValue:
        return self.call('get_parameters', GetParameters, names=[name]).values[0]

    def close(self) -> None:
        self.executor.shutdown()
        self.node.destroy_node()
        rclpy.shutdown(context=self.context)
