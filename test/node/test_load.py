"""The node under load, over DDS: thousands of calls, lost messages, and a first start without kernels."""

from __future__ import annotations

import signal
import time
from pathlib import Path
from typing import Any

import pytest

pytest.importorskip('rclpy', reason='the tests of the node need rclpy')

from fault_samples import OPTIONS, circle
from nav_msgs.srv import GetMap
from rclpy.qos import QoSProfile
from robot import Robot
from sensor_msgs.msg import Range
from std_srvs.srv import SetBool, Trigger

CALLS = 2000
FEWER = 200
"""Number of calls of services that are made like the one with many."""


@pytest.mark.slow
def test_two_thousand_calls_at_once_get_responses(start: Any, robot: Robot) -> None:
    start(*OPTIONS)
    robot.meet()
    robot.play(circle(0, 50))
    requests = {
        'get_live_map': (GetMap, {}, CALLS),
        'get_ml_map': (GetMap, {}, FEWER),
        'pause': (SetBool, {'data': False}, FEWER),
        'run_em': (Trigger, {}, CALLS),
        'reset': (Trigger, {}, FEWER),
        'save_maps': (Trigger, {}, CALLS),
    }
    for name, (kind, fields, count) in requests.items():
        # a client keeps 10 responses by default
        client = robot.node.create_client(kind, f'{robot.name}/{name}', qos_profile=QoSProfile(depth=2 * count))
        robot.until(client.service_is_ready, 20.0, f'{name} is there')
        futures = [client.call_async(kind.Request(**fields)) for _ in range(count)]
        robot.until(lambda futures=futures: all(future.done() for future in futures), 120.0, f'{name} answers all')
        robot.node.destroy_client(client)
    robot.sent = 0
    robot.play(circle(50, 50))
    assert robot.call('run_em').success


@pytest.mark.slow
def test_messages_dropped_by_the_middleware_are_counted(start: Any, robot: Robot) -> None:
    """The publisher keeps few messages for a stopped node, so that most are lost on any machine."""
    robot.node.destroy_publisher(robot.range_out)
    robot.range_out = robot.node.create_publisher(Range, '/sonar', QoSProfile(depth=200))
    node = start(*OPTIONS)
    robot.meet()
    robot.play(circle(0, 50))
    node.process.send_signal(signal.SIGSTOP)
    for message in circle(50, 5000):
        robot.send(message)
    node.process.send_signal(signal.SIGCONT)

    def counts() -> list[int]:
        readings = robot.diagnostics['readings']
        keys = ('readings received', 'readings lost in the middleware (estimated)')
        return [int(readings[key]) for key in keys]

    robot.until(lambda: sum(counts()) >= 5050, what='all are accounted for')
    received, lost = counts()
    assert received + lost == 5050
    assert lost > 1000
    assert robot.diagnostics['readings']['level'] != b'\x00'
    assert 'were lost before this node received them' in robot.diagnostics['readings']['message']
    node.wait_for('were lost before this node received them', 20.0)


@pytest.mark.slow
def test_first_start_loses_no_messages_and_shows_the_live_map_first(start: Any, robot: Robot, tmp_path: Path) -> None:
    node = start(*OPTIONS, ready=False, NUMBA_CACHE_DIR=str(tmp_path / 'cache'))
    robot.meet()
    robot.listen()
    robot.play(circle(0, 300))
    readings = robot.diagnostics['readings']
    assert readings['readings received'] == '300'
    em = robot.ask('run_em')
    robot.until(
        lambda: 'waiting for the compilation' in robot.diagnostics['EM']['state'], what='EM says what it waits for'
    )
    assert 'compiling kernels' in robot.diagnostics['background']['message']
    robot.until(lambda: robot.maps['live_map'], 240.0, 'a live map')
    assert not em.done()
    node.wait_for('ready:')
    order = ('listening:', 'live map kernels are ready', 'EM kernels are ready')
    node.wait_for(order[-1])
    assert sorted(order, key=node.output.index) == list(order), 'it listens before its kernels are compiled'
    answer = robot.until(em.result, 240.0, 'EM answers')
    assert answer.success
    assert answer.message.startswith('300 readings')
    assert robot.diagnostics['readings']['readings rejected'] == '0'
    begin = time.monotonic()
    assert robot.call('run_em').success
    assert time.monotonic() - begin < 60.0
