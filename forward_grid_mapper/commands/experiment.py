"""`experiment`: the paper's figures 3 to 6, and maps with drifting odometry, each as a table and a figure."""

from __future__ import annotations

import argparse
import sys
from collections.abc import Sequence
from pathlib import Path

from ..core.common.errors import ParameterError
from ..core.common.parameters import Parameters
from ..files.figure import write_density, write_figure
from ..files.output_folder import free_name, output_errors, output_folder
from .console import Ticker, run
from .desktop import show
from .experiment_density import density_of_ranges, density_table
from .experiment_drift import drift
from .experiment_maps import corridor, door, passer_by
from .options import add_mapping_options, add_show_option, chosen_parameters, output_name

COMMAND = 'experiment'

MAPS = {
    'door': (door, "The paper's Fig. 4, simulated"),
    'passer-by': (passer_by, "The paper's Fig. 5, simulated"),
    'corridor': (corridor, "The paper's Fig. 6, simulated"),
}


def parser() -> argparse.ArgumentParser:
    """Return the parser of the command line."""
    made = argparse.ArgumentParser(
        COMMAND,
        description=(
            "Repeat one of the paper's figures in simulation: prints a table and writes a figure. The standard map "
            'has the best gains for each experiment; the forward map has the parameters below.'
        ),
        epilog='example: experiment passer-by --seeds 1 -o fig5',
    )
    made.add_argument(
        'which',
        choices=('density', *MAPS, 'drift'),
        help=(
            'Fig. 3: the density of a range; Fig. 4: a door seen n times; Fig. 5: two doors on either side, and a '
            "person who walks by; Fig. 6: a long corridor; drift: wheel odometry that drifts, in the paper's corridor "
            'and in a building'
        ),
    )
    made.add_argument('-o', '--output', type=output_name, metavar='DIR', help='new folder (default: experiment_WHICH)')
    made.add_argument(
        '--seeds', type=int, default=5, metavar='N', help='seeds of the noise to average over (default 5)'
    )
    add_show_option(made, 'the figure')
    add_mapping_options(made)
    return made


def experiment(options: argparse.Namespace) -> int:
    """Run the command with its options."""
    if options.seeds < 1:
        raise ParameterError('--seeds must be a positive number')
    parameters, _, ignored = chosen_parameters(options)
    for warning in ignored:
        print(f'{COMMAND}: warning: {warning}', file=sys.stderr)
    output = Path(options.output) if options.output else free_name(Path.cwd(), f'experiment_{options.which}')
    with Ticker() as ticker, output_folder(output) as folder:
        if options.which == 'density':
            table = density(folder, parameters)
        elif options.which == 'drift':
            table = drifting(folder, options, parameters, ticker)
        else:
            table = maps(folder, options, parameters, ticker)
        with output_errors(folder):
            (folder / 'table.txt').write_text(table + '\n', encoding='utf-8')
    print(table)
    figures = sorted(output.glob('figure*.png'))
    print(f'\ntable and figure{"s" * (len(figures) > 1)} are in {output}')
    if options.show:
        show(figures[0])
    return 0


def density(folder: Path, parameters: Parameters) -> str:
    """Draw Fig. 3; return its table."""
    curve, tile = density_of_ranges(parameters)
    write_density(folder / 'figure.png', "The paper's Fig. 3", tile, curve)
    return density_table(curve, parameters)


def maps(folder: Path, options: argparse.Namespace, parameters: Parameters, ticker: Ticker) -> str:
    """Draw one of the figures with maps; return its table."""
    made, title = MAPS[options.which]
    table, rows = made(options, parameters, ticker)
    ticker.say('drawing')
    left, right, bottom, top = rows[0][0].grid.extent
    write_figure(folder / 'figure.png', title, rows, (left, right, bottom, top))
    return table


def drifting(folder: Path, options: argparse.Namespace, parameters: Parameters, ticker: Ticker) -> str:
    """Draw maps with drifting odometry, a figure for each world; return the table."""
    table, figures = drift(options, parameters, ticker)
    ticker.say('drawing')
    for name, (rows, view) in figures.items():
        write_figure(folder / f'figure_{name}.png', f'Wheel odometry that drifts, {name}', rows, view)
    return table


def main(arguments: Sequence[str] | None = None) -> int:
    """Run the command; return its exit code."""
    return run(parser(), experiment, arguments)
