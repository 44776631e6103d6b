"""The command that compiles all kernels."""

from __future__ import annotations

import os
import subprocess
import sys
from pathlib import Path

import pytest

from forward_grid_mapper.core import warm_up

COMMAND = (sys.executable, '-m', 'forward_grid_mapper', 'warm_up')

COMPILED = 1100.0
"""Seconds within which all kernels are compiled, also on a busy machine."""


def test_second_warm_up_compiles_nothing() -> None:
    for _ in range(2):
        done = subprocess.run(
            COMMAND, capture_output=True, text=True, check=True, env=dict(os.environ), timeout=COMPILED
        )
    assert 'nothing to compile' in done.stdout
    assert [line.split(' …')[0] for line in done.stdout.splitlines()[:4]] == [
        'live map kernels',
        'online map kernels',
        'EM kernels',
        'trajectory kernels',
    ]


def test_this_file_runs_first(request: pytest.FixtureRequest) -> None:
    """`test/conftest.py` sorts it first, by its name."""
    assert request.session.items[0].path == Path(__file__)


SIGNATURES = """
import sys
from forward_grid_mapper.core.warm_up import warm_up
def signatures():
    return {
        (name, kernel, str(types))
        for name, module in list(sys.modules.items())
        if name.startswith('forward_grid_mapper.core.')
        for kernel, value in vars(module).items()
        for types in getattr(value, 'signatures', None) or []
    }
"""


@pytest.mark.slow
def test_refinement_after_warm_up_compiles_nothing() -> None:
    program = f"""{SIGNATURES}
warm_up()
before = signatures()
import numpy as np
from forward_grid_mapper.core.common.parameters import Parameters
from forward_grid_mapper.core.trajectory.refinement import Refiner
from forward_grid_mapper.core.trajectory.windows import Odometry
from forward_grid_mapper.simulation.drift import LEVELS, with_drift
from forward_grid_mapper.simulation.drive import drive
from forward_grid_mapper.simulation.sonar import NOISY, sonar_ring
from forward_grid_mapper.simulation.world import building_tour, building_world
made = with_drift(drive(building_world(), building_tour()[:10], 0.15, sonar_ring(16), NOISY, seed=3), LEVELS['high'], 6)
poses = np.array([m.pose for m in made.odometry], float)
from forward_grid_mapper.core.mapping import Mapper
Mapper(Parameters()).run(made.readings)
found = Refiner(Parameters()).run(made.readings, Odometry.of(np.array([m.stamp for m in made.odometry]), poses))
print(found.accepted, len(before) > 2, signatures() - before)
"""
    done = subprocess.run([sys.executable, '-c', program], capture_output=True, text=True, check=True, timeout=600)
    assert done.stdout.split() == ['True', 'True', 'set()'], done.stdout


def test_the_page_of_a_map_and_the_explanation_of_a_cell_need_no_more_kernels() -> None:
    """The node writes the page as well, when it saves maps."""
    program = f"""{SIGNATURES}
from forward_grid_mapper.core.common.parameters import Parameters
from forward_grid_mapper.core.maps.cell_evidence import cell_evidence, prior_odds
maps = warm_up()
before = signatures()
prior_odds(maps.grid, maps.ml, Parameters())
found = cell_evidence(maps.readings, maps.grid, maps.ml, Parameters(), maps.normals, (0.5, 0.5))
print(len(found.readings) > 0, len(before) > 2, [kernel for _, kernel, _ in signatures() - before])
"""
    done = subprocess.run([sys.executable, '-c', program], capture_output=True, text=True, check=True, timeout=600)
    assert done.stdout.split() == ['True', 'True', '[]'], done.stdout


def test_warm_up_of_the_live_map_compiles_no_other_kernels(monkeypatch: pytest.MonkeyPatch) -> None:
    def refuse(*arguments: object, **options: object) -> None:
        raise AssertionError('not needed for the live map')

    monkeypatch.setattr(warm_up, 'OnlineMap', refuse)
    monkeypatch.setattr(warm_up, 'Mapper', refuse)
    warm_up.warm_up_live_map()
