"""Messages of a file in batches give bit-identical results to single messages, also with bad messages."""

from __future__ import annotations

import math
import random
from collections.abc import Sequence
from dataclasses import fields
from typing import Any

import numpy as np
import pytest
from hypothesis import example, given, settings
from hypothesis import strategies as st

from forward_grid_mapper.core.common.parameters import Parameters
from forward_grid_mapper.core.common.readings import Readings
from forward_grid_mapper.core.messages.batch_association import BatchAssociator
from forward_grid_mapper.core.messages.extrinsics import STEEP, Mount
from forward_grid_mapper.core.messages.limit_watch import LimitWatch
from forward_grid_mapper.core.messages.message_batch import batch_of
from forward_grid_mapper.core.messages.message_types import NANOSECONDS, OdometryMessage, Pose2, RangeMessage
from forward_grid_mapper.core.messages.pose_association import PoseAssociator
from forward_grid_mapper.core.messages.rep117 import measure, measure_all
from forward_grid_mapper.core.messages.sensor_records import MOST_FRAMES

Message = RangeMessage | OdometryMessage

MOUNTS: dict[str, Pose2 | str | None] = {
    'front': Pose2(0.2, 0.1, 0.3),
    'level': Mount(0.1, 0.0, 1.0),
    'up': Mount(-0.1, 0.05, 2.0, 0.4),
    'high': Mount(0.0, 0.0, 0.0, 1.04),
    'steep': STEEP,
    'nowhere': None,
}
NAMES = [*MOUNTS, 'servo', '', 'x' * 300, 'a\nb']
RANGES = [0.0, 0.05, 1.0, 3.999, 4.0, 5.0, 900.0, -1.0, math.nan, math.inf, -math.inf]


def mount_of(base: str, frame: str, stamp: int) -> Pose2 | str | None:
    if frame != 'servo':
        return MOUNTS.get(frame)
    # on a moving joint: sometimes its pose is not known, or it looks up steeply
    phase = stamp // 10_000_000 % 100
    return ('late_transform', STEEP)[phase - 98] if phase >= 98 else Mount(0.1, 0.01 * phase, 0.1 * phase, 0.02 * phase)


def moves(base: str, frame: str) -> bool:
    return frame == 'servo'


def drive(seed: int, count: int, bad_share: float) -> list[Message]:
    """A drive in the order of recording; the larger `bad_share`, the more gaps, jumps and late stamps."""
    rng = random.Random(seed)
    found: list[Message] = []
    now, x, y = 10 * NANOSECONDS, 0.0, 0.0

    def bad(times: float = 1.0) -> bool:
        return rng.random() < bad_share * times

    for _ in range(count):
        now += rng.randrange(10_000_000, 80_000_000)
        if bad():
            now += rng.choice([700_000_000, 3 * NANOSECONDS, 0])
        x, y = x + rng.uniform(-0.1, 0.1), y + rng.uniform(-0.1, 0.1)
        if rng.random() < 0.3:
            stamp = now - (rng.randrange(0, 3 * NANOSECONDS) if bad(0.2) else 0)
            if bad(0.2):
                stamp += rng.choice([1_500_000_000, 3600 * NANOSECONDS])
            pose: Pose2 | None = Pose2(x, y, rng.uniform(-4, 4))
            if bad(0.1):
                pose = rng.choice([None, Pose2(1e9, 0.0, 0.0), Pose2(x + 300.0, y, 0.0)])
            names = ('odom', 'base') if not bad(0.1) else rng.choice([('map', 'base'), ('o' * 300, 'b'), ('', '')])
            found.append(OdometryMessage(stamp, *names, pose))
            continue
        stamp = now - rng.randrange(0, 50_000_000) + (rng.randrange(-2, 2) * NANOSECONDS if bad() else 0)
        if found and bad():
            stamp = found[-1].stamp
        if bad(0.1):
            stamp = 0
        measured = rng.choice(RANGES) if bad() else rng.uniform(0.2, 4.2)
        limits = rng.choice([(4.0, 4.0), (0.0, math.inf), (5.0, 4.0), (0.1, 40.0)]) if bad() else (0.1, 4.0)
        angle = rng.choice([0.0, math.nan, 2.6, 3.2]) if bad() else 0.3
        name = rng.choice(NAMES) if bad() else rng.choice(('front', 'level', 'up', 'servo'))
        variance = rng.choice([0.0, 0.01, math.nan, math.inf, -1.0]) if bad(3) else 0.0
        found.append(RangeMessage(stamp, name, measured, *limits, angle, variance))
    return found


