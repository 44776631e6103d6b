"""Options that choose parameters, the same for every command that maps."""

from __future__ import annotations

import argparse
import codecs
import difflib
import math
import os
import sys
from collections.abc import Mapping, Sequence
from typing import Any, NamedTuple, NoReturn

from ..core.common.errors import OutputError, ParameterError
from ..core.common.former_parameters import DEPRECATED
from ..core.common.parameters import Parameters, find
from ..core.common.shell import quoted
from ..core.messages.message_types import Pose2
from ..files.output_folder import expanded, readable
from ..files.parameter_file import load_parameters, parse_sensor, parse_setting
from ..files.parameter_text import dump_parameters
from ..files.report import json_text
from ..recordings.drive import Part
from ..recordings.given_poses import GivenPoses, read_given_poses


def output_name(text: str) -> str:
    """Return the name of an output, for argparse.

    An empty name may be that of an unset shell variable; bash does not expand the `~` of `--output=~/maps`.
    """
    if not text.strip():
        raise argparse.ArgumentTypeError('the name is empty')
    try:
        return str(expanded(text)) if text.startswith('~') else text
    except OutputError as error:
        raise argparse.ArgumentTypeError(str(error)) from None


def add_json_option(parser: argparse.ArgumentParser) -> None:
    """Add `--json`."""
    parser.add_argument(
        '--json', action='store_true', help='print the result as JSON, and nothing else on standard output'
    )


def print_json(data: Mapping[str, Any]) -> None:
    """Print the result as JSON: in UTF-8, or escaped to ASCII if the output has another encoding."""
    encoding = getattr(sys.stdout, 'encoding', None) or 'ascii'
    print(json_text(data, ascii=codecs.lookup(encoding).name != 'utf-8'), end='')


def add_show_option(parser: argparse.ArgumentParser, what: str) -> None:
    """Add `--show`, which opens `what`."""
    parser.add_argument('--show', action='store_true', help=f"open {what} with the desktop's viewer")


class BagParser(argparse.ArgumentParser):
    """A parser for commands that read a bag, which may also be behind an option with several words.

    `--range-topics A BAG` would leave no word for the bag: then the last word of such an option is the bag.
    """

    _several: tuple[str, ...] = ('range_topics', 'remap')
    _takes_bags = False

    def add_bag(self, help: str) -> None:
        """Add the argument `bag`."""
        # required nevertheless, see below
        self.add_argument('bag', help=help).required = False

    def add_bags(self, help: str) -> None:
        """Add the argument `bags`, at least one; they may be on both sides of options."""
        self.add_argument('bags', nargs='*', metavar='bag', help=help)
        self.usage = f'{self.prog} bag [bag ...] [options]'
        self._takes_bags = True

    def parse_args(  # type: ignore[override]
        self, args: Sequence[str] | None = None, namespace: argparse.Namespace | None = None
    ) -> argparse.Namespace:
        """Return the options; exit with a usage message if they are wrong."""
        options: argparse.Namespace
        if self._takes_bags:
            options = super().parse_intermixed_args(args, namespace)
        else:
            options = super().parse_args(args, namespace)
        found = (
            [] if getattr(options, 'bags', None) or getattr(options, 'bag', None) else self._bags_in_options(options)
        )
        if found and self._takes_bags:
            options.bags = found
        elif found:
            options.bag = found[-1]
        # parameters are printed without a bag
        shown = getattr(options, 'dump_config', False)
        if not shown and not (options.bags if self._takes_bags else options.bag):
            taken = next((name for name in self._several if getattr(options, name, None)), None)
            hint = ''
            if taken is not None:
                option, words = f'--{taken.replace("_", "-")}', ' '.join(map(quoted, getattr(options, taken)))
                hint = f'; {option} took all of: {words}. Give the bag first: {self.prog} BAG {option} {words}'
            self.error(f'no bag is given, or it does not exist; a bag is a folder, or a .mcap, .db3 or .bag file{hint}')
        if getattr(options, 'range_topics', None) is not None:
            # names of topics have no commas
            options.range_topics = [t for word in options.range_topics for t in word.split(',') if t.strip()]
            if not options.range_topics:
                self.error('argument --range-topics: the name of a topic is expected, not an empty one')
        return options

    def error(self, message: str) -> NoReturn:
        """Exit with a usage message; it names the option that an unknown one is like, such as --refine_poses."""
        unknown = next((word for word in message.split() if word.startswith('--')), '').partition('=')[0]
        if message.startswith('unrecognized arguments') and unknown:
            near = difflib.get_close_matches(unknown, self._option_string_actions, n=1)
            message += f'; did you mean {near[0]}?' if near else ''
        super().error(message)

    def _bags_in_options(self, options: argparse.Namespace) -> list[str]:
        """Return the last words of an option with several words that can only be bags; one if only one is allowed."""
        for name in self._several:
            words: list[str] | None = getattr(options, name, None)
            found: list[str] = []
            # a word that is the path of a file, and not a rule of remapping, can only be a bag
            while words and ':=' not in words[-1] and os.path.lexists(words[-1]):
                found.insert(0, words.pop())
                if not self._takes_bags:
                    break
            if found and not words:
                self.error(f'argument --{name.replace("_", "-")}: expected one word or more before the bag')
            if found:
                return found
        return []


