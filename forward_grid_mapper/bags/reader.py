"""Reads a recorded bag: its topics, and its ranges and odometry in the order of recording."""

from __future__ import annotations

import random
from collections import Counter
from collections.abc import Callable, Collection, Iterator, Mapping, Sequence
from contextlib import contextmanager
from itertools import islice, repeat
from pathlib import Path
from types import TracebackType
from typing import Any

import numpy as np

from ..core.common.errors import BagError
from ..core.messages.message_batch import MessageBatch, joined
from ..core.messages.message_types import OdometryMessage, RangeMessage, range_message
from ..core.messages.rep117 import proper_name
from ..core.messages.repeated_topics import RepeatedTopics
from .choice import ODOMETRY, RANGE, Topics, choose_range_topics, choose_topics
from .columns import Columns, InOrder
from .decoder import TF_MESSAGE, decoder_of
from .moving_transforms import MovingTransforms
from .namespaces import by_precedence
from .opening import open_sources
from .poses import POSES
from .repair import Problem, reasons_of, remedies_of, repair_hint
from .source import Channel, RawMessage, Source, close_all, one_line
from .static_transforms import StaticTransforms
from .transform_chain import TransformChain, chain_of, constant_transforms

_CONVERSIONS: dict[str, Callable[[Any], RangeMessage | OdometryMessage | None]] = {RANGE: range_message, **POSES}
_PROGRESS_STEP = 1000
MOST_SEARCHED = 20_000
"""Most messages in which frames are searched: half of them at the start, the others all over the bag."""

BATCH = 16
"""Steps of progress after which messages are decoded: 12 MB of Odometry."""


