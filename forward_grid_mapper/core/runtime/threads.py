"""Parallel work on all cores: kernels release the GIL, so plain threads are enough."""

from __future__ import annotations

import itertools
import math
import os
from collections import deque
from collections.abc import Callable, Iterable, Iterator
from concurrent.futures import Future, ThreadPoolExecutor, wait
from pathlib import Path
from typing import TypeVar

from .control_groups import control_groups

T = TypeVar('T')

LEAST_PART = 5000
"""Fewest readings for which another thread saves time."""


def cores() -> int:
    """Return the number of cores that this process may use, by its affinity and by the limits of its control groups.

    With more threads than a container may use at once, the kernel would stop all threads of the process from time to
    time, also those that receive messages.
    """
    available = len(os.sched_getaffinity(0)) if hasattr(os, 'sched_getaffinity') else os.cpu_count() or 1
    limits = (_cores_of(folder, version) for folder, version in control_groups('cpu'))
    return max(min([available, *(math.floor(limit) for limit in limits if limit is not None)]), 1)


def _cores_of(folder: Path, version: int) -> float | None:
    """Return the limit of cores of a control group; None if there is none."""
    try:
        if version == 1:
            quota, period = ((folder / f'cpu.cfs_{name}_us').read_text() for name in ('quota', 'period'))
        else:
            quota, period = (folder / 'cpu.max').read_text().split()
        # no limit is -1 in version 1, and max, which is no number, in version 2
        return int(quota) / int(period) if int(quota) > 0 else None
    except (OSError, ValueError, ZeroDivisionError):
        return None


def parts(begin: int, end: int, threads: int) -> list[tuple[int, int]]:
    """Divide a range of readings into at most `threads` parts of equal length, each of at least LEAST_PART."""
    n = max(min(threads, (end - begin) // LEAST_PART), 1)
    edges = [begin + (end - begin) * k // n for k in range(n + 1)]
    return list(itertools.pairwise(edges))


def run_each(work: list[Callable[[], None]], pool: ThreadPoolExecutor) -> None:
    """Run each of `work` in a thread of the pool, and wait for all; raise the exception of the first one that failed.

    The pool needs a thread for each. Single work runs in the calling thread, and so does work for which the system
    starts no thread. No work runs any more when this returns or raises, not even after Ctrl-C: callers then restore the
    state that it changes.
    """
    if len(work) == 1:
        work[0]()
        return
    # not those of the pool: if it cannot start a thread, it keeps the work, and would run it at any later time
    ends: list[Future[None]] = [Future() for _ in work]
    errors: dict[int, BaseException] = {}
    try:
        try:
            for k, job in enumerate(work):
                pool.submit(_run, job, ends[k], k, errors)
        except (RuntimeError, MemoryError):
            for job, end in zip(work, ends, strict=True):
                if end.cancel():
                    job()
        wait([end for end in ends if not end.cancelled()])
    finally:
        wait([end for end in ends if not end.cancel()])
    first = errors[min(errors)] if errors else None
    # tracebacks refer to the work: in a cycle, they would keep the evidence and its threads
    errors.clear()
    try:
        if first is not None:
            raise first
    finally:
        del first


def _run(job: Callable[[], None], end: Future[None], k: int, errors: dict[int, BaseException]) -> None:
    """Run job k unless its end is cancelled; note its error, and tell its end."""
    if not end.set_running_or_notify_cancel():
        return
    try:
        job()
    except BaseException as error:
        errors[k] = error
    end.set_result(None)


def in_order(work: Iterable[Callable[[], T]], threads: int) -> Iterator[T]:
    """Run each of `work` on so many threads, and yield the results in the order of `work`.

    At most two results for each thread are kept before they are asked for. With one thread, work runs in the calling
    one, and so does work for which the system starts no thread; another thread may then run it as well, so it must not
    change anything. If work fails, its exception is raised in the place of its result. After that, or if the iteration
    ends early, no more work begins.
    """
    if threads <= 1:
        for job in work:
            yield job()
        return
    pool, ahead = ThreadPoolExecutor(threads), deque[Future[T]]()
    try:
        for job in work:
            ahead.append(_begun(job, pool))
            if len(ahead) == 2 * threads:
                yield ahead.popleft().result()
        while ahead:
            yield ahead.popleft().result()
    finally:
        pool.shutdown(cancel_futures=True)


def _begun(job: Callable[[], T], pool: ThreadPoolExecutor) -> Future[T]:
    """Return the result of a job, which a thread of the pool computes, or this one if the system starts none."""
    try:
        return pool.submit(job)
    except (RuntimeError, MemoryError):
        done = Future[T]()
        done.set_result(job())
        return done
