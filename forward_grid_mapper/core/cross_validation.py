"""Cross-validation of learned values by held-out readings.

The drive is divided into blocks of `BLOCK` seconds, and every fifth block is held out in turn. Values are learned from
the rest, and two maps are made, one with the initial values and one with the learned ones. On both, the likelihood of
the held-out readings is evaluated. Values that fit the noise increase the likelihood of any map, also of one with fewer
walls. So the maps are compared at the same values, once at the initial and once at the learned ones. The learned values
are accepted if their map is better in both cases by more than a standard error. This is computed from differences of
blocks, since the readings within a block are correlated.
"""

from __future__ import annotations

import dataclasses
import math

import numpy as np
from numpy.typing import NDArray

from .common.grid import UNKNOWN
from .common.parameter_groups import ModelParameters
from .common.parameters import Parameters
from .common.readings import Floats, Readings
from .joint_learning import LEAST_STANDARD_ERRORS, CrossValidation, Learned, Watch, learn_jointly
from .mapping import Mapper
from .maps.map_set import MapSet
from .messages.message_types import NANOSECONDS
from .sensor.cone_table import grid_of
from .sensor.forward_model import ForwardModel
from .sensor.surface_normals import on_larger_grid

BLOCK = 2.0
"""Length of a block, seconds: readings within it are correlated."""

FOLDS = 5


def folds_of(readings: Readings) -> NDArray[np.int64]:
    """Return the fold in which each reading is held out, shape (N,); pauses of the drive do not count."""
    return np.unique(blocks_of(readings), return_inverse=True)[1].ravel() % FOLDS


def blocks_of(readings: Readings) -> NDArray[np.int64]:
    """Return the block of each reading, shape (N,)."""
    since = (readings.stamp - readings.stamp.min()) / NANOSECONDS
    return np.asarray(since // BLOCK, np.int64)


def cross_validated(
    readings: Readings, parameters: Parameters, rounds: int, watch: Watch = lambda stage, progress: None
) -> CrossValidation | None:
    """Return the cross-validation of learning; None if the drive is too short for held-out readings.

    Parameters
    ----------
    readings : Readings
    parameters : Parameters
        With the initial values.
    rounds : int
        Most rounds of learning.
    watch : callable
        Receives stages and progress, as in `Mapper.run`.
    """
    fold = folds_of(readings)
    if len(np.unique(fold)) < FOLDS:
        return None
    # of each reading: by map, and by the values that it is evaluated with
    log_likelihood = np.zeros((2, 2, len(readings)))
    for k in range(FOLDS):
        watch(f'held-out readings, {k + 1} of {FOLDS}', None)
        rest, held = readings.select(fold != k), readings.select(fold == k)
        first = Mapper(parameters).run(rest)
        learned = learn_jointly(rest, parameters, rounds, keep_going=True, first=first).maps
        for i, maps in enumerate((first, learned)):
            for j, values in enumerate((parameters.model, learned.parameters.model)):
                log_likelihood[i, j, fold == k] = log_likelihoods(held, maps, values)
    errors = [standard_error(readings, log_likelihood[1, j] - log_likelihood[0, j]) for j in range(2)]
    return CrossValidation(*log_likelihood.mean(axis=2).ravel().tolist(), *errors)


def standard_error(readings: Readings, differences: Floats) -> float:
    """Return the standard error of the mean of differences, shape (N,), correlated within blocks; inf for one block."""
    _, block = np.unique(blocks_of(readings), return_inverse=True)
    sums, sizes = np.bincount(block, differences), np.bincount(block)
    count = len(sums)
    if count < 2:
        return math.inf
    rest = sums - differences.mean() * sizes
    return math.sqrt(count / (count - 1) * float(rest @ rest)) / len(differences)


def log_likelihoods(held: Readings, maps: MapSet, values: ModelParameters) -> Floats:
    """Return log p(z | map) of held-out readings, nats; outside of the map all is free."""
    whole = grid_of(held, values, maps.parameters.grid, maps.grid)
    ml = np.full(whole.shape, UNKNOWN, np.int8)
    ml[whole.window(maps.grid)] = maps.ml
    return (
        ForwardModel(held, whole, values, on_larger_grid(maps.normals, maps.grid, whole))
        .expectations(ml)
        .log_likelihood
    )


def only_if_validated(
    found: Learned,
    readings: Readings,
    parameters: Parameters,
    rounds: int,
    watch: Watch = lambda stage, progress: None,
) -> Learned:
    """Return the result of learning, or the initial values if cross-validation does not support it.

    The parameters are those of `learn_jointly`, and its result `found`.
    """
    if not found.accepted:
        return found
    validation = cross_validated(readings, parameters, rounds, watch)
    if validation is None:
        short = (
            f'there are readings of less than {FOLDS * BLOCK:.0f} s: no readings could be held out to test the values'
        )
        return dataclasses.replace(found, warnings=(*found.warnings, short))
    if validation.better:
        return dataclasses.replace(found, cross_validation=validation)
    at_first, at_learned = validation.gains
    why = (
        'the learned values are refused, and the initial values are kept: the map of the learned values does not '
        'predict held-out readings better than the map of the initial values. Its gain, with the standard error, is '
        f'{at_first:+.3f} ± {validation.error_at_first:.3f} nats a reading by the initial model and '
        f'{at_learned:+.3f} ± {validation.error_at_learned:.3f} by the learned one; both must be larger than '
        f'{LEAST_STANDARD_ERRORS:g} standard error. '
        '--keep-going writes the learned values in any case'
    )
    return dataclasses.replace(
        found,
        parameters=parameters,
        estimates={},
        accepted=0,
        maps=Mapper(parameters).run(readings, watch),
        warnings=(why, *(f'of the refused values: {warning}' for warning in found.warnings)),
        cross_validation=validation,
    )
