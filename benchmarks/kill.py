#!/usr/bin/env python3
"""Kills a node with a journal repeatedly, after various faults, and counts lost readings.

usage: kill.py [--times 50] [--rate 200] [--seed 1]

A robot publishes all the time. The node is started, killed (SIGKILL) at a random moment, and started again with the
same journal. Before each kill there is another fault, in turn:

    nothing
    reset         ~/reset is called until the kill
    deleted       the file and its log are deleted
    moved         the file is renamed
    cut           the file and its log are cut off at a random length
    full          the files cannot grow for three seconds
    descriptors   the process has no free file descriptor
    hostile       before the start, the newest file is replaced by a database with an endless view, with readings that
                  are not finite, with a trigger, by random bytes, or by a pipe
    starting      the node is killed at a random moment after its start

After each kill, every reading that was published between the first one accepted by the node and one second before the
kill must be in a file of the journal, and none twice in a file; all readings of a file that was deleted, moved or
truncated must be in another one. No node may print a traceback. Needs rclpy.
"""

from __future__ import annotations

import argparse
import contextlib
import os
import random
import resource
import sqlite3
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
from std_srvs.srv import Trigger

from forward_grid_mapper.core.common.errors import BagError
from forward_grid_mapper.files.journal import drive_file, drives
from forward_grid_mapper.files.journal_format import APPLICATION, ROW, TABLES, VERSION, Contents
from forward_grid_mapper.files.journal_opening import log_of
from forward_grid_mapper.files.journal_reader import read

SECOND = 1_000_000_000
START = 600
"""Longest time from the start of a node to its first reading, seconds; the first start compiles kernels."""

KINDS = ('nothing', 'reset', 'deleted', 'moved', 'cut', 'full', 'descriptors', 'hostile', 'starting')


class Robot:
    """Publishes readings and odometry at a steady rate, with the current time as stamps, in a thread."""

    def __init__(self, rate: float) -> None:
        rclpy.init()
        self.node = rclpy.create_node('robot')
        quality = QoSProfile(depth=1000)
        self._ranges = self.node.create_publisher(Range, 'sonar', quality)
        self._odometry = self.node.create_publisher(Odometry, 'odom', quality)
        self._reset = self.node.create_client(Trigger, 'forward_grid_mapper/reset')
        self._rate = rate
        self.stamps: list[int] = []
        self._ended = threading.Event()
        self._thread = threading.Thread(target=self._run, daemon=True)
        self._thread.start()

    def stop(self) -> None:
        """Stop publishing."""
        self._ended.set()
        self._thread.join()
        rclpy.shutdown()

    def reset(self) -> None:
        """Call ~/reset repeatedly."""
        self._reset.call_async(Trigger.Request())

    def _run(self) -> None:
        reading = Range(range=2.0, min_range=0.1, max_range=5.0, field_of_view=0.3)
        reading.header.frame_id = 'sonar'
        pose = Odometry(child_frame_id='base_link')
        pose.header.frame_id = 'odom'
        while not self._ended.is_set():
            stamp = time.time_ns()
            for header in (reading.header, pose.header):
                header.stamp.sec, header.stamp.nanosec = divmod(stamp, SECOND)
            pose.pose.pose.position.x = len(self.stamps) * 1e-4
            self._odometry.publish(pose)
            self._ranges.publish(reading)
            self.stamps.append(stamp)
            time.sleep(1.0 / self._rate)


class Node:
    """The node with a journal, in its own process."""

    def __init__(self, folder: Path, log: Path) -> None:
        values = {
            'range_reliability': 'reliable',
            'odom_reliability': 'reliable',
            'sensors.sonar.pose': '[0.1, 0.0, 0.4]',
            'journal': str(folder),
        }
        command = [sys.executable, '-m', 'forward_grid_mapper.node.main', '--ros-args']
        for name, value in values.items():
            command += ['-p', f'{name}:={value}']
        self.log = log
        with log.open('w') as out:
            self.process = subprocess.Popen(command, stdout=out, stderr=subprocess.STDOUT)

    def kill(self) -> str:
        """Kill it; return its output."""
        self.process.kill()
        self.process.wait()
        return self.log.read_text()


def in_file(path: Path) -> np.ndarray:
    """Return the stamps of the readings in a journal file; none if it is not a journal."""
    found = [np.zeros(0, np.int64)]
    with contextlib.suppress(BagError):
        found += [readings.stamp for readings in read(path, Contents())]
    return np.concatenate(found)


def kept(folder: Path) -> np.ndarray:
    """Return the stamps of the readings in all files of a journal, without repetitions."""
    return np.unique(np.concatenate([np.zeros(0, np.int64), *map(in_file, drives(folder))]))


def twice(folder: Path) -> int:
    """Return the number of readings that are twice in a file."""
    counts = [(len(stamps), len(np.unique(stamps))) for stamps in map(in_file, drives(folder))]
    return sum(count - unique for count, unique in counts)


