"""The node in the process of the test, which turns the executor and has access to all parts."""

from __future__ import annotations

import os
import sys
import threading
import time
import traceback
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any

import pytest

pytest.importorskip('rclpy', reason='the tests of the node need rclpy')

import rclpy
from nav_msgs.msg import Odometry
from rclpy.context import Context
from rclpy.executors import SingleThreadedExecutor
from rclpy.parameter import Parameter
from robot import ros_message
from sensor_msgs.msg import Range

from forward_grid_mapper.core.messages.message_types import NANOSECONDS, OdometryMessage, RangeMessage
from forward_grid_mapper.node.mapper_node import MapperNode


class Answer:
    """The responses of a service."""

    def __init__(self, request: Any = None) -> None:
        self.request = request
        self.sent: list[tuple[Any, ...]] = []

    def send(self, *fields: Any) -> None:
        self.sent.append(fields)


class Inside:
    """A node in this process; the test calls its callbacks and turns its executor."""

    def __init__(self, domain: int, folder: Path, **parameters: Any) -> None:
        os.environ['ROS_AUTOMATIC_DISCOVERY_RANGE'] = 'LOCALHOST'
        self.context = Context()
        rclpy.init(args=['mapper', '--ros-args', '--log-level', 'FATAL'], context=self.context, domain_id=domain)
        values = {'sensors.sonar.pose': [0.1, 0.0, 0.4], 'save_directory': str(folder / 'maps'), **parameters}
        overrides = [Parameter(name, value=value) for name, value in values.items()]
        self.node = MapperNode(context=self.context, parameter_overrides=overrides)
        self.executor = SingleThreadedExecutor(context=self.context)
        self.executor.add_node(self.node)
        self.logged: list[str] = []
        self.sent = 0
        self._closed = False

    def start(self) -> Inside:
        """Start the node, and wait until it maps."""
        self.node.start()
        self.until(lambda: self.node.failure or (self.node.mapping and self.node.kernels.has('EM')))
        assert not self.node.failure
        return self

    def until(self, condition: Callable[[], Any], seconds: float = 500.0) -> Any:
        """Turn the executor until the condition holds; a second counts at most for each turn, if the machine stalls."""
        left, before = seconds, time.monotonic()
        while not (value := condition()):
            now = time.monotonic()
            left, before = left - min(now - before, 1.0), now
            assert left > 0.0, f'it did not happen: {condition}\n{self._state()}'
            self.executor.spin_once(timeout_sec=0.01)
        return value

    def _state(self) -> str:
        """Return what the node does, and where each of its threads is."""
        names = {thread.ident: thread.name for thread in threading.enumerate()}
        stacks = [
            f'{names.get(number, number)}:\n{"".join(traceback.format_stack(frame, limit=-12))}'
            for number, frame in sys._current_frames().items()
            if number != threading.get_ident()
        ]
        em = self.node.em
        return '\n'.join([f'EM: {em.current}; last run: {em.last_run}; intake busy: {self.node.intake.busy}', *stacks])

    def spin(self, seconds: float) -> None:
        """Turn the executor for some seconds."""
        end = time.monotonic() + seconds
        while time.monotonic() < end:
            self.executor.spin_once(timeout_sec=0.01)

    def odometry(self, seconds: float, x: float = 0.0) -> None:
        """Give the node an odometry message."""
        made = Odometry(child_frame_id='base_link')
        made.header.frame_id = 'odom'
        made.pose.pose.position.x, made.pose.pose.orientation.w = x, 1.0
        self._stamp(made.header, seconds)
        self.node.intake.on_odometry(made, {'source_timestamp': time.time_ns()})

    def range(self, seconds: float, value: float = 2.0, number: int | None = None, frame: str = 'sonar') -> None:
        """Give the node a Range message."""
        made = Range(min_range=0.1, max_range=5.0, field_of_view=0.3, range=value)
        made.header.frame_id = frame
        self._stamp(made.header, seconds)
        intake = self.node.intake
        self.sent += 1
        info = {'source_timestamp': time.time_ns(), 'publication_sequence_number': number or self.sent}
        intake.on_range(intake.range_losses[0], made, info)

    def hand(self, messages: Sequence[RangeMessage | OdometryMessage]) -> None:
        """Give the node messages of a drive, and turn the executor until they are processed."""
        for k, message in enumerate(messages):
            made = ros_message(message)
            if isinstance(message, RangeMessage):
                intake = self.node.intake
                self.sent += 1
                info = {'source_timestamp': time.time_ns(), 'publication_sequence_number': self.sent}
                intake.on_range(intake.range_losses[0], made, info)
            else:
                self.node.intake.on_odometry(made, {'source_timestamp': time.time_ns()})
            if k % 50 == 0:
                self.executor.spin_once(timeout_sec=0.0)
        self.until(lambda: not self.node.intake.busy)

    @staticmethod
    def _stamp(header: Any, seconds: float) -> None:
        header.stamp.sec, header.stamp.nanosec = divmod(round(seconds * NANOSECONDS), NANOSECONDS)

    def drive(self, first: int, count: int) -> None:
        """Give the node readings of a robot that drives slowly, each with an odometry message."""
        for k in range(first, first + count):
            self.odometry(100.0 + 0.05 * k, 0.001 * k)
            self.range(100.0 + 0.05 * k)
        self.until(lambda: not self.node.intake.busy)

    def set(self, **values: Any) -> None:
        """Set parameters of the node."""
        results = self.node.set_parameters([Parameter(name, value=value) for name, value in values.items()])
        assert all(result.successful for result in results), results

    def status(self, part: str) -> dict[str, Any]:
        """Let the node publish diagnostics, and return those of a part."""
        found: dict[str, Any] = {}
        reporter: Any = self.node.reporter
        publish, reporter._out.publish = (
            reporter._out.publish,
            lambda array: found.update(
                {
                    status.name.rpartition(': ')[2]: {
                        **{pair.key: pair.value for pair in status.values},
                        'message': status.message,
                        'level': status.level,
                    }
                    for status in array.status
                }
            ),
        )
        try:
            reporter.report()
        finally:
            reporter._out.publish = publish
        return dict(found[part])

    def begin(self, handler: Callable[[Any], None], request: Any = None) -> Answer:
        """Call a service, and return the object that receives the response."""
        answer = Answer(request)
        handler(answer)
        return answer

    def call(self, handler: Callable[[Any], None], request: Any = None) -> tuple[Any, ...]:
        """Call a service, and turn the executor until it responds."""
        answer = self.begin(handler, request)
        self.until(lambda: answer.sent)
        assert len(answer.sent) == 1
        return answer.sent[0]

    def close(self) -> None:
        """Close the node, if it is not closed yet."""
        if self._closed:
            return
        self._closed = True
        self.node.close()
        self.executor.shutdown()
        self.node.destroy_node()
        rclpy.shutdown(context=self.context)
