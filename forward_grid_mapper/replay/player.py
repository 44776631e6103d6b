"""Plays recorded messages at their times."""

from __future__ import annotations

import math
import time
from collections import Counter
from collections.abc import Callable, Collection, Mapping

from ..bags.choice import ODOMETRY, RANGE, Topics
from ..bags.reader import Bag
from ..core.common.errors import BagError
from ..core.messages.message_types import stamp_of
from .publishers import Publishers
from .ros_messages import MISFITS
from .stop_signal import StopSignal
from .timeline import Timeline

CLOCK = '/clock'


class Player:
    """Publishes the messages of an open bag when they are due.

    Parameters
    ----------
    names : mapping
        Published name by the bag's topic.
    clock : float or None
        Rate of `/clock` in Hz.
    tell : callable
        Receives the progress of the replay.
    transforms : collection of str
        Topics of transforms. They are published between the messages around them: their stamps may be in the future.

    Attributes
    ----------
    played : Counter
        Messages published, by message type.
    unusable : Counter
        Messages of another definition that were skipped, by topic.
    jumps : int
        Gaps and steps back of the stamps that were skipped.
    """

    def __init__(
        self,
        bag: Bag,
        topics: Topics,
        names: Mapping[str, str],
        publishers: Publishers,
        stop: StopSignal,
        clock: float | None,
        tell: Callable[[str], None],
        transforms: Collection[str] = (),
    ) -> None:
        self.played: Counter[str] = Counter()
        self.unusable: Counter[str] = Counter()
        self.jumps = 0
        self._bag = bag
        self._topics = topics
        self._names = names
        self._publishers = publishers
        self._stop = stop
        self._period = 1 / clock if clock else math.inf
        self._next_tick = 0.0 if clock else math.inf
        self._tell = tell
        self._transforms = transforms
        self._total = sum(count for topic, (_, count) in bag.topics().items() if topic in self._kinds)

    @property
    def _kinds(self) -> dict[str, str]:
        return {**dict.fromkeys(self._topics.range_topics, RANGE), self._topics.odom_topic: ODOMETRY}

    def play(self, rate: float, label: str) -> None:
        """Play the bag once; return early on a request to stop.

        Raises
        ------
        BagError
            If none of the topics' messages can be read.
        """
        timeline = Timeline(rate)
        kinds, done = self._kinds, 0
        for topic, message in self._bag.originals(self._topics, self._transforms):
            try:
                if topic not in self._transforms:
                    self._wait(timeline, timeline.due(topic, stamp_of(message.header)))
                if self._stop.is_set():
                    break
                self._publishers.publish(self._names[topic], message)
            except MISFITS:
                self.unusable[topic] += 1
                continue
            if topic in self._transforms:
                continue
            done += 1
            self.played[kinds[topic]] += 1
            self._tell(f'{label}: {100 * done // max(done, self._total)} % of {self._total:,} messages')
        self.jumps += timeline.jumps
        if not done and not self._stop.is_set():
            raise BagError(f'{self._bag.path}: no message of the chosen topics can be read')

    def _wait(self, timeline: Timeline, due: float) -> None:
        """Wait until a message is due, and publish the clock meanwhile; it is also published at every message."""
        while (now := time.monotonic()) < due and not self._stop.is_set():
            if now >= self._next_tick:
                self._tick(timeline)
                self._next_tick = now + self._period
            self._stop.wait(min(due, self._next_tick) - now)
        if self._next_tick < math.inf:
            self._tick(timeline)

    def _tick(self, timeline: Timeline) -> None:
        self._publishers.publish_clock(self._names[CLOCK], timeline.time())
