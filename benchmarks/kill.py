#!/usr/bin/env python3
"""Kills a node that keeps a journal, again and again, and counts what was lost.

usage: kill.py [--times 50] [--rate 200] [--seed 1]

A robot publishes all the time. The node is started, killed (SIGKILL) at a random moment, and started again with the
same journal. After each kill, every reading that was published between the first that the node took and one second
before the kill must be in the journal, once. Needs rclpy.
"""

from __future__ import annotations

import argparse
import os
import random
import subprocess
import sys
import tempfile
import threading
import time
from pathlib import Path

os.environ.setdefault('ROS_AUTOMATIC_DISCOVERY_RANGE', 'LOCALHOST')
os.environ['ROS_DOMAIN_ID'] = str(1 + os.getpid() % 100)

import numpy as np
import rclpy
from nav_msgs.msg import Odometry
from rclpy.qos import QoSProfile
from sensor_msgs.msg import Range

from forward_grid_mapper.files.journal import drive_file
from forward_grid_mapper.files.journal_format import Contents
from forward_grid_mapper.files.journal_reader import read

SECOND = 1_000_000_000


class Robot:
    """Publishes a reading and an odometry message at a steady rate, each stamped with now, in a thread."""

    def __init__(self, rate: float) -> None:
        rclpy.init()
        self.node = rclpy.create_node('robot')
        quality = QoSProfile(depth=1000)
        self._ranges = self.node.create_publisher(Range, 'sonar', quality)
        self._odometry = self.node.create_publisher(Odometry, 'odom', quality)
        self._rate = rate
        self.stamps: list[int] = []
        threading.Thread(target=self._run, daemon=True).start()

    def _run(self) -> None:
        reading = Range(range=2.0, min_range=0.1, max_range=5.0, field_of_view=0.3)
        reading.header.frame_id = 'sonar'
        pose = Odometry(child_frame_id='base_link')
        pose.header.frame_id = 'odom'
        while True:
            stamp = time.time_ns()
            for header in (reading.header, pose.header):
                header.stamp.sec, header.stamp.nanosec = divmod(stamp, SECOND)
            pose.pose.pose.position.x = len(self.stamps) * 1e-4
            self._odometry.publish(pose)
            self._ranges.publish(reading)
            self.stamps.append(stamp)
            time.sleep(1.0 / self._rate)


def start(folder: Path) -> subprocess.Popen[bytes]:
    """Start the node with a journal."""
    values = {
        'range_reliability': 'reliable',
        'odom_reliability': 'reliable',
        'sensors.sonar.pose': '[0.1, 0.0, 0.4]',
        'journal': str(folder),
    }
    command = [sys.executable, '-m', 'forward_grid_mapper.node.main', '--ros-args']
    for name, value in values.items():
        command += ['-p', f'{name}:={value}']
    return subprocess.Popen(command, stdout=subprocess.DEVNULL, stderr=subprocess.DEVNULL)


def kept(folder: Path) -> np.ndarray:
    """Return the stamps of the readings in the journal."""
    path = drive_file(folder)
    found = [readings.stamp for readings in read(path, Contents())] if path else []
    return np.concatenate([np.zeros(0, np.int64), *found])


def main() -> int:
    """Run the kills; return 1 if anything was lost that should not be."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument('--times', type=int, default=50)
    parser.add_argument('--rate', type=float, default=200.0)
    parser.add_argument('--seed', type=int, default=1)
    options = parser.parse_args()
    rng = random.Random(options.seed)
    robot = Robot(options.rate)
    lost = twice = idle = 0
    worst = 0.0
    with tempfile.TemporaryDirectory() as name:
        folder = Path(name) / 'journal'
        for _ in range(options.times):
            begin, before = time.time_ns(), len(kept(folder))
            process = start(folder)
            time.sleep(rng.uniform(1.5, 6.0))
            died = time.time_ns()
            process.kill()
            process.wait()
            stamps = kept(folder)
            if not np.isin(stamps[:before], stamps).all() or len(stamps) < before:
                lost += 1
            twice += len(stamps) - len(np.unique(stamps))
            new = stamps[before:]
            if not len(new):
                idle += 1
                continue
            sent = np.array(robot.stamps)
            due = sent[(sent >= new.min()) & (sent > begin) & (sent < died)]
            missing = due[~np.isin(due, new)]
            lost += int(np.count_nonzero(missing < died - SECOND))
            worst = max(worst, (died - int(missing.min())) / SECOND if len(missing) else 0.0)
        total = len(kept(folder))
    rclpy.shutdown()
    print(f'{options.times} kills ({idle} before the first reading), {total} readings in the journal, {twice} twice')
    print(f'lost before the last second: {lost}; the oldest reading that was lost was {worst:.2f} s old')
    return 1 if lost or twice else 0


if __name__ == '__main__':
    sys.exit(main())
