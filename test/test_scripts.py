"""scripts/: they make an environment that works or say why not, and leave the caller where he is."""

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
    """Somebody in a folder of his own who runs scripts of ours, with an interpreter that only pretends."""

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
    def asked(self) -> list[str]:
        return self.log.read_text().splitlines()

    @property
    def made(self) -> int:
        """How many environments were made in the last run."""
        return sum('|-m venv ' in line for line in self.asked)


@pytest.fixture
def caller(tmp_path: Path) -> Caller:
    return Caller(tmp_path)


def test_the_environment_is_made_once(caller: Caller) -> None:
    assert caller.run('demo').returncode == 0
    assert caller.made == 1
    assert caller.run('demo').returncode == 0
    assert caller.made == 0
    assert not any('pip install' in line for line in caller.asked)


def test_a_command_runs_where_its_caller_is(caller: Caller) -> None:
    assert caller.run('demo', '-o', 'out').returncode == 0
    assert caller.asked[-1] == f'{caller.folder}|-m forward_grid_mapper demo -o out'


def test_tests_run_in_the_checkout(caller: Caller) -> None:
    assert caller.run('test', '-k', 'one').returncode == 0
    assert caller.asked[-1] == f'{ROOT}|-m pytest -n 2 --dist loadfile --no-loadscope-reorder -k one'


def test_a_python_without_venv_is_named_with_the_remedy_and_leaves_nothing(caller: Caller) -> None:
    failed = caller.run('demo', VENV_FAILS='1')
    assert failed.returncode != 0
    assert 'ensurepip is not available' in failed.stderr
    assert 'sudo apt install python3-venv' in failed.stderr
    assert not caller.venv.exists()
    assert caller.run('demo').returncode == 0


def test_an_environment_that_is_half_made_is_made_anew(caller: Caller) -> None:
    (caller.venv / 'bin').mkdir(parents=True)
    (caller.venv / 'pyvenv.cfg').touch()
    (caller.venv / 'bin' / 'python').symlink_to('/bin/false')
    assert caller.run('demo').returncode == 0
    assert caller.made == 1


def test_another_python_than_that_of_the_environment_makes_it_anew(caller: Caller) -> None:
    assert caller.run('demo').returncode == 0
    (caller.venv / 'bin' / 'python').write_text(PYTHON.replace('${VERSION:-3.12.1}', '3.10.2'))
    assert caller.run('demo').returncode == 0
    assert caller.made == 1


def test_a_folder_that_is_no_environment_is_left_alone(caller: Caller) -> None:
    caller.venv.mkdir()
    (caller.venv / 'thesis.tex').touch()
    failed = caller.run('demo')
    assert failed.returncode != 0
    assert 'is no virtual environment' in failed.stderr
    assert (caller.venv / 'thesis.tex').exists()


def test_without_a_network_a_few_lines_say_so(caller: Caller) -> None:
    failed = caller.run('demo', NO_NETWORK='1')
    assert failed.returncode != 0
    assert 'No matching distribution found' in failed.stderr
    assert 'is there a network?' in failed.stderr
    assert len(failed.stderr.splitlines()) < 10
    assert caller.run('demo').returncode == 0
