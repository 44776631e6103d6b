#!/usr/bin/env python3
"""Reading of bags: CPU time for each message, one by one and many at once, with equal readings.

usage: reading.py BAG [BAG ...] [--repeat 3]

Without bags, one of 100 000 readings is simulated.
"""

from __future__ import annotations

import argparse
import tempfile
import time
from collections.abc import Callable
from pathlib import Path

import numpy as np
from measuring import machine

from forward_grid_mapper.bags.choice import Topics
from forward_grid_mapper.bags.poses import POSES
from forward_grid_mapper.bags.reader import Bag
from forward_grid_mapper.bags.static_transforms import StaticTransforms
from forward_grid_mapper.commands.simulate import write_bag
from forward_grid_mapper.core.common.parameters import Parameters
from forward_grid_mapper.core.messages.batch_association import BatchAssociator
from forward_grid_mapper.core.messages.message_types import range_message
from forward_grid_mapper.core.messages.pose_association import PoseAssociator
from forward_grid_mapper.recordings.bag_extrinsics import BagExtrinsics
from forward_grid_mapper.simulation.campus import campus_drive


def one_by_one(bag: Bag, topics: Topics) -> PoseAssociator:
    """Read a bag message by message."""
    made = PoseAssociator(BagExtrinsics({}, bag.static_transforms(), StaticTransforms), Parameters(), patient=True)
    for topic, message in bag.originals(topics):
        if topic in topics.range_topics:
            made.add_range(range_message(message))
        elif (pose := POSES[topics.odom_type](message)) is not None:
            made.add_odometry(pose)
    made.finish()
    return made


def at_once(bag: Bag, topics: Topics) -> PoseAssociator:
    """Read a bag many messages at once."""
    made = BatchAssociator(BagExtrinsics({}, bag.static_transforms(), StaticTransforms), Parameters())
    for batch in bag.batches(topics):
        made.add_batch(batch)
    made.finish()
    return made


def main() -> None:
    """Print a row for each bag."""
    options = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    options.add_argument('bags', nargs='*', type=Path)
    options.add_argument('--repeat', type=int, default=3)
    chosen = options.parse_args()
    print(machine())
    with tempfile.TemporaryDirectory() as folder:
        if not chosen.bags:
            write_bag(Path(folder, 'simulated'), campus_drive(0, 1, 100_000), 'mcap', False)
        print(f'{"":30}{"messages":>10}{"one by one":>12}{"at once":>10} us a message{"ratio":>8}')
        for path in chosen.bags or [Path(folder, 'simulated')]:
            row(path, chosen.repeat)


def row(path: Path, repeat: int) -> None:
    """Time a bag alternately by both methods, and compare the results."""
    best: dict[Callable[[Bag, Topics], PoseAssociator], float] = {}
    made: list[PoseAssociator] = []
    for read in (one_by_one, at_once) * repeat:
        begun = time.process_time()
        with Bag(path) as bag:
            topics = bag.choose_topics(odom_topic=next(iter(sorted(odometry_of(bag)))))
            made = [*made[-1:], read(bag, topics)]
        best[read] = min(best.get(read, np.inf), time.process_time() - begun)
    one, other = made
    for name in ('x', 'y', 'yaw', 'z', 'stamp', 'sensor'):
        np.testing.assert_array_equal(getattr(one.readings, name), getattr(other.readings, name))
    count = one.received + one.odometry_received
    slow, fast = (1e6 * seconds / count for seconds in best.values())
    print(f'{path.name[-29:]:30}{count:10,}{slow:12.1f}{fast:10.1f}{"":13}{slow / fast:7.1f}x')


def odometry_of(bag: Bag) -> list[str]:
    """Return the topics of odometry."""
    return [topic for topic, (kind, _) in bag.topics().items() if kind in POSES and 'Odometry' in kind]


if __name__ == '__main__':
    main()
