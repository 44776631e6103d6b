"""How much memory a run of EM takes without its pairs, and how much there is.

Linux grants more memory than it has and ends the process that uses it. A run that cannot fit must therefore not begin,
or it takes the readings and the live map with it.
"""

from __future__ import annotations

import resource
from pathlib import Path

from ..common.parameters import Parameters

BYTES_A_READING = 400
"""What the search keeps for a reading without its pairs, twice over where arrays are sorted or grow."""

BYTES_A_CELL = 104
"""What a run on one thread takes for a cell at its peak, when the maps are collected: three maps, the evidence, the
prior, and the sums that surface normals or passed readings are counted in."""

BYTES_A_CELL_AND_THREAD = 32
"""What another thread takes for a cell at its peak: the four sums of readings that passed."""

THREAD_MEMORY = 64_000_000
"""Bytes that all threads but the first may take together. Where an array for each of them would be more, on maps of
some hundred thousand cells and more, fewer threads work; the maps are the same."""

CGROUP = Path('/sys/fs/cgroup')


def least_memory(cells: int, readings: int, threads: int) -> int:
    """Return the bytes that EM of so many readings on so many cells takes at its peak, without memory for pairs."""
    of_threads = min((threads - 1) * cells * BYTES_A_CELL_AND_THREAD, THREAD_MEMORY)
    return cells * BYTES_A_CELL + readings * BYTES_A_READING + of_threads


def memory_for_pairs(parameters: Parameters) -> float:
    """Return the bytes that pairs may take: what the parameters admit, or what is free if that is less."""
    free = free_memory()
    asked = parameters.search.max_memory * 1e6
    # half of it, since others live here as well
    return asked if free is None else min(asked, free / 2)


def free_memory() -> int | None:
    """Return the bytes that this process can still take: of the machine, its control group, and its own limit.

    None where none of them is known.
    """
    known = [value for value in (_of_the_machine(), _of_the_group(), _of_the_process()) if value is not None]
    return max(min(known), 0) if known else None


def shortage(cells: int, readings: int, threads: int) -> str:
    """Return why EM of so many readings on so many cells cannot fit the memory; empty if it may."""
    free, needed = free_memory(), least_memory(cells, readings, threads)
    if free is None or needed <= free:
        return ''
    return (
        f'EM of {readings} readings takes {needed / 1e9:.1f} GB at the least, and {free / 1e9:.1f} GB are free; '
        f'lower max_readings, use a coarser resolution, or reset'
    )


def _of_the_machine() -> int | None:
    return _kilobytes(Path('/proc/meminfo'), 'MemAvailable:')


def _of_the_process() -> int | None:
    limit = resource.getrlimit(resource.RLIMIT_AS)[0]
    used = _kilobytes(Path('/proc/self/status'), 'VmSize:')
    return None if limit == resource.RLIM_INFINITY or used is None else limit - used


def _of_the_group() -> int | None:
    try:
        limit = (CGROUP / 'memory.max').read_text().strip()
        used = int((CGROUP / 'memory.current').read_text())
        return None if limit == 'max' else int(limit) - used
    except (OSError, ValueError):
        return None


def _kilobytes(path: Path, key: str) -> int | None:
    try:
        line = next(line for line in path.read_text().splitlines() if line.startswith(key))
        return int(line.split()[1]) * 1024
    except (OSError, StopIteration, ValueError, IndexError):
        return None
