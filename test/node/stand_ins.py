"""Stand-ins for the parts of rclpy that the node uses: the test decides what is called when."""

from __future__ import annotations

import sys
from collections.abc import Callable
from typing import Any

from nav_msgs.msg import Odometry
from sensor_msgs.msg import Range

from forward_grid_mapper.core.common.parameters import Parameters
from forward_grid_mapper.core.messages.message_types import Pose2
from forward_grid_mapper.core.messages.pose_association import PoseAssociator
from forward_grid_mapper.node.frames import MapFrame, Transforms
from forward_grid_mapper.node.intake import AT_ONCE, Intake


class Guard:
    """A guard condition; `turn` of the node calls its callback."""

    def __init__(self, callback: Callable[[], None]) -> None:
        self.callback, self.triggered = callback, False

    def trigger(self) -> None:
        self.triggered = True


class PlainNode:
    """Stand-in for a node, with what its parts need.

    Attributes
    ----------
    warned : list of str
    The lines of the log.
    publishers : int
    The number of publishers of any topic.
    subscribed : dict of topic → (callback, QoSProfile)
    """

    def __init__(self) -> None:
        self.warned: list[str] = []
        self.publishers = 1
        self.subscribed: dict[str, tuple[Callable[..., None], Any]] = {}
        self._guards: list[Guard] = []
        self._severities: dict[tuple[str, int, int], str] = {}

    def get_logger(self) -> Any:
        return self

    def debug(self, text: str) -> None:
        self._log('debug', text)

    def info(self, text: str) -> None:
        self._log('info', text)

    def warning(self, text: str) -> None:
        self._log('warning', text)

    def error(self, text: str) -> None:
        self._log('error', text)

    def _log(self, severity: str, text: str) -> None:
        caller = sys._getframe(2)
        place = caller.f_code.co_filename, caller.f_lineno, caller.f_lasti
        if self._severities.setdefault(place, severity) != severity:
            # as rclpy does
            raise ValueError('Logger severity cannot be changed between calls.')
        self.warned.append(text)

    def create_guard_condition(self, callback: Callable[[], None]) -> Guard:
        made = Guard(callback)
        self._guards.append(made)
        return made

    def turn(self) -> int:
        """Call triggered callbacks until none is left; return how many were called."""
        turns = 0
        while triggered := [guard for guard in self._guards if guard.triggered]:
            for guard in triggered:
                guard.triggered = False
                guard.callback()
            turns += 1
        return turns

    def count_publishers(self, topic: str) -> int:
        return self.publishers

    def resolve_topic_name(self, name: str) -> str:
        return name if name.startswith('/') else f'/{name}'

    def create_subscription(self, kind: Any, topic: str, callback: Any, quality: Any, **options: Any) -> str:
        self.subscribed[topic] = callback, quality
        return topic

    def destroy_subscription(self, topic: str) -> None:
        del self.subscribed[topic]


SONAR = Pose2(0.1, 0.0, 0.0)


class Taking:
    """An intake with its associator, and a robot that publishes to it.

    Attributes
    ----------
    arrival : float or None
        Time, seconds, at which the middleware receives the next messages; if None, that of their stamps.
    """

    def __init__(self, at_once: int = AT_ONCE, map_frame: MapFrame | None = None, **parameters: Any) -> None:
        self.node = PlainNode()
        own = Parameters.from_flat(parameters)
        self.associator = PoseAssociator(lambda base, frame, stamp: SONAR, own, at_once=at_once)
        self.published: list[int] = []
        frame = map_frame or MapFrame('', Transforms(), 1.0)
        self.intake = Intake(self.node, own, self.associator, frame, self.published.append)
        self.sent = 0
        self.arrival: float | None = None

    def _info(self, seconds: float) -> dict[str, Any]:
        arrival = seconds if self.arrival is None else self.arrival
        return {'source_timestamp': round(seconds * 1e9), 'received_timestamp': round(arrival * 1e9)}

    def odometry(self, seconds: float, x: float = 0.0, number: int | None = None, frame: str = 'odom') -> None:
        made = Odometry(child_frame_id='base_link')
        made.header.frame_id = frame
        made.pose.pose.position.x, made.pose.pose.orientation.w = x, 1.0
        made.header.stamp.sec, made.header.stamp.nanosec = divmod(round(seconds * 1e9), 10**9)
        info = self._info(seconds)
        if number is not None:
            info['publication_sequence_number'] = number
        self.intake.on_odometry(made, info)

    def range(self, seconds: float, frame: str = 'sonar', number: int | None = None, topic: int = 0) -> None:
        made = Range(min_range=0.1, max_range=5.0, field_of_view=0.3, range=2.0)
        made.header.frame_id = frame
        made.header.stamp.sec, made.header.stamp.nanosec = divmod(round(seconds * 1e9), 10**9)
        self.sent += 1
        info = {**self._info(seconds), 'publication_sequence_number': number or self.sent}
        self.intake.on_range(self.intake.range_losses[topic], made, info)

    def account(self) -> tuple[int, int, int, int]:
        """Numbers of received, accepted, waiting and rejected readings; the first is the sum of the others."""
        rejected = sum(self.associator.rejected.values())
        found = self.intake.received, len(self.associator.buffer), self.intake.waiting, rejected
        assert found[0] == found[1] + found[2] + found[3]
        return found