def one_by_one(messages: Sequence[Message], parameters: Parameters) -> PoseAssociator:
    made = PoseAssociator(mount_of, parameters, patient=True)
    for message in messages:
        if isinstance(message, RangeMessage):
            made.add_range(message)
        else:
            made.add_odometry(message)
    return made


def in_batches(messages: Sequence[Message], parameters: Parameters, seed: int) -> BatchAssociator:
    rng, made, done = random.Random(seed), BatchAssociator(mount_of, parameters, moves), 0
    while done < len(messages):
        size = rng.choice([1, 7, 100, 400])
        made.add_batch(batch_of(list(enumerate(messages[done : done + size]))))
        done += size
    return made


def equal(one: Readings, other: Readings) -> bool:
    names = [f.name for f in fields(Readings) if f.name != 'sensor_names']
    same = all(np.array_equal(getattr(one, name), getattr(other, name)) for name in names)
    return same and one.sensor_names == other.sensor_names


def state_of(made: PoseAssociator) -> dict[str, Any]:
    """The whole state of an associator, including the order of entries."""
    return {
        'received': made.received,
        'rejected': list(made.rejected.items()),
        'by frame': [(frame, list(counts.items())) for frame, counts in made.rejected_by_frame.items()],
        'unknown': sorted(made.unknown_frames),
        'odometry': (made.odometry_received, list(made.odometry_rejected.items()), made.time_jumps),
        'frames': (made.map_frame, made.base_frame),
        'waiting': made.waiting,
        'path': made.path,
        'counts': list(made.buffer.counts().items()),
        'held': made.buffer.stored,
        'warnings': made.message_warnings(),
    }


@settings(max_examples=80, deadline=None)
@given(
    seed=st.integers(0, 2**32),
    bad_share=st.sampled_from([0.0, 0.002, 0.02, 0.2]),
    bound=st.sampled_from([0, 0, 50]),
    cells=st.sampled_from([50_000_000, 20_000, 10_000]),
    over=st.sampled_from(['no_echo', 'discard']),
    invalid=st.sampled_from(['discard', 'no_echo']),
    offset=st.sampled_from([0.0, -0.15, 2.0]),
)
# readings of several sensors wait when the clock jumps back
@example(seed=2557, bad_share=0.002, bound=0, cells=50_000_000, over='no_echo', invalid='discard', offset=2.0)
def test_batches_give_the_result_of_single_messages(
    seed: int, bad_share: float, bound: int, cells: int, over: str, invalid: str, offset: float
) -> None:
    chosen = {'max_readings': bound, 'max_cells': cells, 'over_range': over, 'invalid_range': invalid}
    parameters = Parameters.from_flat({**chosen, 'range_time_offset': offset})
    messages = drive(seed, 600, bad_share)
    whole, parts = one_by_one(messages, parameters), in_batches(messages, parameters, seed)
    assert state_of(whole) == state_of(parts)
    assert equal(whole.buffer.snapshot(), parts.buffer.snapshot())
    whole.finish()
    parts.finish()
    assert state_of(whole) == state_of(parts)
    assert equal(whole.readings, parts.readings)
    for one, other in zip(whole.odometry, parts.odometry, strict=True):
        np.testing.assert_array_equal(one, other)


def test_batch_without_bad_messages_is_not_split(monkeypatch: pytest.MonkeyPatch) -> None:
    def never(self: PoseAssociator, message: object, sent: int = 0) -> None:
        raise AssertionError('one message at a time')

    monkeypatch.setattr(BatchAssociator, 'add_range', never)
    monkeypatch.setattr(BatchAssociator, 'add_odometry', never)
    made = in_batches(drive(1, 500, 0.0), Parameters(), 1)
    assert len(made.buffer) > 200


