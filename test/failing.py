"""Memory that runs out at a chosen point: the allocations of a call are counted, and one of them fails."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager
from typing import Any

import numpy as np
import pytest

from forward_grid_mapper.core import online_map
from forward_grid_mapper.core.evidence import evidence
from forward_grid_mapper.core.search import search

NUMPY = (
    *('zeros', 'empty', 'full', 'ones', 'arange', 'array', 'zeros_like', 'empty_like', 'full_like'),
    *('argsort', 'flatnonzero', 'nonzero', 'pad', 'where', 'floor', 'maximum', 'round', 'cos', 'concatenate'),
)

OURS: tuple[tuple[Any, str], ...] = (
    *((evidence, name) for name in ('cone_table', 'reading_state_table', 'no_tiles', 'more_chunks', 'empty_pairs')),
    *((evidence, name) for name in ('workspace_for', 'normals_of', 'renewed', 'on_larger_grid', 'box_of', '_maps')),
    *((evidence.Evidence, name) for name in ('_reserve', '_make_room', '_insert', 'grow', 'extend', 'renew_normals')),
    *((online_map, name) for name in ('map_grid', 'grid_of', 'wall_prior', 'mark_traversed', 'Evidence', 'Search')),
    *((search, name) for name in ('log_prior', 'best_shifts', 'independent_prior', 'wall_prior')),
)


class Allocations:
    """Counts allocations, and lets one of them fail."""

    def __init__(self, monkeypatch: pytest.MonkeyPatch) -> None:
        self.count, self.fails = 0, 0
        self._counting = False
        for where, name in (*((np, name) for name in NUMPY), *OURS):
            monkeypatch.setattr(where, name, self._counted(getattr(where, name)))

    def _counted(self, function: Any) -> Any:
        def counted(*arguments: Any, **options: Any) -> Any:
            if self._counting:
                self.count += 1
                if self.count == self.fails:
                    raise MemoryError(f'allocation {self.count}, {getattr(function, "__name__", function)}')
            return function(*arguments, **options)

        return counted

    @contextmanager
    def failing(self, which: int) -> Iterator[None]:
        """Let the allocation number `which`, counted from 1 and from here on, fail."""
        self.count, self.fails, self._counting = 0, which, True
        try:
            yield
        finally:
            self._counting = False
