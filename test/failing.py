"""Lack of memory at a chosen point: allocations of a call are counted, and one of them fails."""

from __future__ import annotations

import sys
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from typing import Any

import numpy as np
import pytest

from forward_grid_mapper.core import online_map
from forward_grid_mapper.core.evidence import evidence, indexed_readings, learned_normals
from forward_grid_mapper.core.search import search

NUMPY = (
    *('zeros', 'empty', 'full', 'ones', 'arange', 'array', 'zeros_like', 'empty_like', 'full_like'),
    *('argsort', 'flatnonzero', 'nonzero', 'pad', 'where', 'floor', 'maximum', 'round', 'cos', 'concatenate'),
)

OURS: tuple[tuple[Any, str], ...] = (
    *((evidence, name) for name in ('cone_table', 'reading_state_table', 'on_larger_grid', 'box_of')),
    *((module, name) for module in (evidence, indexed_readings) for name in ('no_tiles', 'empty_maps')),
    *((indexed_readings, name) for name in ('more_chunks', 'empty_pairs', 'workspace_for')),
    *((learned_normals, name) for name in ('normals_of', 'renewed')),
    *((evidence.Evidence, name) for name in ('_allocate_readings', '_allocate_pairs', '_insert')),
    *((evidence.Evidence, name) for name in ('grow', 'extend', 'renew_normals')),
    *((online_map, name) for name in ('map_grid', 'grid_of', 'wall_prior', 'mark_traversed', 'Evidence', 'Search')),
    *((search, name) for name in ('log_prior', 'best_shifts', 'independent_prior', 'wall_prior')),
)


def _place() -> tuple[Any, ...]:
    """Return the lines of code that led to an allocation."""
    frame, lines = sys._getframe(2), []
    while frame is not None:
        lines.append((frame.f_code, frame.f_lineno))
        frame = frame.f_back
    return tuple(lines)


class Allocations:
    """Counts allocations, and makes one of them fail."""

    def __init__(self, monkeypatch: pytest.MonkeyPatch) -> None:
        self.count, self.fails = 0, 0
        self._counting = False
        self._places: dict[tuple[Any, ...], list[int]] | None = None
        for where, name in (*((np, name) for name in NUMPY), *OURS):
            monkeypatch.setattr(where, name, self._counted(getattr(where, name)))

    def _counted(self, function: Any) -> Any:
        def counted(*arguments: Any, **options: Any) -> Any:
            if self._counting:
                self.count += 1
                if self._places is not None:
                    self._places.setdefault(_place(), []).append(self.count)
                if self.count == self.fails:
                    raise MemoryError(f'allocation {self.count}, {getattr(function, "__name__", function)}')
            return function(*arguments, **options)

        return counted

    def to_fail(self, work: Callable[[], object]) -> list[int]:
        """Return the numbers of the allocations of `work` to be tested, and at the end one that it does not reach.

        Of allocations repeated at one place, called by the same lines, only the first and the last are tested. Threads
        share arrays, so their number varies a little.
        """
        self._places = {}
        with self.failing(0):
            work()
        chosen = {number for numbers in self._places.values() for number in (numbers[0], numbers[-1])}
        self._places = None
        return [*sorted(chosen), 2 * self.count + 1]

    @contextmanager
    def failing(self, which: int) -> Iterator[None]:
        """Make allocation number `which` fail, counted from 1 from now on."""
        self.count, self.fails, self._counting = 0, which, True
        try:
            yield
        finally:
            self._counting = False
