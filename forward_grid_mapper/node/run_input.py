"""The readings and the odometry of a run of EM."""

from __future__ import annotations

import queue
from collections.abc import Callable, Mapping
from contextlib import suppress
from typing import Any, NamedTuple

from ..core.common.errors import Cancelled
from ..core.common.readings import Readings
from ..core.messages.message_types import Pose2
from ..core.messages.pose_association import PoseAssociator
from ..core.messages.reading_buffer import bounded
from ..core.trajectory.recovering import recovered, that_placed
from ..core.trajectory.windows import Odometry
from .background import Inbox
from .refining import RefinementInput


class _Taken(NamedTuple):
    """What the node holds at one moment: the number of readings accepted so far, those that are kept, and odometry."""

    accepted: int
    readings: Readings
    odometry: Any


class RunInput:
    """The readings and the odometry of a run; the executor makes it, the thread of the run reads it.

    If kernels must be compiled first, the readings that arrive meanwhile are mapped as well.
    """

    def __init__(
        self,
        associator: PoseAssociator,
        inbox: Inbox,
        mounts: Mapping[str, Pose2],
        compiled: bool,
        cancelled: Callable[[], bool],
        restored_mounts: Mapping[str, Pose2],
    ) -> None:
        """Take what the node holds now.

        Parameters
        ----------
        associator : PoseAssociator
        inbox : Inbox
        mounts : mapping
            Poses of the sensors that are fixed to the robot, by frame.
        compiled : bool
            Whether the run can begin at once.
        cancelled : callable
            Returns whether the run is cancelled, so that it waits no longer for the executor.
        restored_mounts : mapping
            The poses on the robot with which readings of an earlier run were placed, by frame, as far as it is known.
        """
        self._associator, self._inbox, self._cancelled = associator, inbox, cancelled
        self._mounts, self._bound = dict(mounts), associator.buffer.bound
        self._earlier_mounts = {**mounts, **restored_mounts}
        self._clock_jumped, self._waits_for_kernels, self._begun = associator.time_jumps > 0, not compiled, False
        self._taken = self._take()

    @property
    def accepted(self) -> int:
        """Number of readings that had been accepted when the input was taken."""
        return self._taken.accepted

    @property
    def empty(self) -> bool:
        """Whether there is no reading."""
        return not len(self._taken.readings)

    @property
    def odometry(self) -> Odometry:
        """Odometry messages, in the order in which they were received."""
        return Odometry(*self._taken.odometry)

    @property
    def uses_all_readings(self) -> bool:
        """Whether the run uses all readings that have been accepted so far."""
        waits = self._waits_for_kernels and not self._begun
        return waits or self.accepted == len(self._associator.buffer)

    # in the thread of the run

    def readings(self) -> Readings:
        """Begin the run, and return its readings, at most `max_readings`.

        Raises
        ------
        Cancelled
        """
        self._begun = True
        if self._waits_for_kernels:
            self._taken = self._take_now()
        return bounded(self._taken.readings, self._bound)

    def drive(self) -> RefinementInput:
        """Return the drive up to the start of the run.

        After a restart, readings of the journal are the only record of the odometry before it; but after a jump back
        of the clock, the times of both overlap.
        """
        held, known = self._taken.readings, Odometry.of(*self._taken.odometry)
        if self._clock_jumped:
            return RefinementInput(that_placed(held, known, self._mounts), held)
        return RefinementInput(recovered(known, held, self._earlier_mounts), held)

    def drive_so_far(self) -> RefinementInput:
        """Return the drive up to now.

        Raises
        ------
        Cancelled
        """
        held = self._take_now()
        return RefinementInput(Odometry.of(*held.odometry), held.readings)

    def _take(self) -> _Taken:
        buffer = self._associator.buffer
        return _Taken(len(buffer), buffer.snapshot(), self._associator.odometry)

    def _take_now(self) -> _Taken:
        """Have the executor take what the node holds."""
        answer = queue.SimpleQueue[_Taken | Exception]()

        def take() -> None:
            try:
                answer.put(self._take())
            except Exception as error:
                # otherwise the run would wait for ever
                answer.put(error)

        self._inbox.put(take)
        while not self._cancelled():
            with suppress(queue.Empty):
                found = answer.get(timeout=0.1)
                if isinstance(found, Exception):
                    raise found
                return found
        raise Cancelled('cancelled before it began')
