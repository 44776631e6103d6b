"""Whether learned values are any good, by readings that had no part in learning them.

The drive is cut into blocks of `BLOCK` seconds, and every fifth block is held out in turn. From the rest, values are
learned and two maps made, one with the values from the start and one with the learned values. Both maps are asked how
likely the readings held out are. Values that fit the noise raise the likelihood of any map, also of one that shows less
of the walls; so the maps are compared at the same values, once at those from the start and once at those learned. The
learned values are accepted if their map is not the worse one by either.
"""

from __future__ import annotations

import dataclasses

import numpy as np
from numpy.typing import NDArray

from .common.grid import UNKNOWN
from .common.parameters import ModelParameters, Parameters
from .common.readings import Readings
from .joint_learning import Foresight, Learned, Watch, learn_jointly
from .mapping import Mapper
from .maps.map_set import MapSet
from .messages.message_types import NANOSECONDS
from .sensor.cone_table import grid_of
from .sensor.forward_model import ForwardModel
from .sensor.surface_normals import on_larger_grid

BLOCK = 2.0
"""Seconds: within them, readings of a sensor see nearly the same."""

FOLDS = 5


def folds_of(readings: Readings) -> NDArray[np.int64]:
    """Return in which fold each reading is held out, shape (N,)."""
    since = (readings.stamp - readings.stamp.min()) / NANOSECONDS
    return np.asarray(since // BLOCK, np.int64) % FOLDS


def foresight(
    readings: Readings, parameters: Parameters, rounds: int, watch: Watch = lambda stage, progress: None
) -> Foresight | None:
    """Return how likely readings are that had no part in learning; None if the drive is too short to hold any out.

    Parameters
    ----------
    readings : Readings
    parameters : Parameters
        Where learning starts.
    rounds : int
        Of learning, at most.
    watch : callable
        Receives stages and progress, as in `Mapper.run`.
    """
    fold = folds_of(readings)
    if len(np.unique(fold)) < FOLDS:
        return None
    total = np.zeros((2, 2))
    for k in range(FOLDS):
        watch(f'held-out readings, {k + 1} of {FOLDS}', None)
        rest, held = readings.select(fold != k), readings.select(fold == k)
        first = Mapper(parameters).run(rest)
        learned = learn_jointly(rest, parameters, rounds, keep_going=True).maps
        for i, maps in enumerate((first, learned)):
            for j, values in enumerate((parameters.model, learned.parameters.model)):
                total[i, j] += log_likelihood_of(held, maps, values)
    return Foresight(*(total / len(readings)).ravel().tolist())


def log_likelihood_of(held: Readings, maps: MapSet, values: ModelParameters) -> float:
    """Return log p(held | map) in nats of readings that the map was not made of; beyond its edges nothing stands."""
    whole = grid_of(held, values, maps.parameters.grid, maps.grid)
    ml = np.full(whole.shape, UNKNOWN, np.int8)
    ml[whole.window(maps.grid)] = maps.ml
    return ForwardModel(held, whole, values, on_larger_grid(maps.normals, maps.grid, whole)).log_likelihood(ml)


def only_if_foreseen(
    found: Learned,
    readings: Readings,
    parameters: Parameters,
    rounds: int,
    watch: Watch = lambda stage, progress: None,
) -> Learned:
    """Return what learning found, or the values from the start where held-out readings do not speak for it.

    The parameters are those of `learn_jointly`, and what it found.
    """
    if not found.accepted:
        return found
    seen = foresight(readings, parameters, rounds, watch)
    if seen is None:
        short = f'the drive is shorter than {FOLDS * BLOCK:.0f} s: no readings could be held out to judge the values by'
        return dataclasses.replace(found, warnings=(*found.warnings, short))
    if seen.better:
        return dataclasses.replace(found, foresight=seen)
    why = (
        f'the learned values are refused: readings that had no part in learning are not likelier with their map '
        f'({seen.learned_at_first:.3f} nats a reading at the values from the start, {seen.learned_at_learned:.3f} at '
        f'the learned ones) than with the map of the values from the start ({seen.first_at_first:.3f} and '
        f'{seen.first_at_learned:.3f}); those are kept. --keep-going hands out the learned ones'
    )
    return dataclasses.replace(
        found,
        parameters=parameters,
        estimates={},
        accepted=0,
        maps=Mapper(parameters).run(readings, watch),
        warnings=(*found.warnings, why),
        foresight=seen,
    )
