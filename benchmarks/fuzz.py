#!/usr/bin/env python3
"""Feeds the node with hostile messages, transforms and parameters, and checks its invariants.

usage: fuzz.py [--messages 100000] [--seed 1] [--dds 5000]

Range and Odometry go through the node's own callbacks, EM, services and files; every fifth message is faulty. Checked
all the time: nothing raises, accepted + waiting + rejected = received, all numbers in a map are valid, memory is
bounded. With --dds, a node in its own process receives serialized messages, half of them garbled. Needs rclpy.
"""

from __future__ import annotations

import argparse
import gc
import os
import sys
import tempfile
import time
from collections import Counter
from pathlib import Path
from typing import Any

os.environ.setdefault('ROS_AUTOMATIC_DISCOVERY_RANGE', 'LOCALHOST')
os.environ.setdefault('ROS_DOMAIN_ID', str(1 + os.getpid() % 100))
sys.path.insert(0, str(Path(__file__).parent))

import numpy as np
import rclpy
from hostile import FRAMES, Hostile, TransformFailed
from rclpy.exceptions import ParameterNotDeclaredException
from rclpy.parameter import Parameter
from std_srvs.srv import SetBool

from forward_grid_mapper.core.common.errors import MapperError
from forward_grid_mapper.core.common.parameters import TABLE
from forward_grid_mapper.core.mapping import Mapper
from forward_grid_mapper.node import frames
from forward_grid_mapper.node.deferred import Reply
from forward_grid_mapper.node.map_publishers import MAPS
from forward_grid_mapper.node.mapper_node import MapperNode

OVERRIDES: dict[str, Any] = {
    'sensors.sonar_left.pose': [0.1, 0.1, 1.5],
    'sensors.sonar_right.pose': [0.1, -0.1, -1.5],
    'max_cells': 1_000_000,
    'max_readings': 2000,
    'max_iterations': 5,
}


class Broken(Exception):
    """The node violated an invariant."""


def resident() -> float:
    """Return the memory that this process uses, in MB."""
    pages = int(Path('/proc/self/statm').read_text().split()[1])
    return pages * os.sysconf('SC_PAGE_SIZE') / 1e6


def require(condition: bool, what: str) -> None:
    """Raise if an invariant is violated."""
    if not condition:
        raise Broken(what)


class Answer(Reply):
    """A reply of a service without a client."""

    def __init__(self, request: Any = None) -> None:
        self.request = request
        self.sent: list[tuple[Any, ...]] = []

    def send(self, *fields: Any) -> None:
        """Store the answer."""
        self.sent.append(fields)


