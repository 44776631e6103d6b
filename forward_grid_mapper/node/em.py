"""EM in the background: one run at a time, in a thread whose kernels release the GIL."""

from __future__ import annotations

import itertools
import time
from collections.abc import Callable, Iterable
from contextlib import suppress
from dataclasses import dataclass, field

import numpy as np
from numpy.typing import NDArray

from ..core.common.errors import Cancelled, InputError, MapperError
from ..core.common.grid import Grid
from ..core.common.parameters import Parameters
from ..core.common.readings import Readings
from ..core.common.words import counted
from ..core.learning.input_warnings import input_warnings
from ..core.learning.sensor_health import SensorHealth, sensor_health
from ..core.mapping import Mapper
from ..core.maps.log_odds_map import map_grid
from ..core.maps.map_set import MapSet
from ..core.runtime.memory import shortage
from ..core.runtime.threads import cores
from ..core.search.search import Progress
from ..files.quality_warning import quality_warning, without_echoes
from .background import Worker, reason
from .refining import RefiningMapper


@dataclass
class Outcome:
    """The result of a run.

    Attributes
    ----------
    maps : MapSet or None
    message : str
        The reason if there are no maps.
    trajectory : str
        A description of the trajectory.
    warnings : list of str
        Faults of the readings, including `drive_faults`.
    drive_faults : list of str
        Those that `Run.find_faults` found.
    replaced : bool
        Whether a call has replaced a run of the node itself.
    health : dict
        The health of each sensor.
    waited : float
        Time until kernels were compiled, seconds.
    """

    maps: MapSet | None
    message: str
    trajectory: str = ''
    warnings: list[str] = field(default_factory=list)
    drive_faults: list[str] = field(default_factory=list)
    replaced: bool = False
    health: dict[str, SensorHealth] = field(default_factory=dict)
    waited: float = 0.0


@dataclass
class Run:
    """One run of EM.

    Attributes
    ----------
    mapper : Mapper or RefiningMapper
    parameters : Parameters
    readings : callable
        Returns the readings of the run; called in the thread.
    on_maps : callable
        Called with the maps once they are made, in the thread.
    start : tuple of Grid and int8, shape `grid.shape`, or None
        The map to start from; None for the empty one.
    begin : float
        When it began, monotonic seconds.
    stage, count, progress
        Name of the current stage, number of readings, and state of the search; updated during the run.
    cancelled : bool
        Whether it was cancelled, for any reason.
    cancel_requested : bool
        Whether `cancel_em` was called.
    map_shown : bool
        Whether an intermediate map was published.
    trajectory_adopted : bool
        Whether its trajectory is the current one.
    by_itself : bool
        Whether the node began it, and no call waits for it.
    uses_all_readings : callable
        Returns whether the run uses all readings so far.
    find_faults : callable
        Returns faults of the drive; called in the thread.
    at_end, callers, next_callers : list of callable
        Called with the outcome: first `at_end`, the work of the node itself; then `callers`, the calls that wait for
        this run. `next_callers` wait for the run after it.
    """

    mapper: Mapper | RefiningMapper
    parameters: Parameters
    readings: Callable[[], Readings]
    on_maps: Callable[[MapSet], object] = lambda maps: None
    start: tuple[Grid, NDArray[np.int8]] | None = None
    begin: float = field(default_factory=time.monotonic)
    stage: str = 'starting'
    count: int = 0
    progress: Progress | None = None
    cancelled: bool = False
    map_shown: bool = False
    trajectory_adopted: bool = False
    cancel_requested: bool = False
    by_itself: bool = False
    uses_all_readings: Callable[[], bool] = lambda: True
    find_faults: Callable[[], Iterable[str]] = tuple
    next_callers: list[Callable[[Outcome], object]] = field(default_factory=list)
    at_end: list[Callable[[Outcome], object]] = field(default_factory=list)
    callers: list[Callable[[Outcome], object]] = field(default_factory=list)

    @property
    def seconds(self) -> float:
        """Seconds since the run began."""
        return time.monotonic() - self.begin

    def __str__(self) -> str:
        # their number is known once the run has begun
        of = f' of {counted(self.count, "reading")}' if self.count else ''
        text = f'{self.stage}{of}, {self.seconds:.1f} s'
        if self.progress:
            p = self.progress
            text += f', iteration {p.iterations}, {p.flips} flips, {p.gain:.0f} nats gained'
        return text + (', being cancelled' if self.cancelled else '')


