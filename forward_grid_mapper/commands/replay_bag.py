"""`replay_bag`: publishes a bag's ranges, odometry and transforms, if `ros2 bag` is not installed."""

from __future__ import annotations

import argparse
import math
import sys
import time
from collections import Counter
from collections.abc import Iterable, Mapping, Sequence
from typing import Any

from ..bags.choice import ODOMETRY, RANGE
from ..bags.decoder import TF_MESSAGE
from ..bags.reader import Bag, skipped
from ..core.common.errors import MapperError
from ..core.common.words import counted, printable
from ..replay.player import CLOCK, Player
from ..replay.publishers import Publishers, renamed
from ..replay.ros_messages import MISFITS, message_class, static_transforms
from ..replay.stop_signal import StopSignal
from .console import Ticker, run
from .options import BagParser, add_topic_options

COMMAND = 'replay_bag'
CLOCK_TYPE = 'rosgraph_msgs/msg/Clock'
TF_DEPTH = 100
"""Messages on /tf that are kept for late subscribers, as tf2's broadcaster does."""


def parser() -> argparse.ArgumentParser:
    """Return the parser of the command line."""
    made = BagParser(
        COMMAND,
        description=(
            "Replay a recorded drive to the mapper: publishes a bag's Range, Odometry, /tf and /tf_static, "
            'with the recorded stamps and in the recorded order, when every topic of Range and Odometry has a '
            'subscriber. Arguments after --ros-args are for ROS.'
        ),
        epilog='example: replay_bag MY_BAG --rate 2 --clock',
    )
    made.add_bag('ROS 2 bag folder, single .mcap or .db3 file, or ROS 1 .bag')
    made.add_argument(
        '--rate', type=_positive, default=1.0, metavar='R', help='speed relative to the recording (default 1)'
    )
    made.add_argument(
        '--loop',
        nargs='?',
        type=_times,
        const=0,
        default=1,
        metavar='N',
        help='play N times; without N, until it is stopped',
    )
    made.add_argument(
        '--clock',
        nargs='?',
        type=_positive,
        const=40.0,
        metavar='HZ',
        help='publish the time of the bag on /clock, also between messages, at HZ of wall time (default 40)',
    )
    add_topic_options(made)
    made.add_argument(
        '--remap', nargs='+', action='extend', default=[], metavar='OLD:=NEW', help='publish topics under other names'
    )
    made.add_argument(
        '--wait',
        type=_number,
        default=30.0,
        metavar='S',
        help='longest wait for subscribers of every topic (default 30); 0 begins at once',
    )
    quality = made.add_mutually_exclusive_group()
    quality.add_argument(
        '--reliable', action='store_true', default=True, help='reliable, for every kind of subscriber (default)'
    )
    quality.add_argument(
        '--best-effort', dest='reliable', action='store_false', help='best effort, like sensor drivers'
    )
    made.add_argument('-q', '--quiet', action='store_true', help='print nothing but errors')
    return made


