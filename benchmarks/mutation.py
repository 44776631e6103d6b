#!/usr/bin/env python3
"""Mutation tests: changes modules one small change at a time, and counts the changes that tests detect.

usage: mutation.py [--only NAME ...] [--most 100] [--seed 0] [--survivors]

cosmic-ray 8 makes the changes (`pip install cosmic-ray`, in its own environment if that is on the path), in a copy of
the checkout: operators, comparisons, numbers and constants are replaced, loops and exceptions left out, and so on. The
tests of a module are run after each change, without compilation of kernels unless a part of the node starts. The score
is the fraction of changes with which a test fails, or does not end; equivalent changes count against it.
`--survivors` prints undetected ones. Of more than `--most` changes of a module, this many are tried, drawn with
`--seed`.

Changes of `|` are left out, nearly all of which are in annotations that are never evaluated, and those of an operator
into a bitwise one, modulo or powers, which any test detects.
"""

from __future__ import annotations

import argparse
import contextlib
import json
import os
import random
import shlex
import shutil
import sqlite3
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
    'core/messages/rejections': ('core/messages/test_rejections',),
    'core/messages/rep117': ('core/messages/test_rep117', 'core/messages/test_pose_association'),
    'core/messages/robot_path': ('core/messages/test_robot_path',),
    'bags/choice': ('bags/test_topic_choice',),
    'bags/static_transforms': ('bags/test_static_transforms',),
    'node/background': ('node/test_background',),
    'node/deferred': ('node/test_deferred',),
    'node/em': ('node/test_em_worker',),
    'node/em_service': ('node/test_em_service',),
    'node/following': ('node/test_following_part',),
    'node/frames': ('node/test_frames',),
    'node/grid_message': ('node/test_map_publishers',),
    'node/sensor_silence': ('node/test_sensor_silence',),
    'node/intake': ('node/test_intake',),
    'node/journal_keeper': ('node/test_journal_keeper',),
    'node/losses': ('node/test_losses',),
    'node/map_publishers': ('node/test_map_publishers',),
    'node/map_updates': ('node/test_map_updates', '-k', 'not node_sends'),
    'node/online': ('node/test_online_worker',),
    'node/ros_parameters': ('node/test_ros_parameters',),
    'node/saver': ('node/test_saver',),
}
"""Modules, and the tests that must detect their changes, with options of pytest; each takes seconds."""

LEFT_OUT = [
    'core/ReplaceBinaryOperator_BitOr_.*',
    'core/ReplaceBinaryOperator_.*_(Mod|Pow|FloorDiv|RShift|LShift|BitOr|BitAnd|BitXor)',
    'core/ReplaceUnaryOperator_.*_Invert',
    'core/ReplaceComparisonOperator_.*_(Is|IsNot)',
]
"""`|` is nearly always in annotations, which are never evaluated; any test detects the others."""

CONFIGURATION = """
[cosmic-ray]
module-path = "forward_grid_mapper/{module}.py"
timeout = {timeout:.1f}
excluded-modules = []
test-command = "{command}"

[cosmic-ray.distributor]
name = "local"

[cosmic-ray.filters.operators-filter]
exclude-operators = {left_out}
"""


def copy_of_checkout(folder: Path) -> None:
    """Copy the files that the tests need."""
    for name in ('forward_grid_mapper', 'test', 'benchmarks', 'config', 'docs', 'launch'):
        shutil.copytree(ROOT / name, folder / name, ignore=shutil.ignore_patterns('__pycache__', 'kernels_*'))
    for name in ('pyproject.toml', 'README.md', 'setup.py', 'setup.cfg', 'package.xml'):
        shutil.copy(ROOT / name, folder / name)


def draw(session: Path, most: int, seed: int) -> int:
    """Keep this many of the planned changes; return their number before."""
    with contextlib.closing(sqlite3.connect(session)) as database, database:
        found = database.execute(
            'select job_id from mutation_specs where job_id not in (select job_id from work_results) '
            'order by operator_name, occurrence, operator_args'
        ).fetchall()
        left_out = random.Random(seed).sample(found, max(len(found) - most, 0))
        for table in ('mutation_specs', 'work_items'):
            database.executemany(f'delete from {table} where job_id = ?', left_out)
    return len(found)


def changes_of(module: str, folder: Path, most: int, seed: int) -> tuple[int, list[tuple[bool, str]]]:
    """Return the number of changes of a module, and for each one tried whether it was detected, and its text."""
    configuration = folder / 'cosmic_ray.toml'
    session = folder / f'{module.replace("/", "_")}.sqlite'
    # sources change within a second and with the same size, which bytecode caches would not notice
    environment = {
        **os.environ,
        'PYTHONPATH': str(folder),
        'PYTHONDONTWRITEBYTECODE': '1',
        # a node compiles its kernels at its start; kernels are not changed
        'NUMBA_DISABLE_JIT': str(int(not module.startswith('node/'))),
        'NUMBA_CACHE_DIR': os.environ.get('NUMBA_CACHE_DIR', str(folder / 'kernels')),
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
    test += [f'test/{word}.py' if '/' in word else word for word in MODULES[module]]
    run(*test)
    begin = time.monotonic()
    run(*test)
    timeout = max(10.0, 4 * (time.monotonic() - begin))
    text = CONFIGURATION.format(module=module, command=shlex.join(test), left_out=json.dumps(LEFT_OUT), timeout=timeout)
    configuration.write_text(text, encoding='utf-8')
    run('cosmic-ray', 'init', configuration, session)
    run('cr-filter-operators', session, configuration)
    count = draw(session, most, seed)
    run('cosmic-ray', 'exec', configuration, session)
    found = []
    for line in run('cosmic-ray', 'dump', session).splitlines():
        item, result = json.loads(line)
        if result is not None and result['worker_outcome'] == 'normal':
            found.append((result['test_outcome'] == 'killed', result['diff'] or str(item)))
    return count, found


def main() -> None:
    """Print a row for each module."""
    parser = argparse.ArgumentParser(description=__doc__.partition('\n')[0])
    parser.add_argument('--only', nargs='+', choices=sorted(MODULES), default=list(MODULES), metavar='NAME')
    parser.add_argument('--most', type=int, default=sys.maxsize, help='changes of a module that are tried')
    parser.add_argument('--seed', type=int, default=0, help='they are drawn with')
    parser.add_argument('--survivors', action='store_true', help='print the changes that no test noticed')
    options = parser.parse_args()
    if shutil.which('cosmic-ray') is None:
        raise SystemExit('cosmic-ray is not on the path: pip install cosmic-ray')
    print(f'{"module":34s}{"changes":>9s}{"tried":>9s}{"detected":>9s}{"score":>8s}{"seconds":>9s}')
    total = tried = noticed = 0
    with tempfile.TemporaryDirectory() as name:
        folder = Path(name) / 'checkout'
        folder.mkdir()
        copy_of_checkout(folder)
        for module in options.only:
            begin = time.monotonic()
            count, found = changes_of(module, folder, options.most, options.seed)
            killed = sum(was_noticed for was_noticed, _ in found)
            total, tried, noticed = total + count, tried + len(found), noticed + killed
            score, seconds = killed / max(len(found), 1), time.monotonic() - begin
            print(f'{module:34s}{count:9d}{len(found):9d}{killed:9d}{score:8.0%}{seconds:9.0f}', flush=True)
            if options.survivors:
                print(*(change for was_noticed, change in found if not was_noticed), sep='\n', flush=True)
    print(f'{"all":34s}{total:9d}{tried:9d}{noticed:9d}{noticed / max(tried, 1):8.0%}')


if __name__ == '__main__':
    main()
