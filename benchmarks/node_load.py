#!/usr/bin/env python3
"""Rate of readings that the node processes without a loss, and its cost.

usage: node_load.py [--rates 480 1000 2000 ...] [--seconds 10] [--best-effort] [--em]

Starts the node in its own process, publishes Range from 24 sonars at each rate, with odometry at 50 Hz, and reads the
node's counts from /diagnostics. `lost` is the number of readings that never arrived, `est.` the number of losses that
the node estimated, `cpu` the node's use of one core, `delay` the longest time from publishing a reading to its
callback. With --em, EM runs repeatedly on all readings so far. Needs rclpy.
"""

from __future__ import annotations

import argparse
import math
import os
import platform
import subprocess
import sys
import time
from pathlib import Path
from typing import Any

os.environ.setdefault('ROS_AUTOMATIC_DISCOVERY_RANGE', 'LOCALHOST')
os.environ['ROS_DOMAIN_ID'] = str(os.getpid() % 100)

import numpy as np
import rclpy
from diagnostic_msgs.msg import DiagnosticArray
from nav_msgs.msg import Odometry
from rclpy.qos import QoSProfile, ReliabilityPolicy
from sensor_msgs.msg import Range
from std_srvs.srv import Trigger

SONARS = 24
ESTIMATE = 'lost in the middleware (estimated)'


def cpu_seconds(pid: int) -> float:
    """Return the seconds of CPU that a process has used."""
    fields = Path(f'/proc/{pid}/stat').read_text().rpartition(')')[2].split()
    return (int(fields[11]) + int(fields[12])) / os.sysconf('SC_CLK_TCK')


class Load:
    """A robot that drives in a circle and fires its sonars in turn."""

    def __init__(self, reliable: bool) -> None:
        rclpy.init()
        self.node = rclpy.create_node('load')
        quality = QoSProfile(
            depth=5000, reliability=ReliabilityPolicy.RELIABLE if reliable else ReliabilityPolicy.BEST_EFFORT
        )
        self.ranges = self.node.create_publisher(Range, 'sonar', quality)
        self.odometry = self.node.create_publisher(Odometry, 'odom', quality)
        self.counts = {'received': 0, 'accepted': 0, ESTIMATE: 0}
        self.ready = False
        self.node.create_subscription(DiagnosticArray, '/diagnostics', self._on_diagnostics, 10)
        self.sent = 0
        self.delay = 0.0
        self.em = self.node.create_client(Trigger, '/forward_grid_mapper/run_em')
        self.runs: list[str] = []
        self.phase = 0.0
        self.message = Range(field_of_view=0.26, min_range=0.1, max_range=5.0)
        self.pose = Odometry(child_frame_id='base_link')
        self.pose.header.frame_id = 'odom'
        self.frames = [f'sonar_{k:02d}' for k in range(SONARS)]

    def _on_diagnostics(self, array: DiagnosticArray) -> None:
        for status in array.status:
            values = {pair.key: pair.value for pair in status.values}
            if status.name.endswith('background'):
                self.ready = 'compiling' not in status.message
            self.delay = max(self.delay, float(values.get('longest delay of a reading (ms)', 0.0)))
            for key in self.counts:
                if f'readings {key}' in values:
                    self.counts[key] = int(values[f'readings {key}'])

    def stamp(self, header: Any) -> None:
        """Set the stamp of a message to the current time."""
        header.stamp.sec, header.stamp.nanosec = divmod(time.time_ns(), 1_000_000_000)

    def run(self, rate: float, seconds: float, em: bool) -> None:
        """Publish `rate` readings a second for this many seconds."""
        begin = time.monotonic()
        fired = moved = 0
        running = None
        while (now := time.monotonic() - begin) < seconds:
            while moved < now * 50:
                self.phase += 0.004
                self.pose.pose.pose.position.x = 3 * math.cos(self.phase)
                self.pose.pose.pose.position.y = 3 * math.sin(self.phase)
                self.pose.pose.pose.orientation.z = math.sin(self.phase / 2)
                self.pose.pose.pose.orientation.w = math.cos(self.phase / 2)
                self.stamp(self.pose.header)
                self.odometry.publish(self.pose)
                moved += 1
            while fired < now * rate:
                self.message.header.frame_id = self.frames[fired % SONARS]
                self.message.range = 2.0 + math.sin(0.1 * fired)
                self.stamp(self.message.header)
                self.ranges.publish(self.message)
                fired += 1
            if em:
                if running is None or running.done():
                    if running is not None:
                        self.runs.append(running.result().message)
                    running = self.em.call_async(Trigger.Request())
                rclpy.spin_once(self.node, timeout_sec=0.0)
            time.sleep(0.0005)
        self.sent += fired

    def settle(self, seconds: float = 4.0) -> None:
        """Wait until the node has counted all messages, or receives no more."""
        end = time.monotonic() + seconds
        while time.monotonic() < end and self.counts['received'] < self.sent:
            before = self.counts['received']
            rclpy.spin_once(self.node, timeout_sec=0.1)
            if self.counts['received'] != before:
                end = time.monotonic() + seconds


