"""What the log is told of the input: once what has lasted, and once that it has ended."""

from __future__ import annotations

from typing import Any

import pytest

pytest.importorskip('rclpy', reason='the tests of the node need rclpy')

from stand_ins import PlainNode

from forward_grid_mapper.node.verdict_log import AGAIN, MOST, VerdictLog

WELL = 'readings are mapped without faults again'


def test_a_fault_that_lasts_is_told_once_whatever_its_numbers(clock: Any) -> None:
    node = PlainNode()
    log = VerdictLog(node)
    for k in range(3, 200):
        log.update([f'no Range for {k} s'], False)
        clock.now += 1.0
    assert node.warned == ['no Range for 4 s']
    log.update([], True)
    log.update([], True)
    assert node.warned == ['no Range for 4 s', WELL]


def test_a_passing_fault_is_not_told(clock: Any) -> None:
    node = PlainNode()
    log = VerdictLog(node)
    for _ in range(5):
        log.update(['1 of 2 readings were rejected'], False)
        log.update([], True)
    assert node.warned == []


def test_a_fault_that_comes_and_goes_is_told_once_a_minute(clock: Any) -> None:
    node = PlainNode()
    log = VerdictLog(node)
    for _ in range(int(2 * AGAIN) // 3):
        for faults in (['gap'], ['gap'], []):
            log.update(faults, not faults)
            clock.now += 1.0
    assert node.warned == ['gap', WELL] * 2


def test_a_fault_that_comes_back_for_good_is_told_though_it_came_early(clock: Any) -> None:
    node = PlainNode()
    log = VerdictLog(node)
    for second in range(300):
        faults = [] if 5 <= second < 10 else ['gap']
        log.update(faults, not faults)
        clock.now += 1.0
    assert node.warned == ['gap', WELL, 'gap']


def test_the_time_in_which_readings_were_rejected_makes_no_new_fault(clock: Any) -> None:
    node = PlainNode()
    log = VerdictLog(node)
    for k in range(300):
        log.update([f'{k} of 300 readings were rejected in the last {("second", "2 s", "10 s")[k % 3]}'], False)
        clock.now += 1.0
    assert node.warned == ['1 of 300 readings were rejected in the last 2 s']


def test_faults_of_ever_new_names_take_no_memory(clock: Any) -> None:
    log = VerdictLog(PlainNode())
    for k in range(5 * MOST):
        name = 'x' * k
        log.update([name], False)
        log.update([name], False)
    assert len(log._logged) <= MOST
