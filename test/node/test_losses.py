"""Lost messages are counted by the numbers of their publishers, or by gaps in the stamps of steady sensors."""

from __future__ import annotations

import random

from forward_grid_mapper.node.losses import Losses

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
    losses.told(Told(5))
    assert losses.lost == 5
    losses.told(Told(3))
    assert losses.lost == 8
    losses.clear()
    assert losses.lost == 0
