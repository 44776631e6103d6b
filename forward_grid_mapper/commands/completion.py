"""Tab completion by argcomplete, an optional package: commands, then the options of the command."""

from __future__ import annotations

import importlib
import os
from collections.abc import Mapping
from typing import TYPE_CHECKING

if TYPE_CHECKING:
    import argparse

REQUEST = '_ARGCOMPLETE'
"""Environment variable that the shell sets when it requests completions."""


def complete(commands: Mapping[str, tuple[str, str]], package: str) -> None:
    """Answer the shell and exit, if it requests completions and argcomplete is installed.

    Parameters
    ----------
    commands : mapping
        Module and help of each command. Only the one on the command line is imported.
    package : str
        Package of the modules.
    """
    if REQUEST not in os.environ:
        return
    try:
        import argcomplete
    except ImportError:
        return
    argcomplete.autocomplete(parser_of_all(commands, package, os.environ.get('COMP_LINE', '').split()))


def parser_of_all(commands: Mapping[str, tuple[str, str]], package: str, words: list[str]) -> argparse.ArgumentParser:
    """Return a parser with all commands; those among `words` have their options."""
    # imported late, after signals have their handlers
    import argparse

    made = argparse.ArgumentParser('forward_grid_mapper')
    made.add_argument('--version', action='store_true')
    below = made.add_subparsers()
    for command, (module, text) in commands.items():
        parents = []
        # the node has no options of its own
        if command in words and not module.startswith('node'):
            parents.append(importlib.import_module(f'.{module}', package).parser())
        below.add_parser(command, parents=parents, help=text, add_help=False)
    return made
