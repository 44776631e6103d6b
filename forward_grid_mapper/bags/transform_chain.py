"""Poses of the robot from transforms that move, where several lie between its base and the frame it moves in."""

from __future__ import annotations

import math
from collections.abc import Iterable
from typing import Any

import numpy as np
from numpy.typing import NDArray

from ..core.messages.message_types import OdometryMessage, Pose2, stamp_of
from ..core.messages.quaternions import heading_of, rotation_of
from .poses import BASE_FRAMES

Numbers = tuple[float, ...]
"""A transform as its message has it: x, y, z of the translation, and x, y, z, w of the rotation."""


class _Link:
    """The pose of a frame in the one above it: the first one of a bag, and whether another one follows."""

    def __init__(self, parent: str, child: str, first: Numbers) -> None:
        self.parent, self.child, self.first = parent, child, first
        self.moves = self.several = False


class TransformChain:
    """Makes poses of the robot out of messages with transforms, which are to come in the order of their recording.

    A pose has the stamp of the lowest link that moves, and of each other link the transform that came last.

    Parameters
    ----------
    links : sequence
        From the robot's base up to the frame that its poses are in; one of them moves.
    """

    def __init__(self, links: list[_Link]) -> None:
        self._latest = {(_plain(link.parent), _plain(link.child)): _matrix(link.first) for link in links}
        lowest = next(link for link in links if link.moves)
        self._lowest = _plain(lowest.parent), _plain(lowest.child)
        self._frames = links[-1].parent, links[0].child

    def pose(self, message: Any) -> OdometryMessage | None:
        """Return the pose of the robot's base once a message has taken effect; None if the lowest link is not in it."""
        header = None
        for item in message.transforms:
            frames = _plain(str(item.header.frame_id)), _plain(str(item.child_frame_id))
            if frames in self._latest:
                self._latest[frames] = _matrix(_numbers(item.transform))
            if frames == self._lowest:
                header = item.header
        return None if header is None else OdometryMessage(stamp_of(header), *self._frames, self._composed())

    def _composed(self) -> Pose2 | None:
        whole = np.eye(4)
        for step in self._latest.values():
            if step is None:
                return None
            whole = step @ whole
        yaw = heading_of(*whole[:3, 0].tolist())
        return None if yaw is None else Pose2(float(whole[0, 3]), float(whole[1, 3]), yaw)


def chain_of(messages: Iterable[Any]) -> TransformChain | None:
    """Return the chain from the robot's base up to the topmost link that moves.

    None if a single transform of each message says it all: if the base is one frame, whose parent it moves in. None too
    if nothing moves, frames make a loop, or one has several parents, of which nobody knows the right one.
    """
    links = _links(messages)
    bases = [frame for frame in BASE_FRAMES if frame in links]
    up: list[_Link] = []
    frame = bases[0] if bases else ''
    while frame in links and links[frame] not in up:
        up.append(links[frame])
        frame = _plain(links[frame].parent)
    highest = max((k for k, link in enumerate(up) if link.moves), default=None)
    if highest is None or (highest == 0 and len(bases) == 1):
        return None
    # the walk up ends at a frame without a parent, or in a loop
    if frame in links or any(link.several for link in up[: highest + 1]):
        return None
    return TransformChain(up[: highest + 1])


def standing(messages: Iterable[Any]) -> list[tuple[str, str, Numbers]]:
    """Return (parent, child, transform) of the frames that all messages place alike."""
    found = _links(messages).values()
    return [(link.parent, link.child, link.first) for link in found if not (link.moves or link.several)]


def _links(messages: Iterable[Any]) -> dict[str, _Link]:
    """Return what places each frame, by its name without a leading slash."""
    links: dict[str, _Link] = {}
    for message in messages:
        for item in message.transforms:
            parent, child, numbers = str(item.header.frame_id), str(item.child_frame_id), _numbers(item.transform)
            link = links.setdefault(_plain(child), _Link(parent, child, numbers))
            link.moves = link.moves or numbers != link.first
            link.several = link.several or _plain(parent) != _plain(link.parent)
    return links


def _numbers(transform: Any) -> Numbers:
    offset, turn = transform.translation, transform.rotation
    return float(offset.x), float(offset.y), float(offset.z), *(float(getattr(turn, name)) for name in 'xyzw')


def _matrix(numbers: Numbers) -> NDArray[np.float64] | None:
    """Return a homogeneous transform, shape (4, 4); None if its quaternion is not normalised or a number not finite."""
    rotation = rotation_of(*numbers[3:])
    if rotation is None or not all(map(math.isfinite, numbers)):
        return None
    made = np.eye(4)
    made[:3, :3] = rotation
    made[:3, 3] = numbers[:3]
    return made


def _plain(frame: str) -> str:
    return frame.lstrip('/')
