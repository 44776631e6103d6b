"""Log lines about faults of the input: once when a fault has lasted, and once when it has ended."""

from __future__ import annotations

from typing import Any

import pytest

pytest.importorskip('rclpy', reason='the tests of the node need rclpy')

from stand_ins import PlainNode

from forward_grid_mapper.node.verdict_log import CHECKS_UNTIL_END, LOG_AGAIN_AFTER, MOST_FAULTS, VerdictLog

WELL = 'readings are mapped without faults again'


def test_lasting_fault_is_logged_once_at_any_numbers(clock: Any) -> None:
    node = PlainNode()
    log = VerdictLog(node)
    for k in range(3, 200):
        log.update([f'no Range for {k} s'], False)
        clock.now += 1.0
    assert node.warned == ['no Range for 4 s']
    for _ in range(CHECKS_UNTIL_END - 1):
        log.update([], True)
    assert node.warned == ['no Range for 4 s']
    log.update([], True)
    log.update([], True)
    assert node.warned == ['no Range for 4 s', WELL]


def test_short_fault_is_not_logged(clock: Any) -> None:
    node = PlainNode()
    log = VerdictLog(node)
    for _ in range(5):
        log.update(['1 of 2 readings were rejected'], False)
        log.update([], True)
    assert node.warned == []


def test_faults_have_not_ended_while_another_part_has_one(clock: Any) -> None:
    """Readings may be mapped while messages are lost: `well` is the verdict on the readings alone."""
    node = PlainNode()
    log = VerdictLog(node)
    for _ in range(3):
        log.update(['gap', 'messages were lost'], False)
    for _ in range(2 * CHECKS_UNTIL_END):
        log.update(['messages were lost'], True)
    assert node.warned == ['gap', 'messages were lost']
    for _ in range(CHECKS_UNTIL_END):
        log.update([], True)
    assert node.warned[2:] == [WELL]


def test_intermittent_fault_is_logged_once_and_has_no_end(clock: Any) -> None:
    node = PlainNode()
    log = VerdictLog(node)
    for _ in range(int(2 * LOG_AGAIN_AFTER) // 3):
        for faults in (['gap'], ['gap'], []):
            log.update(faults, not faults)
            clock.now += 1.0
    assert node.warned == ['gap']


def test_end_of_faults_is_not_logged_before_one_that_takes_longer_to_be_found(clock: Any) -> None:
    """A sensor with a wrong clock is rejected at first, and its clock is found five seconds later."""
    node = PlainNode()
    log = VerdictLog(node)
    for second in range(40):
        log.update(['rejected'] if second < 3 else [], well=3 <= second < 8 or second >= 20)
        clock.now += 1.0
        assert (WELL in node.warned) == (second >= 20 + CHECKS_UNTIL_END - 1)


def test_fault_that_returns_and_lasts_is_logged_again(clock: Any) -> None:
    node = PlainNode()
    log = VerdictLog(node)
    for second in range(300):
        faults = [] if 5 <= second < 5 + CHECKS_UNTIL_END else ['gap']
        log.update(faults, not faults)
        clock.now += 1.0
    assert node.warned == ['gap', WELL, 'gap']


def test_fault_with_another_period_is_no_new_fault(clock: Any) -> None:
    node = PlainNode()
    log = VerdictLog(node)
    for k in range(300):
        log.update([f'{k} of 300 readings were rejected in the last {("second", "2 s", "10 s")[k % 3]}'], False)
        clock.now += 1.0
    assert node.warned == ['1 of 300 readings were rejected in the last 2 s']


def test_number_of_remembered_faults_is_bounded(clock: Any) -> None:
    log = VerdictLog(PlainNode())
    for k in range(5 * MOST_FAULTS):
        name = 'x' * k
        log.update([name], False)
        log.update([name], False)
    assert len(log._logged) <= MOST_FAULTS
