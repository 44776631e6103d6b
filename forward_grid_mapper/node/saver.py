"""The service save_maps: writes the latest maps to files, one call at a time."""

from __future__ import annotations

import re
import threading
import time
from collections.abc import Callable
from contextlib import ExitStack, suppress
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from ..core.common.errors import MapperError
from ..core.common.words import counted
from ..core.maps.map_set import MapSet
from ..files.output_folder import TakenError, expanded, free_name, remove_abandoned
from ..files.quality_warning import thinned
from ..files.results import write_results
from ..files.trajectory_text import trajectory_data, trajectory_files
from .background import Worker
from .deferred import Reply
from .em import Outcome
from .em_service import EmService
from .live import LiveMap
from .refining import FoundTrajectory

USES = {'ml_map.yaml': ' for Nav2', 'report.html': ' for a browser', 'report.txt': ''}
"""Files that the answer names, and what they are for."""


NAMES = re.compile(r'maps_\d{4}-\d\d-\d\d_\d\d-\d\d-\d\d(_\d+)?')
"""Names of the folders that save_maps makes."""

MOST_TAKEN = 10
"""Most names that are tried; more nodes than these do not save at once."""


class Account(NamedTuple):
    """The state of the node and its readings for a report, when the maps were requested.

    `source` is as in `write_results`, `accepted` is the number of readings, `path` is that of the robot by odometry,
    `odometry` are stamps and poses.
    """

    source: dict[str, Any]
    accepted: int
    path: list[tuple[float, float]]
    odometry: tuple[NDArray[np.int64], NDArray[np.float64]]
    folder: str
    title: str


def in_a_free_folder(parent: Path, write: Callable[[Path], dict[str, Any]]) -> tuple[Path, dict[str, Any]]:
    """Write into a folder with the time as its name; return it and the result of `write`.

    Another node may save into the same parent in the same second, so the next free name is tried if one is taken.
    Temporary folders of nodes that were killed are removed.

    Raises
    ------
    OutputError
        If the folder cannot be written.
    """
    remove_abandoned(parent, NAMES)
    stem = f'maps_{time.strftime("%Y-%m-%d_%H-%M-%S")}'
    folder = free_name(parent, stem)
    for _ in range(MOST_TAKEN):
        with suppress(TakenError):
            return folder, write(folder)
        folder = free_name(parent, stem)
    return folder, write(folder)


class Saver:
    """Writes maps in a thread of its own, so that each call finds a free folder name."""

    def __init__(self, em: EmService, live: LiveMap, account: Callable[[], Account], logger: Any) -> None:
        """Prepare; `account` is called by the executor."""
        self.worker = Worker('save_maps', logger.error)
        self._em, self._live, self._account, self._logger = em, live, account, logger
        # locked while a folder gets its name, so that it has one exactly if the response says so
        self._agreeing = threading.Lock()
        self._ended = False

    def close(self, seconds: float) -> None:
        """Wait at most this many seconds for maps that are being written; no folder of them remains after that."""
        self.worker.close(seconds)
        with self._agreeing:
            self._ended = True

    def save_maps(self, reply: Reply) -> None:
        """Answer the service; run EM first if it has not run."""
        if self._em.maps is None and self._em.current is not None:
            self._logger.info('save_maps waits for the end of EM')
        self._em.when_there_are_maps(lambda outcome: self._save(outcome, reply))

    def _save(self, outcome: Outcome, reply: Reply) -> None:
        maps = outcome.maps
        if maps is None:
            reply.send(False, f'there is no map to save: {outcome.message}')
            return
        account, accepted_at_run, generation = self._account(), self._em.accepted_at_run, self._live.generation
        found = self._em.found_trajectory

        def work() -> None:
            try:
                live = self._live.snapshot()
                if live.generation != generation:
                    raise MapperError('there is no map to save: reset deleted them')
                both = maps.with_live(live.grid, live.probability)
                with ExitStack() as named:
                    reply.send(True, self._write(both, account, accepted_at_run, found, named))
            except MapperError as error:
                reply.send(False, str(error))

        self.worker.put(work, lambda why: reply.send(False, f'save_maps failed: {why}'))

    def _write(
        self, maps: MapSet, account: Account, accepted_at_run: int, found: FoundTrajectory | None, named: ExitStack
    ) -> str:
        """Write a folder, and return the response; once it gets its name, `named` keeps `close` waiting."""
        newer = account.accepted - accepted_at_run
        warnings = account.source['warnings']
        if newer > 0:
            after = f'{counted(newer, "reading")} arrived after EM'
            warnings.append(
                f'{after}: only the live map contains {"it" if newer == 1 else "them"}; call run_em before save_maps'
            )
        if note := thinned(len(maps.readings), accepted_at_run):
            warnings.append(note)
        parent = expanded(account.folder).resolve()
        path_xy = np.array(account.path, np.float64).reshape(-1, 2)
        options: dict[str, Any] = {}
        if found is not None and found.refinement is not None:
            account.source['trajectory'] = trajectory_data(found.refinement)
            if found.refinement.unplaced:
                warnings.append(found.refinement.jumps)
        if found is not None and found.correction is not None:
            assert found.refinement is not None
            texts = trajectory_files(found.refinement, found.correction.odometry)
            options = {'extras': texts, 'odometry_xy': path_xy}
            path_xy = found.correction.path_of(*account.odometry)

        def agree() -> None:
            # another name of the folder is tried if this one was taken
            named.close()
            named.enter_context(self._agreeing)
            if self._ended:
                raise MapperError('the maps were not written in time: the node is being cleaned up or stopped')

        def write(folder: Path) -> dict[str, Any]:
            return write_results(folder, maps, account.source, path_xy, account.title, agree=agree, **options)

        folder, report = in_a_free_folder(parent, write)
        for warning in report['warnings']:
            self._logger.warning(f'save_maps: {warning}')
        names = {path.name for path in folder.iterdir()}
        shown = [f'{folder / name}{use}' for name, use in USES.items() if name in names]
        said = [', '.join([*shown, f'and {counted(len(names) - len(shown), "file")} more'])]
        # a robot that drives receives readings meanwhile
        if newer > 0:
            said.append(f'{counted(newer, "reading")} arrived after EM')
        if count := len(report['warnings']) - (newer > 0):
            said.append(f'WARNINGS ({count}): see report.txt')
        return '; '.join(said)
