"""Whether EM fits the memory, before it begins."""

from __future__ import annotations

import tracemalloc
from pathlib import Path

import pytest

from forward_grid_mapper.core.common.parameters import Parameters
from forward_grid_mapper.core.mapping import Mapper
from forward_grid_mapper.core.runtime import memory
from forward_grid_mapper.core.runtime import threads as runtime_threads
from forward_grid_mapper.core.runtime.memory import BYTES_A_CELL, THREAD_MEMORY, free_memory, least_memory, shortage
from forward_grid_mapper.simulation.drive import corridor_drive, door_drive
from forward_grid_mapper.simulation.sonar import NOISY


@pytest.mark.slow
@pytest.mark.parametrize('threads', [1, 2, 16])
@pytest.mark.parametrize('resolution', [0.1, 0.02])
def test_what_a_run_takes_is_what_it_is_said_to_take(
    monkeypatch: pytest.MonkeyPatch, threads: int, resolution: float
) -> None:
    monkeypatch.setattr(runtime_threads, 'LEAST_PART', 100)
    readings = (corridor_drive(0) if resolution == 0.1 else door_drive(3, NOISY)).readings
    parameters = Parameters.from_flat({'threads': threads, 'max_memory': 0, 'resolution': resolution})
    assert len(runtime_threads.parts(0, len(readings), threads)) == min(threads, len(readings) // 100)
    # first, so that compiling is not counted
    Mapper(parameters).run(readings.select(slice(0, 500)))
    tracemalloc.start()
    try:
        maps = Mapper(parameters).run(readings)
        taken = tracemalloc.get_traced_memory()[1]
    finally:
        tracemalloc.stop()
    told = least_memory(maps.grid.size, len(readings), threads)
    assert told / 2 < taken < told


def test_another_thread_takes_no_more_on_a_large_map() -> None:
    assert least_memory(10**7, 0, 64) == least_memory(10**7, 0, 2) <= 10**7 * BYTES_A_CELL + THREAD_MEMORY
    assert least_memory(1000, 0, 3) - least_memory(1000, 0, 1) == 2 * 1000 * 32


def test_what_is_free_is_known_and_bounded_by_the_group(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> None:
    free = free_memory()
    assert free is not None
    assert free > 10**6
    monkeypatch.setattr(memory, 'CGROUP', tmp_path)
    (tmp_path / 'memory.max').write_text('5000000\n')
    (tmp_path / 'memory.current').write_text('2000000\n')
    assert free_memory() == 3_000_000
    assert shortage(1000, 10, 1) == ''
    assert '0.0 GB are free' in shortage(10**5, 12_000, 1)
    (tmp_path / 'memory.max').write_text('max\n')
    assert shortage(10**5, 12_000, 1) == ''
