"""The heading of the robot over the drive, from walls that mostly stand at right angles to each other.

A hidden Markov model. Its state is δ, the correction of the yaw of odometry with which walls are parallel to the axes
of the map. δ changes as odometry drifts,

    δ' = δ + bias · travel + turn_scale · turn + noise of travel and of turns

and the votes of walls are its likelihood at each place. The belief over all values of δ is kept, so the heading is not
lost in a hall or by a slip. Bias, turn scale and noise of travel maximise the likelihood of all votes; for this δ is
filtered modulo 90°, as walls determine it. Then δ is filtered around the full circle, with tempered votes and larger
noise of travel, since each echo votes several times, and with the likeliest noise of turns. This gives the probability
that a right angle was lost, and where.

Parts of a building may stand at an angle to each other. So the state also has the direction of the walls beside the
robot: one of a few, which seldom changes. A direction is added if votes are much likelier with it.

In buildings whose walls stand at any angle, votes do not agree, and there is no result.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from ..common.readings import Floats
from .doubts import doubts, slight
from .hidden_markov import forward, smooth
from .walls import DIRECTIONS, votes_for
from .windows import Windows

STATES = 2 * DIRECTIONS
"""States of δ, half a degree each."""

STEP = math.radians(90.0 / STATES)

UNIFORM_PART = 0.3
"""Weight of the uniform part of the likelihood of a vote: boxes and people have directions too."""

SLIPS = 0.03
"""Fraction of the motions whose noise is three times larger."""

LEAST_NOISE = math.radians(0.3)

NOISES = tuple(math.radians(v) for v in (0.5, 1.0, 2.0, 4.0))
"""Values of the yaw noise that are tried, radians a √metre."""

TURN_NOISES = tuple(math.radians(v) for v in (2.0, 4.0, 8.0))
"""Values of the noise of turns that are tried, radians a √radian. Some wheels make most of their errors in turns
(`benchmarks/wheel_noise.py`), and may lose a right angle there."""

BIASES = np.radians(np.arange(-4.0, 4.01, 0.25))
TURN_SCALES = np.arange(-0.08, 0.081, 0.02)
"""Values of the calibration that are tried, radians a metre, and fraction."""

BIAS_SIGMA, TURN_SCALE_SIGMA = math.radians(1.5), 0.03

NEAR = 8
"""Degrees around the heading within which votes measure it."""

PRECISION = 2.0
"""Information of the mean direction of a peak, in units of that of a single vote."""

TEMPER, WIDER = 0.5, 1.5
"""Exponent of votes, and factor of the noise, if δ is filtered around the full circle."""

LEAST_GAIN = 0.12
"""Nats a vote by which the best heading must be likelier than chance to be accepted."""

FEWEST_VOTES = 4

MOST_FURTHER_PARTS = 2
"""Most parts of a building that stand at an angle to the first one."""

TRIED_DIRECTIONS, FINER = np.radians(np.arange(6.0, 85.0, 3.0)), np.radians([-2.0, -1.0, 1.0, 2.0])
"""Directions of walls that are tried, radians relative to the first part, and offsets around the best of these."""

LEAST_APART = math.radians(6.0)
"""Least angle between the directions of two parts, radians; matching corrects smaller ones."""

ENTERED = 0.02
"""Rate at which the direction of walls is drawn again, 1/m."""

LEAST_PART_GAIN = 8.0
"""Nats by which votes must be likelier with another direction of walls. It was at most 5.1 in 64 drives through
buildings with right angles, 10 to 21 in 5 of 12 drives through buildings with a kink, less than 7 in the other 7."""


class Drifts(NamedTuple):
    """Drift of the yaw of odometry. The signs are those of δ.

    Attributes
    ----------
    bias : float
        Radians a metre.
    turn_scale : float
        Fraction of each turn.
    noise, turn_noise : float
        σ of the noise: radians a √metre of travel, and radians a √radian of turning. The noise of turns is estimated
        only for the probability that a right angle was lost; otherwise it is the smallest of `TURN_NOISES`.
    """

    bias: float
    turn_scale: float
    noise: float
    turn_noise: float = TURN_NOISES[0]


@dataclass(frozen=True)
class Heading:
    """The correction of the yaw from walls, at B places.

    Attributes
    ----------
    at : int64, shape (B,)
        Their nodes.
    correction : float64, shape (B,)
        Of the yaw of odometry, radians, unwrapped.
    measured : float64, shape (B,)
        The same from the votes of this place alone, near `correction`.
    information : float64, shape (B,)
        Of `measured`, 1/rad²; 0 if the votes do not determine it.
    drifts : Drifts
    gain : float
        Log-likelihood ratio to uniform votes, nats a vote.
    certainty : float
        Probability that no right angle was lost, the smallest of the drive.
    over_odometry : float
        Log-likelihood ratio of all votes to odometry without errors of the yaw, nats.
    wall_direction : float64, shape (B,)
        Direction of the walls at each place, radians, modulo a right angle: 0 in the first part of the building.
    doubts : tuple of (int, float)
        Doubtful nodes, and the probability that a right angle was lost there.
    slight : tuple of (int, float)
        Other nodes, at which this probability is small.
    """

    at: NDArray[np.int64]
    correction: Floats
    measured: Floats
    information: Floats
    drifts: Drifts
    gain: float
    certainty: float
    over_odometry: float
    wall_direction: Floats
    doubts: tuple[tuple[int, float], ...] = ()
    slight: tuple[tuple[int, float], ...] = ()

    def turned(self, node: int, angle: float) -> Heading:
        """Return the heading turned by `angle`, radians, from a node on."""
        more = np.where(self.at >= node, angle, 0.0)
        return replace(self, correction=self.correction + more, measured=self.measured + more)


class _Chain:
    """The hidden Markov model of a drive.

    Parameters
    ----------
    directions : sequence of float
        Directions of walls, radians; the first is 0.
    around : int
        Number of right angles that the states of δ cover: 1 or 4.
    temper, wider : float
        Exponent of votes, and factor of the noise.

    Attributes
    ----------
    likelihood : float64, shape (B, D, states)
        Of the votes of each place, for each of D directions of walls and each δ.
    """

    def __init__(
        self,
        windows: Windows,
        at: NDArray[np.int64],
        votes: Floats,
        directions: Sequence[float] = (0.0,),
        around: int = 1,
        temper: float = 1.0,
        wider: float = 1.0,
    ) -> None:
        yaw = windows.node[at, 2]
        self.length, self.turned = np.diff(windows.travel[at]), np.diff(windows.turn[at])
        self.turn = np.diff(yaw)
        self.states, self._wider = around * STATES, wider
        self.grid = np.arange(self.states) * STEP
        # a wall along an axis has the direction −(yaw + δ) in the frame of the node
        rows = votes_for(votes, np.degrees(np.array(directions)[:, None] - (yaw[:, None, None] + self.grid)))
        self.likelihood: Floats = (UNIFORM_PART + (1.0 - UNIFORM_PART) * rows) ** temper
        self._anywhere = np.full(self.states, 1 / self.states)
        self._other = -np.expm1(-ENTERED * self.length) if len(directions) > 1 else np.zeros(len(self.length))

    def drift(self, drifts: Drifts) -> Floats:
        """Return the change of δ from each place to the next, without noise, radians, shape (B − 1,)."""
        out: Floats = drifts.bias * self.length + drifts.turn_scale * self.turn
        return out

    def off(self, value: Any) -> Floats:
        """Return the signed difference of the states from a value, the shorter way around, radians."""
        period = self.states * STEP
        out: Floats = (self.grid - value + period / 2) % period - period / 2
        return out

    def _densities(self, drifts: Drifts) -> Floats:
        """Return the densities of the change of δ from each place to the next, shape (B - 1, states)."""
        noise = self._wider * drifts.noise
        sigma = np.sqrt(noise**2 * self.length + drifts.turn_noise**2 * self.turned + LEAST_NOISE**2)[:, None]
        x = self.off(self.drift(drifts)[:, None])
        density = (1 - SLIPS) * np.exp(-0.5 * (x / sigma) ** 2) + SLIPS / 3 * np.exp(-0.5 * (x / sigma / 3) ** 2)
        out: Floats = density / density.sum(1, keepdims=True)
        return out

    def log_likelihood(self, drifts: Drifts) -> float:
        """Return the log-likelihood of all votes, nats."""
        return forward(self.likelihood, self._densities(drifts), self._other, self._anywhere)[0]

    def smooth(self, drifts: Drifts, start: Floats | None = None) -> Floats:
        """Return the belief over direction and δ at each place given all votes, shape (B, D, states).

        Parameters
        ----------
        drifts : Drifts
        start : float64, shape (states,), optional
            Prior of δ; by default uniform.
        """
        begin = self._anywhere if start is None else start
        return smooth(self.likelihood, self._densities(drifts), self._other, begin)

    def without_drift(self) -> float:
        """Return the log-likelihood of all votes if δ is constant, nats."""
        each = np.log(self.likelihood.mean(1)).sum(0)
        return float(each.max() + math.log(np.exp(each - each.max()).mean()))


def _most_probable(chain: _Chain, belief: Floats) -> tuple[Floats, Floats]:
    """Return the mean δ of the most probable quarter of the circle at each place, unwrapped, and its probability."""
    half = (np.abs(chain.off(0.0)) < math.pi / 4).astype(np.float64)
    masses = np.fft.irfft(np.fft.rfft(belief, axis=1) * np.conj(np.fft.rfft(half)), chain.states, axis=1)
    middle = chain.grid[masses.argmax(1)]
    off = chain.off(middle[:, None])
    inside = belief * (np.abs(off) < math.pi / 4)
    mass = inside.sum(1)
    return np.unwrap(middle + (inside * off).sum(1) / mass), mass


def yaws_of_votes(votes: Floats, yaw: Floats, correction: Floats) -> tuple[Floats, Floats]:
    """Return the correction by the votes of each place alone, near `correction`, and its information."""
    off = np.arange(-NEAR, NEAR + 1)
    rows = votes_for(votes, np.degrees(-(yaw + correction))[:, None] - off)
    excess = np.maximum(rows - 1.0, 0.0)
    mass = excess.sum(1)
    mean = (excess * off).sum(1) / np.maximum(mass, 1e-9)
    spread = (excess * (off - mean[:, None]) ** 2).sum(1) / np.maximum(mass, 1e-9)
    # votes that are several times the mean are no chance
    weight = np.clip((rows.max(1) - 1.5) / 1.5, 0.0, 1.0)
    information = PRECISION * weight / np.radians(np.sqrt(spread + 2.0)) ** 2
    return correction + np.radians(mean), np.where(mass > 0, information, 0.0)


def heading(windows: Windows, at: NDArray[np.int64], votes: Floats, noises: Sequence[float] = NOISES) -> Heading | None:
    """Return the heading from the votes of walls; None if votes do not agree.

    Parameters
    ----------
    windows : Windows
    at, votes
        Those of `wall_votes`.
    noises : sequence of float
        Values of the yaw noise that are tried, radians a √metre.
    """
    if len(at) < FEWEST_VOTES:
        return None
    directions = [0.0]
    chain = _Chain(windows, at, votes)
    best, value = _fitted(chain, Drifts(0.0, 0.0, noises[len(noises) // 2]), noises)
    while len(directions) <= MOST_FURTHER_PARTS:
        angle, noise, likelier = _further_direction(windows, at, votes, directions, best, noises)
        if likelier <= value:
            break
        other = _Chain(windows, at, votes, [*directions, angle])
        found, now = _fitted(other, best._replace(noise=noise), noises)
        if now - value < LEAST_PART_GAIN:
            break
        directions, chain, best, value = [*directions, angle], other, found, now
    total = chain.log_likelihood(best)
    if total < LEAST_GAIN * len(at):
        return None
    circle = _Chain(windows, at, votes, directions, 4, TEMPER, WIDER)
    # at the start of the drive any of the four right angles may be chosen
    first = chain.grid[int(chain.smooth(best)[0].sum(0).argmax())]
    start = (np.abs(circle.off(first)) < math.pi / 4).astype(np.float64)
    belief = circle.smooth(_with_noise_of_turns(chain, best), start)
    correction, certain = _most_probable(circle, belief.sum(1))
    direction = np.array(directions)[belief.sum(2).argmax(1)]
    measured, information = yaws_of_votes(votes, windows.node[at, 2] - direction, correction)
    return Heading(
        at,
        correction,
        measured,
        information,
        best,
        total / len(at),
        float(certain.min()),
        total - chain.without_drift(),
        direction,
        doubts(at, certain),
        slight(at, certain),
    )


def _log_posterior(chain: _Chain, drifts: Drifts) -> float:
    """Return the log-likelihood of all votes plus the log prior of the calibration, nats."""
    prior = (drifts.bias / BIAS_SIGMA) ** 2 + (drifts.turn_scale / TURN_SCALE_SIGMA) ** 2
    return chain.log_likelihood(drifts) - 0.5 * prior


def _fitted(chain: _Chain, drifts: Drifts, noises: Sequence[float]) -> tuple[Drifts, float]:
    """Return the likeliest drift, found one parameter after the other, and its log posterior."""
    for name, values in (('bias', BIASES), ('turn_scale', TURN_SCALES), ('noise', noises)):
        tried = [drifts._replace(**{name: float(value)}) for value in values]
        drifts = max(tried, key=lambda each: _log_posterior(chain, each))
    return drifts, _log_posterior(chain, drifts)


def _with_noise_of_turns(chain: _Chain, drifts: Drifts) -> Drifts:
    """Return the drift with the likeliest noise of turns beside its noise of travel.

    Found together, the noise of travel would be smaller. That is too small, since votes average over straight
    stretches, and the heading would be called certain where these are long.
    """
    tried = [drifts._replace(turn_noise=of_turns) for of_turns in TURN_NOISES]
    return max(tried, key=lambda each: _log_posterior(chain, each))


def _further_direction(
    windows: Windows,
    at: NDArray[np.int64],
    votes: Floats,
    directions: Sequence[float],
    drifts: Drifts,
    noises: Sequence[float],
) -> tuple[float, float, float]:
    """Return the likeliest further direction of walls, radians, the yaw noise with it, and the log posterior."""
    # with the new direction, less of the votes is explained by drift
    some = [noise for noise in noises if noise <= drifts.noise][-2:] or [drifts.noise]

    def best(angles: list[float], noises: Sequence[float]) -> tuple[float, float, float]:
        tried = []
        for angle in angles:
            chain = _Chain(windows, at, votes, [*directions, angle])
            tried += [(angle, noise, _log_posterior(chain, drifts._replace(noise=noise))) for noise in noises]
        return max(tried, key=lambda each: each[2])

    quarter = math.pi / 2
    apart = [min(abs(math.remainder(angle - known, quarter)) for known in directions) for angle in TRIED_DIRECTIONS]
    angle, noise, _ = best(
        [float(a) for a, least in zip(TRIED_DIRECTIONS, apart, strict=True) if least >= LEAST_APART], some
    )
    return best([angle, *(angle + FINER).tolist()], [noise])
