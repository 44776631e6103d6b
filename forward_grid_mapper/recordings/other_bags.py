"""Static transforms of the other bags on a command line, for a bag without any.

Nodes publish them once, as they start: of a recording in several bags, often only the first one has them.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from functools import lru_cache
from pathlib import Path

import numpy as np

from ..bags.choice import Topics
from ..bags.opening import storage_files
from ..bags.reader import Bag
from ..bags.static_transforms import TRANSFORM_TOLERANCE, StaticTransforms
from ..core.common.errors import BagError, InputError
from ..core.messages.extrinsics import Mount
from ..files.journal import drive_file
from ..files.output_folder import readable


class OtherBags:
    """Looks up poses of sensors in other bags; they are read only if a pose is looked up.

    Attributes
    ----------
    used : dict of str
        The bag that a pose is taken from, by the frame of the sensor.
    differing : dict of str
        Bags with different poses, by frame: they may be of different robots, so none is used.
    """

    def __init__(self, paths: Sequence[Path | str] = (), topics: Topics | None = None) -> None:
        """`topics` are those of the bag without transforms."""
        self._paths, self._topics = paths, topics
        self._found: list[tuple[str, StaticTransforms]] | None = None
        self.used: dict[str, str] = {}
        self.differing: dict[str, list[str]] = {}

    def lookup(self, base_frame: str, frame: str) -> Mount | None:
        """Return the pose of a sensor on the robot if all bags that have one have the same."""
        if self._found is None:
            self._found = list(self._read())
        poses: list[tuple[str, Mount]] = []
        for name, transforms in self._found:
            try:
                pose = transforms.lookup(base_frame, frame)
            except InputError:
                continue
            if pose is not None and all(not _same(pose, known) for _, known in poses):
                poses.append((name, pose))
        if len(poses) > 1:
            self.differing[frame] = [name for name, _ in poses]
        if len(poses) != 1:
            return None
        self.used[frame], found = poses[0]
        return found

    def notes(self) -> list[str]:
        """Return a warning for each bag that poses are taken from."""
        frames: dict[str, list[str]] = {}
        for frame, name in self.used.items():
            frames.setdefault(name, []).append(frame)
        return [
            f'the bag has no /tf_static, so that of {name} gives the poses of {", ".join(found)}; if it is of another '
            'robot, or the sensors were moved, give the poses with --sensor'
            for name, found in frames.items()
        ]

    def advice(self) -> str:
        """Return why no other bag is used, in words, if bags differ; otherwise ''."""
        return ''.join(
            f' The other bags have different poses of {frame}, {" and ".join(names)}: are they of different robots?'
            for frame, names in self.differing.items()
        )

    def _read(self) -> Iterator[tuple[str, StaticTransforms]]:
        for path in self._paths:
            try:
                transforms = _transforms_of(str(path), _written(Path(path)), self._topics)
            except (BagError, OSError):
                # it is reported when it is its turn
                continue
            if len(transforms):
                yield readable(path), transforms


def _same(one: Mount, other: Mount) -> bool:
    turned = np.exp(1j * one.yaw) - np.exp(1j * other.yaw)
    return bool(
        np.allclose(one[:2], other[:2], atol=TRANSFORM_TOLERANCE)
        and abs(turned) < TRANSFORM_TOLERANCE
        and one.elevation == other.elevation
    )


@lru_cache(maxsize=4096)
def _transforms_of(path: str, written: int, topics: Topics | None) -> StaticTransforms:
    """Return the transforms of a bag; every bag without transforms needs those of all others."""
    if drive_file(Path(path)) is not None:
        return StaticTransforms()
    with Bag(path) as bag:
        return bag.static_transforms(topics)


def _written(path: Path) -> int:
    """Return the time at which a bag was changed, nanoseconds."""
    files = storage_files(path) if path.is_dir() else [path]
    return max((file.stat().st_mtime_ns for file in files), default=0)
