"""Topics with the same readings: a filtered copy is found, sensors that share a frame or a stamp are not copies."""

from __future__ import annotations

import math
import random
from collections.abc import Callable, Sequence
from typing import Any

import pytest

from forward_grid_mapper.core.messages import repeated_topics
from forward_grid_mapper.core.messages.message_batch import batch_of
from forward_grid_mapper.core.messages.message_types import RangeMessage
from forward_grid_mapper.core.messages.repeated_topics import LEAST_PAIRS, RepeatedTopics

Topics = dict[str, list[RangeMessage]]


def of(frame: str, range_at: Callable[[int], float], count: int = 100, later: int = 0) -> list[RangeMessage]:
    return [RangeMessage((k + 1) * 10**8 + later, frame, range_at(k), 0.1, 5.0, 0.3) for k in range(count)]


def measured(seed: int, count: int = 100) -> list[float]:
    """Ranges that vary, with outliers and without some echoes."""
    draw = random.Random(seed)
    return [math.inf if draw.random() < 0.2 else draw.uniform(0.2, 4.5) for _ in range(count)]


RAW = measured(0)
FILTERED = [sorted(RAW[max(k - 2, 0) : k + 1])[-1] if k % 3 == 0 else value for k, value in enumerate(RAW)]


def notes(topics: Topics, at_once: bool = False) -> list[str]:
    watch = RepeatedTopics()
    if at_once:
        for topic, messages in topics.items():
            watch.add_batch(topic, batch_of(list(enumerate(messages))).ranges)
    else:
        everything = [(m.stamp, topic, m) for topic, messages in topics.items() for m in messages]
        for _, topic, m in sorted(everything, key=lambda item: item[0]):
            watch.add(topic, m.frame_id, m.stamp, m.range)
    return watch.notes(list(topics), _kept)


def _kept(topics: Sequence[str]) -> str:
    return f'keep {" ".join(topics)}'


@pytest.mark.parametrize('at_once', [False, True])
@pytest.mark.parametrize('turned', [False, True])
def test_filtered_copy_is_named_with_the_topics_to_keep(at_once: bool, turned: bool) -> None:
    topics: Topics = {
        '/sonar/front': of('front', RAW.__getitem__),
        '/sonar/front_filtered': of('front', FILTERED.__getitem__),
        '/sonar/rear': of('rear', measured(1).__getitem__),
    }
    if turned:
        topics = dict(reversed(topics.items()))
    (text,) = notes(topics, at_once)
    assert text.startswith(
        '/sonar/front and /sonar/front_filtered contain the same readings (frame front: equal stamps'
    )
    kept = '/sonar/rear /sonar/front' if turned else '/sonar/front /sonar/rear'
    assert text.endswith(f'is /sonar/front_filtered a filtered copy? keep {kept}')


def test_array_and_its_copy_are_named_once() -> None:
    frames = [f'sonar_{n}' for n in range(6)]
    ranges = [message for n, frame in enumerate(frames) for message in of(frame, measured(n).__getitem__)]
    (text,) = notes({'/relay': ranges, '/a/long/name/of/sonars': ranges})
    assert text.startswith('/relay and /a/long/name/of/sonars contain')
    assert 'frame sonar_0, sonar_1, sonar_2, sonar_3 and 2 more' in text and text.endswith('keep /relay')


@pytest.mark.parametrize(
    'other',
    [
        of('sonar', measured(5).__getitem__),
        of('rear', RAW.__getitem__),
        of('sonar', RAW.__getitem__, later=1000),
        of('sonar', RAW.__getitem__, count=LEAST_PAIRS),
        of('sonar', lambda k: math.inf),
    ],
    ids=['another sensor with its frame', 'another frame', 'other stamps', 'few echoes', 'no echoes'],
)
def test_other_topics_are_no_copies(other: Any) -> None:
    assert notes({'/one': of('sonar', RAW.__getitem__), '/other': other}) == []


def test_copies_for_a_small_part_of_the_drive_are_not_named() -> None:
    long = measured(3, 300)
    rest = of('sonar', long.__getitem__, 300)
    shifted = [m._replace(stamp=m.stamp + 7) if k >= 100 else m for k, m in enumerate(rest)]
    assert notes({'/one': rest, '/other': shifted}) == []


def test_messages_without_a_stamp_are_not_compared() -> None:
    messages = [m._replace(stamp=0) for m in of('sonar', lambda k: 1.0)]
    assert notes({'/one': messages, '/other': messages}) == []


@pytest.mark.parametrize('at_once', [False, True])
def test_number_of_compared_messages_is_bounded(monkeypatch: pytest.MonkeyPatch, at_once: bool) -> None:
    monkeypatch.setattr(repeated_topics, 'MOST_COMPARED', 2 * LEAST_PAIRS)
    copies = {'/one': of('sonar', RAW.__getitem__), '/other': of('sonar', RAW.__getitem__)}
    assert notes(copies, at_once) == []
