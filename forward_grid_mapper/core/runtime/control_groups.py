"""The control groups of this process, versions 1 and 2, by which containers and services limit memory and cores."""

from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path

ROOT, OWN = Path('/sys/fs/cgroup'), Path('/proc/self/cgroup')
"""Folder of all control groups, and the file with those of this process."""


def control_groups(controller: str) -> Iterator[tuple[Path, int]]:
    """Yield the folders of the control groups of this process that may limit `controller`, and their version.

    These are the roots, which in a container are the groups of the container, the groups of this process, and all
    parents of these. Folders need not exist.
    """
    yield ROOT, 2
    yield ROOT / controller, 1
    try:
        lines = OWN.read_text().splitlines()
    except OSError:
        return
    for line in lines:
        _, controllers, path = [*line.split(':', 2), '', ''][:3]
        if controllers and controller not in controllers.split(','):
            continue
        folder = Path(path.lstrip('/'))
        while folder.parts:
            yield ROOT / (controller if controllers else '') / folder, 1 if controllers else 2
            folder = folder.parent
