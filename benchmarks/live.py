#!/usr/bin/env python3
"""Quality and speed of the live map: the default, and one sum of all readings as in the paper.

usage: live.py [--quick]

On random buildings of many materials (`material_worlds.py`), of which the first 24 were used to tune the default and
the others were not; on the worlds of `quality.py`; and on the recordings under ../shared/data, if they exist. Figures
are those of ../shared/tools/score_map.py, for all cells with a probability. --quick uses fewer drives.
"""

from __future__ import annotations

import argparse
import itertools
import sys
import time
from collections.abc import Iterator
from pathlib import Path
from types import ModuleType

import numpy as np
import quality_worlds
from material_worlds import building_case
from quality_scores import ROBOT_RADIUS, on_truth
from quality_worlds import Case, recorded_cases, scoring_tool, simulated_cases

from forward_grid_mapper.core.common.parameters import Parameters
from forward_grid_mapper.core.maps.log_odds_map import LogOddsMap
from forward_grid_mapper.files.parameter_file import load_parameters

PAPER = Path(__file__).resolve().parents[1] / 'config' / 'paper.yaml'
RECORDINGS = ('building_a', 'building_b', 'building_c', 'office_a', 'office_b')
TUNED, HELD = 24, 12
FIGURES = ('f1', 'nav_iou', 'leak', 'blocked', 'beyond', 'log_loss')


def figures(case: Case, parameters: Parameters, tool: ModuleType) -> list[float]:
    """Return `FIGURES` and readings a second of one core."""
    seconds = []
    for _ in range(3):
        live, begun = LogOddsMap(parameters), time.process_time()
        live.add(case.readings)
        seconds.append(time.process_time() - begun)
    p = on_truth(live.probability(), live.grid, case, tool)
    path = tool.path_cells(case.path_xy, np.array(case.origin), case.resolution, case.truth.shape)
    scores = tool.score(p, case.truth, path, case.resolution, ROBOT_RADIUS)
    return [*(scores[name] for name in FIGURES), len(case.readings) / min(seconds)]


def groups(tool: ModuleType, quick: bool) -> Iterator[tuple[str, list[Case]]]:
    """Yield names of rows and their cases."""
    share = 6 if quick else 1
    yield 'materials, tuned on', [building_case(seed) for seed in range(0, TUNED, share)]
    yield 'materials, held out', [building_case(seed) for seed in range(TUNED, TUNED + HELD, share)]
    quality_worlds.RECORDINGS = RECORDINGS
    for cases in (recorded_cases(tool), simulated_cases(quick)):
        for name, group in itertools.groupby(cases, key=lambda case: case.group):
            yield name, list(group)


def main() -> None:
    """Run the benchmark."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument('--quick', action='store_true')
    options = parser.parse_args()
    tool = scoring_tool()
    if tool is None:
        sys.exit('without ../shared/tools/score_map.py there are no figures')
    ways = {'default': Parameters(), 'one sum': Parameters.from_flat(load_parameters(PAPER).values)}
    print(f'{"":32s}' + ''.join(f'{name:>9s}' for name in FIGURES) + f'{"readings/s":>12s}')
    for name, cases in groups(tool, options.quick):
        for title, parameters in ways.items():
            *means, rate = np.mean([figures(case, parameters, tool) for case in cases], axis=0)
            print(f'{name:22s}{title:10s}' + ''.join(f'{v:9.3f}' for v in means) + f'{rate:12,.0f}', flush=True)


if __name__ == '__main__':
    main()
