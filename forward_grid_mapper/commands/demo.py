"""`demo`: simulate a drive, map it from its bag, and score the three maps against the truth."""

from __future__ import annotations

import argparse
import sys
from collections.abc import Sequence
from pathlib import Path

from ..core.mapping import Mapper
from ..core.maps import MapSet
from ..core.parameters import Parameters
from ..files.output_folder import free_name, output_folder
from ..files.results import write_results
from ..simulation.drive import Recording
from ..simulation.score import Scores, score_map, threshold, visible_surface
from .console import Ticker, readable, run
from .offline import read_drive
from .options import add_mapping_options, chosen_parameters
from .simulate import SONARS, record, write_recording

COMMAND = 'demo'
SURFACE_DEPTH = 0.2
"""A wall cell counts as visible if a ray meets it at most so many metres beyond the nearest one of its cone."""


def parser() -> argparse.ArgumentParser:
    """Return the parser of the command line."""
    made = argparse.ArgumentParser(
        COMMAND,
        description="Simulate the paper's drive past an open door into a bag, map the bag, and score the maps.",
    )
    made.add_argument('-o', '--output', metavar='DIR', help='new folder (default: demo_output)')
    made.add_argument('--world', choices=('door', 'corridor'), default='door', help='default: door')
    made.add_argument('--seen', type=int, default=3, metavar='N', help='sweeps in front of the door (default 3)')
    made.add_argument('--seed', type=int, default=0, help='of the noise (default 0)')
    add_mapping_options(made)
    return made


def score_all(maps: MapSet, recording: Recording) -> dict[str, Scores]:
    """Score the three maps against the world of the recording."""
    visible = visible_surface(recording.world, recording.readings, SURFACE_DEPTH)
    decided = {'live map': threshold(maps.live), 'ML map': maps.ml, 'uncertainty map': threshold(maps.uncertainty)}
    return {name: score_map(cells, maps.grid, recording.world, visible) for name, cells in decided.items()}


def score_table(scores: dict[str, Scores]) -> str:
    """Return the scores as lines of text."""
    lines = [f'{"":16s}{"F1":>7s}{"precision":>11s}{"recall":>8s}{"false dots":>12s}   open width of each door, m']
    for name, s in scores.items():
        doors = ' '.join(f'{width:.1f}' for width in s.door_widths)
        lines.append(f'{name:16s}{s.f1:7.3f}{s.precision:11.3f}{s.recall:8.3f}{s.false_dots:12d}   {doors}')
    return '\n'.join(lines)


def demo(options: argparse.Namespace) -> int:
    """Do what the command line asks for."""
    parameters: Parameters = chosen_parameters(options)[0]
    output = Path(options.output) if options.output else free_name(Path.cwd(), 'demo_output')
    with Ticker() as ticker:
        ticker.say('simulating')
        recording = record(options.world, options.seen, 1, False, options.seed, SONARS['ring']())
        with output_folder(output) as folder:
            bag = write_recording(folder, recording)
            drive = read_drive(bag, parameters, {}, progress=ticker.reading)
            drive.source['bag'] = readable(output / bag.name)
            maps = Mapper(parameters).run(drive.placer.readings, ticker.mapping)
            ticker.say('writing')
            world = recording.world
            title = f'The {world.name} world, simulated'
            table = score_table(score_all(maps, recording))
            write_results(
                folder / 'maps',
                maps,
                drive.source,
                drive.path_xy,
                title,
                (world.grid, world.reference),
                {'scores.txt': table + '\n'},
            )
    seconds = sum(maps.statistics['seconds'].values())
    print(f'{len(maps.readings):,} readings became three maps in {seconds:.2f} s:\n')
    print(table)
    print(f'\nthe picture is {output / "maps" / "maps.png"}, the report {output / "maps" / "report.txt"}')
    return 0


def main(arguments: Sequence[str] | None = None) -> int:
    """Run the command; return its exit code."""
    return run(parser(), demo, arguments)


if __name__ == '__main__':
    sys.exit(main())
