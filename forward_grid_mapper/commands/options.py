"""Options that choose parameters, the same for every command that maps."""

from __future__ import annotations

import argparse

from ..core.common.errors import ParameterError
from ..core.common.parameters import DEPRECATED, Parameters, find
from ..core.messages.message_types import Pose2
from ..files.parameter_file import load_parameters, parse_setting
from ..files.parameter_text import dump_parameters


def add_bag_options(parser: argparse.ArgumentParser) -> None:
    """Add `--range-topics`, `--odom-topic` and `--sensor`."""
    parser.add_argument('--range-topics', nargs='+', metavar='TOPIC', help='Range topics (default: all in the bag)')
    parser.add_argument('--odom-topic', metavar='TOPIC', help='Odometry topic (needed if the bag has several)')
    parser.add_argument(
        '--sensor',
        action='append',
        default=[],
        metavar='FRAME=X,Y,YAW',
        help='pose of a sensor on the robot in metres and radians (or 90deg); wins over /tf_static; may be repeated',
    )


def add_mapping_options(parser: argparse.ArgumentParser) -> None:
    """Add `--params`, `--set` and `--list-parameters`."""
    group = parser.add_argument_group('parameters')
    group.add_argument('--params', metavar='FILE', help='parameter YAML, the same file that the node takes')
    group.add_argument(
        '--set',
        action='append',
        default=[],
        metavar='NAME=VALUE',
        help='set one parameter, after --params; may be repeated (--list-parameters shows all)',
    )
    group.add_argument('--list-parameters', action=ListParameters, help='show every parameter as YAML and exit')


class ListParameters(argparse.Action):
    """Prints the parameter table with defaults, units and ranges."""

    def __init__(self, option_strings: list[str], dest: str, help: str | None = None) -> None:
        super().__init__(option_strings, dest, nargs=0, default=argparse.SUPPRESS, help=help)

    def __call__(self, parser: argparse.ArgumentParser, *unused: object) -> None:
        """Print and exit."""
        print(dump_parameters(Parameters()), end='')
        parser.exit()


def chosen_parameters(options: argparse.Namespace) -> tuple[Parameters, dict[str, Pose2]]:
    """Return the parameters and the sensor poses of `--params` and `--set`.

    Raises
    ------
    ParameterError
        If the file or a setting is wrong.
    """
    values, extrinsics, _ = load_parameters(options.params) if options.params else ({}, {}, {})
    settings = dict(parse_setting(text) for text in options.set)
    for name in settings:
        if name not in DEPRECATED and find(name).group == 'node':
            raise ParameterError(f'--set {name}: only the node has this parameter; topics have options of their own')
    return Parameters.from_flat({**values, **settings}), dict(extrinsics)
