"""The command that fills the cache of kernels."""

from __future__ import annotations

import os
import subprocess
import sys

import pytest

from forward_grid_mapper.core import warm_up

COMMAND = (sys.executable, '-m', 'forward_grid_mapper', 'warm_up')


def test_after_it_there_is_nothing_to_compile() -> None:
    for _ in range(2):
        done = subprocess.run(COMMAND, capture_output=True, text=True, check=True, env=dict(os.environ), timeout=600)
    assert 'nothing to compile' in done.stdout
    assert [line.split(' …')[0] for line in done.stdout.splitlines()[:3]] == [
        'kernels of the live map',
        'kernels of the online map',
        'kernels of the EM',
    ]


def test_the_live_map_needs_no_kernel_of_the_others(monkeypatch: pytest.MonkeyPatch) -> None:
    def refuse(*arguments: object, **options: object) -> None:
        raise AssertionError('not needed for the live map')

    monkeypatch.setattr(warm_up, 'OnlineMap', refuse)
    monkeypatch.setattr(warm_up, 'Mapper', refuse)
    warm_up.warm_up_live_map()
