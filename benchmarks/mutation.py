#!/usr/bin/env python3
"""Changes modules in small ways, one change at a time, and counts how many of the changes the tests notice.

usage: mutation.py [--only NAME ...] [--survivors]

The changes are made by cosmic-ray 8 (`pip install cosmic-ray`, in an environment of its own if that is on the path), in
a copy of the checkout: operators, comparisons, numbers and constants are replaced, loops and exceptions left out, and
so on. The tests of a module are run after each change, without compiling kernels. The score is the part of the changes
with which a test fails; changes that mean the same as before count against it. `--survivors` prints the others.

Left out are changes of `|`, nearly all of which are in annotations that are never evaluated, and those of an operator
into one of bits, modulo or powers, which any test notices.
"""

from __future__ import annotations

import argparse
import json
import os
import shlex
import shutil
import subprocess
import sys
import tempfile
import time
from pathlib import Path

ROOT = Path(__file__).resolve().parents[1]

MODULES = {
    'core/common/grid': ('core/common/test_grid',),
    'core/messages/map_extent': ('core/messages/test_map_extent',),
    'core/messages/pose_history': ('core/messages/test_pose_history',),
    'core/messages/quaternions': ('core/messages/test_quaternions',),
    'core/messages/rep117': ('core/messages/test_rep117', 'core/messages/test_pose_association'),
    'core/messages/robot_path': ('core/messages/test_robot_path',),
    'bags/choice': ('bags/test_topic_choice',),
    'bags/static_transforms': ('bags/test_static_transforms',),
    'node/losses': ('node/test_losses',),
}
"""Modules, and the tests that must notice their changes; each takes seconds."""

LEFT_OUT = [
    'core/ReplaceBinaryOperator_BitOr_.*',
    'core/ReplaceBinaryOperator_.*_(Mod|Pow|FloorDiv|RShift|LShift|BitOr|BitAnd|BitXor)',
    'core/ReplaceUnaryOperator_.*_Invert',
    'core/ReplaceComparisonOperator_.*_(Is|IsNot)',
]
"""`|` is nearly always in annotations, which are never evaluated; the others would be noticed by any test."""

CONFIGURATION = """
[cosmic-ray]
module-path = "forward_grid_mapper/{module}.py"
timeout = 60.0
excluded-modules = []
test-command = "{command}"

[cosmic-ray.distributor]
name = "local"

[cosmic-ray.filters.operators-filter]
exclude-operators = {left_out}
"""


def copy_of_checkout(folder: Path) -> None:
    """Copy what the tests need."""
    for name in ('forward_grid_mapper', 'test', 'benchmarks', 'config', 'docs', 'launch'):
        shutil.copytree(ROOT / name, folder / name, ignore=shutil.ignore_patterns('__pycache__', 'kernels_*'))
    for name in ('pyproject.toml', 'README.md', 'setup.py', 'setup.cfg', 'package.xml'):
        shutil.copy(ROOT / name, folder / name)


def changes_of(module: str, folder: Path) -> list[tuple[bool, str]]:
    """Return for each change of a module whether a test noticed it, and what it was."""
    configuration = folder / 'cosmic_ray.toml'
    session = folder / f'{module.replace("/", "_")}.sqlite'
    # sources change within a second and without changing in size, which compiled files would hide
    environment = {
        **os.environ,
        'PYTHONPATH': str(folder),
        'PYTHONDONTWRITEBYTECODE': '1',
        'NUMBA_DISABLE_JIT': '1',
        'PYTEST_DISABLE_PLUGIN_AUTOLOAD': '1',
    }

    def run(*command: str | Path) -> str:
        done = subprocess.run(
            [str(word) for word in command], cwd=folder, env=environment, check=False, capture_output=True, text=True
        )
        if done.returncode:
            raise SystemExit(f'{command[0]} {command[1]} failed: {done.stdout[-2000:]}{done.stderr[-2000:]}')
        return done.stdout

    test = [sys.executable, '-m', 'pytest', '-x', '-q', '-p', 'no:cacheprovider']
    test += [f'test/{name}.py' for name in MODULES[module]]
    run(*test)
    text = CONFIGURATION.format(module=module, command=shlex.join(test), left_out=json.dumps(LEFT_OUT))
    configuration.write_text(text, encoding='utf-8')
    run('cosmic-ray', 'init', configuration, session)
    run('cr-filter-operators', session, configuration)
    run('cosmic-ray', 'exec', configuration, session)
    found = []
    for line in run('cosmic-ray', 'dump', session).splitlines():
        item, result = json.loads(line)
        if result is not None and result['worker_outcome'] == 'normal':
            found.append((result['test_outcome'] == 'killed', result['diff'] or str(item)))
    return found


def main() -> None:
    """Print a row for each module."""
    parser = argparse.ArgumentParser(description=__doc__.partition('\n')[0])
    parser.add_argument('--only', nargs='+', choices=sorted(MODULES), default=list(MODULES), metavar='NAME')
    parser.add_argument('--survivors', action='store_true', help='print the changes that no test noticed')
    options = parser.parse_args()
    if shutil.which('cosmic-ray') is None:
        raise SystemExit('cosmic-ray is not on the path: pip install cosmic-ray')
    print(f'{"module":34s}{"changes":>9s}{"noticed":>9s}{"score":>8s}{"seconds":>9s}')
    total = noticed = 0
    with tempfile.TemporaryDirectory() as name:
        folder = Path(name) / 'checkout'
        folder.mkdir()
        copy_of_checkout(folder)
        for module in options.only:
            begin = time.monotonic()
            found = changes_of(module, folder)
            killed = sum(was_noticed for was_noticed, _ in found)
            total, noticed = total + len(found), noticed + killed
            seconds = time.monotonic() - begin
            print(f'{module:34s}{len(found):9d}{killed:9d}{killed / max(len(found), 1):8.0%}{seconds:9.0f}', flush=True)
            if options.survivors:
                print(*(change for was_noticed, change in found if not was_noticed), sep='\n', flush=True)
    print(f'{"all":34s}{total:9d}{noticed:9d}{noticed / max(total, 1):8.0%}')


if __name__ == '__main__':
    main()