class Bag:
    """A recorded bag, open for reading in a `with` block.

    Parameters
    ----------
    path : str or Path
        ROS 2 bag folder, single `.mcap` or `.db3` file, or ROS 1 `.bag`.

    Attributes
    ----------
    undecodable : dict
        Number of messages by topic that did not fit their type and were skipped.
    repeated : RepeatedTopics
        Compares the ranges that `batches` has read.
    """

    def __init__(self, path: str | Path) -> None:
        self.path = Path(path)
        self.undecodable: dict[str, int] = {}
        self.repeated = RepeatedTopics()
        self._sources: list[Source] = []
        self._files: list[tuple[Path, Source]] = []
        self._problems: list[Problem] = []

    def __enter__(self) -> Bag:
        """Open the bag.

        Raises
        ------
        BagError
            If there is no bag, or nothing of it can be read.
        """
        self._sources, self._files, self._problems = open_sources(self.path)
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        """Close the bag."""
        self._problems = self._found_problems()
        sources, self._sources, self._files = self._sources, [], []
        close_all(sources)

    @property
    def truncated(self) -> str | None:
        """One line about what could not be read, complete only after reading; None for an undamaged bag."""
        problems = self._found_problems()
        if not problems:
            return None
        name = self.path.name or self.path.resolve().name
        reasons, remedies = reasons_of(problems), remedies_of(problems)
        return f'{name} is damaged or cut off ({reasons}); the intact part was read{remedies}.'

    def topics(self) -> dict[str, tuple[str, int]]:
        """Return (message type, number of messages) by topic; several types are joined by ' | '."""
        types: dict[str, set[str]] = {}
        counts: Counter[str] = Counter()
        for channel in self._channels():
            types.setdefault(channel.topic, set()).add(channel.msgtype)
            counts[channel.topic] += channel.total
        return {topic: (' | '.join(sorted(types[topic])), counts[topic]) for topic in sorted(types)}

    def choose_topics(
        self, range_topics: Sequence[str] | None = None, odom_topic: str | None = None, any_poses: bool = False
    ) -> Topics:
        """Return the topics to map from: those named, or else all Range topics and the only Odometry topic.

        With `any_poses`, the only topic of stamped poses is allowed if there is no Odometry.

        Raises
        ------
        BagError
            If a named topic is missing, or there is none, or several Odometry topics and none is named.
        """
        with self._naming_damage():
            return choose_topics(self.topics(), range_topics, odom_topic, self._frames_of, any_poses)

    def choose_range_topics(self, range_topics: Sequence[str] | None = None) -> Topics:
        """Return the topics to map from if the poses are from elsewhere: those of ranges, without odometry.

        Raises
        ------
        BagError
            If a named topic is missing, or there is none.
        """
        with self._naming_damage():
            return Topics(choose_range_topics(self.topics(), range_topics), '')

    @contextmanager
    def _naming_damage(self) -> Iterator[None]:
        """Add the damage to a `BagError`: what is missing may be in the part that cannot be read."""
        try:
            yield
        except BagError as error:
            if self.truncated is None:
                raise
            raise BagError(f'{error}\n{self.truncated}') from error

    def base_frame(self) -> str:
        """Return the frame whose pose the bag's odometry gives; '' if there is none."""
        wanted = {(channel.topic, ODOMETRY) for channel in self._channels() if channel.msgtype == ODOMETRY}
        for _, message in self._decoded(wanted):
            if message is not None:
                return str(message.child_frame_id)
        return ''

    def messages(
        self, topics: Topics, progress: Callable[[int, int], None] | None = None
    ) -> Iterator[RangeMessage | OdometryMessage]:
        """Yield the messages of the chosen topics one by one, in the order of `batches`."""
        for batch in self.batches(topics, progress):
            yield from batch.one_by_one()

    def batches(self, topics: Topics, progress: Callable[[int, int], None] | None = None) -> Iterator[MessageBatch]:
        """Yield the messages of the chosen topics by log time, many at once; the files of a split bag in order.

        Files whose log times overlap are read together.

        Parameters
        ----------
        topics : Topics
            From `choose_topics`.
        progress : callable, optional
            Called with (done, total) messages as they are read.

        Raises
        ------
        BagError
            If the bag is damaged and nothing of these topics can be read.
        """
        chain = self._chain(topics)
        wanted = self._begin(topics)
        self.repeated = RepeatedTopics()
        total = sum(c.total for c in self._channels() if (c.topic, c.msgtype) in wanted)
        done = decoded = 0

        def tell(more: int) -> None:
            nonlocal done
            done += more
            if progress and more:
                progress(done, max(done, total))

        for channels, columns, raw in self._raw(wanted, chain, tell):
            bad: list[tuple[int, Channel]] = []
            parts: list[MessageBatch] = []
            keys = np.fromiter((key for key, _, _ in raw), np.int64, len(raw))
            for mine, decoding in columns.items():
                places = np.flatnonzero(np.isin(keys, mine))
                found, wrong = decoding.decode(places, [raw[k][2] for k in places.tolist()])
                parts += found
                if len(topics.range_topics) > 1:
                    for part in found:
                        self.repeated.add_batch(channels[mine[0]].topic, part.ranges)
                bad += [(place, channels[int(keys[place])]) for place in wrong]
            for _, channel in sorted(bad, key=lambda one: one[0]):
                self._count_undecodable(channel)
            decoded += len(raw) - len(bad)
            if parts:
                yield joined(parts)
        if not decoded and (problems := self._found_problems()):
            raise BagError(
                f'{self.path} is damaged or cut off ({reasons_of(problems)}) and no message of the chosen topics can '
                f'be read{remedies_of(problems)}.'
            )

    def _raw(
        self, wanted: Collection[tuple[str, str]], chain: TransformChain | None, tell: Callable[[int], None]
    ) -> Iterator[tuple[dict[int, Channel], dict[tuple[int, ...], Columns], list[RawMessage]]]:
        """Yield channels by key, decoders for some of them, and some messages; `tell` receives numbers of messages."""
        for source in self._sources:
            channels = {c.key: c for c in source.channels if (c.topic, c.msgtype) in wanted}
            if not channels:
                continue
            columns = _decoding(channels, chain)
            held: list[RawMessage] = []
            messages = source.messages(channels.keys())
            more = True
            while more:
                before = len(held)
                try:
                    # messages before an error are kept
                    held.extend(islice(messages, _PROGRESS_STEP))
                except Exception as error:  # rosbags raises many classes; the next file of a split bag may be undamaged
                    source.damage = source.damage or one_line(error)
                more = len(held) - before == _PROGRESS_STEP
                tell(len(held) - before)
                if held and (not more or len(held) >= BATCH * _PROGRESS_STEP):
                    yield channels, columns, held
                    held = []

    def static_transforms(self, topics: Topics | None = None) -> StaticTransforms:
        """Return the transforms on `/tf_static` and on the `tf_static` of namespaces, in the order of `by_precedence`.

        Parameters
        ----------
        topics : Topics, optional
            The topics to map from; without them, `/tf_static` takes precedence over any namespace.
        """
        parts: dict[str, StaticTransforms] = {}
        for channel, message in self._static():
            part = parts.setdefault(channel.topic, StaticTransforms(channel.topic))
            try:
                for item in message.transforms:
                    part.add_message(item)
            except (AttributeError, TypeError, ValueError):
                self._count_undecodable(channel)
        transforms = StaticTransforms()
        for topic in by_precedence(parts, [] if topics is None else [topics.odom_topic, *topics.range_topics]):
            transforms.take(parts[topic])
        return transforms

    def moving_frames(self, topic: str | None = None) -> dict[str, str]:
        """Return the parent of each frame that transforms of this topic, or of `/tf`, place; they may move."""
        topics = self.moving_topics() if topic is None else {topic}
        parents: dict[str, str] = {}
        for message in self._searched(topics):
            for item in message.transforms:
                child, parent = str(item.child_frame_id).lstrip('/'), str(item.header.frame_id).lstrip('/')
                if proper_name(child) and proper_name(parent):
                    parents[child] = parent
        return parents

    def constant_transforms_on_tf(self, topics: Topics) -> StaticTransforms:
        """Return the constant transforms on `/tf`, and the result of `static_transforms`, which takes precedence.

        Simulators, and the static_transform_publisher of ROS 1's tf, repeat fixed transforms there. `topics` are those
        to map from.
        """
        transforms = StaticTransforms('/tf')
        for parent, child, numbers in constant_transforms(self._searched(self.moving_topics())):
            transforms.add_if_valid(parent, child, numbers[:3], numbers[3:])
        transforms.take(self.static_transforms(topics))
        return transforms

    def moving_transforms(
        self, topics: Topics, parents: Mapping[str, str], base_frame: str, sensor_frame: str, longest_gap: float
    ) -> MovingTransforms:
        """Return the transforms by stamp that may connect a sensor to the robot: those on `/tf`, and static ones.

        `parents` are those of `moving_frames`, and `longest_gap` is that of `MovingTransforms`, seconds.
        """
        fixed = self.static_transforms(topics)
        moving = MovingTransforms.between(fixed, parents, base_frame, sensor_frame, longest_gap)
        # it takes long to read all transforms of a long drive
        sources = set[str]() if moving.empty else self.moving_topics()
        for channel, message in self._decoded({(topic, TF_MESSAGE) for topic in sources}):
            if message is None:
                continue
            try:
                moving.add_message(message)
            except (AttributeError, TypeError, ValueError):
                self._count_undecodable(channel)
        return moving

    def moving_topics(self) -> set[str]:
        """Return `/tf` and the `tf` of any namespace, if the bag has them."""
        return {c.topic for c in self._channels() if c.msgtype == TF_MESSAGE and c.topic.split('/')[-1] == 'tf'}

    def originals(self, topics: Topics, transforms: Collection[str] = ()) -> Iterator[tuple[str, Any]]:
        """Yield topic and message of the chosen topics by log time, as rosbags decodes them.

        `transforms` are topics of transforms to be yielded as well.
        """
        wanted = self._begin(topics) | {(topic, TF_MESSAGE) for topic in transforms}
        for channel, message in self._decoded(wanted):
            if message is not None:
                yield channel.topic, message

    def static_originals(self) -> Iterator[tuple[str, Any]]:
        """Yield topic and message of `/tf_static`, and of the `tf_static` of any namespace, in the same way."""
        return ((channel.topic, message) for channel, message in self._static())

    def _static(self) -> Iterator[tuple[Channel, Any]]:
        wanted = {(c.topic, c.msgtype) for c in self._channels() if c.topic.split('/')[-1] == 'tf_static'}
        found = self._decoded({pair for pair in wanted if pair[1] == TF_MESSAGE})
        return ((channel, message) for channel, message in found if message is not None)

    def _begin(self, topics: Topics) -> set[tuple[str, str]]:
        """Return the (topic, type) pairs of the topics, and set their counts of undecodable messages to 0."""
        wanted = {(topic, RANGE) for topic in topics.range_topics} | {(topics.odom_topic, topics.odom_type)}
        for topic, _ in wanted:
            self.undecodable.pop(topic, None)
        return wanted

    def _found_problems(self) -> list[Problem]:
        """Return what could not be read, as far as known; a file in a bag folder is named."""
        found = list(self._problems)
        for file, source in self._files:
            if source.damage is not None:
                where = '' if file == self.path else f'{file.name}: '
                found.append(Problem(f'{where}{source.damage}', repair_hint(file)))
        return found or [Problem(source.damage) for source in self._sources if source.damage is not None]

    def _channels(self) -> Iterator[Channel]:
        if not self._sources:
            raise ValueError('the bag is not open; use it in a with block')
        return (channel for source in self._sources for channel in source.channels)

    def _decoded(
        self, wanted: Collection[tuple[str, str]], chosen: Iterator[bool] | None = None
    ) -> Iterator[tuple[Channel, Any]]:
        """Yield the messages of these (topic, type) pairs, None for one that does not fit its definition.

        `chosen` yields for each message whether to decode it; without it, all are decoded.
        """
        chosen = repeat(True) if chosen is None else chosen
        for source in self._sources:
            channels = {c.key: c for c in source.channels if (c.topic, c.msgtype) in wanted}
            decoders = {key: decoder_of(channel) for key, channel in channels.items()}
            if not channels:
                continue
            try:
                for key, _, data in source.messages(channels.keys()):
                    if not next(chosen):
                        continue
                    try:
                        message = decoders[key](data)
                    except Exception:  # rosbags raises many classes for bytes that do not fit
                        self._count_undecodable(channels[key])
                        message = None
                    yield channels[key], message
            except Exception as error:  # as above; the next file of a split bag may be undamaged
                source.damage = source.damage or one_line(error)

    def _count_undecodable(self, channel: Channel) -> None:
        self.undecodable[channel.topic] = self.undecodable.get(channel.topic, 0) + 1

    def _chain(self, topics: Topics) -> TransformChain | None:
        """Return the chain that gives the robot's pose, if several transforms are needed."""
        if topics.odom_type != TF_MESSAGE:
            return None
        return chain_of(self._searched({topics.odom_topic}))

    def _searched(self, topics: Collection[str]) -> Iterator[Any]:
        """Yield messages with transforms of these topics; only a selection if there are many."""
        wanted = {(topic, TF_MESSAGE) for topic in topics}
        total = sum(c.total for c in self._channels() if (c.topic, c.msgtype) in wanted)
        found = self._decoded(wanted, _selected(total, MOST_SEARCHED))
        return (message for _, message in found if message is not None)

    def _frames_of(self, topic: str) -> str:
        for channel, message in self._decoded({(topic, kind) for kind in POSES}):
            if message is not None and (odometry := POSES[channel.msgtype](message)) is not None:
                return f'{odometry.frame_id or "?"} → {odometry.child_frame_id or "?"}'
        return 'none of them readable'


def skipped(count: int, topic: str) -> str:
    """Return the warning about messages that could not be decoded."""
    if count == 1:
        return f'1 message on {topic} does not fit its type and was skipped'
    return f'{count} messages on {topic} do not fit their type and were skipped'


def _selected(total: int, most: int) -> Iterator[bool]:
    """Yield for each of `total` things whether it is among about `most`: the first ones, then a fixed random choice."""
    yield from repeat(True, most // 2)
    share = most / 2 / max(total - most // 2, 1)
    # at random, since any regular step may coincide with publishers that alternate
    draw = random.Random(0).random
    while True:
        yield draw() < share


def _decoding(channels: Mapping[int, Channel], chain: TransformChain | None) -> dict[tuple[int, ...], Columns]:
    """Return the decoders of channels, by their keys; those of a chain are decoded together, in order."""
    moving = tuple(key for key, c in channels.items() if chain is not None and c.msgtype == TF_MESSAGE)
    found: dict[tuple[int, ...], Columns] = {
        (key,): Columns(decoder_of(c), _CONVERSIONS[c.msgtype]) for key, c in channels.items() if key not in moving
    }
    if chain is not None and moving:
        found[moving] = InOrder(decoder_of(channels[moving[0]]), chain.pose)
    return found
