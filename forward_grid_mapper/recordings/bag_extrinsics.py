"""Poses of the sensors on the robot, for a bag: from the user, from its transforms, or from other bags."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from functools import cache

from ..bags.moving_transforms import MovingTransforms
from ..bags.static_transforms import StaticTransforms, SteepSensorError
from ..core.common.errors import InputError
from ..core.common.shell import quoted
from ..core.messages.extrinsics import STEEP
from ..core.messages.message_types import Pose2
from .other_bags import OtherBags

NO_STATIC = (
    'the bag has no /tf_static (nodes publish it once, as they start: record it from the start; of a split bag the '
    'first file has it, so give the whole folder, or that file as well)'
)
"""Remedy if no transform is known."""

MOST_NAMED = 3
"""Most frames that are named as examples."""

MOST_OPTIONS = 8
"""Most sensors for which a message contains options to copy."""


class BagExtrinsics:
    """Poses of the sensors on the robot: given by the user, or else by the bag's transforms.

    Attributes
    ----------
    steep, used, unusable : dict of str
        By frame: where a sensor looks that is too steep for a planar map, up or down; the source of its pose; and why
        its transform is invalid.
    doubts : dict
        Warnings about doubtful poses, in order.
    """

    def __init__(
        self,
        given: Mapping[str, Pose2],
        transforms: StaticTransforms,
        more: Callable[[], StaticTransforms],
        others: OtherBags | None = None,
        joints: Callable[[str, str], MovingTransforms] | None = None,
    ) -> None:
        """Prepare for sensors.

        If `transforms` do not connect a sensor to the robot, those that `more` returns are used, or else those that
        `joints` returns for the frames of the robot and of the sensor. `others` are used if there are no `transforms`.
        """
        self._given = {frame.lstrip('/'): pose for frame, pose in given.items()}
        self._transforms, self._more = transforms, cache(more)
        self._others = others or OtherBags()
        self._joints, self._read = joints, list[MovingTransforms]()
        self._on_joints: dict[tuple[str, str], MovingTransforms] = {}
        self._found: dict[tuple[str, str], Pose2 | str | None] = {}
        self.steep: dict[str, str] = {}
        self.used: dict[str, str] = {}
        self.unusable: dict[str, str] = {}
        self.doubts: dict[str, None] = {}

    def __call__(self, base_frame: str, frame: str, stamp: int) -> Pose2 | str | None:
        """Return the pose of a sensor, as defined by `ExtrinsicsLookup`; static transforms hold for any stamp."""
        key = (base_frame, frame)
        if key not in self._found:
            self._found[key] = self._look_up(base_frame, frame)
        if key in self._on_joints:
            return self._on_joints[key].lookup(base_frame, frame, stamp)
        return self._found[key]

    def moves(self, base_frame: str, frame: str) -> bool:
        """Return whether a sensor that was looked up is on a moving joint."""
        return (base_frame, frame) in self._on_joints

    def _look_up(self, base_frame: str, frame: str) -> Pose2 | str | None:
        pose = self._given.get(frame.lstrip('/'))
        if pose is not None:
            self.used[frame] = 'parameters'
            return pose
        transforms, where = self._transforms, '/tf_static'
        try:
            pose = transforms.lookup(base_frame, frame)
            if pose is None and base_frame:
                transforms, where = self._more(), 'constant transforms on /tf'
                pose = transforms.lookup(base_frame, frame)
            if pose is None and base_frame and self._has_joint(base_frame, frame):
                self.used[frame] = 'moving transforms on /tf'
                return None
            if pose is None and base_frame and not len(self._transforms):
                pose = self._others.lookup(base_frame, frame)
                where = f'/tf_static of {self._others.used.get(frame)}'
        except SteepSensorError as error:
            self.steep[frame] = error.side
            return STEEP
        except InputError as error:
            self.unusable[frame] = str(error)
            return None
        if pose is not None:
            self.used[frame] = where
            self.doubts.update(dict.fromkeys(transforms.doubts(base_frame, frame)))
        return pose

    def _has_joint(self, base_frame: str, frame: str) -> bool:
        """Return whether moving transforms connect a sensor to the robot; the bag is read once for each joint."""
        if self._joints is None:
            return False
        known = next((each for each in self._read if each.connects(base_frame, frame)), None)
        if known is None:
            known = self._joints(base_frame, frame)
            if not known.connects(base_frame, frame):
                if doubt := known.doubt(base_frame, frame):
                    self.unusable[frame] = doubt
                return False
            self._read.append(known)
        self._on_joints[base_frame, frame] = known
        return True

    @property
    def poses(self) -> dict[str, Pose2]:
        """Poses of the sensors that have readings and are fixed to the robot, by frame."""
        return {frame: pose for (_, frame), pose in self._found.items() if isinstance(pose, Pose2)}

    @property
    def notes(self) -> list[str]:
        """Warnings about the sources of poses."""
        return [*self.doubts, *self._others.notes()]

    def too_steep(self, base_frame: str) -> list[str]:
        """Return warnings about sensors that are too steep: one for all that look up, and one for all that look down.

        They often have the same fault, such as another axis in the direction of the beam.
        """
        by_side: dict[str, list[str]] = {}
        for frame, side in self.steep.items():
            by_side.setdefault(side, []).append(frame.lstrip('/'))
        return [str(SteepSensorError(frames, side, base_frame.lstrip('/'))) for side, frames in by_side.items()]

    @property
    def unused(self) -> list[str]:
        """Frames with a given pose that have no readings."""
        return sorted(set(self._given) - {frame.lstrip('/') for frame in self.used})

    def advice(self, base_frame: str, frames: Sequence[str]) -> str:
        """Return a remedy for frames without a pose."""
        known = self._transforms.frames
        joined = f'/tf_static connects {", ".join(known[:12])}' if known else NO_STATIC
        if not base_frame:
            joined += '; odometry has no child_frame_id, which is needed to look up transforms'
        # frames may have the same reason
        wrong = dict.fromkeys(self.unusable[frame] for frame in frames if frame in self.unusable)
        reasons = ''.join(f' {why}' for why in wrong) or self._other_names(base_frame, frames)
        reasons += self._others.advice()
        options = ' '.join(f'--sensor {quoted(f"{frame}=x,y,yaw")}' for frame in frames[:MOST_OPTIONS])
        more = ', and so on' if len(frames) > MOST_OPTIONS else ''
        return (
            f'no pose on the robot (frame {base_frame or "?"}) is known for {", ".join(frames)}: {joined}.{reasons} '
            f'Give {options}{more}, in metres and radians (or 90deg), or sensors.{frames[0]}.pose in --params'
        )

    def _other_names(self, base_frame: str, frames: Sequence[str]) -> str:
        """Return the frames that transforms have with another prefix, in words, or that they lack the robot's."""
        known = self._transforms.frames
        by_end = {name.rpartition('/')[2]: name for name in reversed(known)}
        unknown = [frame for name in (base_frame, *frames) if (frame := name.lstrip('/')) and frame not in known]
        pairs = [(by_end[end], frame) for frame in unknown if (end := frame.rpartition('/')[2]) in by_end]
        # two different prefixes are those of two robots
        found = [f'{name}, not {frame}' for name, frame in pairs if '/' not in name or '/' not in frame]
        if found:
            more = f', and {len(found) - MOST_NAMED} more' if len(found) > MOST_NAMED else ''
            return (
                f' The transforms have {"; ".join(found[:MOST_NAMED])}{more}: set the same prefix in the drivers of '
                f'ranges and odometry as in the publisher of the transforms.'
            )
        tops = sorted({self._transforms.top_of(frame) for frame in frames} & set(known))
        if tops and base_frame.lstrip('/') in unknown:
            return (
                f' {base_frame} is the child_frame_id of odometry, and the transforms do not join it to {tops[0]}: '
                f'publish that transform, or have odometry name {tops[0]}.'
            )
        return ''
