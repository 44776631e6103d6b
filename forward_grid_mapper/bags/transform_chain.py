"""Poses of the robot from moving transforms, if there are several between its base and the fixed frame."""

from __future__ import annotations

import math
from collections.abc import Iterable
from typing import Any

import numpy as np
from numpy.typing import NDArray

from ..core.messages.message_types import OdometryMessage, Pose2, stamp_of
from ..core.messages.quaternions import heading_of, rotation_of
from .poses import BASE_FRAMES
from .static_transforms import plain

Numbers = tuple[float, ...]
"""The numbers of a transform's message: x, y, z of the translation, and x, y, z, w of the rotation."""


class _Link:
    """The pose of a frame in its parent: the first one of a bag, and whether it changes later."""

    def __init__(self, parent: str, child: str, first: Numbers) -> None:
        self.parent, self.child, self.first = parent, child, first
        self.moves = self.several = False


class TransformChain:
    """Makes poses of the robot from messages with transforms, which must be given in the order of recording.

    A pose has the stamp of the lowest moving link; for each other link, the latest transform is used.

    Parameters
    ----------
    links : sequence
        From the robot's base up to the fixed frame; one of them moves.
    """

    def __init__(self, links: list[_Link]) -> None:
        self._latest = {(plain(link.parent), plain(link.child)): _matrix(link.first) for link in links}
        lowest = next(link for link in links if link.moves)
        self._lowest = plain(lowest.parent), plain(lowest.child)
        self._frames = links[-1].parent, links[0].child

    def pose(self, message: Any) -> OdometryMessage | None:
        """Update the links, and return the pose of the robot's base; None if the lowest moving link is not updated."""
        header = None
        for item in message.transforms:
            frames = plain(str(item.header.frame_id)), plain(str(item.child_frame_id))
            if frames in self._latest:
                self._latest[frames] = _matrix(numbers_of(item.transform))
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

    None if a single transform of each message suffices: if the child frame is the base and its parent the fixed frame.
    None too if nothing moves, frames form a loop, or one has several parents, so that the right one is unknown.
    """
    links = _links(messages)
    bases = [frame for frame in BASE_FRAMES if frame in links]
    up: list[_Link] = []
    frame = bases[0] if bases else ''
    while frame in links and links[frame] not in up:
        up.append(links[frame])
        frame = plain(links[frame].parent)
    highest = max((k for k, link in enumerate(up) if link.moves), default=None)
    if highest is None or (highest == 0 and len(bases) == 1):
        return None
    # the search upwards ends at a frame without a parent, or in a loop
    if frame in links or any(link.several for link in up[: highest + 1]):
        return None
    return TransformChain(up[: highest + 1])


def constant_transforms(messages: Iterable[Any]) -> list[tuple[str, str, Numbers]]:
    """Return (parent, child, transform) of the frames that have the same pose in all messages."""
    found = _links(messages).values()
    return [(link.parent, link.child, link.first) for link in found if not (link.moves or link.several)]


def _links(messages: Iterable[Any]) -> dict[str, _Link]:
    """Return the link of each frame, by its name without a leading slash."""
    links: dict[str, _Link] = {}
    for message in messages:
        for item in message.transforms:
            parent, child, numbers = str(item.header.frame_id), str(item.child_frame_id), numbers_of(item.transform)
            link = links.setdefault(plain(child), _Link(parent, child, numbers))
            link.moves = link.moves or numbers != link.first
            link.several = link.several or plain(parent) != plain(link.parent)
    return links


def numbers_of(transform: Any) -> Numbers:
    """Return the numbers of a `geometry_msgs/Transform`."""
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
