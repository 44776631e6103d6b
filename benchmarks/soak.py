#!/usr/bin/env python3
"""A drive of hours, compressed in time: whether memory and delays are constant, and the maps right.

usage: soak.py [--readings 1000000] [--max-readings 200000] [--journal]

A robot with 24 sonars drives back and forth in the simulated corridor, each tour with its own noise: 24 000 readings in
four minutes. Its messages are passed to the callbacks of the node, in this process, as fast as they are processed;
after every simulated second the node's timers are run. At the end EM runs, and the maps are scored against the world,
beside those of the first tour alone. Needs rclpy.
"""

from __future__ import annotations

import argparse
import gc
import heapq
import os
import platform
import sys
import tempfile
import time
from collections.abc import Iterator
from pathlib import Path
from typing import Any

os.environ.setdefault('ROS_AUTOMATIC_DISCOVERY_RANGE', 'LOCALHOST')
os.environ.setdefault('ROS_DOMAIN_ID', str(1 + os.getpid() % 100))

import numpy as np
import rclpy
from nav_msgs.msg import Odometry
from rclpy.parameter import Parameter
from sensor_msgs.msg import Range

from forward_grid_mapper.core.mapping import Mapper
from forward_grid_mapper.core.messages.message_types import NANOSECONDS, OdometryMessage, RangeMessage
from forward_grid_mapper.node.mapper_node import MapperNode
from forward_grid_mapper.simulation.drive import corridor_drive
from forward_grid_mapper.simulation.score import score_map, threshold, visible_surface

TOUR = 24_000
TICK = NANOSECONDS
"""Simulated time between two runs of the timers."""


def resident() -> float:
    """Return the memory that this process uses, in MB."""
    return int(Path('/proc/self/statm').read_text().split()[1]) * os.sysconf('SC_PAGE_SIZE') / 1e6


def ros(message: RangeMessage | OdometryMessage) -> Range | Odometry:
    """Return the message in the form of a subscription."""
    if isinstance(message, RangeMessage):
        made = Range(
            range=message.range,
            min_range=message.min_range,
            max_range=message.max_range,
            field_of_view=message.field_of_view,
        )
    else:
        made = Odometry(child_frame_id=message.child_frame_id)
        assert message.pose is not None
        made.pose.pose.position.x, made.pose.pose.position.y = message.pose.x, message.pose.y
        turn = made.pose.pose.orientation
        turn.z, turn.w = float(np.sin(message.pose.yaw / 2)), float(np.cos(message.pose.yaw / 2))
    made.header.frame_id = message.frame_id
    made.header.stamp.sec, made.header.stamp.nanosec = divmod(message.stamp, NANOSECONDS)
    return made


def messages(tours: int) -> Iterator[RangeMessage | OdometryMessage]:
    """Yield the messages of this many tours by stamp, one tour after the other."""
    shift = 0
    for seed in range(tours):
        drive = corridor_drive(seed, passes=2)
        last = 0
        both: Iterator[RangeMessage | OdometryMessage]
        both = heapq.merge(drive.odometry, drive.ranges, key=lambda message: message.stamp)
        for message in both:
            last = message.stamp
            yield message._replace(stamp=last + shift)
        shift += last - drive.odometry[0].stamp + NANOSECONDS // 50


