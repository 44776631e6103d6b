#!/usr/bin/env python3
"""Longest times for which the node's executor is busy, or delayed.

usage: executor.py [--readings 500000] [--rate 500] [--seconds 30] [--cold] [--max-readings 500000]
       executor.py --messages

Starts a node in its own process, with the online map and a journal of this many readings of the simulated corridor to
restore, publishes Range and odometry meanwhile, and calls every service: EM runs, maps are requested and saved,
parameters change, and at last all is reset. A timer of 2 ms in the node's own executor measures the delay of its calls:
`late` is the longest delay, of which the executor's own thread computed for `own` ms. `most own` is its longest
computation between two calls. The rest of a delay is due to other threads that held the GIL, and to the machine:
`machine` is the longest delay of a process that does nothing else. With --cold, the kernels are compiled first. With
--messages, only the cost of making a message of a map with a million cells is measured. Needs rclpy.
"""

from __future__ import annotations

import argparse
import dataclasses
import math
import os
import subprocess
import sys
import tempfile
import threading
import time
from collections.abc import Callable, Iterable
from pathlib import Path
from typing import Any

os.environ.setdefault('ROS_AUTOMATIC_DISCOVERY_RANGE', 'LOCALHOST')
os.environ.setdefault('ROS_DOMAIN_ID', str(1 + os.getpid() % 100))
sys.path.insert(0, str(Path(__file__).parent))

import numpy as np

PERIOD = 0.002
SAMPLE = 0.1
"""Seconds of each line of the probe's output."""


class Probe:
    """A timer in the node's executor that records the delay of its calls."""

    def __init__(self, node: Any, clock: Any) -> None:
        self._last, self._cpu = time.monotonic(), time.thread_time()
        self._late = self._own = 0.0
        self._begin = self._last
        node.create_timer(PERIOD, self._tick, clock=clock)

    def _tick(self) -> None:
        now, cpu = time.monotonic(), time.thread_time()
        if now - self._last - PERIOD > self._late:
            self._late, self._own = now - self._last - PERIOD, cpu - self._cpu
        if now > self._begin + SAMPLE:
            print(f'probe {now:.4f} {self._late:.5f} {self._own:.5f}', flush=True)
            self._begin, self._late, self._own = now, 0.0, 0.0
        self._last, self._cpu = now, cpu


def run_control() -> None:
    """Measure the delay of a process that does nothing else."""
    late, begin = 0.0, time.monotonic()
    while True:
        last = time.monotonic()
        time.sleep(PERIOD)
        now = time.monotonic()
        late = max(late, now - last - PERIOD)
        if now > begin + SAMPLE:
            print(f'probe {now:.4f} {late:.5f} 0', flush=True)
            late, begin = 0.0, now


def run_node(arguments: list[str]) -> int:
    """Run the node with a probe in its executor."""
    from forward_grid_mapper.node import main, mapper_node

    start = mapper_node.MapperNode.start

    def probed(self: Any) -> None:
        start(self)
        Probe(self, self._steady)

    mapper_node.MapperNode.start = probed  # type: ignore[method-assign]
    return main.main(arguments)


def readings_of(count: int) -> Any:
    """Return this many readings: tours of the corridor, one after the other, each with its own noise."""
    from forward_grid_mapper.core.common.readings import Readings
    from forward_grid_mapper.simulation.drive import corridor_drive

    parts: list[Readings] = []
    begin = 0
    while sum(map(len, parts)) < count:
        readings = corridor_drive(len(parts), passes=2).readings
        stamp = readings.stamp - readings.stamp.min() + begin
        begin = int(stamp.max()) + 1_000_000_000
        parts.append(dataclasses.replace(readings, stamp=stamp))
    columns = {
        field.name: np.concatenate([getattr(part, field.name) for part in parts])
        for field in dataclasses.fields(Readings)
        if field.name != 'sensor_names'
    }
    return Readings(**columns, sensor_names=parts[0].sensor_names).select(slice(count))


class Output:
    """The output of a process, read in threads: the log has its own stream, so as not to mix with the probe's."""

    def __init__(self, process: subprocess.Popen[str]) -> None:
        self.samples: list[tuple[float, float, float]] = []
        self.lines: list[str] = []
        for stream in (process.stdout, process.stderr):
            if stream is not None:
                threading.Thread(target=self._read, args=(stream,), daemon=True).start()

    def _read(self, stream: Iterable[str]) -> None:
        for line in stream:
            if line.startswith('probe '):
                now, late, own = map(float, line.split()[1:])
                self.samples.append((now, late, own))
            else:
                self.lines.append(line)

    def has_logged(self, text: str) -> bool:
        """Return whether the node has logged a text."""
        return any(text in line for line in self.lines)

    def row(self, begin: float, end: float) -> str:
        """Return measurements of a time span: longest delay, the executor's part of it, longest computation, 99 %."""
        within = [(late, own) for now, late, own in self.samples if begin < now <= end + SAMPLE]
        late, own = max(within, default=(math.nan, math.nan))
        usual = np.percentile([late for late, _ in within], 99) if within else math.nan
        most = max((own for _, own in within), default=math.nan)
        return f'{1e3 * late:10.1f}{1e3 * own:10.1f}{1e3 * most:10.1f}{1e3 * usual:10.1f}'


