"""Node and offline tool use the same readings and make the same live map, for any order of messages."""

from __future__ import annotations

import random
from typing import Any

import numpy as np
import pytest

pytest.importorskip('rclpy', reason='the parts of the node need rclpy')

from forward_grid_mapper.core.common.parameters import Parameters
from forward_grid_mapper.core.common.readings import Readings, in_canonical_order
from forward_grid_mapper.core.messages.message_types import NANOSECONDS, OdometryMessage, Pose2, RangeMessage
from forward_grid_mapper.core.messages.pose_association import PoseAssociator
from forward_grid_mapper.node.live import LiveMap, LiveSnapshot
from forward_grid_mapper.recordings.drive import FullLiveMap

DRIVES = 100
EXTRINSICS = {'left': Pose2(0.1, 0.1, 1.5), 'right': Pose2(0.1, -0.1, -1.5)}


def drive(rng: random.Random) -> list[Any]:
    """Messages by stamp of a robot on a random path, sometimes far away or with a gap in odometry."""
    messages: list[Any] = []
    x = y = yaw = 0.0
    gap = rng.uniform(1.0, 4.0)
    for k in range(rng.randrange(30, 120)):
        stamp = 100 * NANOSECONDS + k * NANOSECONDS // 20
        speed = rng.choice((0.02, 0.05, 0.3))
        x, y, yaw = x + rng.uniform(-speed, 1.5 * speed), y + rng.uniform(-speed, speed), yaw + rng.uniform(-0.3, 0.3)
        if abs(k / 20 - gap) > rng.choice((0.0, 0.0, 0.6)):
            messages.append(OdometryMessage(stamp, 'odom', 'base', Pose2(x, y, yaw)))
        for frame in EXTRINSICS:
            z = rng.choice((rng.uniform(0.05, 4.5), 4.0, 0.6, float('inf')))
            messages.append(RangeMessage(stamp + rng.randrange(40_000_000), frame, z, 0.1, 4.0, 0.3))
    # so that odometry covers all ranges, as at the end of the offline tool
    messages.append(OdometryMessage(messages[-1].stamp + NANOSECONDS // 10, 'odom', 'base', Pose2(x, y, yaw)))
    return sorted(messages, key=lambda message: message.stamp)


def lookup(base: str, frame: str, stamp: int) -> Pose2:
    return EXTRINSICS[frame]


def late(messages: list[Any], rng: random.Random) -> list[Any]:
    """The messages in order of arrival: each topic in order, ranges up to a second early or late."""
    lag = rng.uniform(-1.0, 1.0) * NANOSECONDS
    return sorted(messages, key=lambda message: message.stamp + (lag if isinstance(message, RangeMessage) else 0))


def of_the_node(messages: list[Any], parameters: Parameters, rng: random.Random) -> tuple[Readings, LiveSnapshot, int]:
    associator = PoseAssociator(lookup, parameters, at_once=rng.choice((1, 7, 200)))
    aside: list[Any] = []
    associator.buffer.run_in_background = lambda thin, done: aside.append((thin, done))
    live, fed = LiveMap(parameters, lambda snapshot: None, print), 0

    def feed() -> None:
        nonlocal fed
        live.offer(associator.buffer.snapshot(fed))
        fed = len(associator.buffer)

    associator.buffer.before_thinning.append(feed)
    for message in messages:
        while associator.behind:
            associator.settle()
        if isinstance(message, RangeMessage):
            associator.add_range(message)
        else:
            associator.add_odometry(message)
        if rng.random() < 0.1:
            feed()
        if aside and rng.random() < 0.1:
            thin, done = aside.pop()
            done(thin())
    while associator.behind:
        associator.settle()
    feed()
    snapshot = live.snapshot()
    live.worker.close(10.0)
    return associator.readings, snapshot, len(associator.buffer)


@pytest.mark.parametrize('max_readings', [0, 60])
def test_node_and_offline_use_the_same_readings_in_any_order(max_readings: int) -> None:
    parameters = Parameters.from_flat({'max_readings': max_readings})
    for seed in range(DRIVES):
        rng = random.Random(seed)
        messages = drive(rng)
        offline = PoseAssociator(lookup, parameters, patient=True)
        whole = FullLiveMap(offline, parameters)
        for message in messages:
            if isinstance(message, RangeMessage):
                offline.add_range(message)
            else:
                offline.add_odometry(message)
        offline.finish()
        whole._add_new()
        theirs, live = in_canonical_order(offline.readings), whole._live
        readings, snapshot, accepted = of_the_node(late(messages, rng), parameters, rng)
        ours = in_canonical_order(readings)
        assert accepted == len(offline.buffer) > 0, seed
        for name in ('x', 'y', 'yaw', 'z', 'stamp'):
            assert np.array_equal(getattr(ours, name), getattr(theirs, name)), (seed, name)
        assert snapshot.grid == live.grid, seed
        assert np.array_equal(snapshot.probability, live.probability(), equal_nan=True), seed
