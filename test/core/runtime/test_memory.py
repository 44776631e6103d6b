"""Whether EM fits the memory, before it begins."""

from __future__ import annotations

from pathlib import Path

import pytest

from forward_grid_mapper.core.common.parameters import Parameters
from forward_grid_mapper.core.mapping import Mapper
from forward_grid_mapper.core.runtime import memory
from forward_grid_mapper.core.runtime.memory import free_memory, least_memory, shortage
from forward_grid_mapper.simulation.drive import corridor_drive


def test_the_least_is_less_than_what_is_taken_and_not_by_much() -> None:
    readings = corridor_drive(0).readings
    maps = Mapper(Parameters()).run(readings)
    taken = maps.statistics['pairs'] * maps.statistics['bytes_per_pair']
    assert taken / 4 < least_memory(maps.grid.size, len(readings)) < taken


def test_what_is_free_is_known_and_bounded_by_the_group(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> None:
    free = free_memory()
    assert free is not None
    assert free > 10**6
    monkeypatch.setattr(memory, 'CGROUP', tmp_path)
    (tmp_path / 'memory.max').write_text('5000000\n')
    (tmp_path / 'memory.current').write_text('2000000\n')
    assert free_memory() == 3_000_000
    assert shortage(1000, 10) == ''
    assert '0.0 GB are free' in shortage(10**5, 12_000)
    (tmp_path / 'memory.max').write_text('max\n')
    assert shortage(10**5, 12_000) == ''
