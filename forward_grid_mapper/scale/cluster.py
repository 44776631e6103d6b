"""Distribution by Dask: a cluster of processes on this machine, or an existing one, and tasks for it."""

from __future__ import annotations

import contextlib
import logging
import signal
import uuid
from collections.abc import Callable, Iterable, Iterator
from typing import Any

from ..core.common.errors import ClusterError, MapperError, OutputError
from .job import Job, check_versions, versions
from .starting import signals_later

PATIENCE = 10.0
"""Seconds in which a scheduler must answer."""

FIRST_WORKER = 60.0
"""Seconds in which the first worker of a scheduler must appear."""

SETTINGS = {
    # the data of workers are on disk already: nothing needs to be spilled, and no worker waits for memory
    'distributed.worker.memory.target': False,
    'distributed.worker.memory.spill': False,
    'distributed.worker.memory.pause': False,
    'distributed.worker.memory.terminate': 0.95,
    'distributed.scheduler.allowed-failures': 3,
    'distributed.comm.timeouts.connect': f'{PATIENCE:g}s',
    'distributed.admin.tick.limit': '1h',
}

Work = Callable[..., dict[str, Any]]


def _memory_of(dask_worker: Any) -> int:
    """Return the memory limit of a worker, bytes, 0 if none; Dask passes the worker."""
    return int(dask_worker.memory_manager.memory_limit or 0)


def _leave_interrupts() -> None:
    """Ignore Ctrl-C in workers, to which a terminal sends it as well: the client ends them without messages."""
    signal.signal(signal.SIGINT, signal.SIG_IGN)


class Cluster:
    """Workers of a scheduler, in a `with` block.

    Attributes
    ----------
    dashboard : str
        The address of Dask's dashboard.
    workers : int
        Their number at the start.
    memory : int
        Memory limit of the smallest one, bytes; 0 if there is none.
    """

    def __init__(self, workers: int, scheduler: str | None, memory: int) -> None:
        """Prepare.

        Parameters
        ----------
        workers : int
            Number of processes to start on this machine, without a scheduler.
        scheduler : str, optional
            Address of an existing one, with its own workers.
        memory : int
            Memory limit of a worker started here, bytes; one that exceeds it is ended, and its task is repeated.
        """
        self.workers, self._scheduler, self.memory = workers, scheduler, memory
        # several jobs may use one scheduler
        self._token = uuid.uuid4().hex
        self._open = contextlib.ExitStack()
        self.dashboard = ''

    def __enter__(self) -> Cluster:
        """Start workers, or connect to existing ones.

        Raises
        ------
        ClusterError
            If the scheduler cannot be reached or has no workers, or one of them has other versions.
        """
        import dask
        from distributed import Client, LocalCluster

        try:
            self._open.enter_context(dask.config.set(SETTINGS))
            # errors of tasks are reported by the client
            for name in ('distributed', 'tornado.application'):
                logging.getLogger(name).setLevel(logging.CRITICAL)
            address: Any = self._scheduler
            if address is None:
                with signals_later():
                    address = self._open.enter_context(
                        LocalCluster(
                            n_workers=self.workers,
                            threads_per_worker=1,
                            processes=True,
                            memory_limit=self.memory,
                            dashboard_address='127.0.0.1:0',
                            silence_logs=logging.CRITICAL,
                        )
                    )
            try:
                self._client = self._open.enter_context(Client(address, timeout=PATIENCE, set_as_default=False))
            except (OSError, ValueError, TimeoutError) as error:
                raise ClusterError(
                    f'no scheduler answers at {self._scheduler}: {error or "no response"}. Is the address right '
                    '(tcp://HOST:8786), and does "dask scheduler" run there?'
                ) from error
            if self._scheduler is None:
                # also for workers that start later
                self._client.register_worker_callbacks(_leave_interrupts)
            self._check()
        except BaseException:
            self._open.close()
            raise
        return self

    def __exit__(self, *unused: object) -> None:
        """End the workers that were started here, and drop all tasks of this job."""
        self._open.close()

    def _check(self) -> None:
        """Check the current workers."""
        try:
            self._client.wait_for_workers(1, timeout=FIRST_WORKER)
        except TimeoutError as error:
            raise ClusterError(f'the scheduler at {self._scheduler} has no workers; start some') from error
        self.dashboard = str(self._client.dashboard_link)
        try:
            self._client.get_versions(check=True)
            self._client.run(check_versions, versions())
        except ValueError as error:
            raise ClusterError(f'the workers do not have the packages of this machine: {error}') from error
        except ImportError as error:
            raise ClusterError(f'a worker lacks a package of this machine: {error}') from error
        limits = list(self._client.run(_memory_of).values())
        self.workers, self.memory = len(limits), min(filter(None, limits), default=0)

    def each(self, name: str, work: Work, job: Job, numbers: Iterable[int], *more: Any) -> Iterator[tuple[int, Any]]:
        """Run a task for each number; yield numbers and results, in the order of completion.

        If a worker dies, others repeat its tasks.

        Raises
        ------
        ClusterError
            If workers died repeatedly during a task, or the scheduler has ended.
        MapperError
            The error of a task.
        """
        from distributed import as_completed
        from distributed.scheduler import KilledWorker

        begun = {
            self._client.submit(work, job, k, *more, pure=False, key=f'{name}-{k}-{self._token}'): k for k in numbers
        }
        try:
            for future in as_completed(begun, loop=self._client.loop):
                number = begun[future]
                try:
                    yield number, future.result()
                except MapperError:
                    raise
                except KilledWorker as error:
                    raise ClusterError(
                        f'{name} {number} ended its worker more than '
                        f'{SETTINGS["distributed.scheduler.allowed-failures"]} times: most likely it has too little '
                        'memory. Give it more (--memory-per-worker), or make tiles smaller (--tiles)'
                    ) from error
                except MemoryError as error:
                    raise ClusterError(
                        f'{name} {number}: its worker has too little memory; give it more (--memory-per-worker), or '
                        'make tiles smaller (--tiles)'
                    ) from error
                except OSError as error:
                    raise OutputError(f'{name} {number}: {error}') from error
                except Exception as error:
                    if type(error).__module__.startswith('distributed'):
                        raise ClusterError(f'{name} {number}: {type(error).__name__}: {error}') from error
                    raise
                finally:
                    future.release()
        finally:
            with contextlib.suppress(Exception):
                self._client.cancel(list(begun), force=True)
