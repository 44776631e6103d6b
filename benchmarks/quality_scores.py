"""Figures of a map for `quality.py`, and the standard map with the best gains for each drive."""

from __future__ import annotations

import itertools
import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from types import ModuleType
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray
from quality_worlds import Case

from forward_grid_mapper.commands.experiment_maps import GAINS, standard_map
from forward_grid_mapper.core.common.grid import Grid
from forward_grid_mapper.core.common.readings import Floats
from forward_grid_mapper.simulation.score import score_map

CLIP = 0.02
"""Probabilities are clipped to this distance from 0 and 1 before the log loss."""

OFTEN = 6
"""Fewest readings that must hit a wall cell for it to count as well observed."""

ROBOT_RADIUS = 0.15
SCALES = (0.03, 0.06, 0.1, 0.2, 0.35, 0.6, 1.0)
"""Factors on the log odds of the standard map, of which the best is used, in addition to its gains."""

LOGIT = math.log(0.65 / 0.35)
"""Absolute log odds from which a cell of the standard map counts as occupied, or as free if negative."""


@dataclass(frozen=True)
class Figures:
    """Quality of a map of a case; NaN for figures that do not apply.

    `coverage` and `gap` are over all visible wall cells, `coverage_often` and `gap_often` over those that `OFTEN`
    readings hit. `loss` is in nats a cell.
    """

    f1: float
    door: float
    doors_closed: float
    coverage: float
    gap: float
    coverage_often: float
    gap_often: float
    smooth: float
    dots: float
    nav_iou: float
    leak: float
    blocked: float
    loss: float = math.nan


_WORST = {'door': min, 'doors_closed': max, 'gap': max, 'gap_often': max, 'smooth': min}
"""How figures of several seeds are combined; others by their mean."""


def together(figures: Sequence[Figures]) -> Figures:
    """Return the figures of a group."""
    out = {}
    for name in Figures.__dataclass_fields__:
        values = [getattr(f, name) for f in figures]
        out[name] = float(_WORST[name](values) if name in _WORST else np.mean(values))
    return Figures(**out)


def on_truth(values: NDArray[Any], grid: Grid, case: Case, tool: ModuleType | None) -> Floats:
    """Return a map (NaN unknown) at the cells of the case's truth."""
    if case.world is None:
        assert tool is not None
        shape, origin = case.truth.shape, np.array(case.origin)
        sampled = tool.resample(values, np.array(grid.origin), grid.resolution, shape, origin, case.resolution)
        return np.asarray(sampled, np.float64)
    whole = grid.union(case.world.grid)
    out = np.full(whole.shape, np.nan)
    out[whole.window(grid)] = values
    return np.array(out[whole.window(case.world.grid)])


def _nav(p: Floats, case: Case, tool: ModuleType | None) -> dict[str, float]:
    if tool is None:
        return dict.fromkeys(('f1', 'nav_iou', 'leak', 'blocked'), math.nan)
    path = tool.path_cells(case.path_xy, np.array(case.origin), case.resolution, case.truth.shape)
    scores: dict[str, float] = tool.score(p, case.truth, path, case.resolution, ROBOT_RADIUS)
    return scores


def nav_of(ml: NDArray[np.int8], grid: Grid, case: Case, tool: ModuleType | None) -> float:
    """Return nav_iou of a map of any resolution (1 occupied, 0 free, -1 unknown); NaN without the scoring tool."""
    if tool is None:
        return math.nan
    known, target = np.where(ml < 0, np.nan, ml), np.array(case.origin)
    p = tool.resample(known, np.array(grid.origin), grid.resolution, case.truth.shape, target, case.resolution)
    return _nav(p, case, tool)['nav_iou']


def _near(cells: NDArray[np.bool_]) -> NDArray[np.bool_]:
    wide = np.pad(cells, 1)
    rows = wide[:-2] | wide[1:-1] | wide[2:]
    return np.asarray(rows[:, :-2] | rows[:, 1:-1] | rows[:, 2:])


def score(ml: NDArray[np.int8], grid: Grid, case: Case, tool: ModuleType | None, loss: float = math.nan) -> Figures:
    """Return the figures of a map of a case: 1 occupied, 0 free, -1 unknown."""
    p = on_truth(np.where(ml < 0, np.nan, ml), grid, case, tool)
    nav = _nav(p, case, tool)
    ways = {k: nav[k] for k in ('nav_iou', 'leak', 'blocked')}
    if case.world is None:
        dots = (p > 0.65) & (case.truth < 0.35) & ~_near(case.truth > 0.65)
        none = math.nan
        return Figures(nav['f1'], none, none, none, none, none, none, none, float(dots.sum()), loss=loss, **ways)
    s = score_map(ml, grid, case.world, case.met > 0)
    often = score_map(ml, grid, case.world, case.met >= OFTEN)
    doors = len(s.door_widths)
    return Figures(
        f1=s.f1,
        door=min(s.door_widths, default=math.nan),
        doors_closed=doors - s.doors_open if doors else math.nan,
        coverage=s.column_coverage,
        gap=s.longest_gap,
        coverage_often=often.column_coverage,
        gap_often=often.longest_gap,
        smooth=s.smooth_recall,
        dots=s.false_dots,
        loss=loss,
        **ways,
    )


