"""How much memory a run of EM takes without its pairs, and how much there is.

Linux grants more memory than it has and ends the process that uses it. A run that cannot fit must therefore not begin,
or it takes the readings and the live map with it.
"""

from __future__ import annotations

import resource
from collections.abc import Iterator
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

CGROUP, OWN_CGROUPS = Path('/sys/fs/cgroup'), Path('/proc/self/cgroup')
"""Where control groups are, and the file that names those of this process."""

NO_LIMIT = 1 << 60
"""A limit of so many bytes or more is none: v1 writes a large number."""


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
        f'EM of {readings} readings takes {_words(needed)}, and {_words(free)} are free; lower max_readings, use a '
        'coarser resolution, or call reset'
    )


def _of_the_machine() -> int | None:
    return _kilobytes(Path('/proc/meminfo'), 'MemAvailable:')


def _of_the_process() -> int | None:
    limit = resource.getrlimit(resource.RLIMIT_AS)[0]
    used = _kilobytes(Path('/proc/self/status'), 'VmSize:')
    return None if limit == resource.RLIM_INFINITY or used is None else limit - used


def _of_the_group() -> int | None:
    """Return how many bytes the control groups (v1 or v2) of this process leave, None if unlimited."""
    left = [_left_in(folder, *names) for folder, names in _groups()]
    return min((value for value in left if value is not None), default=None)


def _groups() -> Iterator[tuple[Path, tuple[str, str, str]]]:
    """Yield the folders of the control groups, and the names there of limit, use and reclaimable memory."""
    second = 'memory.max', 'memory.current', 'inactive_file'
    first = 'memory.limit_in_bytes', 'memory.usage_in_bytes', 'total_inactive_file'
    yield CGROUP, second
    yield CGROUP / 'memory', first
    try:
        lines = OWN_CGROUPS.read_text().splitlines()
    except OSError:
        return
    for line in lines:
        _, controllers, path = [*line.split(':', 2), '', ''][:3]
        names = second if not controllers else first if 'memory' in controllers.split(',') else None
        folder = Path(path.lstrip('/'))
        while names and folder.parts:
            yield CGROUP / ('memory' if controllers else '') / folder, names
            folder = folder.parent


def _left_in(folder: Path, limit: str, use: str, reclaimable: str) -> int | None:
    try:
        most, used = (folder / limit).read_text().strip(), int((folder / use).read_text())
        if most == 'max' or int(most) >= NO_LIMIT:
            return None
    except (OSError, ValueError):
        return None
    # the use includes the page cache, which the kernel can reclaim
    return int(most) - max(used - (_number(folder / 'memory.stat', reclaimable) or 0), 0)


def _kilobytes(path: Path, key: str) -> int | None:
    found = _number(path, key)
    return None if found is None else found * 1024


def _number(path: Path, key: str) -> int | None:
    """Return the number behind a key in a file that has one a line."""
    try:
        words = [line.split() for line in path.read_text().splitlines()]
        return next(int(line[1]) for line in words if len(line) > 1 and line[0] == key)
    except (OSError, StopIteration, ValueError):
        return None


def _words(size: float) -> str:
    """Return bytes in words."""
    return f'{size / 1e9:.1f} GB' if size >= 1e9 else f'{size / 1e6:.0f} MB'