class EmWorker:
    """Runs EM on snapshots of the readings, one at a time; all methods return at once, and one thread calls them.

    Attributes
    ----------
    current : Run or None
        The current run, until its thread has finished all work for it.
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
            Receives the run at every stage and iteration, in its thread.
        log : callable
            Receives errors that no user caused.
        conclude : callable
            Receives a function, and has it called in the thread that calls the methods.
        prepare : callable
            Called in the thread before each run, with a function that returns whether to stop.
        """
        self.worker = Worker('EM', log)
        self._log = log
        self.current: Run | None = None
        self._watch, self._conclude, self._prepare = watch, conclude, prepare

    def start(self, run: Run, done: Callable[[Outcome], object]) -> bool:
        """Begin a run, and return True; False if there is a current one. `done` is called first at its end."""
        if self.current is not None:
            return False
        run.at_end.append(done)
        self.current = run
        self.worker.put(lambda: self._work(run), lambda why: self._end(run, Outcome(None, f'EM failed: {why}')))
        return True

    def cancel(self) -> None:
        """Cancel the current run, if any."""
        run = self.current
        if run is not None:
            run.cancelled = True
            run.mapper.cancel()

    def close(self, seconds: float) -> None:
        """Cancel the current run, and wait at most this many seconds for its end."""
        self.cancel()
        self.worker.close(seconds)

    def _work(self, run: Run) -> None:
        """Do all work of a run; the worker reports unexpected exceptions."""
        outcome = self._outcome(run)
        if outcome.maps is not None:
            run.on_maps(outcome.maps)
            run.stage, run.progress = 'judging sensors', None
            self._judge(outcome, outcome.maps, run.find_faults)
        self._end(run, outcome)

    def _judge(self, outcome: Outcome, maps: MapSet, find_faults: Callable[[], Iterable[str]]) -> None:
        """Add the health of sensors and warnings; the maps are valid without them."""
        try:
            outcome.health = sensor_health(maps)
            outcome.drive_faults = list(find_faults())
            outcome.warnings = [*without_echoes(maps.readings), *input_warnings(maps.readings), *outcome.drive_faults]
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
                f'EM of {counted(run.count, "reading")} does not fit into the memory; call reset, or use a coarser '
                'resolution',
            )

    def _end(self, run: Run, outcome: Outcome) -> None:
        def conclude() -> None:
            self.current = None
            for done in itertools.chain(run.at_end, run.callers):
                try:
                    done(outcome)
                except Exception as error:
                    # if one callback fails, the others are still called, and its own caller is answered
                    self._log(f'EM has ended, but not every caller could be informed: {error!r}')
                    with suppress(Exception):
                        done(Outcome(None, f'EM has ended, but the work after it failed: {reason(error)}'))

        self._conclude(conclude)


def summary(maps: MapSet, seconds: float, warned: bool = False) -> str:
    """Return the result of a run in one line; `warned` is whether there are warnings beside it."""
    s = maps.statistics
    return (
        f'{counted(len(maps.readings), "reading")}, {s["occupied"]} occupied cells, {seconds:.2f} seconds '
        f'({s["iterations"]} iterations, {s["flips"]} flips, {s["shifts"]} shifts, '
        f'log-likelihood {maps.log_likelihood:.1f}, objective {maps.objective:.1f})'
        + ('' if s['converged'] else '; NOT converged: raise max_iterations')
        + (f'; WARNING: {warning}' if (warning := quality_warning(maps, warned)) else '')
    )
