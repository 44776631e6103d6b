"""`simulate`: record a drive through a small world whose map is known."""

from __future__ import annotations

import argparse
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from concurrent.futures import ProcessPoolExecutor, as_completed
from concurrent.futures.process import BrokenProcessPool
from contextlib import contextmanager
from dataclasses import dataclass
from multiprocessing import active_children, get_context
from pathlib import Path
from typing import TypeVar

import numpy as np

from ..bags.writer import BagWriter, check_bag_path
from ..core.common.errors import ClusterError, MapperError, ParameterError
from ..core.common.shell import command_line
from ..core.common.words import counted
from ..core.messages.message_types import OdometryMessage, RangeMessage
from ..core.runtime.threads import cores
from ..core.trajectory.windows import Odometry
from ..files.map_files import write_trinary
from ..files.output_folder import output_errors, output_folder
from ..files.trajectory_text import tum_text
from ..scale.starting import signals_later
from ..simulation.campus import campus_drive, campus_world
from ..simulation.drift import LEVELS, with_drift
from ..simulation.drive import BASE_FRAME, Recording, corridor_drive, door_drive
from ..simulation.sonar import NOISE_FREE, NOISY, SonarArray, front_array, sonar_ring
from .console import Ticker, run
from .options import output_name

COMMAND = 'simulate'
REFERENCE = 'reference.tum'

T = TypeVar('T')

WORLD_OPTIONS = {
    'door': {'seen': 3},
    'corridor': {'passes': 1},
    'campus': {'drives': 4, 'buildings': 4, 'readings': 40_000, 'jobs': cores()},
}
"""Options of single worlds, and their defaults."""

LARGEST_OPTION = 10_000_000
"""The largest value of these options; more would need too much memory and time."""

FORMATS = {'mcap': 'bag', 'sqlite3': 'bag', 'ros1': 'drive.bag'}
SONARS: dict[str, Callable[[], SonarArray]] = {'ring': sonar_ring, 'front': front_array}


def parser() -> argparse.ArgumentParser:
    """Return the parser of the command line."""
    made = argparse.ArgumentParser(
        COMMAND,
        description='Record a simulated drive: a bag of sonar Range and Odometry, the true map (reference.yaml) and '
        "the robot's path (trajectory.csv).",
        epilog='example: simulate corridor --drift wheels -o drifting',
    )
    made.add_argument(
        'world',
        choices=('door', 'corridor', 'campus'),
        help="door: a robot passes an open door (the paper's Fig. 4); corridor: 64 m with six doors, a smooth wall "
        'and a person walking behind the robot (Fig. 6); campus: many drives through many buildings',
    )
    made.add_argument(
        '-o', '--output', type=output_name, required=True, metavar='DIR', help='new folder for the recording'
    )
    made.add_argument('--seen', type=int, metavar='N', help='door: sweeps taken in front of it (default 3)')
    made.add_argument('--passes', type=int, metavar='N', help='corridor: number of passes (default 1)')
    made.add_argument('--drives', type=int, metavar='N', help='campus: drives (default 4)')
    made.add_argument('--buildings', type=int, metavar='N', help='campus: buildings (default 4)')
    made.add_argument('--readings', type=int, metavar='N', help='campus: readings of each drive (default 40000)')
    made.add_argument(
        '--jobs', type=int, metavar='N', help='campus: drives simulated in parallel (default: one for each core)'
    )
    made.add_argument('--noise-free', action='store_true', help='no random readings, no noise, no person')
    made.add_argument(
        '--drift',
        choices=tuple(LEVELS),
        help='drift of odometry: low, middle, high, like old wheels, or mostly in turns (default: none)',
    )
    made.add_argument(
        '--sonars', choices=sorted(SONARS), default='ring', help='ring of 24 (default) or front array of 8'
    )
    made.add_argument(
        '--topics', choices=('one', 'each'), default='one', help='all sonars on /sonar (default), or one topic each'
    )
    made.add_argument('--format', choices=sorted(FORMATS), default='mcap', help='bag format (default mcap)')
    made.add_argument('--seed', type=int, default=0, help='seed of the noise (default 0)')
    made.add_argument('-q', '--quiet', action='store_true', help='print nothing but errors')
    return made


def fill_in(options: argparse.Namespace, known: Mapping[str, Mapping[str, int]]) -> None:
    """Set defaults of options of single worlds; `known` is a table such as `WORLD_OPTIONS`.

    Raises
    ------
    ParameterError
        If an option of another world is given, or a number is not positive or too large.
    """
    for world, defaults in known.items():
        for name, default in defaults.items():
            given = getattr(options, name)
            if given is not None and world != options.world:
                raise ParameterError(f'--{name} is an option of the world {world}, and the world is {options.world}')
            if given is not None and given < 1:
                raise ParameterError(f'--{name} must be a positive number')
            if given is not None and given > LARGEST_OPTION:
                raise ParameterError(f'--{name} must be at most {LARGEST_OPTION}')
            setattr(options, name, default if given is None else given)
    if options.seed < 0:
        raise ParameterError('--seed must be a positive number or 0')


def record(world: str, seen: int, passes: int, noise_free: bool, seed: int, sonars: SonarArray) -> Recording:
    """Simulate the drive of the options.

    Raises
    ------
    MapperError
        If there is not enough memory; names the option to lower.
    """
    noise = NOISE_FREE if noise_free else NOISY
    try:
        if world == 'door':
            return door_drive(seen, noise, seed, sonars)
        return corridor_drive(seed, passes, noise, not noise_free, sonars)
    except MemoryError as error:
        option = '--seen' if world == 'door' else '--passes'
        raise MapperError(f'there is not enough memory for a drive of this length; lower {option}') from error


