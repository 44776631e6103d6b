"""The times when messages are due, with a wall clock set by the tests."""

from __future__ import annotations

import pytest

from forward_grid_mapper.core.messages.message_types import NANOSECONDS
from forward_grid_mapper.replay.timeline import LONGEST_GAP, Timeline

SECOND = NANOSECONDS
START = 1_700_000_000 * SECOND


class Wall:
    """A clock set by the test."""

    def __init__(self) -> None:
        self.seconds = 100.0

    def __call__(self) -> float:
        return self.seconds


@pytest.fixture
def wall() -> Wall:
    return Wall()


def test_stamps_are_scaled_to_the_wall_clock(wall: Wall) -> None:
    timeline = Timeline(4.0, wall)
    assert [timeline.due('odom', START + i * SECOND) for i in (0, 2, 3, 30)] == [100.0, 100.5, 100.75, 107.5]
    assert timeline.jumps == 0


def test_bag_time_advances_up_to_the_next_message(wall: Wall) -> None:
    timeline = Timeline(2.0, wall)
    assert timeline.time() == 0
    timeline.due('odom', START)
    timeline.due('odom', START + 3 * SECOND)
    wall.seconds += 1
    assert timeline.time() == START + 2 * SECOND
    wall.seconds += 1
    assert timeline.time() == START + 3 * SECOND


def test_highest_rate_is_no_fault(wall: Wall) -> None:
    timeline = Timeline(1e308, wall)
    timeline.due('odom', START)
    timeline.due('odom', START + SECOND)
    wall.seconds += 0.1
    assert timeline.time() == START + SECOND


def test_latency_of_a_topic_delays_no_messages(wall: Wall) -> None:
    timeline = Timeline(1.0, wall)
    timeline.due('odom', START)
    assert timeline.due('odom', START + SECOND) == 101.0
    wall.seconds = 101.0
    assert timeline.due('sonar', START + SECOND // 2) == 101.0
    assert timeline.due('odom', START + 2 * SECOND) == 102.0


@pytest.mark.parametrize('offset', [-5 * SECOND, -3600 * SECOND, -START, 3600 * SECOND])
def test_sensor_with_a_wrong_clock_does_not_stop_the_replay(wall: Wall, offset: int) -> None:
    timeline = Timeline(1.0, wall)
    for i in range(100):
        for topic, shift in (('odom', 0), ('sonar', offset)):
            wall.seconds = max(wall.seconds, timeline.due(topic, START + shift + i * SECOND // 10))
    assert wall.seconds == pytest.approx(109.9, abs=0.2)


def test_single_wrong_stamp_does_not_stop_the_replay(wall: Wall) -> None:
    timeline = Timeline(1.0, wall)
    for i in range(100):
        wrong = 10 * LONGEST_GAP if i == 50 else 0
        wall.seconds = max(wall.seconds, timeline.due('odom', START + i * SECOND // 10 + wrong))
    assert wall.seconds == pytest.approx(109.7, abs=0.2)
    assert timeline.jumps == 2


def test_replay_follows_a_clock_that_was_set_back(wall: Wall) -> None:
    timeline = Timeline(1.0, wall)
    for run in range(2):
        for i in range(50):
            for topic in ('odom', 'sonar'):
                wall.seconds = max(wall.seconds, timeline.due(topic, START - run * 5 * SECOND + i * SECOND // 10))
    assert wall.seconds == pytest.approx(109.8, abs=0.2)
    assert timeline.jumps == 1, 'not one for each topic'


def test_long_delay_is_not_caught_up(wall: Wall) -> None:
    timeline = Timeline(1.0, wall)
    timeline.due('odom', START)
    wall.seconds += 10
    assert timeline.due('odom', START + SECOND) == 110.0
    assert timeline.due('odom', START + 2 * SECOND) == 111.0


def test_short_delay_is_caught_up(wall: Wall) -> None:
    timeline = Timeline(1.0, wall)
    timeline.due('odom', START)
    wall.seconds += 1.2
    assert timeline.due('odom', START + SECOND) <= wall.seconds
    assert timeline.due('odom', START + 2 * SECOND) == 102.0
