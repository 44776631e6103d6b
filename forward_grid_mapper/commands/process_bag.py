"""`process_bag`: from one recorded drive or several to three maps, a picture and a report."""

from __future__ import annotations

import argparse
import math
import sys
import time
from collections.abc import Mapping, Sequence
from contextlib import suppress
from dataclasses import replace
from functools import partial
from pathlib import Path
from typing import Any

from ..core.common.errors import ParameterError
from ..core.common.parameters import Parameters
from ..core.common.shell import module_line
from ..core.common.words import printable
from ..core.joint_learning import map_and_learn
from ..core.mapping import Mapper
from ..core.maps.map_set import MapSet
from ..core.tiled_mapping import TiledMapper
from ..files.calibration_file import load_calibration
from ..files.map_files import occupancy_values
from ..files.output_folder import free_name, output_folder, readable
from ..files.picture import NOWHERE
from ..files.quality_warning import NOT_CONVERGED
from ..files.report import report_text
from ..files.rerun_recording import RECORDING, check_rerun, write_rerun
from ..files.results import write_results
from ..recordings.drive import jumps_note
from ..recordings.drives import Drives, read_drives
from ..recordings.journal_drive import poses_unused
from ..recordings.refined import GivenCalibration, refine_drives
from .console import Ticker, run
from .desktop import show
from .many_workers import add_worker_options, with_workers
from .options import (
    BagParser,
    add_bag_options,
    add_json_option,
    add_mapping_options,
    add_part_options,
    add_show_option,
    chosen_parameters,
    chosen_part,
    chosen_poses,
    chosen_sensors,
    output_name,
    print_json,
)

SMALLEST_TILE = 1.0
"""Smallest tile, metres: smaller ones consist mostly of their margins."""

COMMAND = 'process_bag'


def parser() -> argparse.ArgumentParser:
    """Return the parser of the command line."""
    made = BagParser(
        COMMAND,
        description='Map recorded drives: reads sonar Range and Odometry from ROS 1 or ROS 2 bags and writes the '
        'standard map, the maximum likelihood map and the uncertainty map. Several drives make one map; their poses '
        'must be in one map frame.',
        epilog='example: process_bag MY_BAG --sensor sonar_left=0.1,0.15,90deg -o maps --show',
    )
    made.add_bags(
        'ROS 2 bag folder, single .mcap or .db3 file, ROS 1 .bag, journal of the node, folder of bags, or a pattern '
        "such as 'monday_*'"
    )
    made.add_argument(
        '-o', '--output', type=output_name, metavar='DIR', help='new folder for the results (default: BAG_maps)'
    )
    add_bag_options(made)
    add_part_options(made)
    made.add_argument(
        '--learn',
        type=int,
        default=0,
        metavar='ROUNDS',
        help='learn p_hit, p_rand, p_lost and sigma in this number of rounds; p_hit is biased upward, check the maps',
    )
    made.add_argument(
        '--refine-poses',
        action='store_true',
        help=(
            'correct the drift of wheel odometry: estimate the trajectory together with the map; odometry is kept if '
            'held-out readings do not support the trajectory'
        ),
    )
    made.add_argument(
        '--odometry-calibration',
        metavar='FILE',
        help='apply a calibration to wheel odometry first: the YAML that --refine-poses wrote for this robot',
    )
    made.add_argument(
        '--tiles',
        type=float,
        metavar='M',
        help='map in tiles with this edge length in metres, one after the other; 20 or more for sonars of 5 m range',
    )
    add_worker_options(made)
    made.add_argument('--bag', dest='write_bag', action='store_true', help='also write the maps as a bag (mcap)')
    made.add_argument('--rerun', action='store_true', help='also write the drive for the viewer Rerun (drive.rrd)')
    made.add_argument('-q', '--quiet', action='store_true', help='print nothing but warnings, errors and the folder')
    add_json_option(made)
    add_show_option(made, 'the report')
    add_mapping_options(made)
    return made


