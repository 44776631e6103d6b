"""The folder of compiled kernels, also for read-only installations and home folders."""

from __future__ import annotations

import os
import shutil
import subprocess
import sys
import tempfile
import time
from pathlib import Path

import pytest

PACKAGE = Path(__file__).resolve().parents[3] / 'forward_grid_mapper'
PROGRAM = """
import numpy as np
from forward_grid_mapper.core.evidence import fixed_point
from forward_grid_mapper.core.runtime import compiling, jit
room, out = fixed_point.ratio_workspace_for(1), np.ones(4, np.int32)
room.ratio[:] = 1.0
fixed_point.quantise_logs(room, 1, out)
assert out[0] == 0
print(compiling.count(), jit.CACHE, fixed_point.__file__)
"""
"""Calls one small kernel; all kernels are kept in the same folder."""


def run(install: Path, temporary: Path) -> tuple[int, Path]:
    """Call a kernel with a copy of the package; return how many compilations that took, and the folder of kernels."""
    changes = {'PYTHONPATH': str(install), 'HOME': '/dev/null', 'TMPDIR': str(temporary), 'XDG_CACHE_HOME': ''}
    environment = {k: v for k, v in os.environ.items() if k != 'NUMBA_CACHE_DIR'} | changes
    done = subprocess.run(
        [sys.executable, '-c', PROGRAM], env=environment, capture_output=True, text=True, check=True, cwd=install
    )
    count, cache, file = done.stdout.split()
    assert Path(file).is_relative_to(install), 'another copy of the package ran'
    assert list(Path(cache).rglob('*quantise_logs*.nbc')), 'the kernel was not kept'
    return int(count), Path(cache)


@pytest.fixture
def install(tmp_path: Path) -> Path:
    folder = tmp_path / 'install'
    shutil.copytree(PACKAGE, folder / PACKAGE.name, ignore=shutil.ignore_patterns('__pycache__'))
    return folder


def test_read_only_install_and_home_use_a_temporary_folder(install: Path, tmp_path: Path) -> None:
    # a file with the name of the folder: even root cannot make the folder
    (install / PACKAGE.name / 'core' / '__pycache__').write_text('')
    temporary = tmp_path / 'temporary'
    temporary.mkdir()
    first, cache = run(install, temporary)
    assert cache.is_relative_to(temporary)
    again, _ = run(install, temporary)
    assert first > 0 and again == 0


def test_kernels_are_beside_the_sources_and_renewed_on_any_change(install: Path) -> None:
    temporary = Path(tempfile.gettempdir())
    _, before = run(install, temporary)
    assert before.parent == install / PACKAGE.name / 'core' / '__pycache__'
    with (install / PACKAGE.name / 'core' / 'sensor' / 'cone.py').open('a') as file:
        file.write('\n# changed\n')
    _, after = run(install, temporary)
    assert after != before


def test_kernels_of_other_sources_are_deleted_after_a_day(install: Path) -> None:
    beside = install / PACKAGE.name / 'core' / '__pycache__'
    old, recent = beside / 'kernels_old', beside / 'kernels_recent'
    for folder in (old, recent):
        folder.mkdir(parents=True)
    day_ago = time.time() - 25 * 3600
    os.utime(old, (day_ago, day_ago))
    _, cache = run(install, Path(tempfile.gettempdir()))
    assert cache.parent == beside
    assert not old.exists()
    assert recent.exists()
