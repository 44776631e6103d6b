"""Lost messages are counted by sequence numbers of publishers, or by gaps in the stamps of regular sensors."""

from __future__ import annotations

import random
import time

import pytest

from forward_grid_mapper.core.messages.message_types import NANOSECONDS
from forward_grid_mapper.node.losses import LOSS_WARNING, MOST_STREAMS, NEW_PUBLISHER_GAP, STEADY, Losses

MILLISECOND = 1_000_000


def numbered(losses: Losses, *numbers: int) -> None:
    for number in numbers:
        losses.taken({'publication_sequence_number': number}, 'sonar', 0)


class LostMessages:
    def __init__(self, change: int) -> None:
        self.total_count_change = change


def test_gaps_in_the_numbers_of_one_publisher_are_counted() -> None:
    losses = Losses(lambda: 1)
    numbered(losses, *range(3001, 3100))
    assert losses.lost == 0
    numbered(losses, 3105, 3106, 13_107)
    assert losses.lost == 5 + 10_000


def test_losses_of_several_publishers_are_estimated() -> None:
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


def test_new_or_restarted_publisher_is_no_loss() -> None:
    losses = Losses(lambda: 2)
    numbered(losses, 10, 11, 12)
    numbered(losses, 1_000_000, 13, 1_000_001)
    assert losses.lost == 0
    again = Losses(lambda: 1)
    numbered(again, 5000, 5001, 1, 2, 3)
    assert again.lost == 0


def test_gaps_in_the_stamps_of_a_regular_sensor_are_counted() -> None:
    losses = Losses(lambda: 1)
    rng = random.Random(2)
    for k in [*range(200), *range(230, 400)]:
        for frame, period in (('left', 50), ('right', 20)):
            jitter = rng.uniform(-0.1, 0.1)
            losses.taken({}, frame, round((k + jitter) * period * MILLISECOND))
    assert losses.lost == 60


def test_sensor_without_a_regular_rate_has_no_losses() -> None:
    losses = Losses(lambda: 1)
    rng = random.Random(3)
    stamp = 0
    for _ in range(300):
        stamp += round(rng.expovariate(1.0) * 100 * MILLISECOND)
        losses.taken({}, 'bumper', stamp)
    assert losses.lost == 0


def test_losses_reported_before_their_gap_are_counted_once() -> None:
    losses = Losses(lambda: 1)
    numbered(losses, 1, 2)
    losses.reported(LostMessages(5))
    numbered(losses, 8)
    assert losses.lost == 5
    losses.dropped()
    assert losses.lost == 6, 'what the node drops has arrived, so it is in neither of the other counts'
    losses.clear()
    assert losses.lost == 0


def test_losses_reported_after_their_gap_are_counted_once() -> None:
    losses = Losses(lambda: 1)
    numbered(losses, 1, 2, 8)
    losses.reported(LostMessages(5))
    assert losses.lost == 5
    losses.reported(LostMessages(3))
    assert losses.lost == 8
    losses.clear()
    assert losses.lost == 0
    assert losses.recent + LOSS_WARNING <= 0
    losses.reported(LostMessages(0))
    assert losses.recent + LOSS_WARNING <= 0, 'nothing was lost'
    losses.reported(LostMessages(2))
    assert losses.lost == 2
    assert time.monotonic() - LOSS_WARNING < losses.recent <= time.monotonic()


def at_steps(losses: Losses, *steps: float, frame: str = 'sonar') -> list[int]:
    """Messages of one sensor at these multiples of the usual interval; returns the losses after each."""
    stamp, found = 10**9, []
    for step in (0.0, *steps):
        stamp += round(step * 100 * MILLISECOND)
        losses.taken({}, frame, stamp)
        found.append(losses.lost)
    return found[1:]


