"""The memory that a run of EM needs without pairs, and the memory that is free.

Linux grants more memory than there is, and kills the process that uses it (overcommit). So a run that does not fit must
not begin, or readings and live map would be lost as well.
"""

from __future__ import annotations

import resource
from pathlib import Path

from ..common.parameters import Parameters
from ..common.words import counted
from .control_groups import control_groups

BYTES_A_READING = 400
"""Bytes of the search for each reading, without pairs; twice as much as stored, because arrays are sorted and grow."""

BYTES_A_CELL = 104
"""Bytes of a single-threaded run for each cell at its peak, when the final maps are made: three maps, evidence, prior,
and the sums for surface normals or passed readings."""

BYTES_A_CELL_AND_THREAD = 32
"""Bytes of each further thread for each cell at its peak: the four sums of passed readings."""

THREAD_MEMORY = 64_000_000
"""Most bytes of all threads but the first. On maps of some hundred thousand cells and more, arrays for all threads
would be more, so fewer threads are used; the maps are the same."""

NAMES = {
    1: ('memory.limit_in_bytes', 'memory.usage_in_bytes', 'total_inactive_file'),
    2: ('memory.max', 'memory.current', 'inactive_file'),
}
"""Names of limit, usage and reclaimable memory in a control group, by version."""

NO_LIMIT = 1 << 60
"""A limit of this many bytes or more means no limit: v1 has a large number."""


def least_memory(cells: int, readings: int, threads: int) -> int:
    """Return the bytes that EM needs at its peak, without pairs."""
    of_threads = min((threads - 1) * cells * BYTES_A_CELL_AND_THREAD, THREAD_MEMORY)
    return cells * BYTES_A_CELL + readings * BYTES_A_READING + of_threads


def memory_for_pairs(parameters: Parameters) -> float:
    """Return the bytes that pairs may take: the limit of the parameters, or half of the free memory if that is less."""
    free = free_memory()
    asked = parameters.search.max_memory * 1e6
    # half of it, since other processes need memory as well
    return asked if free is None else min(asked, free / 2)


def free_memory() -> int | None:
    """Return the bytes that this process can still allocate, by the machine, its control group, and its own limit.

    None if none of them is known.
    """
    known = [value for value in (_of_the_machine(), _of_the_group(), _of_the_process()) if value is not None]
    return max(min(known), 0) if known else None


def shortage(cells: int, readings: int, threads: int) -> str:
    """Return why EM of this many readings on this many cells does not fit into the memory; empty if it may."""
    free, needed = free_memory(), least_memory(cells, readings, threads)
    if free is None or needed <= free:
        return ''
    return (
        f'EM of {counted(readings, "reading")} takes {_words(needed)}, and {_words(free)} are free; lower '
        'max_readings, use a coarser resolution, or call reset'
    )


def _of_the_machine() -> int | None:
    return _kilobytes(Path('/proc/meminfo'), 'MemAvailable:')


def _of_the_process() -> int | None:
    limit = resource.getrlimit(resource.RLIMIT_AS)[0]
    used = _kilobytes(Path('/proc/self/status'), 'VmSize:')
    return None if limit == resource.RLIM_INFINITY or used is None else limit - used


def _of_the_group() -> int | None:
    """Return the free bytes in the control groups (v1 or v2) of this process; None if unlimited."""
    left = [_left_in(folder, *NAMES[version]) for folder, version in control_groups('memory')]
    return min((value for value in left if value is not None), default=None)


def _left_in(folder: Path, limit: str, use: str, reclaimable: str) -> int | None:
    try:
        most, used = (folder / limit).read_text().strip(), int((folder / use).read_text())
        if most == 'max' or int(most) >= NO_LIMIT:
            return None
    except (OSError, ValueError):
        return None
    # the usage includes the page cache, which the kernel can reclaim
    return int(most) - max(used - (_number(folder / 'memory.stat', reclaimable) or 0), 0)


def _kilobytes(path: Path, key: str) -> int | None:
    found = _number(path, key)
    return None if found is None else found * 1024


def _number(path: Path, key: str) -> int | None:
    """Return the number after a key in a file with one key on each line."""
    try:
        words = [line.split() for line in path.read_text().splitlines()]
        return next(int(line[1]) for line in words if len(line) > 1 and line[0] == key)
    except (OSError, StopIteration, ValueError):
        return None


def _words(size: float) -> str:
    """Return a number of bytes as text."""
    return f'{size / 1e9:.1f} GB' if size >= 1e9 else f'{size / 1e6:.0f} MB'