class Load:
    """A robot that drives back and forth, and calls services."""

    def __init__(self, process: subprocess.Popen[str], rate: float, first: int) -> None:
        import rclpy
        from nav_msgs.msg import Odometry
        from rclpy.qos import QoSProfile, ReliabilityPolicy
        from sensor_msgs.msg import Range

        rclpy.init()
        self._process = process
        self.node = rclpy.create_node('load')
        quality = QoSProfile(depth=5000, reliability=ReliabilityPolicy.RELIABLE)
        self._ranges = self.node.create_publisher(Range, 'sonar', quality)
        self._odometry = self.node.create_publisher(Odometry, 'odom', quality)
        self._range = Range(field_of_view=0.26, min_range=0.1, max_range=3.0)
        self._pose = Odometry(child_frame_id='base_link')
        self._pose.header.frame_id = 'odom'
        self._rate, self._first, self._begin = rate, first, time.monotonic()
        self.sent = self._moved = 0

    def subscribed(self) -> bool:
        """Return whether the node has subscribed."""
        return bool(self._ranges.get_subscription_count() and self._odometry.get_subscription_count())

    def send(self) -> None:
        """Publish the messages that are due."""
        now = time.monotonic() - self._begin
        while self._moved < now * 50:
            at = self._moved / 50
            self._pose.pose.pose.position.x = 10.0 + 8.0 * math.sin(0.05 * at)
            self._pose.pose.pose.position.y = 1.0
            self._pose.pose.pose.orientation.w = 1.0
            self._stamp(self._pose.header, at)
            self._odometry.publish(self._pose)
            self._moved += 1
        while self.sent < now * self._rate:
            self._range.header.frame_id = f'sonar_{self.sent % 24:02d}'
            self._range.range = 1.0 + 0.5 * math.sin(0.1 * self.sent)
            self._stamp(self._range.header, self.sent / self._rate)
            self._ranges.publish(self._range)
            self.sent += 1

    def _stamp(self, header: Any, at: float) -> None:
        header.stamp.sec, header.stamp.nanosec = divmod(self._first + round(at * 1e9), 1_000_000_000)

    def until(self, condition: Callable[[], Any], seconds: float = 600.0) -> None:
        """Publish until a condition holds."""
        import rclpy

        end = time.monotonic() + seconds
        while not condition():
            if time.monotonic() > end:
                raise TimeoutError('the node does not answer')
            if self._process.poll() is not None:
                raise RuntimeError(f'the node ended with {self._process.returncode}')
            if self.subscribed():
                self.send()
            rclpy.spin_once(self.node, timeout_sec=0.001)

    def call(self, kind: Any, name: str, **fields: Any) -> Any:
        """Call a service, publishing meanwhile; return the answer."""
        from rclpy.qos import QoSProfile

        client = self.node.create_client(kind, f'/forward_grid_mapper/{name}', qos_profile=QoSProfile(depth=5000))
        self.until(client.service_is_ready)
        future = client.call_async(kind.Request(**fields))
        self.until(future.done)
        self.node.destroy_client(client)
        return future.result()


