"""`python3 -m forward_grid_mapper COMMAND …`, for machines without ros2cli."""

from __future__ import annotations

import sys

if sys.argv[1:2] == ['mapper']:
    # as in `node.main`: Ctrl-C gives no traceback, however early
    import signal

    signal.signal(signal.SIGINT, signal.SIG_DFL)

import importlib

from . import __version__

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


def main() -> int:
    """Run the command named by the first argument."""
    if len(sys.argv) > 1 and sys.argv[1] in COMMANDS:
        module, _ = COMMANDS[sys.argv[1]]
        return int(importlib.import_module(f'.{module}', __package__).main(sys.argv[2:]))
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