def add_topic_options(
    parser: argparse.ArgumentParser, odometry: str = 'Odometry topic (needed if the bag has several)'
) -> None:
    """Add `--range-topics` and `--odom-topic`, with this help."""
    parser.add_argument(
        '--range-topics',
        nargs='+',
        action='extend',
        metavar='TOPIC',
        help='Range topics, separated by spaces or commas; may be repeated (default: all in the bag)',
    )
    parser.add_argument('--odom-topic', metavar='TOPIC', help=odometry)


def add_bag_options(parser: argparse.ArgumentParser) -> None:
    """Add `--range-topics`, `--odom-topic` and `--sensor`."""
    add_topic_options(
        parser,
        'topic with the poses of the robot: Odometry, PoseStamped, PoseWithCovarianceStamped, or /tf for those of '
        'base_link (needed if the bag has several)',
    )
    parser.add_argument(
        '--poses',
        metavar='FILE',
        help="take the robot's poses from a TUM or CSV file instead of the odometry in the bag; stamps in seconds",
    )
    parser.add_argument(
        '--sensor',
        action='append',
        default=[],
        metavar='FRAME=X,Y,YAW',
        help='pose of a sensor on the robot in metres and radians (or 90deg); overrides /tf_static; may be repeated',
    )


def chosen_sensors(options: argparse.Namespace) -> dict[str, Pose2]:
    """Return the poses of `--sensor`, by frame.

    Raises
    ------
    ParameterError
        If one is wrong, or a sensor has two different poses.
    """
    found: dict[str, Pose2] = {}
    for text in options.sensor:
        frame, pose = parse_sensor(text)
        if found.setdefault(frame.lstrip('/'), pose) != pose:
            raise ParameterError(f'--sensor gives two poses of {frame}; give one of them')
    return found


def chosen_poses(options: argparse.Namespace) -> GivenPoses | None:
    """Return the poses of `--poses`, if given.

    Raises
    ------
    ParameterError
        If an odometry topic is given as well.
    InputError
        If the file cannot be read.
    """
    if options.poses is None:
        return None
    if options.odom_topic:
        raise ParameterError('--poses replaces odometry; leave out --odom-topic')
    return read_given_poses(options.poses)


def add_part_options(parser: argparse.ArgumentParser) -> None:
    """Add `--start` and `--duration`."""
    parser.add_argument(
        '--start',
        type=float,
        default=0.0,
        metavar='S',
        help='start of the mapped part, in seconds after the first message of each drive (default 0)',
    )
    parser.add_argument(
        '--duration',
        type=float,
        default=math.inf,
        metavar='S',
        help='length of the mapped part of each drive, in seconds (default: all)',
    )


