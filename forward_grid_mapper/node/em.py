"""EM in the background: one run at a time, in a thread whose kernels leave the GIL to the node."""

from __future__ import annotations

import time
from collections.abc import Callable
from contextlib import suppress
from dataclasses import dataclass, field

import numpy as np
from numpy.typing import NDArray

from ..core.common.errors import Cancelled, InputError, MapperError
from ..core.common.grid import Grid
from ..core.common.parameters import Parameters
from ..core.common.readings import Readings
from ..core.learning.input_warnings import input_warnings
from ..core.learning.sensor_health import SensorHealth, sensor_health
from ..core.mapping import Mapper
from ..core.maps.log_odds_map import map_grid
from ..core.maps.map_set import MapSet
from ..core.runtime.memory import shortage
from ..core.runtime.threads import cores
from ..core.search.search import Progress
from ..files.quality_warning import deaf, quality_warning
from .background import Worker, reason
from .refining import RefiningMapper


@dataclass
class Outcome:
    """How a run ended: `maps`, or None and the reason in `message`.

    `warnings` say what is wrong with the readings, `health` how each sensor does, `trajectory` what became of it,
    `waited` the seconds that went by until kernels were compiled.
    """

    maps: MapSet | None
    message: str
    trajectory: str = ''
    warnings: list[str] = field(default_factory=list)
    health: dict[str, SensorHealth] = field(default_factory=dict)
    waited: float = 0.0


@dataclass
class Run:
    """One run of EM on what `readings` returns, from map `start` or from the empty one.

    `stage` and `progress` say where it stands. `found` is called with the maps as soon as they are there, in the
    thread. `shown` says whether the map so far was published, `asked` whether somebody asked for its end alone.
    `by_itself` says whether nobody has asked for it so far, `fresh` whether it looks at all that there is by now. In
    `then` is who waits for the run after it.
    """

    mapper: Mapper | RefiningMapper
    parameters: Parameters
    readings: Callable[[], Readings]
    found: Callable[[MapSet], object] = lambda maps: None
    start: tuple[Grid, NDArray[np.int8]] | None = None
    begin: float = field(default_factory=time.monotonic)
    stage: str = 'starting'
    count: int = 0
    progress: Progress | None = None
    cancelled: bool = False
    shown: bool = False
    asked: bool = False
    by_itself: bool = False
    fresh: Callable[[], bool] = lambda: True
    then: list[Callable[[Outcome], object]] = field(default_factory=list)
    waiting: list[Callable[[Outcome], object]] = field(default_factory=list)

    @property
    def seconds(self) -> float:
        """Seconds since the run began."""
        return time.monotonic() - self.begin

    def __str__(self) -> str:
        text = f'{self.stage} of {self.count} readings, {self.seconds:.1f} s'
        if self.progress:
            p = self.progress
            text += f', iteration {p.iterations}, {p.flips} flips, {p.gain:.0f} nats gained'
        return text + (', being cancelled' if self.cancelled else '')


class EmWorker:
    """Runs EM on snapshots of the readings, one at a time; all methods return at once, and are called by one thread.

    Attributes
    ----------
    current : Run or None
        The run that goes on; there is no other until its thread has done everything for it.
    """

    def __init__(
        self,
        watch: Callable[[Run], object],
        log: Callable[[str], object],
        conclude: Callable[[Callable[[], None]], object],
        prepare: Callable[[Callable[[], bool]], None] = lambda stop: None,
    ) -> None:
        """Begin without a run.

        Parameters
        ----------
        watch : callable
            Takes the run at every stage and iteration, in the run's thread.
        log : callable
            Takes errors no user caused.
        conclude : callable
            Takes a function and has the thread that calls the methods call it.
        prepare : callable
            Called in the thread before the first run, and given what says whether to stop.
        """
        self.worker = Worker('EM', log)
        self._log = log
        self.current: Run | None = None
        self._watch, self._conclude, self._prepare = watch, conclude, prepare

    def start(self, run: Run, done: Callable[[Outcome], object]) -> bool:
        """Begin a run; `done` is called when it has ended. Return whether it began: it does not while one goes on."""
        if self.current is not None:
            return False
        run.waiting.append(done)
        self.current = run
        self.worker.put(lambda: self._work(run), lambda why: self._end(run, Outcome(None, f'EM failed: {why}')))
        return True

    def cancel(self) -> None:
        """Cancel the run that goes on, if any."""
        run = self.current
        if run is not None:
            run.cancelled = True
            run.mapper.cancel()

    def close(self, seconds: float) -> None:
        """Cancel the run that goes on, and wait so long for its end."""
        self.cancel()
        self.worker.close(seconds)

    def _work(self, run: Run) -> None:
        """Do all that a run does; whatever is raised here and not expected, the worker reports."""
        outcome = self._outcome(run)
        if outcome.maps is not None:
            run.found(outcome.maps)
            run.stage, run.progress = 'judging sensors', None
            self._judge(run, outcome, outcome.maps)
        self._end(run, outcome)

    def _judge(self, run: Run, outcome: Outcome, maps: MapSet) -> None:
        """Add what the maps say of sensors and readings; the maps are good without it."""
        try:
            outcome.health = sensor_health(maps)
            outcome.warnings = [*deaf(maps.readings), *input_warnings(maps.readings)]
        except Exception as error:
            outcome.warnings = [f'sensors could not be judged: {error!r}']

    def _outcome(self, run: Run) -> Outcome:
        def watch(stage: str, progress: Progress | None) -> None:
            run.stage, run.progress = stage, progress
            self._watch(run)

        try:
            run.stage = 'waiting for the compilation of kernels'
            begin = time.monotonic()
            self._prepare(lambda: run.cancelled)
            waited = time.monotonic() - begin
            run.stage = 'starting'
            readings, p = run.readings(), run.parameters
            run.count = len(readings)
            if lack := shortage(map_grid(readings, p).size, len(readings), p.search.threads or cores()):
                raise InputError(lack)
            return Outcome(run.mapper.run(readings, watch, run.start), '', waited=waited)
        except Cancelled:
            return Outcome(None, 'EM was cancelled')
        except MapperError as error:
            return Outcome(None, str(error))
        except MemoryError:
            return Outcome(
                None,
                f'EM of {run.count} readings does not fit into the memory; call reset, or use a coarser resolution',
            )

    def _end(self, run: Run, outcome: Outcome) -> None:
        def conclude() -> None:
            self.current = None
            for done in run.waiting:
                try:
                    done(outcome)
                except Exception as error:
                    # one that fails must not keep the others waiting, nor wait itself
                    self._log(f'EM has ended, but not every caller could be informed: {error!r}')
                    with suppress(Exception):
                        done(Outcome(None, f'EM has ended, but the work after it failed: {reason(error)}'))

        self._conclude(conclude)


def summary(maps: MapSet, seconds: float) -> str:
    """Return a run's result in one line."""
    s = maps.statistics
    return (
        f'{len(maps.readings)} readings, {s["occupied"]} occupied cells, {seconds:.2f} seconds '
        f'({s["iterations"]} iterations, {s["flips"]} flips, {s["shifts"]} shifts, '
        f'log-likelihood {maps.log_likelihood:.1f}, objective {maps.objective:.1f})'
        + ('' if s['converged'] else '; NOT converged: raise max_iterations')
        + (f'; WARNING: {warning}' if (warning := quality_warning(maps)) else '')
    )
