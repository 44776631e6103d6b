"""The entry of every command: `python3 -m forward_grid_mapper COMMAND …`, and one script each once it is installed.

Signals get their handlers before the commands' modules are imported, which takes a second.
"""

from __future__ import annotations

import importlib
import sys
from collections.abc import Sequence

from . import __version__
from .commands import signals

COMMANDS = {
    'mapper': ('node.main', 'the ROS 2 node: map while driving'),
    'process_bag': ('commands.process_bag', 'map a recorded drive'),
    'learn': ('commands.learn', 'learn the sensor model from a recorded drive'),
    'replay_bag': ('commands.replay_bag', 'play a recorded drive to the node'),
    'simulate': ('commands.simulate', 'record a drive through a small world with a known map'),
    'experiment': ('commands.experiment', "repeat the paper's experiments: a table and a figure"),
    'demo': ('commands.demo', 'simulate, map, score: the whole way in one command'),
}
"""Module and help of each command."""


EXTRAS = {'rosbags': 'offline', 'matplotlib': 'offline', 'rclpy': 'ros'}
"""The extra of the installation that brings a package which not every command needs."""


def run(command: str, arguments: Sequence[str] | None = None) -> int:
    """Import a command and run it; return its exit code. `arguments` are those of the process unless given."""
    signals.leave_at_once(command)
    signals.end_with_parent()
    module, _ = COMMANDS[command]
    try:
        main = importlib.import_module(f'.{module}', __package__).main
    except ModuleNotFoundError as error:
        if error.name is None or (package := error.name.partition('.')[0]) not in EXTRAS:
            raise
        print(f'{command}: error: {_what_brings(package)}', file=sys.stderr)
        return 1
    try:
        return int(main(arguments))
    finally:
        signals.leave_silently()


def _what_brings(package: str) -> str:
    """Say how a package that is not installed can be."""
    extra = f'pip install "forward_grid_mapper[{EXTRAS[package]}]", or .[{EXTRAS[package]}] in a checkout'
    if package == 'rclpy':
        return f"{package} is not installed: source ROS 2's setup.bash, or {extra}"
    return f'{package} is not installed: {extra}; pip install {package} will do as well'


def mapper() -> int:
    """Run `mapper`; return its exit code."""
    return run('mapper')


def process_bag() -> int:
    """Run `process_bag`; return its exit code."""
    return run('process_bag')


def learn() -> int:
    """Run `learn`; return its exit code."""
    return run('learn')


def replay_bag() -> int:
    """Run `replay_bag`; return its exit code."""
    return run('replay_bag')


def simulate() -> int:
    """Run `simulate`; return its exit code."""
    return run('simulate')


def experiment() -> int:
    """Run `experiment`; return its exit code."""
    return run('experiment')


def demo() -> int:
    """Run `demo`; return its exit code."""
    return run('demo')


def main() -> int:
    """Run the command named by the first argument."""
    if len(sys.argv) > 1 and sys.argv[1] in COMMANDS:
        return run(sys.argv[1], sys.argv[2:])
    if len(sys.argv) > 1 and sys.argv[1] == '--version':
        print(__version__)
        return 0
    lines = '\n'.join(f'  {name:12s} {text}' for name, (_, text) in COMMANDS.items())
    usage = f'usage: python3 -m forward_grid_mapper COMMAND …\n\n{lines}\n\nCOMMAND --help tells more.'
    if len(sys.argv) > 1 and sys.argv[1] in ('-h', '--help'):
        print(usage)
        return 0
    print(usage, file=sys.stderr)
    return 2


if __name__ == '__main__':
    sys.exit(main())
