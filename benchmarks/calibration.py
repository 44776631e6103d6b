#!/usr/bin/env python3
"""Fits the weights of the uncertainty map again, and prints the log loss with them.

usage: calibration.py [--buildings 24]

A logistic regression on three parts: every other drive of quality_worlds.py, buildings of material_worlds.py, and
these again with a truth where walls end most rays of the laser. Held out: the other drives, and twelve more buildings
with both truths. The evidence of the readings has the weight 1. Prints the constants of `core/maps/uncertainty.py`
beside the current ones, and log losses in nats a cell with both.
"""

from __future__ import annotations

import argparse
from collections.abc import Iterable
from typing import NamedTuple

import numpy as np
from material_worlds import building_case
from numpy.typing import NDArray
from quality_scores import on_truth
from quality_worlds import Case, scoring_tool, simulated_cases
from scipy.optimize import minimize

from forward_grid_mapper.core.common.parameters import Parameters
from forward_grid_mapper.core.common.readings import Floats
from forward_grid_mapper.core.evidence.evidence import Evidence
from forward_grid_mapper.core.evidence.neighbourhood import patterns
from forward_grid_mapper.core.mapping import Mapper
from forward_grid_mapper.core.maps import uncertainty as weighting
from forward_grid_mapper.core.maps.free_space import expected_passes

NAMES = ('HOLE', 'INSIDE', 'STEP', 'END', 'BESIDE', 'ALONE', 'OCCUPIED', 'LEAST_AROUND', 'MEAN_AROUND')
CLIP = 0.02
"""Probabilities are clipped to this value and 1 minus it, as in score_map.py."""

SHARES = (0.57, 0.215, 0.215)
"""Weights of the three parts: with less for the worlds, which have thin walls along the lattice, gaps in their walls
would become walls."""

HELD = 12


class Cells(NamedTuple):
    """The cells of a drive that are known in its uncertainty map and in the truth.

    Attributes
    ----------
    nats : float64, shape (N,)
        Evidence of the readings, nats.
    features : float64, shape (N, 9)
        Features of the weights `NAMES`.
    occupied : bool, shape (N,)
        In the truth.
    """

    nats: Floats
    features: Floats
    occupied: NDArray[np.bool_]


def cells_of(case: Case) -> Cells:
    """Return the cells of a drive."""
    parameters, tool = Parameters(), scoring_tool()
    maps = Mapper(parameters).run(case.readings)
    evidence = Evidence(maps.grid, parameters.model, start=(maps.searched == 1).astype(np.uint8))
    evidence.extend(maps.readings)
    passed = expected_passes(evidence, evidence.state.maps.occupied).all.reshape(maps.grid.shape)
    occupied = (maps.ml == 1).astype(np.uint8)
    kinds = weighting.KINDS[patterns(occupied.ravel(), maps.grid.shape)].reshape(maps.grid.shape)
    layers = [(kinds == getattr(weighting, name)).astype(float) for name in NAMES[:6]]
    layers += [occupied.astype(float), *(np.log1p(part) for part in weighting.around(passed))]
    nats = weighting.discounted(evidence.of_occupancy().reshape(maps.grid.shape))
    known = np.isfinite(on_truth(maps.uncertainty, maps.grid, case, tool)) & np.isfinite(case.truth)
    columns = [on_truth(layer, maps.grid, case, tool)[known] for layer in (nats, *layers)]
    return Cells(columns[0], np.stack(columns[1:], axis=1), case.truth[known] > 0.5)


def fitted(parts: Iterable[list[Cells]]) -> Floats:
    """Return the weights with the smallest log loss; all drives of a part have equal weights."""
    shares = zip(SHARES, parts, strict=True)
    drives = [(cells, share / len(part) / len(cells.nats)) for share, part in shares for cells in part]
    nats = np.concatenate([cells.nats for cells, _ in drives])
    features = np.concatenate([cells.features for cells, _ in drives])
    occupied = np.concatenate([cells.occupied for cells, _ in drives]).astype(float)
    weight = np.concatenate([np.full(len(cells.nats), each) for cells, each in drives])

    def loss(weights: Floats) -> tuple[float, Floats]:
        logit = nats + features @ weights
        error = 1 / (1 + np.exp(-logit)) - occupied
        return float(weight @ (np.logaddexp(0, logit) - occupied * logit)), features.T @ (weight * error)

    return np.asarray(minimize(loss, np.zeros(len(NAMES)), jac=True, method='L-BFGS-B').x)


def log_loss(part: list[Cells], weights: Floats) -> float:
    """Return the mean log loss of drives, nats a cell."""
    out = []
    for cells in part:
        p = np.clip(1 / (1 + np.exp(-cells.nats - cells.features @ weights)), CLIP, 1 - CLIP)
        out.append(float(-np.log(np.where(cells.occupied, p, 1 - p)).mean()))
    return float(np.mean(out))


def main() -> None:
    """Run the benchmark."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument('--buildings', type=int, default=24)
    count = parser.parse_args().buildings
    worlds = [cells_of(case) for case in simulated_cases(False)]
    any_ray, most_rays = (
        [cells_of(building_case(seed, mostly=mostly)) for seed in range(count + HELD)] for mostly in (False, True)
    )
    new = fitted((worlds[::2], any_ray[:count], most_rays[:count]))
    now = np.array([getattr(weighting, name) for name in NAMES])
    print(f'{"":32s}{"now":>8s}{"fitted":>8s}')
    for name, a, b in zip(NAMES, now, new, strict=True):
        print(f'{name:32s}{a:8.2f}{b:8.2f}')
    held = {'worlds, held out': worlds[1::2], 'buildings, held out': any_ray[count:]}
    for name, part in {**held, 'buildings by most rays, held out': most_rays[count:]}.items():
        print(f'{name:32s}{log_loss(part, now):8.3f}{log_loss(part, new):8.3f}')


if __name__ == '__main__':
    main()
