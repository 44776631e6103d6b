"""Learning of the model together with the map: rounds of map search and updates, and warnings about the result.

Each round makes the map for the present values, and updates these on that map until they converge. The map of the next
round shows whether the new values are good: if it has lost walls of the first map, they are rejected, and learning ends
with those of the round before.
"""

from __future__ import annotations

import dataclasses
import math
import time
from collections.abc import Callable
from dataclasses import dataclass
from typing import Any, NamedTuple, Protocol

import numpy as np
from numpy.typing import NDArray

from .common.grid import part_of
from .common.parameter_groups import ModelParameters
from .common.parameters import Parameters
from .common.readings import Readings
from .common.words import counted
from .learning.lost_walls import Stretch, lost_walls
from .learning.model_update import learn
from .learning.standard_errors import LEARNED, ParameterEstimate, parameter_estimates
from .mapping import Mapper
from .maps.map_set import MapSet
from .search.search import Progress
from .sensor.forward_model import ForwardModel

Watch = Callable[[str, Progress | None], None]

FEW_READINGS = 200
"""Fewer readings with information about a value give a warning."""
LARGE_P_RAND = 0.3
"""A larger learned p_rand gives a warning."""
LIKELIHOOD_DROP = 0.01
"""Nats a reading by which a new map may be less likely than the one before, at the same values, without a warning."""
LEAST_STANDARD_ERRORS = 1.0
"""Standard errors by which held-out readings must be likelier with the map of learned values: the rule of one standard
error in cross-validation, by which the simpler model is kept unless another one is better by more than that."""
_UPDATES = 100
_SETTLED = 2e-4
_CONVERGED = 0.01
_NO_LOSS = 1e-4


@dataclass(frozen=True)
class Round:
    """One round of learning.

    Attributes
    ----------
    model : ModelParameters
        The values; of round 0, those that learning started from.
    readings : int
    log_likelihood : float
        Of the readings, given these values and the map made with them, in nats.
    log_likelihood_before : float
        The same, at the same values and with the same normals, of the map that the values were learned from; NaN in
        round 0.
    occupied : int
        Occupied cells of the map.
    unexplained : int
        Echoes that are random measurements by this map.
    lost : tuple of Stretch
        Walls of the first map that are missing on this one.
    """

    model: ModelParameters
    readings: int
    log_likelihood: float
    log_likelihood_before: float
    occupied: int
    unexplained: int
    lost: tuple[Stretch, ...]

    @property
    def lost_length(self) -> float:
        """Total length of lost walls, metres."""
        return sum(stretch.length for stretch in self.lost)


class CrossValidation(NamedTuple):
    """Mean log-likelihood of a held-out reading, nats, on the map of the first values and on that of the learned ones.

    Each map is evaluated with the first values and with the learned ones; `error_at_…` is the standard error of the
    difference between the two maps.
    """

    first_at_first: float
    first_at_learned: float
    learned_at_first: float
    learned_at_learned: float
    error_at_first: float
    error_at_learned: float

    @property
    def better(self) -> bool:
        """Whether the map of the learned values is significantly better, with both the first and the learned values."""
        at_first, at_learned = self.gains
        least = LEAST_STANDARD_ERRORS
        return at_first > least * self.error_at_first and at_learned > least * self.error_at_learned

    @property
    def gains(self) -> tuple[float, float]:
        """Gains of the map of the learned values, with the first values and with the learned ones, nats a reading."""
        return self.learned_at_first - self.first_at_first, self.learned_at_learned - self.first_at_learned