def measure(options: argparse.Namespace, folder: Path) -> None:
    """Start the node, and print a table."""
    from nav_msgs.srv import GetMap
    from rcl_interfaces.msg import Parameter, ParameterValue
    from rcl_interfaces.srv import SetParameters
    from std_srvs.srv import Trigger

    from forward_grid_mapper.files.journal import Journal

    readings = readings_of(options.readings)
    journal = Journal(folder / 'journal', print)
    list(journal.restore())
    for first in range(0, len(readings), 1000):
        journal.put(readings.select(slice(first, first + 1000)), ('odom', 'base_link'))
        while journal.unwritten > 100_000:
            time.sleep(0.01)
    journal.close(60.0)
    command = [sys.executable, __file__, '--node', '--ros-args', '-p', 'online:=true']
    for name in ('range_reliability', 'odom_reliability'):
        command += ['-p', f'{name}:=reliable']
    command += ['-p', f'journal:={folder}/journal', '-p', f'save_directory:={folder}/maps']
    command += ['-p', f'max_readings:={options.max_readings}']
    for k in range(24):
        command += ['-p', f'sensors.sonar_{k:02d}.pose:=[0.2, 0.0, {2 * math.pi * k / 24}]']
    environment = dict(os.environ)
    if options.cold:
        environment['NUMBA_CACHE_DIR'] = str(folder / 'cache')
    process = subprocess.Popen(
        command, stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True, bufsize=1, env=environment
    )
    control = subprocess.Popen([sys.executable, __file__, '--control'], stdout=subprocess.PIPE, text=True, bufsize=1)
    account, machine, begin = Output(process), Output(control), time.monotonic()
    load = Load(process, options.rate, int(readings.stamp.max()) + 10_000_000_000)
    print(
        f'{"":42s}{"s":>8s}{"late ms":>10s}{"own ms":>10s}{"most own":>10s}{"99 % late":>10s}{"machine":>10s}',
        flush=True,
    )

    def phase(name: str, work: Callable[[], object]) -> None:
        nonlocal begin
        work()
        end = time.monotonic()
        time.sleep(2 * SAMPLE)
        print(f'{name:42s}{end - begin:8.1f}{account.row(begin, end)}{machine.row(begin, end)[:10]}', flush=True)
        begin = time.monotonic()

    def wait(seconds: float) -> Callable[[], None]:
        end = time.monotonic() + seconds
        return lambda: load.until(lambda: time.monotonic() > end, seconds + 60)

    def set_parameters() -> None:
        for k in range(20):
            given = Parameter(name='p_hit', value=ParameterValue(type=3, double_value=0.5 + 0.01 * k))
            load.call(SetParameters, 'set_parameters', parameters=[given])

    answers: list[str] = []
    try:
        phase(
            f'start with {len(readings)} readings',
            lambda: load.until(lambda: load.subscribed() and account.has_logged('ready:')),
        )
        phase('online map catches up', wait(options.seconds))
        phase('EM', lambda: answers.append(load.call(Trigger, 'run_em').message))
        phase('50 maps', lambda: [load.call(GetMap, f'get_{name}') for name in ['live_map', 'ml_map'] * 25])
        phase('maps are saved', lambda: answers.append(load.call(Trigger, 'save_maps').message[:60]))
        phase('parameters change', set_parameters)
        phase('driving on', wait(options.seconds))
        phase('reset', lambda: answers.append(load.call(Trigger, 'reset').message))
        phase('driving on after it', wait(5.0))
    finally:
        process.terminate()
        control.kill()
        process.wait(20)
    print(f'{load.sent} ranges sent')
    print('\n'.join(answers))
    print(''.join(line for line in account.lines if 'WARN' in line or 'ERROR' in line), end='')


def measure_messages(side: int = 1000, times: int = 20) -> None:
    """Print the time that the thread of map messages needs for a million cells; it holds the GIL for most of it."""
    import rclpy
    from builtin_interfaces.msg import Time
    from nav_msgs.msg import OccupancyGrid

    from forward_grid_mapper.core.common.grid import Grid
    from forward_grid_mapper.node.grid_message import grid_message
    from forward_grid_mapper.node.map_publishers import LATCHED

    rng, grid = np.random.default_rng(0), Grid(0.1, 0, 0, side, side)
    cells = rng.integers(-1, 2, grid.shape).astype(np.int8)
    chances = np.where(cells < 0, np.nan, rng.random(grid.shape)).astype(np.float32)
    rclpy.init()
    node = rclpy.create_node('messages')
    out = node.create_publisher(OccupancyGrid, 'map', LATCHED)
    listener = node.create_subscription(OccupancyGrid, 'map', lambda message: None, LATCHED)
    while not out.get_subscription_count():
        time.sleep(0.01)
    message = grid_message(grid, cells, 'map', Time())

    def cost(work: Callable[[], object]) -> float:
        taken = []
        for _ in range(times):
            begin = time.thread_time()
            work()
            taken.append(time.thread_time() - begin)
        return 1e3 * float(np.median(taken))

    for name, work in (
        ('a maximum likelihood map becomes a message', lambda: grid_message(grid, cells, 'map', Time())),
        ('a live map or an uncertainty map does', lambda: grid_message(grid, chances, 'map', Time())),
        ('it is published, one subscription', lambda: out.publish(message)),
    ):
        print(f'{name:46s}{cost(work):8.2f} ms of a thread, {side}x{side} cells')
    node.destroy_subscription(listener)
    rclpy.shutdown()


def main() -> None:
    """Run the benchmark."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument('--readings', type=int, default=500_000)
    parser.add_argument('--max-readings', type=int, default=500_000)
    parser.add_argument('--rate', type=float, default=500.0, help='Range messages a second')
    parser.add_argument('--seconds', type=float, default=30.0, help='of the phases in which nothing is called')
    parser.add_argument('--cold', action='store_true', help='without a cache of kernels')
    parser.add_argument('--messages', action='store_true', help='only what a map costs as a message')
    options = parser.parse_args()
    if options.messages:
        measure_messages()
        return
    with tempfile.TemporaryDirectory() as folder:
        measure(options, Path(folder))


if __name__ == '__main__':
    if sys.argv[1:2] == ['--node']:
        sys.exit(run_node(sys.argv[2:]))
    if sys.argv[1:2] == ['--control']:
        run_control()
    main()
