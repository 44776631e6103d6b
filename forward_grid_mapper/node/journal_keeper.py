"""Connects the associator and its journal: readings are written as they arrive, and restored after a restart."""

from __future__ import annotations

import errno
import math
import time
from collections.abc import Callable, Mapping
from typing import Any

from diagnostic_msgs.msg import DiagnosticStatus
from rclpy.node import Node

from ..core.common.errors import OutputError
from ..core.common.parameters import Parameters
from ..core.common.words import counted
from ..core.messages.message_types import Pose2
from ..core.messages.pose_association import PoseAssociator
from ..files.journal import Journal
from ..files.journal_format import stated, with_mounts
from .diagnostics import status

CHECK_PERIOD = 0.1
"""Seconds between two checks for new readings."""

NOTICE = 60.0
"""Seconds for which the status warns of a repaired fault; a value of the status keeps it for ever."""

SAME_PLACE, SAME_YAW = 0.01, math.radians(1.0)
"""Metres and radians up to which two poses of a sensor are the same."""

MOST_NAMED = 8
"""Most sensors that a warning names."""

FULL = (errno.ENOSPC, errno.EDQUOT)


class JournalKeeper:
    """Keeps a node's journal; does nothing if the folder is ''.

    Attributes
    ----------
    restored_mounts : mapping of str to Pose2
        The poses on the robot of the sensors that have readings of an earlier run, by frame.
    """

    def __init__(
        self,
        node: Node,
        folder: str,
        associator: PoseAssociator,
        mounts: Callable[[], Mapping[str, Pose2 | None]] = dict,
    ) -> None:
        """Prepare; call `open` and `restore` before anything else.

        Parameters
        ----------
        node : Node
            Its attribute `parameters` holds the parameters of the mapper.
        folder : str
        associator : PoseAssociator
        mounts : callable
            Returns the poses on the robot of the sensors that have readings, by frame; None for those that moved on it.
        """
        self._node, self._mounts = node, mounts
        self.restored_mounts: Mapping[str, Pose2] = {}
        # of the journal, and of this run
        self._known_mounts: dict[str, Pose2] = {}
        self._associator = associator
        self._journal: Journal | None = None
        self._folder = folder
        self._trouble = ''
        self._restored = self._taken = 0
        self._last_point: tuple[float, float] | None = None
        self._parameters: Parameters | None = None
        self._begun = False

    def open(self) -> None:
        """Open the journal, which locks its folder until `close`.

        Raises
        ------
        OutputError
            If the journal belongs to another node, or cannot be opened for another reason than a full disk.
        """
        if not self._folder:
            return
        warn: Callable[[str], Any] = self._node.get_logger().warning
        try:
            self._journal = Journal(self._folder, warn)
        except OutputError as error:
            cause = error.__cause__
            if not (isinstance(cause, OSError) and cause.errno in FULL):
                raise
            self._trouble = str(error)
            warn(f'no journal is kept: {error}')

    def restore(self) -> None:
        """Give the journal's readings to the associator; from any thread, while no other one uses the associator.

        Raises
        ------
        OutputError
            If another program has the file open.
        """
        if self._journal is not None:
            self._restore(self._journal)

    def begin(self, clock: Any) -> None:
        """Write new readings periodically, with a timer of this clock, and before readings are removed."""
        if self._journal is not None:
            self._associator.buffer.before_thinning.append(self.take)
            self._node.create_timer(CHECK_PERIOD, self.take, clock=clock)
            self._begun = True

    def _restore(self, journal: Journal) -> None:
        associator, logger = self._associator, self._node.get_logger()
        refused = 0
        for readings in journal.restore():
            refused += associator.restore(readings)
        associator.map_frame, associator.base_frame = journal.contents.map_frame, journal.contents.base_frame
        self.restored_mounts = {frame.lstrip('/'): pose for frame, pose in journal.contents.mounts.items()}
        self._known_mounts = dict(journal.contents.mounts)
        for point in journal.contents.path:
            associator.extend_path(point)
        self._restored = self._taken = len(associator.buffer)
        self._last_point = associator.path[-1] if associator.path else None
        logger.info(
            f'journal {journal.path}: restored {counted(self._restored, "reading")} of an earlier run, in frame '
            f'{associator.map_frame or "(none yet)"}'
        )
        if refused:
            logger.warning(
                f'journal {journal.path}: {refused} of its readings do not fit into the map (max_cells, resolution) '
                'and are left out'
            )

    def take(self) -> None:
        """Give new readings to the journal, or all readings in memory if the journal must be written again."""
        journal, associator = self._journal, self._associator
        if journal is None:
            return
        self._describe(journal)
        frames = associator.map_frame, associator.base_frame
        if journal.gone:
            self._taken = len(associator.buffer)
            journal.renew(associator.buffer.snapshot(), frames, associator.path)
        elif len(associator.buffer) > self._taken:
            new = associator.buffer.snapshot(self._taken)
            self._taken = len(associator.buffer)
            point = associator.path[-1] if associator.path else None
            points = [point] if point is not None and point != self._last_point else []
            self._last_point = point
            journal.put(new, frames, points)

    def _describe(self, journal: Journal) -> None:
        parameters, mounts = self._node.parameters, self._mounts()
        # a sensor that moves on the robot, as on a turret, has no pose to compare with after a restart
        known = {frame: pose for frame, pose in {**self._known_mounts, **mounts}.items() if pose is not None}
        if parameters is self._parameters and known == self._known_mounts:
            return
        before = self._known_mounts
        if moved := sorted(frame for frame, pose in known.items() if frame in before and _moved(before[frame], pose)):
            self._node.get_logger().warning(
                f'journal {journal.path}: the pose on the robot of {", ".join(moved[:MOST_NAMED])}'
                f'{" and others" if len(moved) > MOST_NAMED else ""} is another one than for earlier readings, which '
                'stay where they were mapped; if it was wrong before, call reset to begin a new drive'
            )
        self._parameters, self._known_mounts = parameters, known
        journal.parameters = with_mounts(stated(parameters), known)

    def reset(self) -> str:
        """Begin a new drive after readings were forgotten; return the file of the old ones, in words."""
        self._restored = self._taken = 0
        self._last_point = None
        self._known_mounts, self._parameters, self.restored_mounts = {}, None, {}
        if self._journal is None:
            return ''
        old = self._journal.path
        self._journal.begin_drive()
        return f'; the journal keeps them in {old.name}' if old != self._journal.path else ''

    def close(self) -> None:
        """Write the remaining readings, and close the journal."""
        if self._journal is not None:
            if self._begun:
                self.take()
            self._journal.close()

    def statuses(self, name: str) -> list[DiagnosticStatus]:
        """Return the status of the journal; none if no journal is wanted."""
        if not self._folder:
            return []
        journal = self._journal
        trouble = self._trouble if journal is None else journal.trouble
        values: dict[str, Any] = {'folder': self._folder, 'readings restored': self._restored}
        if journal is not None:
            if journal.lost:
                trouble = trouble or f'{counted(journal.lost, "reading")} came while nothing could be written'
            if time.monotonic() < journal.noticed + NOTICE:
                trouble = trouble or journal.notice
            values |= {
                'file': journal.path.name,
                'readings to be written': journal.unwritten,
                'readings lost': journal.lost,
                'last fault of a file': journal.notice or 'none',
            }
        level = DiagnosticStatus.WARN if trouble else DiagnosticStatus.OK
        return [status(f'{name}: journal', level, trouble or 'writing', name, values)]


def _moved(before: Pose2, now: Pose2) -> bool:
    """Return whether a sensor has another pose on the robot."""
    turned = abs(math.remainder(now.yaw - before.yaw, 2 * math.pi))
    return math.dist(before[:2], now[:2]) > SAME_PLACE or turned > SAME_YAW
