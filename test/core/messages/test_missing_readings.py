"""Readings without an echo that the driver leaves out are found by the pauses of the sensors."""

from __future__ import annotations

import math
import random
from collections.abc import Callable

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from forward_grid_mapper.core.messages.message_batch import batch_of
from forward_grid_mapper.core.messages.message_types import RangeMessage
from forward_grid_mapper.core.messages.missing_readings import EDGES, MIDDLES, MissingReadings

PERIOD = 50_000_000
SENSORS = [f'sonar_{n}' for n in range(8)]

Keep = Callable[[int, int], bool]
"""Whether a reading is sent, by its number and that of its sensor."""


def sent(keep: Keep, *, apart: int = 0, value: float = 2.0, rounds: int = 1000) -> list[RangeMessage]:
    """Messages of eight sensors at 20 Hz; `apart` nanoseconds between two sensors."""
    rng = random.Random(1)
    return [
        RangeMessage(k * PERIOD + n * apart + rng.randrange(4_000_000), frame, value, 0.1, 5.0, 0.3)
        for k in range(rounds)
        for n, frame in enumerate(SENSORS)
        if keep(k, n)
    ]


def warnings_of(messages: list[RangeMessage]) -> list[str]:
    """Return the warnings, which are the same for single messages and for batches of them."""
    one, many = MissingReadings(), MissingReadings()
    for message in messages:
        one.add(message)
    for first in range(0, len(messages), 700):
        many.add_all(batch_of(list(enumerate(messages[first : first + 700]))).ranges)
    assert one.warnings() == many.warnings()
    return one.warnings()


def in_front_of_a_hall(k: int, n: int) -> bool:
    """Sensors 2 and 3 have no echo for two seconds of every five."""
    return n not in (2, 3) or k % 100 >= 40


@pytest.mark.parametrize('apart', [0, PERIOD // len(SENSORS)])
def test_readings_that_are_left_out_give_a_warning(apart: int) -> None:
    (warning,) = warnings_of(sent(in_front_of_a_hall, apart=apart))
    assert warning.startswith('sensors sonar_2, sonar_3 send nothing for up to 38% of the time')
    assert '+inf (REP 117)' in warning


@pytest.mark.parametrize('value', [math.inf, 5.0, 0.0, math.nan, -math.inf])
def test_driver_that_tells_of_missing_echoes_gives_none(value: float) -> None:
    messages = sent(in_front_of_a_hall)
    assert warnings_of([m._replace(range=value) if k % 400 == 0 else m for k, m in enumerate(messages)]) == []


LOST = random.Random(2)
SOUND: dict[str, Keep] = {
    'all are sent': lambda k, n: True,
    'a third gets lost, one by one': lambda k, n: LOST.random() > 0.33,
    'all pause': lambda k, n: k % 100 >= 40,
    'one has a bad contact': lambda k, n: n != 2 or k % 100 >= 40,
    'slow ones': lambda k, n: n not in (2, 3) or k % 10 == 0,
    'two stop': lambda k, n: n not in (2, 3) or k < 600,
    'two are switched off once, for a minute': lambda k, n: n not in (2, 3) or not 100 < k < 1300,
    'hardly any readings': lambda k, n: k < 60 and in_front_of_a_hall(k, n),
}


@pytest.mark.parametrize('name', sorted(SOUND))
def test_sound_sensors_give_no_warning(name: str) -> None:
    assert warnings_of(sent(SOUND[name], rounds=2000)) == []


@pytest.mark.parametrize('count', [4, 8])
@pytest.mark.parametrize('pause', [1e6, 5e6, 20e6])
@pytest.mark.parametrize('in_turn', [True, False])
def test_sensors_that_wait_for_their_echo_give_no_warning(count: int, pause: float, in_turn: bool) -> None:
    rng, messages = random.Random(3), []
    stamps = [0.0] * count
    for k in range(12_000):
        # of those that do not wait for each other, the one whose turn is first
        n = k % count if in_turn else stamps.index(min(stamps))
        stamp = max(stamps) if in_turn else stamps[n]
        # from a narrow place to a wide one and back, as fast as a robot drives
        value = rng.uniform(0.9, 1.1) * (0.3 if stamp // 8e9 % 2 else 4.5)
        stamps[n] = stamp + pause + 2 * value / 340 * 1e9
        messages.append(RangeMessage(int(stamps[n]), SENSORS[n], value, 0.02, 5.0, 0.3))
    messages.sort(key=lambda message: message.stamp)
    assert warnings_of(messages) == []


@settings(max_examples=50, deadline=None)
@given(seed=st.integers(0, 2**32), sizes=st.lists(st.integers(0, 40), max_size=5))
def test_batch_counts_as_single_messages(seed: int, sizes: list[int]) -> None:
    rng = random.Random(seed)
    one, many = MissingReadings(), MissingReadings()
    steps = [*EDGES[[0, 1, -2, -1]].tolist(), -5, 0, 10**6 - 1, 10**12]
    for size in sizes:
        messages, stamp = [], rng.randrange(10**15)
        for _ in range(size):
            stamp += rng.choice(steps)
            value = rng.choice([-1.0, 0.0, 1.0, 5.0, math.inf, math.nan])
            limit = rng.choice([3.0, 5.0, 500.0, math.inf, math.nan])
            messages.append(RangeMessage(stamp, rng.choice(['a', 'b', '', 'c\n']), value, 0.1, limit, 0.3))
        for message in messages:
            one.add(message)
        many.add_all(batch_of(list(enumerate(messages))).ranges)
    assert (one._count, one._silent, one._by_frame.keys()) == (many._count, many._silent, many._by_frame.keys())
    assert one._largest_max_range == many._largest_max_range
    assert not one._by_frame.keys() & {'', 'c\n'}
    for first, second in [
        (one._together, many._together),
        *((one._by_frame[name], many._by_frame[name]) for name in one._by_frame),
    ]:
        assert first._last == second._last
        np.testing.assert_array_equal(first.counts, second.counts)


def test_intervals_are_known_to_some_percent() -> None:
    assert np.all(MIDDLES / EDGES[:-1] < 1.03) and np.all(EDGES[1:] / MIDDLES < 1.03)
