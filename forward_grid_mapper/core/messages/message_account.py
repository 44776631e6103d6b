"""The account of messages: how many came, and how many were rejected for which reason."""

from __future__ import annotations

from collections import Counter

from .message_types import RangeMessage
from .rep117 import LONGEST_NAME
from .sensor_records import MOST_FRAMES

OTHERS = '(other frames)'
"""Stands for the frames beyond `MOST_FRAMES`, and for those whose names are too long: they are counted together."""


class MessageAccount:
    """Counts messages.

    Attributes
    ----------
    received, odometry_received : int
        Range and Odometry messages so far.
    rejected, odometry_rejected : Counter of str
        Messages by reason (`REASONS`, `ODOMETRY_REASONS`).
    rejected_by_frame : dict of frame_id → Counter
    unknown_frames : set of str
        Sensor frames whose pose on the robot is unknown at present.
    time_jumps : int
        Number of times that the clock of odometry jumped back.
    jumps_before_begin : int
        Those of them, at most one, with which the drive begins: nothing of it was lost.
    """

    def __init__(self) -> None:
        self.received = self.odometry_received = self.time_jumps = self.jumps_before_begin = 0
        self.rejected: Counter[str] = Counter()
        self.odometry_rejected: Counter[str] = Counter()
        self.rejected_by_frame: dict[str, Counter[str]] = {}
        self.unknown_frames: set[str] = set()

    def begin_account(self) -> None:
        """Begin to count anew."""
        self.received = self.odometry_received = self.time_jumps = self.jumps_before_begin = 0
        self.rejected.clear()
        self.odometry_rejected.clear()
        self.rejected_by_frame.clear()
        self.unknown_frames.clear()

    def reject(self, message: RangeMessage, reason: str, count: int = 1) -> None:
        """Count one Range message, or several from its frame, as rejected for an external reason."""
        self.received += count
        self._reject(message.frame_id, reason, count)

    def _reject(self, frame_id: str, reason: str, count: int = 1) -> None:
        self.rejected[reason] += count
        known = self.rejected_by_frame
        new = len(known) < MOST_FRAMES and len(frame_id) <= LONGEST_NAME
        name = frame_id if frame_id.isprintable() else frame_id.encode('unicode_escape').decode()
        frame = name if name in known or new else OTHERS
        self.rejected_by_frame.setdefault(frame, Counter())[reason] += count

    def _reject_unplaced(self, frame_id: str, reason: str, count: int = 1) -> None:
        """Count readings as rejected, and note a sensor whose pose on the robot is unknown."""
        if reason == 'unknown_extrinsics' and len(self.unknown_frames) < MOST_FRAMES:
            self.unknown_frames.add(frame_id)
        self._reject(frame_id, reason, count)
