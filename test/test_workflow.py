"""The workflow for forges with containers: it follows the README, and names no host."""

from __future__ import annotations

import re
import shlex
import subprocess
from pathlib import Path
from typing import Any

import pytest
import yaml

from forward_grid_mapper.__main__ import COMMANDS

ROOT = Path(__file__).resolve().parents[1]
FILE = ROOT / '.github' / 'workflows' / 'jazzy.yaml'


@pytest.fixture(scope='module')
def job() -> dict[str, Any]:
    (job,) = yaml.safe_load(FILE.read_text(encoding='utf-8'))['jobs'].values()
    return dict(job)


def commands(job: dict[str, Any]) -> list[list[str]]:
    """The words of all command lines."""
    scripts = [step['run'].replace('\\\n', ' ') for step in job['steps'] if 'run' in step]
    return [shlex.split(line) for script in scripts for line in script.splitlines() if line]


def test_workflow_uses_the_jazzy_image_and_names_no_host(job: dict[str, Any]) -> None:
    assert job['container'] == 'ros:jazzy'
    text = FILE.read_text(encoding='utf-8')
    assert '://' not in text
    assert not re.search(r'\b[\w-]+\.(?:org|com|io|net)\b', text)
    assert [step['uses'] for step in job['steps'] if 'uses' in step] == ['actions/checkout@v4']


def test_all_scripts_are_valid_bash(job: dict[str, Any]) -> None:
    assert job['defaults']['run']['shell'] == 'bash'
    for step in job['steps']:
        if 'run' in step:
            subprocess.run(['bash', '-n'], input=step['run'], text=True, check=True)


def test_workflow_installs_and_builds_like_the_readme(job: dict[str, Any]) -> None:
    readme = (ROOT / 'README.md').read_text(encoding='utf-8')
    lines = [
        shlex.split(line)
        for line in re.findall(
            r'^    ((?:rosdep install|pip install --break|colcon build|source install).*)$', readme, re.M
        )
    ]
    assert len(lines) >= 4
    assert all(line in commands(job) for line in lines if line != ['source', 'install/setup.bash'])
    # the package is in the folder given in the README
    (checkout,) = (step['with'] for step in job['steps'] if 'uses' in step)
    assert checkout['path'] == 'src/forward_grid_mapper'


def test_commands_of_the_workflow_are_installed(job: dict[str, Any]) -> None:
    ran = [line for line in commands(job) if line[:3] == ['ros2', 'run', 'forward_grid_mapper']]
    assert {line[3] for line in ran} <= set(COMMANDS)
    assert any(line[3] == 'mapper' for line in ran)
    launched = [line[3] for line in commands(job) if line[:2] == ['ros2', 'launch']]
    assert launched and all((ROOT / 'launch' / name).is_file() for name in launched)


def test_pip_installs_the_keys_that_rosdep_skips_in_the_versions_of_setup(job: dict[str, Any]) -> None:
    (skipped,) = (line[-1].split() for line in commands(job) if line[:2] == ['rosdep', 'install'])
    (wanted,) = (line[3:] for line in commands(job) if line[:2] == ['pip', 'install'])
    assert [re.split('[<>]', each)[0] for each in wanted] == [
        key.removeprefix('python3-').removesuffix('-pip') for key in skipped
    ]
    assert all(each in (ROOT / 'setup.py').read_text(encoding='utf-8') for each in wanted)
