"""Faults around the node, which it can only see by asking: publishers it cannot receive from, and namesakes."""

from __future__ import annotations

import time
from typing import Any

from rclpy.qos import QoSCompatibility, QoSProfile, qos_check_compatible

PERIOD = 3.0
"""Seconds between two looks."""


class Surroundings:
    """Looks around now and then, and reports each fault once in the log and as long as it lasts in diagnostics."""

    def __init__(self, node: Any, subscriptions: dict[str, QoSProfile]) -> None:
        """`subscriptions` are the topics that the node listens to."""
        self._node, self._subscriptions = node, subscriptions
        self._reported: set[str] = set()
        self._next = 0.0
        self._faults: list[str] = []

    def faults(self) -> list[str]:
        """Return what is wrong, in words."""
        now = time.monotonic()
        if now >= self._next:
            self._next = now + PERIOD
            self._faults = [*self._deaf(), *self._namesakes()]
            for fault in self._faults:
                if fault not in self._reported and len(self._reported) < 100:
                    self._reported.add(fault)
                    self._node.get_logger().warning(fault)
        return self._faults

    def _deaf(self) -> list[str]:
        faults = []
        for topic, wanted in self._subscriptions.items():
            for publisher in self._node.get_publishers_info_by_topic(topic):
                fit, _ = qos_check_compatible(publisher.qos_profile, wanted)
                if fit == QoSCompatibility.ERROR:
                    offered = publisher.qos_profile.reliability.name.lower()
                    faults.append(
                        f'{publisher.node_name} publishes {topic} as {offered}, and this node asks for '
                        f'{wanted.reliability.name.lower()}: nothing of it is received; set range_reliability or '
                        f'odom_reliability to {offered}'
                    )
        return list(dict.fromkeys(faults))

    def _namesakes(self) -> list[str]:
        own = self._node.get_name(), self._node.get_namespace()
        count = sum(pair == own for pair in self._node.get_node_names_and_namespaces())
        name = self._node.get_fully_qualified_name()
        return [f'{count} nodes are called {name}: their maps and services mix; remap __node or __ns'] * (count > 1)
