"""The scripts make a working environment or report why not, and do not change the working directory."""

from __future__ import annotations

import os
import subprocess
from pathlib import Path

import pytest

ROOT = Path(__file__).resolve().parents[1]

PYTHON = """#!/bin/bash
# stands for an interpreter: makes an environment of itself, and writes down what it is asked for
echo "$PWD|$*" >> "$ASKED"
case "$*" in
    *sys.exit*) exit 0 ;;
    *version_info*) echo "${VERSION:-3.12.1}" ;;
    '-m venv '*)
        mkdir -p "$3/bin"
        touch "$3/pyvenv.cfg"
        if [ "${VENV_FAILS:-}" ]; then
            ln -sf /bin/false "$3/bin/python"
            echo 'ensurepip is not available'
            exit 1
        fi
        sed "s/VERSION:-[0-9.]*/VERSION:-${VERSION:-3.12.1}/" "$0" > "$3/bin/python"
        chmod +x "$3/bin/python" ;;
    '-m pip install'*)
        if [ "${NO_NETWORK:-}" ]; then
            seq 30
            echo 'ERROR: No matching distribution found'
            exit 1
        fi ;;
esac
"""


class Caller:
    """A user in another folder who runs our scripts, with a fake interpreter."""

    def __init__(self, folder: Path) -> None:
        self.folder, self.venv, self.log = folder / 'here', folder / 'venv', folder / 'asked'
        self.folder.mkdir()
        self.python = folder / 'python'
        self.python.write_text(PYTHON)
        self.python.chmod(0o755)

    def run(self, script: str, *arguments: str, **environment: str) -> subprocess.CompletedProcess[str]:
        self.log.write_text('')
        given = {'PYTHON': str(self.python), 'VENV': str(self.venv), 'ASKED': str(self.log), **environment}
        return subprocess.run(
            ['bash', str(ROOT / 'scripts' / script), *arguments],
            cwd=self.folder,
            env={**os.environ, **given},
            capture_output=True,
            text=True,
            check=False,
        )

    @property
    def calls(self) -> list[str]:
        return self.log.read_text().splitlines()

    @property
    def made(self) -> int:
        """Number of environments made in the last run."""
        return sum('|-m venv ' in line for line in self.calls)


@pytest.fixture
def caller(tmp_path: Path) -> Caller:
    return Caller(tmp_path)


def test_environment_is_made_once(caller: Caller) -> None:
    assert caller.run('demo').returncode == 0
    assert caller.made == 1
    assert caller.run('demo').returncode == 0
    assert caller.made == 0
    assert not any('pip install' in line for line in caller.calls)


def test_command_runs_in_the_working_directory(caller: Caller) -> None:
    assert caller.run('demo', '-o', 'out').returncode == 0
    assert caller.calls[-1] == f'{caller.folder}|-m forward_grid_mapper demo -o out'


def test_tests_run_in_the_checkout(caller: Caller) -> None:
    assert caller.run('test', '-k', 'one').returncode == 0
    options = '-n 2 --dist loadfile --no-loadscope-reorder --max-worker-restart 0'
    assert caller.calls[-1] == f'{ROOT}|-m pytest {options} -k one'


def test_missing_venv_is_reported_with_a_remedy(caller: Caller) -> None:
    failed = caller.run('demo', VENV_FAILS='1')
    assert failed.returncode != 0
    assert 'ensurepip is not available' in failed.stderr
    assert 'sudo apt install python3-venv' in failed.stderr
    assert not caller.venv.exists()
    assert caller.run('demo').returncode == 0


def test_incomplete_environment_is_replaced(caller: Caller) -> None:
    (caller.venv / 'bin').mkdir(parents=True)
    (caller.venv / 'pyvenv.cfg').touch()
    (caller.venv / 'bin' / 'python').symlink_to('/bin/false')
    assert caller.run('demo').returncode == 0
    assert caller.made == 1


def test_environment_of_another_python_is_replaced(caller: Caller) -> None:
    assert caller.run('demo').returncode == 0
    (caller.venv / 'bin' / 'python').write_text(PYTHON.replace('${VERSION:-3.12.1}', '3.10.2'))
    assert caller.run('demo').returncode == 0
    assert caller.made == 1


def test_folder_that_is_no_environment_is_kept(caller: Caller) -> None:
    caller.venv.mkdir()
    (caller.venv / 'thesis.tex').touch()
    failed = caller.run('demo')
    assert failed.returncode != 0
    assert 'is no virtual environment' in failed.stderr
    assert (caller.venv / 'thesis.tex').exists()


def test_missing_network_is_reported_in_a_few_lines(caller: Caller) -> None:
    failed = caller.run('demo', NO_NETWORK='1')
    assert failed.returncode != 0
    assert 'No matching distribution found' in failed.stderr
    assert 'is there a network?' in failed.stderr
    assert len(failed.stderr.splitlines()) < 10
    assert caller.run('demo').returncode == 0
