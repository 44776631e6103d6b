"""Common parts of benchmarks: the machine, settings, processes, memory, medians, and the bandwidth of memory."""

from __future__ import annotations

import gc
import multiprocessing
import os
import platform
import statistics
import time
from collections.abc import Callable
from concurrent.futures import ProcessPoolExecutor
from pathlib import Path
from typing import Any, TypeVar

import numba
import numpy as np

from forward_grid_mapper.core.common.parameters import CONSTANTS, Parameters
from forward_grid_mapper.core.common.readings import Readings
from forward_grid_mapper.core.mapping import Mapper
from forward_grid_mapper.core.maps.map_set import MapSet
from forward_grid_mapper.files.parameter_file import parse_setting

T = TypeVar('T')

PLAIN: dict[str, float] = {
    'surface_offset': 0.0,
    'max_incidence_angle': 1.5708,
    'end_cost': 0.0,
    'least_passed': 0.0,
    'likelihood_exponent': 1.0,
}
"""Parameters for which the search maximises only log p(Z | m) + logit(prior) x (occupied cells), over maps
without occupied cells on the paths of sensors."""

LITTLE = 0.1
"""Fraction of the machine that other processes may use during a run."""

PATIENCE = 'BENCHMARK_PATIENCE'
"""Environment variable with the seconds to wait for undisturbed runs, also for processes started by a benchmark."""


def machine() -> str:
    """Return processor, cores, memory, load and versions."""
    model = platform.processor() or platform.machine()
    for line in Path('/proc/cpuinfo').read_text().splitlines():
        if line.startswith('model name'):
            model = line.partition(': ')[2]
            break
    cache = Path('/sys/devices/system/cpu/cpu0/cache/index3/size')
    third = f', L3 {cache.read_text().strip()}' if cache.exists() else ''
    memory = os.sysconf('SC_PHYS_PAGES') * os.sysconf('SC_PAGE_SIZE') / 2**30
    return (
        f'{model}{third}, {os.cpu_count()} cores, {memory:.0f} GiB, {platform.system()} {platform.release()}, '
        f'load {os.getloadavg()[0]:.2f}\n'
        f'Python {platform.python_version()}, numpy {np.__version__}, numba {numba.__version__}'
    )


def setting(text: str) -> tuple[str, Any]:
    """Return the name and the value of `name=value`, of a parameter or of a constant of the model."""
    name, _, value = (part.strip() for part in text.partition('='))
    constants = {row.name: row for row in CONSTANTS}
    return (name, type(constants[name].default)(value)) if name in constants else parse_setting(text)


def in_own_process(work: Callable[..., T], *arguments: Any) -> T:
    """Return the result of `work` in a new process, so that its memory can be measured."""
    with ProcessPoolExecutor(1, mp_context=multiprocessing.get_context('spawn')) as pool:
        return pool.submit(work, *arguments).result()


class Others:
    """The fraction of the machine that other processes use from now on; needs Linux."""

    def __init__(self) -> None:
        self._all, self._own, self._begin = self._busy(), time.process_time(), time.perf_counter()

    @staticmethod
    def _busy() -> float:
        # user, nice, system, irq, softirq, steal
        fields = [int(field) for field in Path('/proc/stat').read_text().split('\n', 1)[0].split()[1:9]]
        return sum(fields[:3] + fields[5:]) / os.sysconf('SC_CLK_TCK')

    @property
    def share(self) -> float:
        """Fraction of all cores."""
        busy = self._busy() - self._all - (time.process_time() - self._own)
        return max(busy / (time.perf_counter() - self._begin) / (os.cpu_count() or 1), 0.0)


def undisturbed(work: Callable[[], T], runs: int) -> tuple[list[T], float]:
    """Return the results of the `runs` runs with the least use by other processes, and their largest such use.

    Runs are repeated until others used less than `LITTLE` of the machine in this many runs, or until PATIENCE seconds
    are over. So runs are selected by the use of others, never by their own duration.
    """
    done: list[tuple[float, int, T]] = []
    patience, begin = float(os.environ.get(PATIENCE, '0')), time.perf_counter()
    while len(done) < runs or (
        sum(share < LITTLE for share, _, _ in done) < runs and time.perf_counter() - begin < patience
    ):
        others = Others()
        result = work()
        done.append((others.share, len(done), result))
        if done[-1][0] >= LITTLE and patience:
            time.sleep(1.0)
    best = sorted(done, key=lambda row: row[:2])[:runs]
    return [result for _, _, result in best], best[-1][0]


def timed(work: Callable[[], object], runs: int) -> float:
    """Return the median duration of `work`, seconds."""

    def run() -> float:
        begin = time.perf_counter()
        work()
        return time.perf_counter() - begin

    return statistics.median(undisturbed(run, runs)[0])


class Timing(dict[str, float]):
    """Medians over runs, in seconds: each stage, and `total`, all except the standard map, which no other map needs.

    `maps` are those of the last run, `others` is the largest use of the machine by other processes.
    """

    def __init__(self, parameters: Parameters, readings: Readings, runs: int) -> None:
        super().__init__()
        self.maps: MapSet

        def run() -> dict[str, float]:
            begin = time.perf_counter()
            self.maps = Mapper(parameters).run(readings)
            seconds = dict(self.maps.statistics['seconds'])
            seconds['total'] = time.perf_counter() - begin - seconds['standard map']
            return seconds

        stages, self.others = undisturbed(run, runs)
        self.update({name: statistics.median(stage[name] for stage in stages) for name in stages[0]})


def memory_in_use() -> int:
    """Return the memory of this process, bytes."""
    return _status('VmRSS')


class PeakMemory:
    """The growth of this process's peak memory from now on; needs Linux."""

    def __init__(self) -> None:
        gc.collect()
        # resets the kernel's peak
        Path('/proc/self/clear_refs').write_text('5')
        self._before = _status('VmRSS')

    @property
    def growth(self) -> int:
        """Difference between the peak since then and the memory at that time, bytes."""
        return _status('VmHWM') - self._before


def _status(name: str) -> int:
    for line in Path('/proc/self/status').read_text().splitlines():
        if line.startswith(name + ':'):
            return 1024 * int(line.split()[1])
    raise LookupError(f'{name} is not in /proc/self/status')


@numba.njit(nogil=True)
def _sum(words: Any) -> Any:
    total = np.uint64(0)
    for k in range(len(words)):
        total += words[k]
    return total


def stream_seconds(size: float, runs: int) -> float:
    """Return the time to read this many bytes of memory once in sequence, on one core, seconds."""
    words = np.ones(max(int(size) // 8, 1), np.uint64)
    _sum(words)
    return timed(lambda: _sum(words), runs)
