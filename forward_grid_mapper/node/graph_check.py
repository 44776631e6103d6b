"""Faults in the ROS graph: incompatible QoS, no clock, nodes with the same name, two publishers of a transform."""

from __future__ import annotations

import time
from collections.abc import Callable, Sequence
from typing import Any

from rclpy.qos import DurabilityPolicy, QoSCompatibility, QoSProfile, ReliabilityPolicy, qos_check_compatible

from .diagnostics import listed

GRAPH_PERIOD = 3.0
"""Seconds between two checks of the graph of nodes and topics."""

KINDS = {'Range': 'sensor_msgs/msg/Range', 'Odometry': 'nav_msgs/msg/Odometry'}
PARAMETER = {'Range': 'range_topics, or remap sonar', 'Odometry': 'odom_topic, or remap odom'}
"""Parameters that set the topics of a kind."""


class GraphCheck:
    """Checks the graph periodically; logs each fault once, and reports it while it lasts."""

    def __init__(
        self,
        node: Any,
        subscriptions: dict[str, QoSProfile],
        transforms: tuple[str, ...] = (),
        frames_missing: Callable[[], bool] = lambda: False,
        other_publisher_fault: Callable[[], str] = str,
    ) -> None:
        """Prepare to check.

        Parameters
        ----------
        node : Node
        subscriptions : dict of topic → QoSProfile
            Subscriptions of the node, except TF.
        transforms : tuple of str
            The topics of TF and of static TF; empty if the node does not subscribe to TF.
        frames_missing : callable
            Returns whether a sensor has no pose.
        other_publisher_fault : callable
            Returns the fault of another publisher of a transform that this node publishes, or ''.
        """
        self._node, self._subscriptions = node, subscriptions
        self._transforms, self._frames_missing = transforms, frames_missing
        self._other_publisher_fault = other_publisher_fault
        self._reported: set[str] = set()
        self._next = 0.0
        self._begin = time.monotonic()
        self._faults: list[str] = []

    def faults(self) -> list[str]:
        """Return the faults, in words."""
        now = time.monotonic()
        if now >= self._next:
            self._next = now + GRAPH_PERIOD
            self._faults = [*self._incompatible(), *self._transforms_lost(), *self._no_clock(), *self._same_names()]
            self._faults += filter(None, [self._other_publisher_fault()])
            for fault in self._faults:
                if fault not in self._reported and len(self._reported) < 100:
                    self._reported.add(fault)
                    self._node.get_logger().warning(fault)
        return self._faults

    def absent(self, kind: str, topics: Sequence[str]) -> str:
        """Return the reason why no 'Range' or 'Odometry' arrives on topics, for the end of a message; '' if unknown."""
        of_kind, said = KINDS[kind], []
        for topic in topics:
            types = {publisher.topic_type for publisher in self._node.get_publishers_info_by_topic(topic)}
            if not types:
                said.append(f'no node publishes {topic}')
            elif of_kind not in types:
                said.append(f'{topic} carries {", ".join(sorted(types))}, not {of_kind}')
        if not said:
            return ''
        elsewhere = sorted(
            topic
            for topic, types in self._node.get_topic_names_and_types()
            if of_kind in types and topic not in topics and self._node.count_publishers(topic)
        )
        remedy = f'; {kind} is published on {listed(elsewhere)}: set {PARAMETER[kind]}' if elsewhere else ''
        return f': {", ".join(said)}{remedy}'

    def _incompatible(self) -> list[str]:
        faults = []
        of_transforms = dict.fromkeys(self._transforms, QoSProfile(depth=1, reliability=ReliabilityPolicy.RELIABLE))
        for topic, wanted in (self._subscriptions | of_transforms).items():
            for publisher in self._node.get_publishers_info_by_topic(topic):
                fit, _ = qos_check_compatible(publisher.qos_profile, wanted)
                if fit == QoSCompatibility.ERROR:
                    offered = publisher.qos_profile.reliability.name.lower()
                    remedy = (
                        'set its publisher to reliable'
                        if topic in of_transforms
                        else f'set range_reliability or odom_reliability to {offered}'
                    )
                    faults.append(
                        f'{publisher.node_name} publishes {topic} as {offered}, but this node requests '
                        f'{wanted.reliability.name.lower()}: no message is received; {remedy}'
                    )
        return list(dict.fromkeys(faults))

    def _transforms_lost(self) -> list[str]:
        """Return faults of publishers whose static transforms may have been sent before this node subscribed."""
        if not self._frames_missing():
            return []
        names = {
            f'{publisher.node_name} publishes {topic} as volatile: messages sent before this node subscribed are '
            'lost; set its publisher to transient_local (ros2 bag play: --qos-profile-overrides-path), or set '
            'sensors.*.pose'
            for topic in self._transforms[1:]
            for publisher in self._node.get_publishers_info_by_topic(topic)
            if publisher.qos_profile.durability == DurabilityPolicy.VOLATILE
        }
        return sorted(names)

    def _no_clock(self) -> list[str]:
        """Return the fault of missing simulated time, once there was time to discover publishers."""
        clock = self._node.get_clock()
        if not clock.ros_time_is_active or clock.now().nanoseconds or time.monotonic() < self._begin + GRAPH_PERIOD:
            return []
        topic = self._node.resolve_topic_name('/clock')
        who = 'publishes' if not self._node.count_publishers(topic) else 'has published on'
        return [
            f'use_sim_time is true, but no node {who} {topic}: maps have the stamp 0; start the simulation, play the '
            'bag with --clock, or leave out use_sim_time'
        ]

    def _same_names(self) -> list[str]:
        own = self._node.get_name(), self._node.get_namespace()
        count = sum(pair == own for pair in self._node.get_node_names_and_namespaces())
        name = self._node.get_fully_qualified_name()
        text = (
            f'{count} nodes have the name {name}: their maps and services are mixed up; start each with a different '
            'name, --ros-args -r __node:=NAME'
        )
        return [text] * (count > 1)
