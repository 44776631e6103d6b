"""`demo`: simulate a drive into a bag, replay it to the node, run EM, and score the three maps against the truth."""

from __future__ import annotations

import argparse
from collections.abc import Iterable, Sequence
from pathlib import Path

from ..core.common.errors import MapperError, ParameterError
from ..core.common.parameters import Parameters
from ..core.mapping import Mapper
from ..files.figure import write_figure
from ..files.map_archive import MapArchive, read_npz
from ..files.output_folder import free_name, output_errors, output_folder, readable
from ..files.panels import FigureTile
from ..files.results import write_results
from ..recordings.read_drive import read_drive
from ..simulation.drive import Recording
from ..simulation.score import SURFACE_DEPTH, Scores, score_map, threshold, visible_surface
from ..simulation.world import Door
from .console import Ticker, run
from .desktop import show
from .options import add_mapping_options, add_show_option, chosen_parameters, output_name
from .simulate import SONARS, WORLD_OPTIONS, fill_in, record, write_recording

COMMAND = 'demo'


def parser() -> argparse.ArgumentParser:
    """Return the parser of the command line."""
    made = argparse.ArgumentParser(
        COMMAND,
        description=(
            "Run the whole pipeline: simulates the paper's drive past an open door into a bag, starts the node, "
            'replays the bag to it over DDS, runs EM, saves the maps, and scores them against the truth.'
        ),
        epilog='example: demo --world corridor -o seen',
    )
    made.add_argument('-o', '--output', type=output_name, metavar='DIR', help='new folder (default: demo_output)')
    made.add_argument('--world', choices=('door', 'corridor'), default='door', help='default: door')
    made.add_argument('--seen', type=int, metavar='N', help='door: sweeps in front of it (default 3)')
    made.add_argument('--rate', type=float, default=10.0, metavar='R', help='speed of the replay (default 10)')
    made.add_argument('--offline', action='store_true', help='map the bag with process_bag instead, without ROS')
    made.add_argument('--seed', type=int, default=0, help='seed of the noise (default 0)')
    add_show_option(made, 'the picture')
    add_mapping_options(made)
    return made


def score_all(maps: MapArchive, recording: Recording) -> dict[str, Scores]:
    """Score the three maps against the world of the recording."""
    visible = visible_surface(recording.world, recording.readings, SURFACE_DEPTH)
    decided = {
        'standard map': threshold(maps.live),
        'maximum likelihood map': maps.ml,
        'uncertainty map': threshold(maps.uncertainty),
    }
    return {name: score_map(cells, maps.grid, recording.world, visible) for name, cells in decided.items()}


def score_table(scores: dict[str, Scores], doors: Sequence[Door]) -> str:
    """Return the scores as lines of text, and the true widths of the doors."""
    lines = [f'{"":24s}{"F1":>7s}{"precision":>11s}{"recall":>8s}{"false dots":>12s}   open width of each door, m']
    for name, s in scores.items():
        found = _widths(s.door_widths)
        lines.append(f'{name:24s}{s.f1:7.3f}{s.precision:11.3f}{s.recall:8.3f}{s.false_dots:12d}   {found}')
    lines.append(f'{"truth":62s}   {_widths(door.width for door in doors)}')
    return '\n'.join(lines)


def _widths(doors: Iterable[float]) -> str:
    return ' '.join(f'{width:.1f}' for width in doors)


