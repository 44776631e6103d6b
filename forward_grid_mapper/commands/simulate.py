"""`simulate`: record a drive through a small world whose map is known."""

from __future__ import annotations

import argparse
from collections.abc import Callable, Sequence
from pathlib import Path

import numpy as np

from ..bags.writer import BagWriter, check_bag_path
from ..core.common.errors import ParameterError
from ..core.common.shell import command_line
from ..core.messages.message_types import OdometryMessage, RangeMessage
from ..core.trajectory.windows import Odometry
from ..files.map_files import write_trinary
from ..files.output_folder import output_errors, output_folder
from ..files.trajectory_text import tum_text
from ..simulation.drift import LEVELS, with_drift
from ..simulation.drive import BASE_FRAME, START, Recording, corridor_drive, door_drive
from ..simulation.sonar import NOISE_FREE, NOISY, SonarArray, front_array, sonar_ring
from .console import Ticker, run

COMMAND = 'simulate'
REFERENCE = 'reference.tum'
FORMATS = {'mcap': 'bag', 'sqlite3': 'bag', 'ros1': 'drive.bag'}
SONARS: dict[str, Callable[[], SonarArray]] = {'ring': sonar_ring, 'front': front_array}


def parser() -> argparse.ArgumentParser:
    """Return the parser of the command line."""
    made = argparse.ArgumentParser(
        COMMAND,
        description='Record a simulated drive: a bag of sonar Range and Odometry, the true map (reference.yaml) and '
        "the robot's path (trajectory.csv).",
        epilog='example: simulate corridor --passes 3 --drift wheels -o drifting',
    )
    made.add_argument(
        'world',
        choices=('door', 'corridor'),
        help="door: a robot passes an open door (the paper's Fig. 4); corridor: 64 m with six doors, a smooth wall "
        'and a person walking behind the robot (Fig. 6)',
    )
    made.add_argument('-o', '--output', required=True, metavar='DIR', help='new folder for the recording')
    made.add_argument('--seen', type=int, default=3, metavar='N', help='door: sweeps taken in front of it (default 3)')
    made.add_argument('--passes', type=int, default=1, metavar='N', help='corridor: times along it (default 1)')
    made.add_argument('--noise-free', action='store_true', help='no random readings, no noise, nobody walking')
    made.add_argument(
        '--drift',
        choices=tuple(LEVELS),
        help='let odometry drift: low, middle, high, or as wheels of old robots do (default: it is exact)',
    )
    made.add_argument('--sonars', choices=sorted(SONARS), default='ring', help='ring of 24 or front array of 8')
    made.add_argument(
        '--topics', choices=('one', 'each'), default='one', help='all sonars on /sonar, or one topic each'
    )
    made.add_argument('--format', choices=sorted(FORMATS), default='mcap', help='bag format (default mcap)')
    made.add_argument('--seed', type=int, default=0, help='of the noise (default 0)')
    made.add_argument('-q', '--quiet', action='store_true', help='print nothing but errors')
    return made


def check_numbers(seen: int, passes: int, seed: int) -> None:
    """Check the numbers that `record` takes.

    Raises
    ------
    ParameterError
        If a number is not positive, or the seed is negative.
    """
    for name, value in (('--seen', seen), ('--passes', passes), ('--seed', seed + 1)):
        if value < 1:
            raise ParameterError(f'{name} must be a positive number (for --seed, or 0)')


def record(world: str, seen: int, passes: int, noise_free: bool, seed: int, sonars: SonarArray) -> Recording:
    """Simulate the drive that the options ask for.

    Raises
    ------
    ParameterError
        If a number is not positive, or the seed is negative.
    """
    check_numbers(seen, passes, seed)
    noise = NOISE_FREE if noise_free else NOISY
    if world == 'door':
        return door_drive(seen, noise, seed, sonars)
    return corridor_drive(seed, passes, noise, not noise_free, sonars)


def write_recording(folder: Path, recording: Recording, format: str = 'mcap', each: bool = False) -> Path:
    """Write bag, true map and path into an existing folder; return the bag's path.

    Messages are logged by stamp, as a robot would; a Range follows the odometry of its stamp.
    """
    path = folder / FORMATS[format]
    with BagWriter(path, format) as writer:
        writer.write_static_transforms([(BASE_FRAME, frame, pose) for frame, pose in recording.extrinsics], START)
        # both lists are in order of time, and the sort is stable
        messages: list[OdometryMessage | RangeMessage] = [*recording.odometry, *recording.ranges]
        for message in sorted(messages, key=lambda message: message.stamp):
            if isinstance(message, OdometryMessage):
                writer.write_odometry('/odom', message)
            else:
                writer.write_range(f'/{message.frame_id}' if each else '/sonar', message)
    world = recording.world
    write_trinary(folder / 'reference', world.grid, world.reference)
    with output_errors(folder):
        np.savetxt(folder / 'trajectory.csv', recording.robot[:, :2], fmt='%.4f', delimiter=',')
    return path


def write_reference(folder: Path, recording: Recording) -> None:
    """Write the true pose at each odometry message into an existing folder; `recording` is the one without drift."""
    messages = recording.odometry
    poses = np.array([message.pose for message in messages], np.float64)
    true = Odometry.of(np.array([message.stamp for message in messages], np.int64), poses)
    with output_errors(folder):
        (folder / REFERENCE).write_text(tum_text(true), encoding='utf-8')


def simulate(options: argparse.Namespace) -> int:
    """Do what the command line asks for."""
    with Ticker(options.quiet) as ticker:
        check_numbers(options.seen, options.passes, options.seed)
        # the folder first: if it cannot be written, that should be known before the work
        with output_folder(options.output) as folder:
            check_bag_path(folder / FORMATS[options.format], options.format)
            ticker.say('simulating')
            recording = record(
                options.world,
                options.seen,
                options.passes,
                options.noise_free,
                options.seed,
                SONARS[options.sonars](),
            )
            true = recording
            if options.drift:
                recording = with_drift(recording, LEVELS[options.drift], options.seed)
            ticker.say('writing')
            bag = write_recording(folder, recording, options.format, options.topics == 'each').name
            if options.drift:
                write_reference(folder, true)
    if not options.quiet:
        print(f'{len(recording.ranges):,} readings and {len(recording.odometry):,} odometry messages')
        files = 'bag, reference.yaml, trajectory.csv and' if options.drift else 'bag, reference.yaml and'
        files += f' {REFERENCE}, the true trajectory for evo,' if options.drift else ' trajectory.csv'
        print(f'{files} are in {options.output}; map it with')
        refine = ['--refine-poses'] if options.drift else []
        print(f'  {command_line("process_bag", Path(options.output) / bag, *refine)}')
    return 0


def main(arguments: Sequence[str] | None = None) -> int:
    """Run the command; return its exit code."""
    return run(parser(), simulate, arguments)