def test_sensor_is_regular_after_some_similar_intervals() -> None:
    # the first step determines the interval
    assert at_steps(Losses(lambda: 1), *[1.0] * STEADY, 4.0)[-1] == 0
    assert at_steps(Losses(lambda: 1), *[1.0] * (1 + STEADY), 4.0)[-1] == 3
    assert at_steps(Losses(lambda: 1), 1.0, *[1.25, 0.8] * (STEADY // 2), 4.0)[-1] == 3


@pytest.mark.parametrize(('step', 'missing'), [(1.6, 0), (1.75, 1), (2.4, 1), (2.6, 2), (50.0, 49)])
def test_number_of_missing_intervals(step: float, missing: int) -> None:
    assert at_steps(Losses(lambda: 1), *[1.0] * 20, step)[-1] == missing


@pytest.mark.parametrize('odd', [0.5, 1.5])
def test_irregular_interval_makes_a_sensor_irregular(odd: float) -> None:
    # from now on the irregular interval is the usual one, and the next ones are no gaps
    found = at_steps(Losses(lambda: 1), *[1.0] * 20, odd, 3.0, *[1.0] * STEADY, 3.0)
    assert found[-1] == 0


def begun() -> tuple[Losses, int]:
    """Losses of a sensor with ten messages a second, and its last stamp."""
    losses, stamp = Losses(lambda: 1), 10**9
    for _ in range(30):
        stamp += 100 * MILLISECOND
        losses.taken({}, 'sonar', stamp)
    return losses, stamp


@pytest.mark.parametrize('slower', [2.0, 2.5, 10.0])
def test_slower_sensor_has_no_lasting_losses(slower: float) -> None:
    """As odometry or sonars of a robot that saves power at its dock."""
    losses, found = begun()
    counts = []
    for factor in (1.0, slower, 1.0, slower):
        before = losses.lost
        for _ in range(500):
            found += round(factor * 100 * MILLISECOND)
            losses.taken({}, 'sonar', found)
        counts.append(losses.lost - before)
    assert counts[0] == counts[2] == 0
    assert max(counts) <= slower * STEADY
    # at the other rate, losses are found as before
    before = losses.lost
    losses.taken({}, 'sonar', found + round(3 * slower * 100 * MILLISECOND))
    assert losses.lost == before + 2


def test_sensor_that_was_switched_off_has_lost_nothing() -> None:
    losses, stamp = begun()
    for pause in (3600, 100_000):
        stamp += pause * NANOSECONDS
        losses.taken({}, 'sonar', stamp)
        for _ in range(20):
            stamp += 100 * MILLISECOND
            losses.taken({}, 'sonar', stamp)
    assert losses.lost == 0
    losses.taken({}, 'sonar', stamp + 300 * MILLISECOND)
    assert losses.lost == 2, 'its rate is still known'


def test_messages_while_the_node_was_not_subscribed_are_not_lost() -> None:
    losses, stamp = begun()
    numbered(losses, 1, 2, 3)
    losses.begin_anew()
    losses.taken({}, 'sonar', stamp + 20 * NANOSECONDS)
    numbered(losses, 50)
    assert losses.lost == 0


def test_stamp_that_does_not_advance_is_ignored() -> None:
    assert at_steps(Losses(lambda: 1), *[1.0] * 20, 0.0, 3.0)[-1] == 2
    assert at_steps(Losses(lambda: 1), *[1.0] * 20, -5.0, 1.0, 3.0)[-1] == 2


def test_number_of_distinguished_sensors_is_bounded() -> None:
    losses = Losses(lambda: 1)
    for k in range(MOST_STREAMS + 1):
        at_steps(losses, frame=f'sonar_{k}')
    assert at_steps(losses, *[1.0] * 20, 5.0, frame=f'sonar_{MOST_STREAMS}')[-1] == 0
    assert at_steps(losses, *[1.0] * 20, 5.0, frame=f'sonar_{MOST_STREAMS - 1}')[-1] == 4


@pytest.mark.parametrize(('gap', 'lost'), [(NEW_PUBLISHER_GAP, NEW_PUBLISHER_GAP - 1), (NEW_PUBLISHER_GAP + 1, 0)])
def test_large_gap_with_several_publishers_is_no_loss(gap: int, lost: int) -> None:
    losses = Losses(lambda: 2)
    numbered(losses, 1000, 1000 + gap)
    assert losses.lost == lost
    alone = Losses(lambda: 1)
    numbered(alone, 1000, 1000 + gap)
    assert alone.lost == gap - 1