class Soak:
    """The node in this process, with measurements."""

    def __init__(self, max_readings: int, folder: Path, journal: bool) -> None:
        extrinsics = corridor_drive(0, passes=1).extrinsics
        values: dict[str, Any] = {f'sensors.{frame}.pose': [*map(float, pose)] for frame, pose in extrinsics}
        values |= {'max_readings': max_readings, 'save_directory': str(folder)}
        if journal:
            values['journal'] = str(folder / 'journal')
        self.node = MapperNode(parameter_overrides=[Parameter(k, value=v) for k, v in values.items()])
        self.node.start()
        while not (self.node.mapping and self.node.kernels.has('EM')):
            self.node.inbox.work()
            time.sleep(0.01)
        self.message: list[float] = []
        self.update: list[float] = []
        self.live: list[float] = []

    def take(self, message: Range | Odometry) -> None:
        """Pass a message to the node."""
        intake, info = self.node.intake, {'source_timestamp': time.time_ns()}
        begin = time.perf_counter()
        if isinstance(message, Range):
            intake.on_range(intake.range_losses[0], message, info)
        else:
            intake.on_odometry(message, info)
        self.message.append(time.perf_counter() - begin)

    def tick(self) -> None:
        """Run the node's timers."""
        begin = time.perf_counter()
        self.node.publish_live()
        self.update.append(time.perf_counter() - begin)
        self.node.journal.take()
        self.node.reporter.report()
        self.node.intake.work()
        self.node.inbox.work()
        self.live.append(time.perf_counter() - begin)
        # the drive is a thousand times as fast as a real one, so the thread of the live map may fall behind
        if self.node.live.worker.waiting > 20:
            self.node.live.snapshot()

    def row(self, seconds: float) -> str:
        """Return the measurements since the last row."""
        buffer = self.node.associator.buffer
        worst, typical = 1e3 * max(self.message), 1e6 * float(np.median(self.message))
        update, live = (1e3 * max(x) for x in (self.update, self.live))
        for measured in (self.message, self.update, self.live):
            measured.clear()
        gc.collect()
        return (
            f'{len(buffer):10d}{buffer.stored:9d}{seconds / 3600:8.2f}{resident():9.0f}{typical:10.1f}{worst:10.1f}'
            f'{update:10.2f}{live:10.2f}'
        )


def main() -> None:
    """Run the soak."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument('--readings', type=int, default=1_000_000)
    parser.add_argument('--max-readings', type=int, default=200_000)
    parser.add_argument('--journal', action='store_true', help='keep a journal as well')
    options = parser.parse_args()
    # as in the node
    sys.setswitchinterval(0.0005)
    rclpy.init(args=['soak', '--ros-args', '--log-level', 'ERROR'])
    print(f'{platform.machine()}, {os.cpu_count()} cores, Python {platform.python_version()}, numpy {np.__version__}')
    with tempfile.TemporaryDirectory() as folder:
        soak = Soak(options.max_readings, Path(folder), options.journal)
        begin = time.monotonic()
        print('  readings     held   hours    RSS MB    us/msg  worst ms   feed ms timers ms', flush=True)
        start = due = shown = 0
        tours = -(-options.readings // TOUR)
        for message in messages(tours):
            start = start or message.stamp
            soak.take(ros(message))
            if message.stamp >= due:
                due = message.stamp + TICK
                soak.tick()
            if len(soak.node.associator.buffer) >= shown + options.readings // 20:
                shown = len(soak.node.associator.buffer)
                print(soak.row((message.stamp - start) / NANOSECONDS), flush=True)
        soak.tick()
        associator = soak.node.associator
        print(
            f'{associator.received} received, {len(associator.buffer)} accepted, {associator.waiting} waiting, ', end=''
        )
        print(f'rejected: {dict(associator.rejected)}; {time.monotonic() - begin:.0f} s in all')
        live = soak.node.live.snapshot()
        soak.node.close()
        if options.journal:
            size = sum(path.stat().st_size for path in (Path(folder) / 'journal').iterdir())
            print(f'the journal has {size / 1e6:.1f} MB, {size / len(associator.buffer):.0f} bytes a reading')
        first = corridor_drive(0, passes=2)
        visible = visible_surface(first.world, first.readings.select(slice(None, None, 20)))
        for name, readings in (('first tour', first.readings), ('all of it', associator.readings)):
            maps = Mapper(soak.node.parameters).run(readings)
            scores = score_map(maps.ml, maps.grid, first.world, visible)
            summary = f'ML F1 {scores.f1:.3f}, {scores.doors_open} of 6 doors, {scores.false_dots} false dots'
            if name == 'all of it':
                scores = score_map(threshold(live.probability), live.grid, first.world, visible)
                summary += f'; live map F1 {scores.f1:.3f}'
            print(f'{name}: {len(maps.readings)} readings, {summary}, {sum(maps.statistics["seconds"].values()):.1f} s')
        soak.node.destroy_node()
    rclpy.shutdown()


if __name__ == '__main__':
    main()
