"""The check before EM whether there is enough memory."""

from __future__ import annotations

import tracemalloc
from pathlib import Path

import pytest

from forward_grid_mapper.core.common.parameters import Parameters
from forward_grid_mapper.core.mapping import Mapper
from forward_grid_mapper.core.runtime import control_groups
from forward_grid_mapper.core.runtime import threads as runtime_threads
from forward_grid_mapper.core.runtime.memory import BYTES_A_CELL, THREAD_MEMORY, free_memory, least_memory, shortage
from forward_grid_mapper.simulation.drive import corridor_drive, door_drive
from forward_grid_mapper.simulation.sonar import NOISY


@pytest.mark.slow
@pytest.mark.parametrize('threads', [1, 2, 16])
@pytest.mark.parametrize('resolution', [0.1, 0.02])
def test_memory_of_a_run_is_between_half_and_all_of_the_estimate(
    monkeypatch: pytest.MonkeyPatch, threads: int, resolution: float
) -> None:
    monkeypatch.setattr(runtime_threads, 'LEAST_PART', 100)
    readings = (corridor_drive(0) if resolution == 0.1 else door_drive(3, NOISY)).readings
    parameters = Parameters.from_flat({'threads': threads, 'max_memory': 0, 'resolution': resolution})
    assert len(runtime_threads.parts(0, len(readings), threads)) == min(threads, len(readings) // 100)
    # first, so that compilation is not counted
    Mapper(parameters).run(readings.select(slice(0, 500)))
    tracemalloc.start()
    try:
        maps = Mapper(parameters).run(readings)
        taken = tracemalloc.get_traced_memory()[1]
    finally:
        tracemalloc.stop()
    estimated = least_memory(maps.grid.size, len(readings), threads)
    assert estimated / 2 < taken < estimated


def test_memory_of_threads_is_bounded_on_large_maps() -> None:
    assert least_memory(10**7, 0, 64) == least_memory(10**7, 0, 2) <= 10**7 * BYTES_A_CELL + THREAD_MEMORY
    assert least_memory(1000, 0, 3) - least_memory(1000, 0, 1) == 2 * 1000 * 32


def test_free_memory_is_bounded_by_the_control_group(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> None:
    free = free_memory()
    assert free is not None
    assert free > 10**6
    monkeypatch.setattr(control_groups, 'ROOT', tmp_path)
    (tmp_path / 'memory.max').write_text('5000000\n')
    (tmp_path / 'memory.current').write_text('2000000\n')
    assert free_memory() == 3_000_000
    assert shortage(1000, 10, 1) == ''
    assert '15 MB, and 3 MB are free' in shortage(10**5, 12_000, 1)
    (tmp_path / 'memory.max').write_text('max\n')
    assert shortage(10**5, 12_000, 1) == ''


@pytest.mark.parametrize('version', [1, 2])
def test_free_memory_in_a_group_includes_the_page_cache(
    monkeypatch: pytest.MonkeyPatch, tmp_path: Path, version: int
) -> None:
    limit, use, cached = (
        ('memory.limit_in_bytes', 'memory.usage_in_bytes', 'total_inactive_file'),
        ('memory.max', 'memory.current', 'inactive_file'),
    )[version - 1]
    root = tmp_path / 'cgroup'
    group = root / ('memory' if version == 1 else '') / 'system.slice' / 'mapper.service'
    group.mkdir(parents=True)
    own = tmp_path / 'own'
    own.write_text(
        '12:cpu,memory:/system.slice/mapper.service\n' if version == 1 else '0::/system.slice/mapper.service\n'
    )
    monkeypatch.setattr(control_groups, 'ROOT', root)
    monkeypatch.setattr(control_groups, 'OWN', own)
    machine = free_memory()
    assert machine is not None and machine > 10**7
    (group / limit).write_text('9000000\n')
    (group / use).write_text('8000000\n')
    assert free_memory() == 1_000_000
    (group / 'memory.stat').write_text(f'anon 1\n{cached} 6000000\n')
    assert free_memory() == 7_000_000
    # the limit of the parent slice counts as well
    (group.parent / limit).write_text('9000000\n')
    (group.parent / use).write_text('8500000\n')
    assert free_memory() == 500_000
    for folder in (group, group.parent):
        (folder / limit).write_text('9223372036854771712\n' if version == 1 else 'max\n')
    assert free_memory() > 10**7