@pytest.mark.parametrize('at', [99, 100, 101])
def test_stamp_ahead_at_the_end_of_a_batch_is_dropped_by_the_next_batch(at: int) -> None:
    messages: list[Message] = []
    for k in range(200):
        stamp = (100 + k) * NANOSECONDS // 10
        messages.append(
            OdometryMessage(stamp + (9 * NANOSECONDS if k == at else 0), 'odom', 'base', Pose2(k, 0.0, 0.0))
        )
        messages.append(RangeMessage(stamp if k % 50 else 0, 'front', 1.0, 0.1, 4.0, 0.3))
    whole, parts = one_by_one(messages, Parameters()), BatchAssociator(mount_of, moves=moves)
    for part in (messages[:201], messages[201:]):
        parts.add_batch(batch_of(list(enumerate(part))))
    for made in (whole, parts):
        made.finish()
        assert made.odometry_rejected == {'ahead_of_others': 1}
        assert made.time_jumps == 0 and made.rejected['zero_stamp'] == 4
    assert state_of(whole) == state_of(parts)
    assert equal(whole.readings, parts.readings)


def test_readings_before_all_odometry_give_the_result_of_single_messages() -> None:
    messages = drive(5, 300, 0.01)
    later = sorted(messages, key=lambda m: isinstance(m, OdometryMessage))
    whole, parts = one_by_one(later, Parameters()), in_batches(later, Parameters(), 5)
    assert state_of(whole) == state_of(parts)
    assert equal(whole.readings, parts.readings)


@settings(max_examples=60, deadline=None)
@given(seed=st.integers(0, 2**32), angle=st.sampled_from([0.0, 0.5]), limit=st.sampled_from([0.0, 3.0]))
def test_measurements_of_a_batch_equal_single_ones(seed: int, angle: float, limit: float) -> None:
    parameters = Parameters.from_flat({'field_of_view': angle, 'max_range': limit}).association
    ranges = [m for m in drive(seed, 200, 0.5) if isinstance(m, RangeMessage)]
    many = measure_all(batch_of(list(enumerate(ranges))).ranges, parameters)
    for k, message in enumerate(ranges):
        one = measure(message, parameters)
        if isinstance(one, str):
            assert many.reason[k] == one
        else:
            assert many.reason[k] == ''
            assert (many.z[k], many.z_max[k], many.half_angle[k], many.sigma[k]) == (
                one.z,
                one.z_max,
                one.half_angle,
                one.sigma,
            )


@pytest.mark.parametrize('max_range', [0.0, 0.6])
@pytest.mark.parametrize('sizes', [[10, 5000, 1, 1, 1023, 7000], [1024, 1024, 1, 9000], [20000]])
def test_limits_of_a_batch_are_checked_as_for_single_messages(sizes: list[int], max_range: float) -> None:
    one, many = LimitWatch(), LimitWatch()
    rng, names = random.Random(3), ['left', 'right', 'rare']
    for size in sizes:
        messages = [
            RangeMessage(0, rng.choice(names), rng.random(), rng.random(), rng.choice((1.0, 200.0)) * rng.random(), 0.3)
            for _ in range(size)
        ]
        for message in messages:
            one.add(message, max_range)
        many.add_all(batch_of(list(enumerate(messages))).ranges, max_range)
    assert one._of.keys() == many._of.keys() == set(names)
    for name in names:
        first, second = one._of[name], many._of[name]
        assert (first._every, first._count) == (second._every, second._count)
        np.testing.assert_array_equal(first.values, second.values)


def test_limits_of_too_many_sensors_are_not_watched() -> None:
    one, many = LimitWatch(), LimitWatch()
    messages = [RangeMessage(0, f's{k}', 100.0, 0.1, 5.0, 0.3) for k in range(2 * MOST_FRAMES)]
    for message in messages:
        one.add(message)
    many.add_all(batch_of(list(enumerate(messages))).ranges)
    assert len(one._of) == len(many._of) == MOST_FRAMES


def test_batch_yields_its_messages_in_order() -> None:
    messages = drive(7, 200, 0.0)
    batch = batch_of(random.Random(1).sample(list(enumerate(messages)), len(messages)))
    assert list(batch.one_by_one()) == messages
    empty = batch_of([])
    assert list(empty.one_by_one()) == []
    some = batch.select(np.arange(len(batch.ranges.place)) % 2 == 0, batch.odometry.place < 0)
    assert list(some.one_by_one()) == [m for m in messages if isinstance(m, RangeMessage)][::2]