class Fuzz:
    """A node in this process, whose callbacks are called as by the executor."""

    def __init__(self, seed: int, folder: Path) -> None:
        self.hostile = Hostile(seed)
        self.rejected: Counter[str] = Counter()
        self.sent = self.total = self.accepted = self.parameters_refused = self.parameters_set = 0
        frames.Transforms.of = classmethod(  # type: ignore[assignment, method-assign]
            lambda cls, node: cls(self.hostile, TransformFailed)
        )
        overrides = {**OVERRIDES, 'save_directory': str(folder / 'maps'), 'journal': str(folder / 'journal')}
        self.node = MapperNode(parameter_overrides=[Parameter(k, value=v) for k, v in overrides.items()])
        self.node.start()
        while not self.node.mapping:
            self.work()
            time.sleep(0.01)

    @property
    def associator(self) -> Any:
        """The node's associator."""
        return self.node.associator

    def work(self) -> None:
        """Do the executor's work between messages."""
        while self.node.intake.busy:
            self.node.intake.work()
        self.node.inbox.work()

    def step(self) -> None:
        """Send one message."""
        self.total += 1
        if self.hostile.random.random() < 0.4:
            self.node.intake.on_odometry(self.hostile.odometry(), {'source_timestamp': time.time_ns()})
        else:
            self.sent += 1
            intake = self.node.intake
            intake.on_range(intake.range_losses[0], self.hostile.range(), {'source_timestamp': time.time_ns()})
        self.work()

    def check(self) -> None:
        """Run the node's timers, and check its counts and its live map."""
        self.node.publish_live()
        self.node.journal.take()
        self.node.reporter.report()
        associator = self.associator
        require(associator.received == self.sent, f'{self.sent} ranges were sent and {associator.received} received')
        accounted = len(associator.buffer) + associator.waiting + sum(associator.rejected.values())
        require(
            accounted == associator.received,
            f'{associator.received} ranges were received and {accounted} accounted for',
        )
        live = self.node.live.snapshot().probability
        known = live[~np.isnan(live)]
        require(bool(((known >= 0) & (known <= 1)).all()), 'the live map has a value that is no probability')
        require(not any(worker.trouble for worker in self.node.workers), 'a worker failed')
        self._check_messages()
        x = associator.readings
        for name in ('x', 'y', 'yaw', 'z', 'z_max', 'half_angle', 'sigma'):
            require(bool(np.isfinite(getattr(x, name)).all()), f'a reading has a {name} that is not finite')

    def _check_messages(self) -> None:
        self.node.maps.worker.ask(lambda: None)
        for name in MAPS:
            message = self.node.maps.latest[name]
            values = np.frombuffer(message.data, np.int8)
            require(bool(((values >= -1) & (values <= 100)).all()), f'{name} has a value that is none of a map')
            require(len(values) == message.info.width * message.info.height, f'{name} has another size than it says')

    def change_parameter(self) -> None:
        """Set a parameter to an arbitrary value."""
        self.parameters_set += 1
        try:
            refused = not self.node.set_parameters([self.hostile.parameter()])[0].successful
        except ParameterNotDeclaredException:
            # the service would answer with a refusal
            refused = True
        self.parameters_refused += refused

    def restore_parameters(self) -> None:
        """Reset every writable parameter to its default."""
        values = {row.name: row.default for row in TABLE if not row.read_only and row.group != 'node'}
        # readings of arbitrary variance, in a model of arbitrary sigma, make EM slow, which is not tested here
        values['max_iterations'] = OVERRIDES['max_iterations']
        defaults = [Parameter(name, value=value) for name, value in values.items()]
        result = self.node.set_parameters_atomically(defaults)
        require(result.successful, f'the defaults were refused: {result.reason}')

    def run_em(self) -> None:
        """Map all readings so far."""
        try:
            maps = Mapper(self.node.parameters).run(self.associator.readings)
        except MapperError as error:
            # these readings may have been accepted with a smaller sigma
            expected = not len(self.associator.readings) or 'more than max_cells' in str(error)
            require(expected, f'EM failed: {error}')
            return
        require(bool(np.isin(maps.ml, (-1, 0, 1)).all()), 'the maximum likelihood map has another value')
        require(bool(np.isfinite(maps.log_likelihood) and np.isfinite(maps.objective)), 'the likelihood is not finite')
        seen = maps.ml >= 0
        require(bool(np.isfinite(maps.uncertainty[seen]).all()), 'the uncertainty map is not finite where observed')
        known = maps.live[~np.isnan(maps.live)]
        require(bool(((known >= 0) & (known <= 1)).all()), 'the live map has a value that is no probability')

    def reset(self) -> None:
        """Check the counts, and reset the node."""
        self.rejected += self.associator.rejected
        self.accepted += len(self.associator.buffer)
        self.rejected['(waited at a reset)'] += self.associator.waiting
        answer = Answer()
        self.node.reset(answer)
        require(answer.sent[0][0], 'reset failed')
        self.sent = 0
        require(self.associator.received == self.associator.waiting == 0, 'a reset left something')

    def pause(self, value: bool) -> None:
        """Call the service."""
        self.node.pause(Answer(SetBool.Request(data=value)))

    def run(self, messages: int) -> float:
        """Send this many messages; return the growth of memory after the first third, MB."""
        begun = 0.0
        while self.total < messages:
            for _ in range(min(500, messages - self.total)):
                self.step()
            self.check()
            if self.hostile.random.random() < 0.5:
                self.restore_parameters()
            for _ in range(10):
                self.change_parameter()
            dice = self.hostile.random.random()
            if dice < 0.1:
                self.run_em()
            elif dice < 0.12:
                self.reset()
            self.pause(dice > 0.97)
            if not begun and self.total >= messages / 3:
                gc.collect()
                begun = resident()
        self.run_em()
        self.check()
        gc.collect()
        grown = resident() - begun
        self.reset()
        return grown


