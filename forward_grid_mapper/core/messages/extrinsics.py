"""What is answered when somebody asks where a sensor sits on the robot."""

from __future__ import annotations

from collections.abc import Callable

from .message_types import Pose2


class Later:
    """The answer that the pose may still become known; `reason` is for readings that cannot wait any longer."""

    def __init__(self, reason: str) -> None:
        self.reason = reason


LATER = Later('unknown_extrinsics')
"""Nobody knows the frame so far."""

LATE = Later('late_transform')
"""The frame is known, but not at this stamp."""

ExtrinsicsLookup = Callable[[str, str, int], 'Pose2 | Later | None']
"""(base frame, sensor frame, stamp in ns) → pose of the sensor in the base frame, a `Later`, or None if unknown."""
