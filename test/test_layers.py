"""The house: each room imports only from the rooms below it, and core only numpy and numba."""

from __future__ import annotations

import ast
import sys
from pathlib import Path

import pytest

PACKAGE = Path(__file__).resolve().parents[1] / 'forward_grid_mapper'
BELOW = {
    'core': set(),
    'files': {'core'},
    'bags': {'core'},
    'simulation': {'core'},
    'node': {'core', 'files'},
    'commands': {'core', 'files', 'bags', 'simulation', 'node'},
}
OUTSIDE = {
    'core': {'numpy', 'numba'},
    'files': {'numpy', 'yaml', 'matplotlib'},
    'bags': {'numpy', 'rosbags'},
    'simulation': {'numpy'},
}


def imports(path: Path) -> set[str]:
    """Absolute names of everything that a file imports, at any depth."""
    names = set()
    parts = list(path.relative_to(PACKAGE.parent).with_suffix('').parts)
    for node in ast.walk(ast.parse(path.read_text())):
        if isinstance(node, ast.Import):
            names |= {alias.name for alias in node.names}
        elif isinstance(node, ast.ImportFrom):
            base = parts[: -node.level] if node.level else []
            stem = [*base, *(node.module.split('.') if node.module else [])]
            names |= {'.'.join([*stem, alias.name]) for alias in node.names}
    return names


@pytest.mark.parametrize('room', sorted(BELOW))
def test_rooms_import_only_from_below(room: str) -> None:
    for path in (PACKAGE / room).rglob('*.py'):
        for name in imports(path):
            parts = name.split('.')
            if parts[0] == PACKAGE.name and len(parts) > 2:
                assert parts[1] == room or parts[1] in BELOW[room], f'{path} imports {name}'
            elif parts[0] != PACKAGE.name and parts[0] not in sys.stdlib_module_names and room in OUTSIDE:
                assert parts[0] in OUTSIDE[room], f'{path} imports {name}'
