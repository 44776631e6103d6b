#!/usr/bin/env python3
"""How often the search finds the optimal map, on maps small enough for exhaustive search.

usage: optimum.py [--cases 200] [--readings 12]

Random readings on 4 x 3 and 4 x 4 cells. Prints the fraction of cases in which the search reached the optimum, and its
distance from the optimum in the others, nats.
"""

from __future__ import annotations

import argparse
import math

import numpy as np

from forward_grid_mapper.core.common.grid import Grid
from forward_grid_mapper.core.common.parameter_groups import ModelParameters, SearchParameters
from forward_grid_mapper.core.common.readings import Readings
from forward_grid_mapper.core.evidence.evidence import Evidence
from forward_grid_mapper.core.search.search import Search
from forward_grid_mapper.core.sensor.forward_model import log_likelihood


def random_readings(rng: np.random.Generator, grid: Grid, count: int) -> Readings:
    """Return readings at random poses in the grid, one in four without echo."""
    left, right, bottom, top = grid.extent
    z_max = 1.2 * max(right - left, top - bottom)
    z = np.where(rng.random(count) < 0.25, z_max, rng.uniform(0.05, 1.0, count) * z_max)
    x, y = rng.uniform(left, right, count), rng.uniform(bottom, top, count)
    half_angle = rng.uniform(0.03, 1.2, count)
    return Readings.from_columns(x=x, y=y, yaw=rng.uniform(-4, 4, count), z=z, z_max=z_max, half_angle=half_angle)


def best_of_all(readings: Readings, grid: Grid, model: ModelParameters, prior: float) -> float:
    """Return the objective of the optimal map, by exhaustive search."""
    best = -math.inf
    for number in range(2**grid.size):
        cells = ((number >> np.arange(grid.size)) & 1).astype(np.uint8).reshape(grid.shape)
        best = max(best, log_likelihood(readings, grid, cells, model) + prior * int(cells.sum()))
    return best


def main() -> None:
    """Run the benchmark."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument('--cases', type=int, default=200)
    parser.add_argument('--readings', type=int, default=12)
    options = parser.parse_args()
    print(f'{"cells":>6s}{"p_hit":>7s}{"prior":>7s}{"cases":>7s}{"reached":>9s}{"mean short":>12s}{"worst":>8s}')
    for width, height, cases in ((4, 3, options.cases), (4, 4, max(1, options.cases // 10))):
        grid = Grid(0.1, 0, 0, width, height)
        for p_hit, prior in ((0.9, 0.5), (0.6, 0.4), (0.3, 0.3)):
            model = ModelParameters(p_hit=p_hit, p_rand=0.1, p_lost=0.1, sigma=0.06, max_incidence_angle=math.pi / 2)
            logit = math.log(prior / (1 - prior))
            short = []
            for seed in range(cases):
                readings = random_readings(np.random.default_rng(seed), grid, options.readings)
                evidence = Evidence(grid, model)
                evidence.extend(readings)
                Search(evidence, SearchParameters(prior=prior, end_cost=0.0)).run()
                cells = evidence.state.maps.occupied
                ours = log_likelihood(readings, grid, cells.reshape(grid.shape), model) + logit * int(cells.sum())
                short.append(best_of_all(readings, grid, model, logit) - ours)
            reached = np.mean(np.array(short) < 1e-3)
            print(
                f'{grid.size:6d}{p_hit:7.1f}{prior:7.1f}{cases:7d}{reached:9.1%}{np.mean(short):12.3f}{max(short):8.2f}'
            )


if __name__ == '__main__':
    main()