def main() -> None:
    """Run the benchmark."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument('--rates', type=float, nargs='+', default=[480, 1000, 2000, 3000, 4000])
    parser.add_argument('--seconds', type=float, default=10.0, help='at each rate (default 10)')
    parser.add_argument('--em', action='store_true', help='run EM all the while')
    parser.add_argument('--best-effort', action='store_true', help="publish with sensor-data's best effort")
    options = parser.parse_args()
    reliability = 'best_effort' if options.best_effort else 'reliable'
    command = [sys.executable, '-m', 'forward_grid_mapper.node.main', '--ros-args']
    for name in ('range_reliability', 'odom_reliability'):
        command += ['-p', f'{name}:={reliability}']
    for k in range(SONARS):
        command += ['-p', f'sensors.sonar_{k:02d}.pose:=[0.2, 0.0, {2 * math.pi * k / SONARS}]']
    node = subprocess.Popen(command, stdout=subprocess.DEVNULL, stderr=subprocess.DEVNULL)
    try:
        load = Load(not options.best_effort)
        while not (load.ready and load.ranges.get_subscription_count() and load.odometry.get_subscription_count()):
            rclpy.spin_once(load.node, timeout_sec=0.1)
        print(
            f'{platform.processor() or platform.machine()}, {os.cpu_count()} cores, Python {platform.python_version()}'
        )
        print(f'numpy {np.__version__}, {reliability}, {options.seconds:g} s at each rate')
        heads = ('Range/s', 'sent', 'lost', 'est.', 'accepted', 'cpu', 'delay ms', 'EM runs')
        print(''.join(f'{head:>10s}' for head in heads))
        for rate in options.rates:
            sent, received, accepted = load.sent, load.counts['received'], load.counts['accepted']
            noticed = load.counts[ESTIMATE]
            cpu = cpu_seconds(node.pid)
            load.delay, load.runs = 0.0, []
            load.run(rate, options.seconds, options.em)
            cpu = (cpu_seconds(node.pid) - cpu) / options.seconds
            load.settle()
            lost = (load.sent - sent) - (load.counts['received'] - received)
            taken, noticed = load.counts['accepted'] - accepted, load.counts[ESTIMATE] - noticed
            row = (
                f'{rate:.0f}',
                load.sent - sent,
                lost,
                noticed,
                taken,
                f'{cpu:.0%}',
                f'{load.delay:.1f}',
                len(load.runs),
            )
            print(''.join(f'{value:>10}' for value in row), flush=True)
        if load.runs:
            print(f'last EM: {load.runs[-1]}')
    finally:
        node.terminate()
        node.wait(10)
        rclpy.try_shutdown()


if __name__ == '__main__':
    main()