def over_dds(messages: int, seed: int) -> str:
    """Send serialized messages, half of them garbled, to a node in its own process; return its counts."""
    import subprocess

    from diagnostic_msgs.msg import DiagnosticArray
    from nav_msgs.msg import Odometry
    from rclpy.qos import QoSProfile
    from sensor_msgs.msg import Range

    command = [sys.executable, '-m', 'forward_grid_mapper.node.main', '--ros-args']
    for name in ('range_reliability', 'odom_reliability'):
        command += ['-p', f'{name}:=reliable']
    for frame in FRAMES:
        command += ['-p', f'sensors.{frame}.pose:=[0.0, 0.0, 0.0]']
    process = subprocess.Popen(command, stdout=subprocess.DEVNULL, stderr=subprocess.DEVNULL)
    account: dict[str, str] = {}

    def on_diagnostics(array: DiagnosticArray) -> None:
        for status in array.status:
            if status.name.endswith('readings'):
                account.update({pair.key: pair.value for pair in status.values})

    robot = rclpy.create_node('hostile_robot')
    try:
        robot.create_subscription(DiagnosticArray, '/diagnostics', on_diagnostics, 10)
        publishers = {
            Range: robot.create_publisher(Range, 'sonar', QoSProfile(depth=5000)),
            Odometry: robot.create_publisher(Odometry, 'odom', QoSProfile(depth=5000)),
        }
        while not all(publisher.get_subscription_count() for publisher in publishers.values()):
            rclpy.spin_once(robot, timeout_sec=0.1)
            require(process.poll() is None, 'the node did not start')
        hostile = Hostile(seed)
        # the first message sets the frames
        publishers[Odometry].publish(Hostile(seed, fault_rate=0.0).odometry())
        time.sleep(0.1)
        for k in range(messages):
            message = hostile.odometry() if k % 3 == 0 else hostile.range()
            garbled = hostile.random.random() < 0.5
            publishers[type(message)].publish(hostile.garbled_bytes(message) if garbled else message)
            if k % 20 == 0:
                rclpy.spin_once(robot, timeout_sec=0.001)
        end = time.monotonic() + 3.0
        while time.monotonic() < end:
            rclpy.spin_once(robot, timeout_sec=0.1)
        require(process.poll() is None, 'the node ended')
        counts = [int(account[f'readings {k}']) for k in ('accepted', 'waiting for a pose', 'rejected', 'received')]
        require(sum(counts[:3]) == counts[3] > 0, f'the account is wrong: {counts}')
        return f'{counts[3]} ranges received, {counts[0]} accepted, {counts[1]} waiting, {counts[2]} rejected'
    finally:
        process.kill()
        process.wait()
        robot.destroy_node()


def main() -> None:
    """Run the fuzzer."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument('--messages', type=int, default=100_000)
    parser.add_argument('--seed', type=int, default=1)
    parser.add_argument('--dds', type=int, default=0, metavar='MESSAGES', help='over DDS as well')
    options = parser.parse_args()
    # without a line for each message that cannot be deserialized
    rclpy.init(args=['fuzz', '--ros-args', '--log-level', 'FATAL'])
    with tempfile.TemporaryDirectory() as folder:
        fuzz = Fuzz(options.seed, Path(folder))
        begin = time.monotonic()
        grown = fuzz.run(options.messages)
        seconds = time.monotonic() - begin
        fuzz.node.close()
        written = sorted({path.relative_to(folder).parts[0] for path in Path(folder).rglob('*')})
        fuzz.node.destroy_node()
    print(f'{fuzz.total} messages in {seconds:.0f} s, seed {options.seed}; no exception, every message accounted for')
    print(f'accepted {fuzz.accepted}; rejected ' + ', '.join(f'{k} {n}' for k, n in sorted(fuzz.rejected.items())))
    print(f'{fuzz.parameters_set} changes of a parameter, {fuzz.parameters_refused} refused')
    print(f'memory grew by {grown:.0f} MB over the last two thirds; written to: {", ".join(written)}')
    if options.dds:
        print(f'{options.dds} messages over DDS, half of them garbled: {over_dds(options.dds, options.seed)}')
    rclpy.shutdown()
    require(grown < 100, 'memory grows')


if __name__ == '__main__':
    main()
