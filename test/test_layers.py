"""Layers: each imports only from those below, no two modules import each other, and the core has few dependencies."""

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
    'recordings': {'core', 'files', 'bags'},
    'replay': {'core', 'bags'},
    'scale': {'core', 'files', 'recordings'},
    'node': {'core', 'files'},
    'commands': {'core', 'files', 'bags', 'simulation', 'recordings', 'replay', 'node', 'scale'},
}
"""The packages that each package may import from, in addition to itself."""

CORE = ('common', 'runtime', 'sensor', 'messages', 'evidence', 'search', 'maps', 'tiles', 'learning', 'trajectory')
"""The layers of the core, from the bottom up; modules outside them are above all layers."""

OUTSIDE = {
    'core': {'numpy', 'numba', 'scipy'},
    'files': {'numpy', 'yaml', 'matplotlib', 'rerun'},
    # rosbags brings the decompressors
    'bags': {'numpy', 'rosbags', 'lz4', 'backports'},
    'simulation': {'numpy'},
    'recordings': {'numpy'},
    'scale': {'numpy', 'numba', 'dask', 'distributed', 'pyarrow', 'zarr'},
}
"""Imports from outside the standard library; without an entry, anything is allowed."""

MODULES = {'.'.join(path.relative_to(PACKAGE.parent).with_suffix('').parts): path for path in PACKAGE.rglob('*.py')}


def imports(module: str) -> set[str]:
    """Absolute names of all imports of a module, at any depth: modules, and names in them."""
    names = set()
    parts = module.split('.')
    for node in ast.walk(ast.parse(MODULES[module].read_text())):
        if isinstance(node, ast.Import):
            names |= {alias.name for alias in node.names}
        elif isinstance(node, ast.ImportFrom):
            base = parts[: -node.level] if node.level else []
            stem = [*base, *(node.module.split('.') if node.module else [])]
            names |= {'.'.join([*stem, alias.name]) for alias in node.names}
    return names


def modules_of(module: str) -> set[str]:
    """The modules of the package that a module imports."""
    found = set()
    for name in imports(module):
        for candidate in (name, name.rpartition('.')[0]):
            if candidate in MODULES:
                found.add(candidate)
                break
    return found - {module}


@pytest.mark.parametrize('package', sorted(BELOW))
def test_packages_import_only_from_below(package: str) -> None:
    for module in MODULES:
        if module.split('.')[1:2] != [package]:
            continue
        for name in imports(module):
            parts = name.split('.')
            if parts[0] == PACKAGE.name and len(parts) > 2:
                assert parts[1] == package or parts[1] in BELOW[package], f'{module} imports {name}'
            elif parts[0] != PACKAGE.name and parts[0] not in sys.stdlib_module_names and package in OUTSIDE:
                assert parts[0] in OUTSIDE[package], f'{module} imports {name}'


def test_all_packages_and_layers_are_listed() -> None:
    folders = {path.parent.relative_to(PACKAGE).parts for path in MODULES.values()}
    assert {parts[0] for parts in folders if parts} == set(BELOW)
    assert {parts[1] for parts in folders if parts[:1] == ('core',) and len(parts) > 1} == set(CORE)


@pytest.mark.parametrize('number', range(len(CORE)))
def test_layers_of_the_core_import_only_from_below(number: int) -> None:
    prefix = f'{PACKAGE.name}.core.'
    allowed = CORE[: number + 1]
    for module in MODULES:
        if module.startswith(f'{prefix}{CORE[number]}.'):
            for name in modules_of(module):
                assert name.removeprefix(prefix).split('.')[0] in allowed, f'{module} imports {name}'


def test_no_modules_import_each_other() -> None:
    left = {module: modules_of(module) for module in MODULES}
    while left:
        free = [module for module, needed in left.items() if not needed & left.keys()]
        assert free, f'these import each other: {sorted(left)}'
        for module in free:
            del left[module]


def test_folders_of_core_tests_are_those_of_the_core() -> None:
    folder = Path(__file__).parent / 'core'
    assert {path.name for path in folder.iterdir() if path.is_dir() and path.name[0] != '_'} <= set(CORE)
