"""EM in the background: one run at a time, in a thread whose kernels leave the GIL to the node."""

from __future__ import annotations

import threading
import time
from collections.abc import Callable
from dataclasses import dataclass, field
from typing import Any

import numpy as np
from numpy.typing import NDArray

from ..core.common.errors import Cancelled, InputError, MapperError
from ..core.common.grid import Grid
from ..core.common.parameters import Parameters
from ..core.common.readings import Readings
from ..core.learning.input_warnings import input_warnings
from ..core.mapping import Mapper
from ..core.maps.log_odds_map import map_grid
from ..core.maps.map_set import MapSet
from ..core.runtime.memory import shortage
from ..core.runtime.threads import cores
from ..core.search.search import Progress
from ..files.quality_warning import quality_warning


@dataclass
class Outcome:
    """How a run ended: `maps`, or None and the reason in `message`; `warnings` say what is wrong with the readings."""

    maps: MapSet | None
    message: str
    warnings: list[str] = field(default_factory=list)


@dataclass
class Run:
    """One run of EM, from map `start` or from the empty one.

    `stage` and `progress` say where it stands; `finished` is set after `done` was called.
    """

    mapper: Mapper
    readings: Readings
    start: tuple[Grid, NDArray[np.int8]] | None = None
    begin: float = field(default_factory=time.monotonic)
    stage: str = 'starting'
    progress: Progress | None = None
    finished: threading.Event = field(default_factory=threading.Event)
    thread: threading.Thread | None = None

    @property
    def seconds(self) -> float:
        """Seconds since the run began."""
        return time.monotonic() - self.begin

    def __str__(self) -> str:
        text = f'{self.stage} of {len(self.readings)} readings, {self.seconds:.1f} s'
        if self.progress:
            p = self.progress
            text += f', iteration {p.iterations}, {p.flips} flips, {p.gain:.0f} nats gained'
        return text


class EmWorker:
    """Runs EM on snapshots of the readings, one at a time."""

    def __init__(self, watch: Callable[[Run], None], log: Callable[[str], Any]) -> None:
        """`watch` is called at every stage and iteration, in the run's thread; `log` takes errors no user caused."""
        self._watch, self._log = watch, log
        self._lock = threading.Lock()
        self._run: Run | None = None

    @property
    def current(self) -> Run | None:
        """The run that goes on, or None."""
        run = self._run
        return run if run is not None and not run.finished.is_set() else None

    def start(
        self,
        readings: Readings,
        parameters: Parameters,
        done: Callable[[Outcome], None],
        start: tuple[Grid, NDArray[np.int8]] | None = None,
    ) -> Run | None:
        """Begin a run; `done` is called in its thread. Return None if one goes on already."""
        with self._lock:
            if self.current is not None:
                return None
            run = Run(Mapper(parameters), readings, start)
            run.thread = threading.Thread(target=self._work, args=(run, parameters, done), name='em', daemon=True)
            self._run = run
        run.thread.start()
        return run

    def cancel(self, wait: float = 0.0) -> None:
        """Cancel the run that goes on, if any, and give it `wait` seconds to end."""
        run = self.current
        if run is not None:
            run.mapper.cancel()
            run.finished.wait(wait)

    def _work(self, run: Run, parameters: Parameters, done: Callable[[Outcome], None]) -> None:
        def watch(stage: str, progress: Progress | None) -> None:
            run.stage, run.progress = stage, progress
            self._watch(run)

        try:
            cells = map_grid(run.readings, parameters).size
            if lack := shortage(cells, len(run.readings), parameters.search.threads or cores()):
                raise InputError(lack)
            outcome = Outcome(run.mapper.run(run.readings, watch, run.start), '', input_warnings(run.readings))
        except Cancelled:
            outcome = Outcome(None, 'EM was cancelled')
        except MapperError as error:
            outcome = Outcome(None, str(error))
        except MemoryError:
            outcome = Outcome(
                None, f'EM of {len(run.readings)} readings does not fit the memory; reset, or use a coarser resolution'
            )
        except Exception as error:
            # a run must never take the live map with it
            self._log(f'EM failed: {error!r}')
            outcome = Outcome(None, f'EM failed: {error!r}')
        # whoever learns that the run has ended may start the next
        self._run = None
        try:
            done(outcome)
        finally:
            run.finished.set()


def summary(maps: MapSet, seconds: float) -> str:
    """Return a run's result in one line."""
    s = maps.statistics
    return (
        f'{len(maps.readings)} readings, {s["iterations"]} iterations, log-likelihood {maps.log_likelihood:.1f}, '
        f'objective {maps.objective:.1f}, {s["flips"]} flips, {s["shifts"]} shifts, {s["occupied"]} occupied cells, '
        f'{seconds:.2f} seconds'
        + ('' if s['converged'] else ', NOT converged: raise max_iterations')
        + (f'; BUT {warning}' if (warning := quality_warning(maps)) else '')
    )