def chosen_part(options: argparse.Namespace) -> Part:
    """Return the part of the drives that `--start` and `--duration` select.

    Raises
    ------
    ParameterError
        If one of them is not a possible number of seconds.
    """
    if not (math.isfinite(options.start) and options.start >= 0):
        raise ParameterError(f'--start {options.start:g}: give seconds from the beginning, 0 or more')
    if not options.duration > 0:
        raise ParameterError(f'--duration {options.duration:g}: give seconds above 0')
    return Part(options.start, options.duration)


def add_mapping_options(parser: argparse.ArgumentParser) -> None:
    """Add `--params`, `--set`, `--dump-config` and `--list-parameters`."""
    group = parser.add_argument_group('parameters')
    group.add_argument('--params', metavar='FILE', help='parameter YAML, the same file as for the node')
    group.add_argument(
        '--set',
        action='append',
        default=[],
        metavar='NAME=VALUE',
        help='set one parameter, after --params; may be repeated (--list-parameters shows all); angles in radians, or '
        'as 40deg',
    )
    group.add_argument('--dump-config', action='store_true', help='print the parameters of this call as YAML, and exit')
    group.add_argument(
        '--list-parameters', action=ListParameters, help='print all parameters with their defaults as YAML, and exit'
    )


class ListParameters(argparse.Action):
    """Prints the parameter table with defaults, units and ranges."""

    def __init__(self, option_strings: list[str], dest: str, help: str | None = None) -> None:
        super().__init__(option_strings, dest, nargs=0, default=argparse.SUPPRESS, help=help)

    def __call__(self, parser: argparse.ArgumentParser, *unused: object) -> None:
        """Print and exit."""
        print(dump_parameters(Parameters()), end='')
        parser.exit()


class Chosen(NamedTuple):
    """Parameters and sensor poses of `--params` and `--set`, and warnings."""

    parameters: Parameters
    extrinsics: dict[str, Pose2]
    warnings: list[str]


INSTEAD = {
    'range_topics': 'give --range-topics',
    'odom_topic': 'give --odom-topic',
    'map_frame': "the maps are in odometry's frame",
    'refine_poses': 'give --refine-poses',
    'save_directory': 'give --output',
}
"""Offline replacements of parameters of the node."""

OTHER_MAPS = INSTEAD.keys() - {'save_directory'}
"""Those of them that change the maps; the node's other parameters are meant for the node alone."""


def chosen_parameters(options: argparse.Namespace) -> Chosen:
    """Return the parameters and the sensor poses of `--params` and `--set`.

    With `--dump-config`, print the parameters and exit.

    Raises
    ------
    ParameterError
        If the file or a setting is wrong.
    """
    values, extrinsics, _ = load_parameters(options.params) if options.params else ({}, {}, {})
    settings = dict(parse_setting(text) for text in options.set)
    for name in settings:
        if name not in DEPRECATED and find(name).group == 'node':
            instead = f'; {INSTEAD[name]}' if name in INSTEAD else ''
            raise ParameterError(f'--set {name}: this parameter is only for the node{instead}')
    warnings = [text] if (text := _ignored(values, options)) else []
    parameters = Parameters.from_flat({**values, **settings})
    if options.dump_config:
        print(dump_parameters(parameters), end='')
        raise SystemExit(0)
    return Chosen(parameters, dict(extrinsics), warnings)


def _ignored(values: Mapping[str, Any], options: argparse.Namespace) -> str:
    """Return a warning about parameters of a file by which the maps of the node would be others; otherwise ''."""
    names = [
        name
        for name in sorted(OTHER_MAPS & values.keys())
        if values[name] != find(name).default and not getattr(options, name, None)
    ]
    if not names:
        return ''
    listed = [f'{name} ({INSTEAD[name]})' for name in names]
    return f'{readable(options.params)}: these parameters are only for the node and are ignored: {", ".join(listed)}'
