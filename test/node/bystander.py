"""A process that the tests of faults kill or stop: it calls a service, subscribes to a map, or publishes a drive."""

from __future__ import annotations

import sys
import time
from typing import Any

import rclpy
from nav_msgs.msg import OccupancyGrid
from rclpy.qos import DurabilityPolicy, QoSProfile, ReliabilityPolicy
from robot import Robot
from std_srvs.srv import Trigger

LATCHED = QoSProfile(depth=1, reliability=ReliabilityPolicy.RELIABLE, durability=DurabilityPolicy.TRANSIENT_LOCAL)


def call(name: str) -> None:
    rclpy.init()
    node = rclpy.create_node('caller')
    client = node.create_client(Trigger, name)
    client.wait_for_service()
    future = client.call_async(Trigger.Request())
    print('called', flush=True)
    rclpy.spin_until_future_complete(node, future)
    print(future.result(), flush=True)


def listen(topic: str) -> None:
    rclpy.init()
    node = rclpy.create_node('listener')
    node.create_subscription(OccupancyGrid, topic, lambda message: print('a map', flush=True), LATCHED)
    rclpy.spin(node)


def publish(first: str, count: str) -> None:
    import os

    from fault_samples import circle

    robot = Robot(int(os.environ['ROS_DOMAIN_ID']))
    robot.meet()
    messages: list[Any] = circle(int(first), int(count))
    for message in messages:
        robot.send(message)
        time.sleep(0.001)
    print('published', flush=True)
    time.sleep(60.0)


if __name__ == '__main__':
    {'call': call, 'listen': listen, 'publish': publish}[sys.argv[1]](*sys.argv[2:])