def replay(options: argparse.Namespace, ros_arguments: Sequence[str]) -> int:
    """Run the command with its options."""
    with StopSignal() as stop, Bag(options.bag) as bag, Ticker(options.quiet) as ticker:
        topics = bag.choose_topics(options.range_topics, options.odom_topic)
        for note in topics.notes():
            _print_warning(note)
        sensors = {**dict.fromkeys(topics.range_topics, RANGE), topics.odom_topic: ODOMETRY}
        clock = {CLOCK: CLOCK_TYPE} if options.clock else {}
        with Publishers(ros_arguments, options.reliable, stop) as publishers:
            fixed: dict[str, list[Any]] = {}
            for topic, message in bag.static_originals():
                fixed.setdefault(topic, []).append(message)
            moving = _moving(bag, options.quiet)
            names = renamed({**sensors, **dict.fromkeys([*fixed, *moving], TF_MESSAGE), **clock}, options.remap)
            for topic in moving:
                publishers.add(names[topic], TF_MESSAGE, depth=TF_DEPTH)
            for topic, transforms in _static(fixed, options.quiet).items():
                publishers.add(names[topic], TF_MESSAGE, latched=True)
                publishers.publish_latched(names[topic], transforms=transforms)
            for topic, msgtype in {names[topic]: kind for topic, kind in {**sensors, **clock}.items()}.items():
                publishers.add(topic, msgtype)
            player = Player(bag, topics, names, publishers, stop, options.clock, ticker.say, moving)
            ticker.say('waiting for subscribers')
            if options.wait:
                publishers.wait_for_subscribers(sorted({names[topic] for topic in sensors}), options.wait)
            begin, passes = time.monotonic(), 0
            while not stop.is_set() and (not options.loop or passes < options.loop):
                passes += 1
                player.play(options.rate, 'replaying' if options.loop == 1 else f'replaying, time {passes}')
            seconds = time.monotonic() - begin
            ticker.say('waiting until subscribers have acknowledged')
            publishers.finish()
    _warn(bag, player)
    if not options.quiet:
        counts = f'{player.played[RANGE]:,} Range and {player.played[ODOMETRY]:,} Odometry messages'
        print(f'{"stopped after" if stop.is_set() else "replayed"} {counts} in {seconds:.1f} s')
    return 0


def _moving(bag: Bag, quiet: bool) -> list[str]:
    """Return the topics of moving transforms; none, with a warning, if such messages cannot be published."""
    topics = sorted(bag.moving_topics())
    try:
        if topics:
            message_class(TF_MESSAGE)
        return topics
    except MapperError as error:
        if not quiet:
            _print_warning(f'{", ".join(topics)} {"is" if len(topics) == 1 else "are"} not replayed ({error})')
        return []


def _static(messages: Mapping[str, Iterable[Any]], quiet: bool) -> dict[str, list[Any]]:
    """Return the transforms of each tf_static topic as ROS messages; if conversion fails, none, with a warning."""
    try:
        if messages:
            message_class(TF_MESSAGE)
        return {topic: static_transforms(found) for topic, found in messages.items()}
    except (MapperError, *MISFITS) as error:
        if not quiet:
            _print_warning(
                f'static transforms are not replayed ({error}); set the poses of the sensors in the parameters of the '
                'mapper: sensors.FRAME.pose: [x, y, yaw]'
            )
        return {}


def _warn(bag: Bag, player: Player) -> None:
    """Print warnings about messages that were not played unchanged."""
    if bag.truncated:
        _print_warning(bag.truncated)
    for topic, count in (player.unusable + Counter(bag.undecodable)).items():
        _print_warning(skipped(count, topic))
    if player.jumps:
        _print_warning(f'the stamps jumped back or had a gap {counted(player.jumps, "time")}, which was skipped')


def _print_warning(text: str) -> None:
    print(f'{COMMAND}: warning: {printable(text)}', file=sys.stderr)


def _positive(text: str) -> float:
    return _number(text, above=True)


def _number(text: str, above: bool = False) -> float:
    try:
        value = float(text)
    except ValueError:
        value = math.nan
    if not 0 <= value < math.inf or (above and not value):
        least = 'above 0' if above else 'of at least 0'
        raise argparse.ArgumentTypeError(f'{text!r} is not a number {least} (the bag goes before the options)')
    return value


def _times(text: str) -> int:
    if not text.isdecimal() or not int(text):
        raise argparse.ArgumentTypeError(f'{text!r} is not a number of times (the bag goes before the options)')
    return int(text)


def split_ros_arguments(arguments: Sequence[str]) -> tuple[list[str], list[str]]:
    """Separate our own arguments from ROS's, which are those from each `--ros-args` to the next `--` or the end."""
    own: list[str] = []
    ros: list[str] = []
    for argument in arguments:
        if argument == '--ros-args' or (ros and ros[-1] != '--'):
            ros.append(argument)
        else:
            own.append(argument)
    return own, ros


def main(arguments: Sequence[str] | None = None) -> int:
    """Run the command; return its exit code."""
    own, ros = split_ros_arguments(sys.argv[1:] if arguments is None else arguments)
    return run(parser(), lambda options: replay(options, ros), own)
