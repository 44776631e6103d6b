"""DDS for the replay: publishers, checks for subscribers, and acknowledgements."""

from __future__ import annotations

import time
from collections.abc import Mapping, Sequence
from types import TracebackType
from typing import Any

from ..core.common.errors import InputError, MapperError, ParameterError
from ..core.messages.message_types import NANOSECONDS
from .ros_messages import filled, message_class
from .stop_signal import StopSignal

NODE_NAME = 'replay_bag'
SETTLING = 0.5
"""Seconds from the discovery of subscribers to the first message: they must discover us too, for best effort."""

LINGER = 0.5
"""Seconds from the last message to the end, so that best-effort subscribers receive it."""

PATIENCE = 30.0
"""Seconds in which subscribers must acknowledge; DDS forgets one that died after 20."""


class Publishers:
    """A node with one publisher for each topic; used in a `with` block.

    Parameters
    ----------
    ros_arguments : sequence of str
        Arguments for rclpy, from `--ros-args` on.
    reliable : bool
        Whether ranges and odometry are reliable; best-effort subscribers receive them in both cases.
    stop : StopSignal
        Ends every wait.
    """

    def __init__(self, ros_arguments: Sequence[str], reliable: bool, stop: StopSignal) -> None:
        self._ros_arguments = list(ros_arguments)
        self._reliable = reliable
        self._stop = stop
        self._publishers: dict[str, Any] = {}
        self._types: dict[str, str] = {}
        self._ros: Any = None
        self._node: Any = None

    def __enter__(self) -> Publishers:
        """Start the node.

        Raises
        ------
        MapperError
            If ROS is not installed, or refuses its arguments.
        """
        try:
            import rclpy
            from rclpy.signals import SignalHandlerOptions
        except ImportError as error:
            raise MapperError(
                f'ROS 2 is not installed, or not sourced ({error}): source its setup.bash, or pip install '
                "'forward_grid_mapper[ros]'"
            ) from error
        self._ros = rclpy
        try:
            rclpy.init(args=[NODE_NAME, *self._ros_arguments], signal_handler_options=SignalHandlerOptions.NO)
            self._node = rclpy.create_node(NODE_NAME, start_parameter_services=False)
        except Exception as error:  # rclpy's errors have no common base
            self.__exit__(None, None, None)
            raise MapperError(f'ROS 2 does not start: {error}') from error
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        """End the node."""
        try:
            if self._node is not None:
                self._node.destroy_node()
        finally:
            self._ros.try_shutdown()

    def add(self, topic: str, msgtype: str, latched: bool = False, depth: int = 0) -> None:
        """Create the publisher of a topic, which keeps this name here even if it is remapped.

        With a `depth` it is reliable, but keeps only this many messages for subscribers that are late.

        Raises
        ------
        ParameterError
            If the name is not a valid topic name.
        """
        from rclpy.exceptions import InvalidTopicNameException
        from rclpy.qos import DurabilityPolicy, HistoryPolicy, QoSProfile, ReliabilityPolicy

        quality = QoSProfile(
            # messages without acknowledgement are kept until the history is full; then publishing waits
            history=HistoryPolicy.KEEP_LAST if latched or depth else HistoryPolicy.KEEP_ALL,
            depth=depth or 1,
            reliability=(
                ReliabilityPolicy.RELIABLE if self._reliable or latched or depth else ReliabilityPolicy.BEST_EFFORT
            ),
            durability=DurabilityPolicy.TRANSIENT_LOCAL if latched else DurabilityPolicy.VOLATILE,
        )
        try:
            self._publishers[topic] = self._node.create_publisher(message_class(msgtype), topic, quality)
        except InvalidTopicNameException as error:
            what = ' '.join(str(error).split())
            raise ParameterError(f'{topic} cannot be published ({what}); choose another name with --remap') from error
        self._types[topic] = msgtype

    def publish(self, topic: str, source: Any) -> None:
        """Publish a copy of a message decoded by rosbags.

        Raises
        ------
        *MISFITS
            If it has another definition.
        InputError
            If a reliable subscriber does not acknowledge.
        """
        from rclpy._rclpy_pybind11 import RCLError

        message = filled(message_class(self._types[topic])(), source)
        deadline = time.monotonic() + PATIENCE
        while not self._stop.is_set():
            try:
                self._publishers[topic].publish(message)
                break
            except RCLError as error:
                # DDS waits only a tenth of a second for space in the history
                if time.monotonic() > deadline:
                    raise InputError(
                        f'subscribers of {topic} have received nothing for {PATIENCE:.0f} s ({error})'
                    ) from error

    def publish_latched(self, topic: str, **fields: Any) -> None:
        """Publish a message with these fields, which late subscribers receive too."""
        self._publishers[topic].publish(message_class(self._types[topic])(**fields))

    def publish_clock(self, topic: str, stamp: int) -> None:
        """Publish a `rosgraph_msgs/Clock`; `stamp` in nanoseconds."""
        message = message_class(self._types[topic])()
        message.clock.sec, message.clock.nanosec = divmod(stamp, NANOSECONDS)
        self._publishers[topic].publish(message)

    def wait_for_subscribers(self, topics: Sequence[str], seconds: float) -> None:
        """Wait until each topic has a subscriber.

        Raises
        ------
        InputError
            Naming those without one after this many seconds, and a remedy.
        """
        deadline = time.monotonic() + seconds
        while unheard := [topic for topic in topics if not self._publishers[topic].get_subscription_count()]:
            if time.monotonic() > deadline:
                raise InputError(self._no_subscribers(unheard, seconds))
            if self._stop.wait(0.05):
                return
        self._stop.wait(SETTLING)

    def wait_until_acknowledged(self) -> None:
        """Wait until every reliable subscriber has acknowledged all messages.

        Raises
        ------
        InputError
            Naming the topics of those that do not acknowledge.
        """
        from rclpy.duration import Duration

        deadline = time.monotonic() + PATIENCE
        waiting = list(self._publishers)
        while not self._stop.is_set():
            # short waits, since rclpy blocks other threads meanwhile
            moment = Duration(nanoseconds=NANOSECONDS // 20)
            waiting = [topic for topic in waiting if not self._publishers[topic].wait_for_all_acked(moment)]
            if not waiting:
                return
            if time.monotonic() > deadline:
                raise InputError(f'subscribers of {", ".join(waiting)} have acknowledged nothing for {PATIENCE:.0f} s')
            self._stop.wait(0.05)

    def finish(self) -> None:
        """Wait until all messages have arrived.

        Raises
        ------
        InputError
            If a reliable subscriber does not acknowledge.
        """
        self.wait_until_acknowledged()
        self._stop.wait(LINGER)

    def _no_subscribers(self, unheard: Sequence[str], seconds: float) -> str:
        lines = [f'\n  {self._publishers[topic].topic_name}: {self._reason(topic)}' for topic in unheard]
        return (
            f'no subscriber after {seconds:g} s{"".join(lines)}\nStart it with the same ROS_DOMAIN_ID, rename topics '
            f'with --remap OLD:=NEW, play fewer with --range-topics, or start without subscribers with --wait 0'
        )

    def _reason(self, topic: str) -> str:
        """Return a reason why a topic has no compatible subscriber, or topics of its type that have one."""
        name, msgtype = self._publishers[topic].topic_name, self._types[topic]
        found = self._node.get_subscriptions_info_by_topic(name)
        for other in found:
            if other.topic_type != msgtype:
                return f'{other.node_name} expects {other.topic_type} there instead of {msgtype}'
        if found:
            return f'{found[0].node_name} requests reliable; leave out --best-effort'
        ours = {publisher.topic_name for publisher in self._publishers.values()}
        elsewhere = [
            other
            for other, types in self._node.get_topic_names_and_types()
            if msgtype in types and other not in ours and self._node.count_subscribers(other)
        ]
        if elsewhere:
            return f'{msgtype} has subscribers on {", ".join(elsewhere)}'
        return f'no node subscribes to {msgtype} on any topic'


def renamed(topics: Mapping[str, str], remaps: Sequence[str]) -> dict[str, str]:
    """Return the name under which each topic is published.

    Parameters
    ----------
    topics : mapping
        Message type by topic, with the bag's names.
    remaps : sequence of str
        Each 'old:=new'; a leading slash makes no difference.

    Raises
    ------
    ParameterError
        If one has another form or an unknown topic, or merges topics of different types.
    """
    names = {topic: f'/{topic.strip("/")}' for topic in topics}
    by_name = {name: topic for topic, name in names.items()}
    for text in remaps:
        old, _, new = (f'/{part.strip().strip("/")}' for part in text.partition(':='))
        if '/' in (old, new):
            raise ParameterError(f'--remap: {text!r} is not of the form OLD:=NEW, such as /sonar:=/robot/sonar')
        if old not in by_name:
            raise ParameterError(f'--remap: {old} is not replayed; replayed topics: {", ".join(sorted(by_name))}')
        names[by_name[old]] = new
    types: dict[str, str] = {}
    for topic, name in names.items():
        if types.setdefault(name, topics[topic]) != topics[topic]:
            raise ParameterError(
                f'{name} would have messages of two types, {types[name]} and {topics[topic]}; see --remap'
            )
    return names
