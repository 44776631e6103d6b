"""Split bags whose files overlap in time are read by log time."""

from __future__ import annotations

import shutil
from collections.abc import Callable, Collection, Iterator
from pathlib import Path

import pytest
from bag_samples import EXTRINSICS, SECOND, START, sample_messages, storage_file

from forward_grid_mapper.bags.interleaved import Interleaved, interleaved
from forward_grid_mapper.bags.reader import Bag
from forward_grid_mapper.bags.source import Channel, RawMessage
from forward_grid_mapper.bags.writer import BagWriter
from forward_grid_mapper.core.common.parameters import Parameters
from forward_grid_mapper.core.messages.message_types import RangeMessage
from forward_grid_mapper.recordings.read_drive import read_drive

MIDDLE = START + 10 * SECOND


def split(folder: Path, kind: str, file_of: Callable[[int, bool, int], int], order: tuple[int, ...]) -> Path:
    """A bag in several files; `file_of` a message's place, kind and stamp, and `order` that of the metadata."""
    whole = folder / 'whole'
    whole.mkdir()
    names = []
    for number in range(len(order)):
        with BagWriter(folder / f'part_{number}', kind) as writer:
            if not number:
                writer.write_static_transforms(EXTRINSICS, START)
            for place, message in enumerate(sample_messages()):
                ranges = isinstance(message, RangeMessage)
                if file_of(place // 2, ranges, message.stamp) != number:
                    continue
                if isinstance(message, RangeMessage):
                    writer.write_range('/sonar', message)
                else:
                    writer.write_odometry('/odom', message)
        names.append(Path(shutil.copy(storage_file(folder / f'part_{number}'), whole)).name)
    listed = ''.join(f'    - {names[number]}\n' for number in order)
    (whole / 'metadata.yaml').write_text(f'rosbag2_bagfile_information:\n  relative_file_paths:\n{listed}')
    return whole


SPLITS: dict[str, tuple[Callable[[int, bool, int], int], tuple[int, ...]]] = {
    'odometry, then ranges': (lambda place, ranges, stamp: int(ranges), (0, 1)),
    'ranges, then odometry': (lambda place, ranges, stamp: int(ranges), (1, 0)),
    'one after the other, listed the other way round': (lambda place, ranges, stamp: int(stamp > MIDDLE), (1, 0)),
    'every second message': (lambda place, ranges, stamp: place % 2, (0, 1)),
    'a second of overlap': (
        lambda place, ranges, stamp: place % 2 if abs(stamp - MIDDLE) < SECOND else int(stamp > MIDDLE),
        (0, 1),
    ),
    'one inside another, and one after both': (
        lambda place, ranges, stamp: 2 if stamp > MIDDLE else int(abs(stamp - MIDDLE + 5 * SECOND) < SECOND),
        (0, 1, 2),
    ),
}


@pytest.mark.parametrize('kind', ['mcap', 'sqlite3'])
@pytest.mark.parametrize(('file_of', 'order'), SPLITS.values(), ids=SPLITS)
def test_messages_are_in_order_of_log_time(
    tmp_path: Path, kind: str, file_of: Callable[[int, bool, int], int], order: tuple[int, ...]
) -> None:
    path = split(tmp_path, kind, file_of, order)
    with Bag(path) as bag:
        assert list(bag.messages(bag.choose_topics())) == sample_messages()
        assert {topic: count for topic, (_, count) in bag.topics().items()} == {
            '/odom': 200,
            '/sonar': 200,
            '/tf_static': 1,
        }
        assert bag.truncated is None
    source = read_drive(path, Parameters(), {}).source
    # the last range has no odometry after it
    assert source['warnings'] == [] and source['counts']['accepted'] == 199


class MadeUp:
    """A source with the messages of one channel at these times; None raises."""

    def __init__(self, name: str, *times: int | None, span: tuple[int, int] | None = None) -> None:
        known = [time for time in times if time is not None]
        self.channels = [Channel(7, name, 'kind', 'cdr', '', '', len(known))]
        self.damage: str | None = None
        self.span = span or (min(known), max(known))
        self.begun = self.closed = False
        self._times = times

    def messages(self, keys: Collection[int]) -> Iterator[RawMessage]:
        assert list(keys) == [7]
        self.begun = True
        for time in self._times:
            if time is None:
                raise ValueError('a bad page')
            yield 7, time, self.channels[0].topic.encode()

    def close(self) -> None:
        self.closed = True


def read(source: Interleaved) -> list[tuple[int, bytes]]:
    return [(time, data) for _, time, data in source.messages([c.key for c in source.channels])]


def test_damaged_file_does_not_end_the_others() -> None:
    one, other = MadeUp('one', 1, 3, None, 5), MadeUp('other', 2, 4, 6)
    both = Interleaved([one, other])
    assert read(both) == [(1, b'one'), (2, b'other'), (3, b'one'), (4, b'other'), (6, b'other')]
    assert both.damage == one.damage == 'a bad page'
    both.damage = 'and more'
    assert both.damage == 'and more; a bad page'
    both.close()
    assert one.closed and other.closed


def test_file_is_opened_when_its_time_has_come() -> None:
    one, other = MadeUp('one', 1, 2, 9), MadeUp('other', 5, 9, 10)
    messages = Interleaved([other, one]).messages([0, 1])
    assert [next(messages)[1] for _ in range(2)] == [1, 2]
    assert not other.begun
    # of equal times, that of the earlier file
    assert [(time, data) for _, time, data in messages] == [(5, b'other'), (9, b'one'), (9, b'other'), (10, b'other')]
    alone = MadeUp('alone', 3)
    both = Interleaved([one, alone])
    assert [time for _, time, _ in both.messages([c.key for c in both.channels if c.topic == 'alone'])] == [3]


def test_only_files_that_overlap_are_read_together() -> None:
    one, other, third = MadeUp('one', 1, 4), MadeUp('other', 4, 6), MadeUp('third', 7, 9)
    first, second = interleaved([one, other, third])
    assert isinstance(first, Interleaved) and first.span == (1, 6) and second is third
    other.span = None
    assert interleaved([one, other, third]) == [one, other, third]
    assert interleaved([]) == []