def write_bag(path: Path, recording: Recording, format: str, each: bool) -> None:
    """Write the bag of a recording, with log times equal to stamps.

    A Range follows the odometry with its stamp; with `each`, every sonar has its own topic.
    """
    with BagWriter(path, format) as writer:
        first = recording.odometry[0].stamp
        writer.write_static_transforms([(BASE_FRAME, frame, pose) for frame, pose in recording.extrinsics], first)
        # both lists are in order of time, and the sort is stable
        messages: list[OdometryMessage | RangeMessage] = [*recording.odometry, *recording.ranges]
        for message in sorted(messages, key=lambda message: message.stamp):
            if isinstance(message, OdometryMessage):
                writer.write_odometry('/odom', message)
            else:
                writer.write_range(f'/{message.frame_id}' if each else '/sonar', message)


def write_path(path: Path, recording: Recording) -> None:
    """Write the path of the robot: x, y in metres, a row for each sweep."""
    with output_errors(path):
        np.savetxt(path, recording.robot[:, :2], fmt='%.4f', delimiter=',')


def write_recording(folder: Path, recording: Recording, format: str = 'mcap', each: bool = False) -> Path:
    """Write bag, true map and path into an existing folder; return the bag's path."""
    path = folder / FORMATS[format]
    write_bag(path, recording, format, each)
    write_trinary(folder / 'reference', recording.world.grid, recording.world.reference)
    write_path(folder / 'trajectory.csv', recording)
    return path


def write_reference(folder: Path, recording: Recording) -> None:
    """Write the true pose at each odometry message into an existing folder; `recording` is the one without drift."""
    messages = recording.odometry
    poses = np.array([message.pose for message in messages], np.float64)
    true = Odometry.of(np.array([message.stamp for message in messages], np.int64), poses)
    with output_errors(folder):
        (folder / REFERENCE).write_text(tum_text(true), encoding='utf-8')


@dataclass(frozen=True)
class Campus:
    """Common data of the drives through a campus; the fields are options of the command."""

    folder: Path
    buildings: int
    readings: int
    noise_free: bool
    seed: int
    sonars: str
    format: str
    each: bool

    def write(self, number: int) -> tuple[int, int]:
        """Simulate and write one drive; return the numbers of its readings and odometry messages."""
        noise = NOISE_FREE if self.noise_free else NOISY
        made = campus_drive(number, self.buildings, self.readings, noise, self.seed, SONARS[self.sonars]())
        name = f'drive_{number:04d}'
        write_bag(
            self.folder / 'drives' / (f'{name}.bag' if self.format == 'ros1' else name), made, self.format, self.each
        )
        write_path(self.folder / 'trajectories' / f'{name}.csv', made)
        return len(made.ranges), len(made.odometry)


def simulate_campus(options: argparse.Namespace, ticker: Ticker) -> None:
    """Simulate many drives, several in parallel, and write the true map that they share."""
    if options.drift:
        raise ParameterError('campus: drives that drift are not in one map frame; leave out --drift')
    with _enough_memory(), output_folder(options.output) as folder:
        for name in ('drives', 'trajectories'):
            with output_errors(folder):
                (folder / name).mkdir()
        world = campus_world(options.buildings)
        write_trinary(folder / 'reference', world.grid, world.reference)
        each = options.topics == 'each'
        campus = Campus(
            folder,
            options.buildings,
            options.readings,
            options.noise_free,
            options.seed,
            options.sonars,
            options.format,
            each,
        )
        done = []
        for counts in at_once(campus.write, range(options.drives), options.jobs):
            done.append(counts)
            ticker.say(f'simulating: {len(done)} of {options.drives} drives')
    if not options.quiet:
        readings, odometry = (sum(column) for column in zip(*done, strict=True))
        print(f'{counted(options.drives, "drive")}: {readings:,} readings and {odometry:,} odometry messages')
        print(f'drives, trajectories and reference.yaml are in {options.output}; map them with')
        print(f'  {command_line("process_bag", Path(options.output) / "drives", "--tiles", "30")}')


@contextmanager
def _enough_memory() -> Iterator[None]:
    """Raise an error with a remedy if there is not enough memory for a campus or its drives."""
    try:
        yield
    except MemoryError as error:
        raise MapperError(
            'there is not enough memory for this campus and its drives; lower --buildings or --readings, or simulate '
            'fewer drives in parallel (--jobs)'
        ) from error


def at_once(work: Callable[[int], T], numbers: Iterable[int], jobs: int) -> Iterator[T]:
    """Yield the results of `work` for each number, in any order, from this many processes."""
    if jobs == 1:
        yield from map(work, numbers)
        return
    # a fork would copy locks held by threads of this process
    with ProcessPoolExecutor(jobs, get_context('spawn')) as pool:
        try:
            # a terminal sends Ctrl-C to all of its processes; children are ended here, with one message
            with signals_later():
                begun = [pool.submit(work, number) for number in numbers]
            for future in as_completed(begun):
                yield future.result()
        except BrokenProcessPool as error:
            raise ClusterError(
                'a process that simulated drives was ended, most likely because of too little memory; simulate fewer '
                'drives in parallel (--jobs), or shorter ones (--readings)'
            ) from error
        except BaseException:
            # unfinished drives are not needed
            for process in active_children():
                process.terminate()
            raise
        finally:
            pool.shutdown(wait=True, cancel_futures=True)


def simulate(options: argparse.Namespace) -> int:
    """Run the command with its options."""
    with Ticker(options.quiet) as ticker:
        fill_in(options, WORLD_OPTIONS)
        if options.world == 'campus':
            simulate_campus(options, ticker)
            return 0
        # first the folder, so that an error is found before the work
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