@dataclass(frozen=True)
class Learned:
    """The result of learning.

    Attributes
    ----------
    parameters : Parameters
        The given ones with the learned values.
    estimates : dict of str to ParameterEstimate
        The learned values with their standard errors; empty if already the first update was rejected.
    rounds : tuple of Round
        From round 0, with the initial values, to the last one, rejected or not.
    accepted : int
        The round whose values are the result.
    converged : bool
        Whether the values converged.
    maps : MapSet
        Of the accepted round.
    warnings : tuple of str
    cross_validation : CrossValidation, optional
        Result of the cross-validation, if it was made (`cross_validated`).
    """

    parameters: Parameters
    estimates: dict[str, ParameterEstimate]
    rounds: tuple[Round, ...]
    accepted: int
    converged: bool
    maps: MapSet
    warnings: tuple[str, ...]
    cross_validation: CrossValidation | None = None


def settle(forward: ForwardModel, occupied: NDArray[Any]) -> ModelParameters:
    """Return the model after updates on one map until its values converge."""
    model = forward.model
    for _ in range(_UPDATES):
        before, model = model, learn(forward.at(model), occupied)
        if _change(before, model) < _SETTLED:
            break
    # the updates approach 0 only asymptotically
    return dataclasses.replace(model, p_lost=0.0) if model.p_lost < _NO_LOSS else model


class MapMaker(Protocol):
    """Makes maps of readings: `Mapper`, or `TiledMapper`."""

    def run(self, readings: Readings, watch: Watch) -> MapSet:
        """Return the maps of readings."""


def map_and_learn(
    readings: Readings,
    parameters: Parameters,
    rounds: int,
    watch: Watch = lambda stage, progress: None,
    mapper: Callable[[Parameters], MapMaker] = Mapper,
) -> MapSet:
    """Return the maps after `rounds` rounds with one update of the model each, without checks of the result.

    The seconds of a stage are the sum over all rounds. `mapper` returns the object that makes the maps.

    Raises
    ------
    InputError
        If there are no readings, or they span too large a map.
    """
    maps = mapper(parameters).run(readings, watch)
    seconds = dict(maps.statistics['seconds'])
    for _ in range(rounds):
        watch('learning', None)
        begun = time.perf_counter()
        parameters = dataclasses.replace(parameters, model=learn(maps.forward_model(), maps.ml))
        seconds['learning'] = seconds.get('learning', 0.0) + time.perf_counter() - begun
        maps = mapper(parameters).run(readings, watch)
        for stage, more in maps.statistics['seconds'].items():
            seconds[stage] += more
    maps.statistics['seconds'] = seconds
    return maps


def learn_jointly(
    readings: Readings,
    parameters: Parameters,
    rounds: int = 5,
    keep_going: bool = False,
    watch: Watch = lambda stage, progress: None,
    first: MapSet | None = None,
) -> Learned:
    """Learn p_hit, p_rand, p_lost and σ together with the map.

    Parameters
    ----------
    readings : Readings
    parameters : Parameters
        With the initial values; p_lost stays 0 if it is 0.
    rounds : int
        Most rounds.
    keep_going : bool
        Whether to accept values even if their map loses walls.
    watch : callable
        Receives stages and progress, as in `Mapper.run`.
    first : MapSet, optional
        The maps of the initial values, if they were made already.

    Raises
    ------
    InputError
        If there are no readings, or they span too large a map.
    """
    first = last = first or Mapper(parameters).run(readings, watch)
    accepted, history = [first], [_round(first, first, None)]
    learned_from = first
    converged = False
    for _ in range(rounds):
        watch('learning', None)
        model = settle(last.forward_model(), last.ml)
        maps = Mapper(dataclasses.replace(parameters, model=model)).run(readings, watch)
        history.append(_round(first, maps, last))
        if history[-1].lost and not keep_going:
            break
        learned_from = last
        accepted.append(maps)
        converged = _change(last.parameters.model, model) < _CONVERGED
        last = maps
        if converged:
            break
    found = {}
    if len(accepted) > 1:
        found = parameter_estimates(learned_from.forward_model().at(last.parameters.model), learned_from.ml)
    number = len(accepted) - 1
    warnings = (*_quality_warnings(history, number, converged), *_value_warnings(found, last.parameters.model))
    return Learned(last.parameters, found, tuple(history), number, converged, last, warnings)