class Belief(NamedTuple):
    """Probabilities of the cells of a case that are known in the map and in the truth, and which are occupied."""

    p: Floats
    occupied: NDArray[np.bool_]

    @property
    def loss(self) -> float:
        """Log loss in nats a cell."""
        p = np.clip(self.p, CLIP, 1 - CLIP)
        return float(-np.where(self.occupied, np.log(p), np.log(1 - p)).mean())

    @property
    def base(self) -> float:
        """Log loss of a map with the fraction of occupied cells everywhere."""
        return Belief(np.full(len(self.p), self.occupied.mean()), self.occupied).loss


def known_cells(uncertainty: Floats, case: Case) -> NDArray[np.bool_]:
    """Return the cells that are known in an uncertainty map and in the truth."""
    return np.asarray(np.isfinite(uncertainty) & np.isfinite(case.truth))


def reliability(beliefs: Sequence[Belief]) -> list[str]:
    """Return a table: for each range of probabilities, the number of cells, and of occupied ones."""
    p = np.concatenate([b.p for b in beliefs])
    occupied = np.concatenate([b.occupied for b in beliefs])
    lines = [f'{"stated":>14s}{"cells":>9s}{"mean":>8s}{"occupied":>10s}']
    edges = (0.0, 0.02, 0.05, 0.1, 0.2, 0.35, 0.5, 0.65, 0.8, 0.9, 0.98, 1.0 + 1e-9)
    for low, high in itertools.pairwise(edges):
        inside = (p >= low) & (p < high)
        if inside.any():
            span = f'{low:.2f} – {min(high, 1.0):.2f}'
            lines.append(f'{span:>14s}{inside.sum():9d}{p[inside].mean():8.3f}{occupied[inside].mean():10.3f}')
    return lines


class Standard:
    """The standard map of a case for all gains: its log odds are linear in them."""

    def __init__(self, case: Case, tool: ModuleType | None) -> None:
        self.case, self._tool = case, tool
        self._parts: dict[float, tuple[Grid, list[Floats], list[Floats]]] = {}
        unit = {'live_p_occupied': 1 / (1 + math.exp(-1)), 'live_p_free': 1 / (1 + math.e)}
        unit['live_p_free_no_echo'] = unit['live_p_free']
        for depth in sorted({gains['depth'] for gains in GAINS}):
            parts = []
            for name, value in unit.items():
                live = standard_map({**dict.fromkeys(unit, 0.5), name: value, 'depth': depth})
                live.add(case.readings)
                parts.append(live.log_odds())
            self._parts[depth] = live.grid, parts, [on_truth(part, live.grid, case, tool) for part in parts]

    def _mix(self, gains: dict[str, float], parts: list[Floats]) -> Floats:
        names = ('live_p_occupied', 'live_p_free', 'live_p_free_no_echo')
        weights = [abs(math.log(gains[name] / (1 - gains[name]))) for name in names]
        return np.asarray(sum(w * part for w, part in zip(weights, parts, strict=True)))

    def map(self, gains: dict[str, float]) -> tuple[Grid, NDArray[np.int8]]:
        """Return the map with these gains: 1 occupied, 0 free, -1 in between or unknown."""
        grid, parts, _ = self._parts[gains['depth']]
        odds = self._mix(gains, parts)
        ml = np.where(odds > LOGIT, 1, np.where(odds < -LOGIT, 0, -1))
        return grid, ml.astype(np.int8)

    def f1(self, gains: dict[str, float]) -> float:
        """Return F1 with these gains."""
        if self.case.world is None:
            return self.figures(gains).f1
        grid, ml = self.map(gains)
        return score_map(ml, grid, self.case.world, self.case.met > 0).f1

    def nav_iou(self, gains: dict[str, float]) -> float:
        """Return nav_iou with these gains."""
        grid, ml = self.map(gains)
        p = on_truth(np.where(ml < 0, np.nan, ml), grid, self.case, self._tool)
        return _nav(p, self.case, self._tool)['nav_iou']

    def figures(self, gains: dict[str, float], loss: float = math.nan) -> Figures:
        """Return all figures with these gains."""
        grid, ml = self.map(gains)
        return score(ml, grid, self.case, self._tool, loss)

    def losses(self, gains: dict[str, float], known: NDArray[np.bool_]) -> Floats:
        """Return the log loss at the cells `known` for each of `SCALES`."""
        odds = self._mix(gains, self._parts[gains['depth']][2])
        inside = known & np.isfinite(odds)
        occupied = self.case.truth[inside] > 0.5
        return np.array([Belief(1 / (1 + np.exp(-s * odds[inside])), occupied).loss for s in SCALES])


def oracle(
    cases: Sequence[Case], known: Sequence[NDArray[np.bool_]], tool: ModuleType | None
) -> tuple[Figures, Figures]:
    """Return the figures of the standard map with the gains of the best F1, and with those of the best nav_iou.

    Both have the smallest log loss of any gains.

    Parameters
    ----------
    cases : sequence of Case
        Of one group: the gains are the same for all.
    known : sequence of bool arrays
        The cells of each for the log loss.
    """
    maps = [Standard(case, tool) for case in cases]
    loss = least_loss(maps, known)

    def best(worth: Callable[[Standard, dict[str, float]], float]) -> Figures:
        gains = max(GAINS, key=lambda gains: float(np.mean([worth(m, gains) for m in maps])))
        return together([m.figures(gains, loss) for m in maps])

    return best(Standard.f1), best(Standard.f1 if tool is None else Standard.nav_iou)


def least_loss(maps: Sequence[Standard], known: Sequence[NDArray[np.bool_]]) -> float:
    """Return the smallest mean log loss of any gains and any of `SCALES`."""
    means = [np.mean([m.losses(g, k) for m, k in zip(maps, known, strict=True)], axis=0).min() for g in GAINS]
    return float(min(means))
