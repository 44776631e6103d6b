"""Lost messages are counted by the numbers of their publishers, or by gaps in the stamps of steady sensors."""

from __future__ import annotations

import random
import time

import pytest

from forward_grid_mapper.node.losses import LASTING, MOST_STREAMS, NEW_PUBLISHER_GAP, STEADY, Losses

MILLISECOND = 1_000_000


def numbered(losses: Losses, *numbers: int) -> None:
    for number in numbers:
        losses.taken({'publication_sequence_number': number}, 'sonar', 0)


class Told:
    def __init__(self, change: int) -> None:
        self.total_count_change = change


def test_gaps_of_one_publisher() -> None:
    losses = Losses(lambda: 1)
    numbered(losses, *range(3001, 3100))
    assert losses.lost == 0
    numbered(losses, 3105, 3106, 13_107)
    assert losses.lost == 5 + 10_000


def test_several_publishers_of_one_topic() -> None:
    losses = Losses(lambda: 3)
    streams = [list(range(1, 5000)), list(range(1, 4000)), list(range(700, 3000))]
    rng = random.Random(1)
    lost = 0
    kept: list[list[int]] = []
    for stream in streams:
        gap = rng.randrange(100, len(stream) - 100)
        lost += 40
        kept.append(stream[:gap] + stream[gap + 40 :])
    while any(kept):
        stream = rng.choice([stream for stream in kept if stream])
        numbered(losses, stream.pop(0))
    assert abs(losses.lost - lost) <= 0.2 * lost


def test_a_publisher_that_joins_or_starts_again_is_no_loss() -> None:
    losses = Losses(lambda: 2)
    numbered(losses, 10, 11, 12)
    numbered(losses, 1_000_000, 13, 1_000_001)
    assert losses.lost == 0
    again = Losses(lambda: 1)
    numbered(again, 5000, 5001, 1, 2, 3)
    assert again.lost == 0


def test_gaps_in_the_stamps_of_a_steady_sensor() -> None:
    losses = Losses(lambda: 1)
    rng = random.Random(2)
    for k in [*range(200), *range(230, 400)]:
        for frame, period in (('left', 50), ('right', 20)):
            jitter = rng.uniform(-0.1, 0.1)
            losses.taken({}, frame, round((k + jitter) * period * MILLISECOND))
    assert losses.lost == 60


def test_a_sensor_without_a_rate_loses_nothing() -> None:
    losses = Losses(lambda: 1)
    rng = random.Random(3)
    stamp = 0
    for _ in range(300):
        stamp += round(rng.expovariate(1.0) * 100 * MILLISECOND)
        losses.taken({}, 'bumper', stamp)
    assert losses.lost == 0


def test_what_the_middleware_says_and_what_gaps_tell_count_once() -> None:
    losses = Losses(lambda: 1)
    numbered(losses, 1, 2, 8)
    losses.reported(Told(5))
    assert losses.lost == 5
    losses.reported(Told(3))
    assert losses.lost == 8
    losses.clear()
    assert losses.lost == 0
    assert losses.recent + LASTING <= 0
    losses.reported(Told(0))
    assert losses.recent + LASTING <= 0, 'nothing was lost'
    losses.reported(Told(2))
    assert losses.lost == 2
    assert time.monotonic() - LASTING < losses.recent <= time.monotonic()


def at_steps(losses: Losses, *steps: float, frame: str = 'sonar') -> list[int]:
    """Messages of one sensor, so many usual intervals apart; returns what is lost after each."""
    stamp, found = 10**9, []
    for step in (0.0, *steps):
        stamp += round(step * 100 * MILLISECOND)
        losses.taken({}, frame, stamp)
        found.append(losses.lost)
    return found[1:]


def test_a_sensor_is_steady_after_some_intervals_of_about_the_same_length() -> None:
    # the first tells the interval
    assert at_steps(Losses(lambda: 1), *[1.0] * STEADY, 4.0)[-1] == 0
    assert at_steps(Losses(lambda: 1), *[1.0] * (1 + STEADY), 4.0)[-1] == 3
    assert at_steps(Losses(lambda: 1), 1.0, *[1.25, 0.8] * (STEADY // 2), 4.0)[-1] == 3


@pytest.mark.parametrize(('step', 'missing'), [(1.6, 0), (1.75, 1), (2.4, 1), (2.6, 2), (50.0, 49)])
def test_how_many_intervals_are_missing(step: float, missing: int) -> None:
    assert at_steps(Losses(lambda: 1), *[1.0] * 20, step)[-1] == missing


@pytest.mark.parametrize('odd', [0.5, 1.5])
def test_an_odd_interval_makes_a_sensor_unsteady(odd: float) -> None:
    # from now on the odd one is the usual interval, and the next ones are no gaps
    found = at_steps(Losses(lambda: 1), *[1.0] * 20, odd, 3.0, *[1.0] * STEADY, 3.0)
    assert found[-1] == 0


def test_a_stamp_that_does_not_advance_changes_nothing() -> None:
    assert at_steps(Losses(lambda: 1), *[1.0] * 20, 0.0, 3.0)[-1] == 2
    assert at_steps(Losses(lambda: 1), *[1.0] * 20, -5.0, 1.0, 3.0)[-1] == 2


def test_more_sensors_than_are_told_apart_are_left_out() -> None:
    losses = Losses(lambda: 1)
    for k in range(MOST_STREAMS + 1):
        at_steps(losses, frame=f'sonar_{k}')
    assert at_steps(losses, *[1.0] * 20, 5.0, frame=f'sonar_{MOST_STREAMS}')[-1] == 0
    assert at_steps(losses, *[1.0] * 20, 5.0, frame=f'sonar_{MOST_STREAMS - 1}')[-1] == 4


@pytest.mark.parametrize(('gap', 'lost'), [(NEW_PUBLISHER_GAP, NEW_PUBLISHER_GAP - 1), (NEW_PUBLISHER_GAP + 1, 0)])
def test_a_large_gap_is_another_publisher_where_there_is_one(gap: int, lost: int) -> None:
    losses = Losses(lambda: 2)
    numbered(losses, 1000, 1000 + gap)
    assert losses.lost == lost
    alone = Losses(lambda: 1)
    numbered(alone, 1000, 1000 + gap)
    assert alone.lost == gap - 1