def _change(before: ModelParameters, after: ModelParameters) -> float:
    """Return the largest change: absolute for probabilities, relative for σ."""
    changes = [abs(getattr(after, name) - getattr(before, name)) for name in LEARNED]
    changes[LEARNED.index('sigma')] /= before.sigma
    return float(max(changes))


def _round(first: MapSet, maps: MapSet, before: MapSet | None) -> Round:
    """Return the data of a round, whose values were learned from the map `before`."""
    forward = maps.forward_model()
    same_values = math.nan
    if before is not None:
        # on the new grid, since the normals belong to its cells
        same_values = forward.log_likelihood(part_of(before.grid, before.ml, maps.grid))
    return Round(
        maps.parameters.model,
        len(maps.readings),
        maps.log_likelihood,
        same_values,
        int(np.count_nonzero(maps.ml == 1)),
        int(np.count_nonzero(maps.readings.echo & maps.unexplained)),
        tuple(lost_walls(first, maps)) if maps is not first else (),
    )


def _quality_warnings(rounds: list[Round], accepted: int, converged: bool) -> list[str]:
    """Return warnings about the rounds of learning."""
    warnings = []
    start, last = rounds[0], rounds[-1]
    if last.lost:
        longest = last.lost[0]
        (x0, y0), (x1, y1) = longest.start, longest.end
        echoes = sum(stretch.echoes for stretch in last.lost)
        rise = last.model.p_hit - start.model.p_hit
        climbed = f'p_hit rose from {start.model.p_hit:.2f} to {last.model.p_hit:.2f}, and ' if rise > 0 else ''
        basin = (
            'smooth walls are lost in this way: with a large p_hit, their missing echoes outweigh their echoes'
            if rise > 0
            else 'their echoes are now explained as random measurements'
        )
        if accepted:
            kept = f'those of round {accepted} are kept'
        else:
            kept = 'the initial values are kept, and nothing was learned'
        warnings.append(
            f'round {len(rounds) - 1} loses walls: {climbed}{last.lost_length:.1f} m of wall in {len(last.lost)} '
            f'segments of the first map are lost, the longest from ({x0:.1f}, {y0:.1f}) to ({x1:.1f}, {y1:.1f}); '
            f'{echoes} of their echoes count as random measurements now, and of all echoes {last.unexplained} instead '
            f'of {start.unexplained}; {basin}; '
            + ('they are written in any case' if accepted == len(rounds) - 1 else f'its values are refused, {kept}')
        )
    for number, this in enumerate(rounds):
        drop = this.log_likelihood_before - this.log_likelihood
        if drop > LIKELIHOOD_DROP * this.readings:
            warnings.append(
                f'round {number}: the search ended in a map that is {drop:.0f} nats less likely than the one before, '
                'at the same values; it is in another local maximum'
            )
    if accepted and not converged and accepted == len(rounds) - 1:
        warnings.append(f'the values had not converged after {counted(accepted, "round")}; try more rounds (--rounds)')
    return warnings


def _value_warnings(found: dict[str, ParameterEstimate], model: ModelParameters) -> list[str]:
    """Return warnings about values with little information."""
    warnings = []
    for name, estimate in found.items():
        if estimate.bound and not (name == 'p_lost' and model.p_lost == 0):
            warnings.append(f'{name} = {estimate.value:.3g} has no standard error: {estimate.bound}')
        if estimate.readings < FEW_READINGS and not (name == 'p_lost' and model.p_lost == 0):
            warnings.append(f'only {estimate.readings:.0f} readings inform {name}; it is only a rough estimate')
    if found and model.p_rand > LARGE_P_RAND:
        warnings.append(
            f'p_rand = {model.p_rand:.2f} is more than the random measurements of a working sonar: look for a broken '
            'sensor, a wrong sensor pose, odometry that drifts, or people around the robot'
        )
    return warnings