def make_hostile(path: Path, rng: random.Random) -> str:
    """Replace a file by one that no node wrote; return its kind."""
    log_of(path).unlink(missing_ok=True)
    path.unlink()
    kind = rng.choice(['view', 'not finite', 'trigger', 'bytes', 'pipe'])
    if kind == 'bytes':
        path.write_bytes(b'SQLite format 3\0' + rng.randbytes(20_000))
    elif kind == 'pipe':
        os.mkfifo(path)
    else:
        made = sqlite3.connect(path, isolation_level=None)
        for sql in TABLES.values():
            made.execute(sql)
        made.execute(f'PRAGMA application_id={APPLICATION}')
        made.execute(f'PRAGMA user_version={VERSION}')
        made.execute("INSERT INTO drive VALUES (0, x'6f646f6d', x'626173655f6c696e6b', x'7b7d')")
        made.execute("INSERT INTO sensors VALUES (0, x'736f6e6172')")
        if kind == 'view':
            endless = 'WITH RECURSIVE n(i) AS (SELECT 0 UNION ALL SELECT i + 1 FROM n)'
            made.execute('DROP TABLE readings')
            made.execute(f'CREATE VIEW readings AS {endless} SELECT i AS number, zeroblob(68) AS rows FROM n')
        elif kind == 'trigger':
            made.execute('CREATE TRIGGER t AFTER INSERT ON readings BEGIN DELETE FROM readings; END')
        else:
            rows = np.zeros(1000, ROW)
            rows['x'] = np.nan
            made.execute('INSERT INTO readings VALUES (0, ?)', (rows.tobytes(),))
        made.close()
    return f'hostile ({kind})'


def keep_from_growing(node: Node, folder: Path) -> None:
    """Bound the size of files for three seconds, and wait three more."""
    largest = max(path.stat().st_size for path in folder.iterdir() if path.is_file())
    unbounded = (resource.RLIM_INFINITY, resource.RLIM_INFINITY)
    resource.prlimit(node.process.pid, resource.RLIMIT_FSIZE, (largest, resource.RLIM_INFINITY))
    time.sleep(3.0)
    resource.prlimit(node.process.pid, resource.RLIMIT_FSIZE, unbounded)
    time.sleep(3.0)


def cause_fault(kind: str, node: Node, robot: Robot, folder: Path, rng: random.Random) -> None:
    """Cause a fault before the kill, and wait until the node can notice."""
    path = drive_file(folder)
    assert path is not None
    files = [file for file in (path, log_of(path)) if file.exists()]
    if kind == 'reset':
        for _ in range(rng.randrange(1, 5)):
            robot.reset()
            time.sleep(rng.uniform(0.0, 0.5))
    elif kind == 'deleted':
        for file in files:
            file.unlink()
    elif kind == 'moved':
        path.rename(folder / 'moved')
    elif kind == 'cut':
        for file in files:
            os.truncate(file, rng.randrange(file.stat().st_size))
    elif kind == 'full':
        keep_from_growing(node, folder)
    elif kind == 'descriptors':
        # open files remain open
        resource.prlimit(node.process.pid, resource.RLIMIT_NOFILE, (3, 1024))
    if kind in ('deleted', 'moved', 'cut'):
        time.sleep(3.0)
    time.sleep(rng.uniform(0.0, 2.0))


def main() -> int:
    """Run the kills; return 1 if readings were lost that must not be."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument('--times', type=int, default=50)
    parser.add_argument('--rate', type=float, default=200.0)
    parser.add_argument('--seed', type=int, default=1)
    options = parser.parse_args()
    rng = random.Random(options.seed)
    robot = Robot(options.rate)
    lost = tracebacks = idle = 0
    worst = 0.0
    with tempfile.TemporaryDirectory() as name:
        folder = Path(name) / 'journal'
        for number in range(options.times):
            kind = KINDS[number % len(KINDS)]
            newest = drive_file(folder)
            if kind == 'hostile' and newest is not None:
                kind = make_hostile(newest, rng)
            begin, before = time.time_ns(), kept(folder)
            node = Node(folder, Path(name) / 'log')
            if kind == 'starting':
                time.sleep(rng.uniform(0.0, 10.0))
            else:
                while not (kept(folder) > begin).any():
                    if node.process.poll() is not None or time.time_ns() > begin + START * SECOND:
                        print(f'the node does not write: {node.kill()}')
                        return 1
                    time.sleep(0.2)
                before = kept(folder)
                cause_fault(kind, node, robot, folder, rng)
            died = time.time_ns()
            said = node.kill()
            stamps = kept(folder)
            missing_before = int(np.count_nonzero(~np.isin(before, stamps)))
            tracebacks += 'Traceback' in said
            new = stamps[stamps > begin]
            age = 0.0
            if len(new):
                sent = np.array(robot.stamps)
                due = sent[(sent >= new.min()) & (sent < died)]
                missing = due[~np.isin(due, new)]
                age = (died - int(missing.min())) / SECOND if len(missing) else 0.0
                lost += int(np.count_nonzero(missing < died - SECOND))
            else:
                idle += 1
            lost += missing_before
            worst = max(worst, age)
            print(f'{number + 1:3d} {kind:22s} {len(new):6d} new, the oldest that was lost {age:.2f} s old', flush=True)
            if missing_before:
                print(f'    {missing_before} of {len(before)} that were in a file are in none')
        total, doubled = len(kept(folder)), twice(folder)
    robot.stop()
    print(f'{options.times} kills ({idle} before the first reading), {total} readings in the journal, {doubled} twice')
    print(f'lost before the last second: {lost}; the oldest reading that was lost was {worst:.2f} s old')
    print(f'nodes that printed a traceback: {tracebacks}')
    return 1 if lost or doubled or tracebacks else 0


if __name__ == '__main__':
    sys.exit(main())