def process(options: argparse.Namespace) -> int:
    """Run the command with its options."""
    parameters, extrinsics, ignored = chosen_parameters(options)
    # those of the node are ignored, so that reports do not have them either
    parameters = replace(parameters, node=Parameters().node)
    extrinsics |= chosen_sensors(options)
    if options.learn < 0:
        raise ParameterError('--learn: the number of rounds must not be negative')
    part, poses = chosen_part(options), chosen_poses(options)
    if options.tiles is not None and not (math.isfinite(options.tiles) and options.tiles >= SMALLEST_TILE):
        raise ParameterError(
            f'--tiles {options.tiles:g}: give the edge length of a tile in metres, {SMALLEST_TILE:g} or more'
        )
    if parameters.association.odometry_noise and not options.refine_poses:
        ignored.append('odometry_noise has an effect only with --refine-poses, which is not given')
    if options.workers is not None or options.scheduler is not None:
        return with_workers(options, parameters, extrinsics, ignored, part, f'{_stem(options.bags)}_maps', tell)
    if options.work is not None or options.memory_per_worker is not None:
        raise ParameterError('--work and --memory-per-worker are for --workers or --scheduler, which are not given')
    if options.rerun:
        check_rerun()
    mapper = Mapper if options.tiles is None else partial(TiledMapper, size=options.tiles)
    given = _given(options.odometry_calibration)
    output = Path(options.output) if options.output else free_name(Path.cwd(), f'{_stem(options.bags)}_maps')
    begin = time.perf_counter()
    # first the folder, so that an error is found before the work
    with Ticker(options.quiet) as ticker, output_folder(output) as folder:
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
        source = drives.source
        source['warnings'] += ignored
        if not (options.refine_poses or given):
            source['warnings'] += poses_unused(source, extrinsics)
        ticker.warn(source['warnings'])
        read = time.perf_counter() - begin
        refined = None
        if options.refine_poses or given:
            refined = refine_drives(drives, parameters, ticker.refining, given, options.refine_poses)
        seconds = {'reading the bag' if len(drives.drives) == 1 else 'reading the bags': read}
        if refined is not None:
            seconds['trajectory'] = time.perf_counter() - begin - read
        if not options.refine_poses:
            for drive in drives.drives:
                name = f'{drive.source["bag"]}: ' if len(drives.drives) > 1 else ''
                source['warnings'] += [name + note for note in jumps_note(drive.associator)]
        along = drives if refined is None else refined
        maps = along.with_live(map_and_learn(along.readings, parameters, options.learn, ticker.mapping, mapper))
        maps.statistics['seconds'] = {**seconds, **maps.statistics['seconds']}
        ticker.say('writing')
        if options.learn:
            source['warnings'].append(_learned(maps))
        if not maps.statistics['converged']:
            source['warnings'].append(NOT_CONVERGED)
        path, title = along.path_xy, _title(drives)
        odometry_xy, texts = (NOWHERE, {}) if refined is None else (refined.odometry_xy, refined.texts)
        report = write_results(folder, maps, source, path, title, extras=texts, odometry_xy=odometry_xy)
        if options.write_bag:
            _write_bag(folder / 'maps.mcap_bag', maps, drives)
        if options.rerun:
            write_rerun(folder / RECORDING, maps, report_text(report), title, path, odometry_xy)
    tell(options, report, output)
    if options.show:
        show(output / 'report.html')
    return 0


def _given(file: str | None) -> GivenCalibration | None:
    """Return the calibration of a file, if given."""
    return None if file is None else GivenCalibration(load_calibration(file), readable(file))


def tell(options: argparse.Namespace, report: Mapping[str, Any], output: Path) -> None:
    """Print the result in the format of the options."""
    if options.json:
        print_json({'folder': readable(output), **report})
        return
    if not options.quiet:
        print(report_text(dict(report)), end='')
    else:
        for warning in report['warnings']:
            print(f'{COMMAND}: warning: {printable(warning)}', file=sys.stderr)
    print(f'maps are in {output}')
    if options.rerun and not options.quiet:
        print(f'play the drive with\n  {module_line("rerun", output / RECORDING)}')


def _stem(words: Sequence[str]) -> str:
    """Return the name of the results of these bags."""
    path = Path(words[0]).resolve()
    path = path.parent if path.name == 'metadata.yaml' else path
    # dots are part of a folder's name
    first = (path.name if path.is_dir() else path.stem).replace('*', '').replace('?', '') or 'bags'
    return first if len(words) == 1 else f'{first}_and_{len(words) - 1}_more'


def _title(drives: Drives) -> str:
    path = Path(drives.drives[0].source['bag'])
    # text for display, with characters that file names of this locale may not have
    with suppress(UnicodeEncodeError):
        path = path.resolve()
    first = readable(Path(*path.parts[-2:]))
    return first if len(drives.drives) == 1 else f'{first} and {len(drives.drives) - 1} more'


def _learned(maps: MapSet) -> str:
    m = maps.parameters.model
    return (
        f'learned p_hit {m.p_hit:.3f}, p_rand {m.p_rand:.3f}, p_lost {m.p_lost:.3f}, sigma {m.sigma:.3f} m together '
        'with the map: p_hit is biased upward, and smooth walls may be lost; compare with a run without --learn; the '
        'command learn also gives standard errors, and stops before walls are lost'
    )


def _write_bag(path: Path, maps: MapSet, drives: Drives) -> None:
    from ..bags.writer import BagWriter

    stamp = drives.source['stamps'][1]
    # ROS 1 frames may begin with a slash, which tf2 refuses
    frame = drives.map_frame.lstrip('/')
    with BagWriter(path, 'mcap') as writer:
        for name, values in (('live_map', maps.live), ('ml_map', maps.ml), ('uncertainty_map', maps.uncertainty)):
            topic = f'/forward_grid_mapper/{name}'
            # log times are not negative
            writer.write_grid(topic, maps.grid, occupancy_values(values), frame, stamp, max(stamp, 0))


def main(arguments: Sequence[str] | None = None) -> int:
    """Run the command; return its exit code."""
    return run(parser(), process, arguments)