def through_node(folder: Path, bag: Path, recording: Recording, options: argparse.Namespace, ticker: Ticker) -> str:
    """Replay a bag to the node and save its maps as `folder`/maps; return the message of run_em."""
    from .live_node import LiveNode

    saved = folder / 'saved'
    ros = {'range_reliability': 'reliable', 'odom_reliability': 'reliable', 'save_directory': str(saved)}
    parameters = Parameters.from_flat(ros, base=chosen_parameters(options).parameters)
    with LiveNode(folder, parameters, recording.extrinsics, ticker.say) as node:
        node.call('reset', 'starting the node')
        ticker.say(f'replaying the bag to the node, {options.rate:g} times as fast as it was recorded')
        node.run('replay_bag', str(bag), '--rate', str(options.rate), '--quiet')
        answer = node.call('run_em', 'running EM')
        node.call('save_maps', 'saving the maps')
    # the only folder there; the answer's text is for people, and cannot be parsed for any path
    (made,) = saved.iterdir()
    made.rename(folder / 'maps')
    saved.rmdir()
    return answer


def offline(folder: Path, bag: Path, output: Path, options: argparse.Namespace, ticker: Ticker) -> str:
    """Map a bag without ROS into `folder`/maps, which will be `output`/maps; return a description of the result."""
    parameters, _, ignored = chosen_parameters(options)
    drive = read_drive(bag, parameters, {}, progress=ticker.reading)
    drive.source['warnings'] += ignored
    drive.source['bag'] = readable(output / bag.name)
    maps = Mapper(parameters).run(drive.associator.readings, ticker.mapping)
    write_results(folder / 'maps', maps, drive.source, drive.path_xy, 'The demo, offline')
    return f'{len(maps.readings)} readings, {sum(maps.statistics["seconds"].values()):.2f} seconds'


def ros_is_here() -> bool:
    """Return whether the node can run."""
    try:
        import rclpy  # noqa: F401
    except ImportError:
        return False
    return True


def demo(options: argparse.Namespace) -> int:
    """Run the command with its options."""
    # first, since the parameters may be wrong, or only be printed
    chosen_parameters(options)
    output = Path(options.output) if options.output else free_name(Path.cwd(), 'demo_output')
    if not options.offline and not ros_is_here():
        raise MapperError(
            'ROS 2 is not installed, or not sourced: source its setup.bash, pip install .[ros], or use --offline'
        )
    if not 0.1 <= options.rate <= 100:
        raise ParameterError('--rate must lie between 0.1 and 100')
    fill_in(options, {'door': WORLD_OPTIONS['door'], 'corridor': {}})
    with Ticker() as ticker, output_folder(output) as folder:
        ticker.say('simulating')
        recording = record(options.world, options.seen, 1, False, options.seed, SONARS['ring']())
        bag = write_recording(folder, recording)
        if options.offline:
            summary = offline(folder, bag, output, options, ticker)
        else:
            summary = through_node(folder, bag, recording, options, ticker)
        ticker.say('scoring')
        maps = read_npz(folder / 'maps' / 'maps.npz')
        table = score_table(score_all(maps, recording), recording.world.doors)
        left, right, bottom, top = recording.world.grid.extent
        tiles = [
            FigureTile('truth', recording.world.grid, recording.world.reference),
            FigureTile('standard map', maps.grid, maps.live),
            FigureTile('maximum likelihood map', maps.grid, maps.ml),
            FigureTile('uncertainty map', maps.grid, maps.uncertainty),
        ]
        rows = [tiles] if options.world == 'door' else [[tile] for tile in tiles]
        write_figure(folder / 'demo.png', f'The {options.world} world, simulated', rows, (left, right, bottom, top))
        with output_errors(folder):
            (folder / 'scores.txt').write_text(table + '\n', encoding='utf-8')
    print(f'EM {"offline" if options.offline else "in the node"}: {summary}\n\n{table}\n')
    print('F1, precision and recall are for wall cells; false dots are occupied cells in free space: docs/quality.md')
    print('the width of a door is that of its free cells: its frame may cover a cell on each side\n')
    print(f'the picture is {output / "demo.png"}; the maps for Nav2 and their report are in {output / "maps"}')
    if options.show:
        show(output / 'demo.png')
    return 0


def main(arguments: Sequence[str] | None = None) -> int:
    """Run the command; return its exit code."""
    return run(parser(), demo, arguments)
