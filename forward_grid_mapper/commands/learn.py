"""`learn`: p_hit, p_rand, p_lost and σ from a recorded drive, with standard errors and warnings."""

from __future__ import annotations

import argparse
import dataclasses
import math
import os
import sys
from collections.abc import Sequence
from pathlib import Path

from ..core.common.errors import OutputError, ParameterError
from ..core.common.shell import command_line
from ..core.common.words import printable
from ..core.cross_validation import only_if_validated
from ..core.joint_learning import learn_jointly
from ..core.learning.sensor_health import health_warning, sensor_health
from ..files.learned_text import learned_data, learned_text, parameter_file_text, write_new_file
from ..files.output_folder import readable, unwritable
from ..files.parameter_file import load_parameters
from ..files.quality_warning import reading_warnings
from ..recordings.drives import read_drives
from ..recordings.journal_drive import poses_unused
from .console import Ticker, run
from .options import (
    BagParser,
    add_bag_options,
    add_json_option,
    add_mapping_options,
    add_part_options,
    chosen_parameters,
    chosen_part,
    chosen_poses,
    chosen_sensors,
    output_name,
    print_json,
)

COMMAND = 'learn'

NOT_JUDGED = (
    'no readings were held out to test the learned values (--keep-going): compare the maps with and without them'
)


def parser() -> argparse.ArgumentParser:
    """Return the parser of the command line."""
    made = BagParser(
        COMMAND,
        description=(
            'Learn p_hit, p_rand, p_lost and sigma from recorded drives, in alternation with the map: prints each '
            'value with its standard error, and warns of values that lose smooth walls or depend on few readings. '
            'Look at the maps of process_bag before you use the values on a robot.'
        ),
        epilog='example: learn MY_BAG -o learned.yaml',
    )
    made.add_bags('one or more: ROS 2 bag folder, single .mcap or .db3 file, ROS 1 .bag, journal, or folder of bags')
    made.add_argument(
        '-o',
        '--output',
        type=output_name,
        metavar='FILE',
        help='new parameter YAML, for process_bag --params and for the node',
    )
    add_bag_options(made)
    add_part_options(made)
    made.add_argument(
        '--rounds',
        type=int,
        default=5,
        metavar='N',
        help='largest number of rounds, each a map and an update of the values (default 5)',
    )
    made.add_argument(
        '--keep-going',
        action='store_true',
        help='write the values even if their map has lost walls, and without a test on held-out readings',
    )
    made.add_argument('-q', '--quiet', action='store_true', help='print nothing but warnings and errors')
    add_json_option(made)
    add_mapping_options(made)
    return made


def learn(options: argparse.Namespace) -> int:
    """Run the command with its options."""
    parameters, extrinsics, ignored = chosen_parameters(options)
    extrinsics |= chosen_sensors(options)
    if options.rounds < 1:
        raise ParameterError('--rounds must be a positive number')
    output = Path(options.output) if options.output else None
    if output is not None:
        # before the work
        if os.path.lexists(output):
            raise OutputError(f'{output} exists; choose another file with --output, or remove it first')
        if not output.parent.is_dir():
            raise OutputError(f'{output.parent} is not a folder; make it first, or choose another with --output')
        if why := unwritable(output.parent):
            raise OutputError(f'{output}: {why}; choose another folder with --output')
        # permissions do not show every reason, such as a read-only file system
        write_new_file(output, '')
        output.unlink()
    part, poses = chosen_part(options), chosen_poses(options)
    with Ticker(options.quiet) as ticker:
        drives = read_drives(
            options.bags,
            parameters,
            extrinsics,
            options.range_topics,
            options.odom_topic,
            part,
            ticker.reading,
            ticker.say,
            poses,
        )
        found = learn_jointly(drives.readings, parameters, options.rounds, options.keep_going, ticker.mapping)
        if not options.keep_going:
            found = only_if_validated(found, drives.readings, parameters, options.rounds, ticker.mapping)
        suspects = health_warning(sensor_health(found.maps))
    warnings = (
        *drives.source['warnings'],
        *poses_unused(drives.source, extrinsics),
        *ignored,
        *reading_warnings(found.maps.readings, drives.source, parameters),
        *found.warnings,
        *([NOT_JUDGED] if options.keep_going and found.accepted else []),
        *filter(None, [suspects]),
    )
    found = dataclasses.replace(found, warnings=warnings)
    if options.json:
        print_json({'file': output and readable(output), **learned_data(found)})
    elif options.quiet:
        for warning in warnings:
            print(f'{COMMAND}: warning: {printable(warning)}', file=sys.stderr)
    else:
        print(learned_text(found), end='')
    if output is not None:
        ros = load_parameters(options.params).node if options.params else {}
        bags = ', '.join(readable(Path(word)) for word in options.bags)
        write_new_file(output, parameter_file_text(found, extrinsics, ros, bags))
        if not options.quiet and not options.json:
            if found.accepted:
                print(f'\nthe parameters are in {output}; compare the maps with and without them:')
                print(f'  {_mapping(options, output)}')
            else:
                print(f'\nthe parameters are in {output}: nothing was learned, so they are the initial values')
    return 0


def _mapping(options: argparse.Namespace, parameters: Path) -> str:
    """Return the command that maps the same readings with the learned parameters."""
    words: list[Path | str] = [*map(Path, options.bags), '--params', parameters]
    if options.start:
        words += ['--start', f'{options.start!r}']
    if math.isfinite(options.duration):
        words += ['--duration', f'{options.duration!r}']
    if options.poses:
        words += ['--poses', Path(options.poses)]
    if options.odom_topic:
        words += ['--odom-topic', options.odom_topic]
    if options.range_topics:
        words += ['--range-topics', *options.range_topics]
    return command_line('process_bag', *words)


def main(arguments: Sequence[str] | None = None) -> int:
    """Run the command; return its exit code."""
    return run(parser(), learn, arguments)
