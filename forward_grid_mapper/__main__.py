# PYTHON_ARGCOMPLETE_OK
"""The entry of every command: `python3 -m forward_grid_mapper COMMAND …`, and a script for each when installed.

Handlers of signals are set before the commands' modules are imported, which takes a second.
"""

from __future__ import annotations

import importlib
import os
import sys
from collections.abc import Callable, Sequence
from pathlib import Path

from . import __version__
from .commands import completion, signals

COMMANDS = {
    'mapper': ('node.main', 'the ROS 2 node: map while driving'),
    'process_bag': ('commands.process_bag', 'map a recorded drive'),
    'explain': ('commands.explain', 'explain why a cell of a map is occupied or free'),
    'learn': ('commands.learn', 'learn the sensor model from a recorded drive'),
    'replay_bag': ('commands.replay_bag', 'play a recorded drive to the node'),
    'simulate': ('commands.simulate', 'record a drive through a small world with a known map'),
    'experiment': ('commands.experiment', "repeat the paper's experiments: a table and a figure"),
    'warm_up': ('commands.warm_up', 'compile all kernels once, so that the node starts fast'),
    'demo': ('commands.demo', 'simulate, map and score in one command'),
}
"""Module and help of each command."""


EXTRAS = {'rosbags': 'offline', 'matplotlib': 'offline', 'rclpy': 'ros'}
"""The extras that install packages which only some commands need."""


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
        print(f'{command}: error: {_how_to_install(package)}', file=sys.stderr)
        return 1
    try:
        return int(main(arguments))
    finally:
        signals.leave_silently()


def _open_streams() -> None:
    """Open standard streams that were closed when the process was started, as by `>&-`.

    Python sets them to None, and the next opened file would get the descriptor of such a stream.
    """
    for name, mode in (('stdin', 'r'), ('stdout', 'w'), ('stderr', 'w')):
        if getattr(sys, name) is None:
            setattr(sys, name, open(os.devnull, mode, encoding='utf-8'))  # noqa: PTH123, SIM115 (for the whole process)


def _with_output(work: Callable[[], int]) -> int:
    """Run a command; the reader of its output may end early, such as `head`."""
    _open_streams()
    try:
        try:
            return work()
        finally:
            # the command may have closed it
            if not sys.stdout.closed:
                sys.stdout.flush()
    except BrokenPipeError:
        if not signals.output_closed():
            raise
        # so that the interpreter has nothing to write at exit
        os.dup2(os.open(os.devnull, os.O_WRONLY), sys.stdout.fileno())
        return 1


def _how_to_install(package: str) -> str:
    """Return how to install a missing package."""
    extra = f'pip install "forward_grid_mapper[{EXTRAS[package]}]", or .[{EXTRAS[package]}] in a checkout'
    if package == 'rclpy':
        return f"{package} is not installed: source ROS 2's setup.bash, or {extra}"
    return f'{package} is not installed: {extra}; pip install {package} will do as well'


def mapper() -> int:
    """Run `mapper`; return its exit code."""
    return _with_output(lambda: run('mapper'))


def process_bag() -> int:
    """Run `process_bag`; return its exit code."""
    return _with_output(lambda: run('process_bag'))


def explain() -> int:
    """Run `explain`; return its exit code."""
    return _with_output(lambda: run('explain'))


def learn() -> int:
    """Run `learn`; return its exit code."""
    return _with_output(lambda: run('learn'))


def replay_bag() -> int:
    """Run `replay_bag`; return its exit code."""
    return _with_output(lambda: run('replay_bag'))


def simulate() -> int:
    """Run `simulate`; return its exit code."""
    return _with_output(lambda: run('simulate'))


def experiment() -> int:
    """Run `experiment`; return its exit code."""
    return _with_output(lambda: run('experiment'))


def warm_up() -> int:
    """Run `warm_up`; return its exit code."""
    return _with_output(lambda: run('warm_up'))


def demo() -> int:
    """Run `demo`; return its exit code."""
    return _with_output(lambda: run('demo'))


def main() -> int:
    """Run the command named by the first argument."""
    return _with_output(_main)


def _main() -> int:
    completion.complete(COMMANDS, __package__)
    given = sys.argv[1] if len(sys.argv) > 1 else ''
    if given in COMMANDS:
        return run(given, sys.argv[2:])
    if given == '--version':
        print(__version__)
        return 0
    name = Path(sys.argv[0]).name
    program = 'python3 -m forward_grid_mapper' if name == '__main__.py' else name
    lines = '\n'.join(f'  {command:12s} {text}' for command, (_, text) in COMMANDS.items())
    usage = f'usage: {program} COMMAND …\n\n{lines}\n\nCOMMAND --help shows its options.'
    if given in ('-h', '--help'):
        print(usage)
        return 0
    if given:
        import difflib

        near = difflib.get_close_matches(given, COMMANDS, n=1)
        hint = f'; did you mean {near[0]}?' if near else ''
        print(f'{program}: error: there is no command {given!r}{hint}\n', file=sys.stderr)
    print(usage, file=sys.stderr)
    return 2


if __name__ == '__main__':
    sys.exit(main())
