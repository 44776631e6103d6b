"""Parallel work on all cores: kernels release the GIL, so plain threads are enough."""

from __future__ import annotations

import itertools
import os
from collections.abc import Callable
from concurrent.futures import ThreadPoolExecutor

LEAST_PART = 5000
"""Fewest readings for which another thread saves time."""


def cores() -> int:
    """Return the number of cores that this process may use."""
    return len(os.sched_getaffinity(0)) if hasattr(os, 'sched_getaffinity') else os.cpu_count() or 1


def parts(begin: int, end: int, threads: int) -> list[tuple[int, int]]:
    """Divide a range of readings into at most `threads` parts of equal length, each of at least LEAST_PART."""
    n = max(min(threads, (end - begin) // LEAST_PART), 1)
    edges = [begin + (end - begin) * k // n for k in range(n + 1)]
    return list(itertools.pairwise(edges))


def run_each(work: list[Callable[[], None]]) -> None:
    """Run each of `work` in its own thread, and wait for all; raise the exception of the first one that failed."""
    if len(work) == 1:
        work[0]()
        return
    with ThreadPoolExecutor(len(work)) as pool:
        for done in [pool.submit(job) for job in work]:
            done.result()
