"""The published messages and their order, with stand-ins for the bag and the publishers."""

from __future__ import annotations

from collections.abc import Collection, Iterator
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import pytest
from replay_samples import ODOMETRY, RANGE, START

from forward_grid_mapper.bags.choice import Topics
from forward_grid_mapper.core.common.errors import BagError
from forward_grid_mapper.core.messages.message_types import NANOSECONDS
from forward_grid_mapper.replay.player import Player

TOPICS = Topics(('sonar',), 'odom')
NAMES = {'sonar': '/sonar', 'odom': '/odom', '/clock': '/clock'}


class FakeBag:
    """Yields messages with only a stamp; None stands for a message of another definition."""

    path = Path('made_up')

    def __init__(self, *stamps: tuple[str, int | None]) -> None:
        self._stamps = stamps

    def topics(self) -> dict[str, tuple[str, int]]:
        return {'sonar': (RANGE, 9), 'odom': (ODOMETRY, 9), 'other': (RANGE, 9)}

    def originals(self, topics: Topics, transforms: Collection[str]) -> Iterator[tuple[str, Any]]:
        assert topics == TOPICS
        for topic, stamp in self._stamps:
            if topic in transforms:
                # each of its transforms has a stamp, the message has none
                yield topic, SimpleNamespace(transforms=stamp)
            elif stamp is None:
                yield topic, SimpleNamespace()
            else:
                time = SimpleNamespace(sec=stamp // NANOSECONDS, nanosec=stamp % NANOSECONDS)
                yield topic, SimpleNamespace(header=SimpleNamespace(stamp=time))


class Log:
    """Publishers that keep (topic, time) of all messages, and a stop signal after some of them."""

    def __init__(self, stop_after: int = 1000) -> None:
        self.published: list[tuple[str, int]] = []
        self._stop_after = stop_after

    def publish(self, topic: str, source: Any) -> None:
        if hasattr(source, 'transforms'):
            self.published.append((topic, source.transforms))
            return
        self.published.append((topic, source.header.stamp.sec * NANOSECONDS + source.header.stamp.nanosec))

    def publish_clock(self, topic: str, stamp: int) -> None:
        self.published.append((topic, stamp))

    def is_set(self) -> bool:
        return len(self.published) >= self._stop_after

    def wait(self, seconds: float) -> bool:
        assert seconds < 10
        return self.is_set()


def player(bag: FakeBag, log: Log, clock: float | None = None) -> Player:
    doubles: Any = (bag, log)
    return Player(doubles[0], TOPICS, NAMES, doubles[1], doubles[1], clock, lambda text: None)


def test_messages_are_counted_and_published_on_renamed_topics() -> None:
    log = Log()
    made = player(FakeBag(('odom', START), ('sonar', START + 5), ('odom', START + 9)), log)
    made.play(1.0, 'replaying')
    assert log.published == [('/odom', START), ('/sonar', START + 5), ('/odom', START + 9)]
    assert made.played == {RANGE: 1, ODOMETRY: 2}


def test_transforms_are_published_between_other_messages() -> None:
    log = Log()
    # that of a broadcaster whose stamps are an hour ahead
    later = START + 3600 * NANOSECONDS
    bag: Any = FakeBag(
        ('tf', START), ('odom', START), ('tf', later), ('sonar', START + NANOSECONDS // 10), ('tf', later)
    )
    doubles: Any = log
    made = Player(bag, TOPICS, {**NAMES, 'tf': '/tf'}, doubles, doubles, None, lambda text: None, ['tf'])
    made.play(1.0, 'replaying')
    assert log.published == [
        ('/tf', START),
        ('/odom', START),
        ('/tf', later),
        ('/sonar', START + NANOSECONDS // 10),
        ('/tf', later),
    ]
    assert made.played == {RANGE: 1, ODOMETRY: 1} and not made.jumps


def test_message_of_another_definition_is_skipped() -> None:
    made = player(FakeBag(('odom', START), ('sonar', None), ('sonar', START + 5)), Log())
    made.play(1.0, 'replaying')
    assert made.unusable == {'sonar': 1}
    assert made.played == {RANGE: 1, ODOMETRY: 1}


def test_bag_without_a_readable_message_is_an_error() -> None:
    with pytest.raises(BagError, match='made_up'):
        player(FakeBag(('sonar', None)), Log()).play(1.0, 'replaying')


def test_no_messages_are_published_after_a_signal() -> None:
    log = Log(stop_after=2)
    player(FakeBag(*(('odom', START + i) for i in range(9))), log).play(1.0, 'replaying')
    assert len(log.published) == 2


def test_signal_before_the_first_message_is_no_error() -> None:
    log = Log(stop_after=0)
    player(FakeBag(('odom', START)), log).play(1.0, 'replaying')
    assert log.published == []


def test_clock_is_not_behind_the_next_message() -> None:
    log = Log()
    stamps = [START, START + NANOSECONDS // 50, START + NANOSECONDS // 25]
    player(FakeBag(*(('odom', stamp) for stamp in stamps)), log, clock=200.0).play(1.0, 'replaying')
    assert log.published[0] == ('/clock', START)
    assert [time for topic, time in log.published if topic == '/odom'] == stamps
    latest = 0
    for topic, time in log.published:
        if topic == '/clock':
            assert time >= latest
            latest = time
        else:
            assert time == latest


def test_jumps_of_all_rounds_are_counted() -> None:
    made = player(FakeBag(('odom', START), ('odom', START + 3600 * NANOSECONDS)), Log())
    for _ in range(3):
        made.play(1.0, 'replaying')
    assert made.jumps == 3
