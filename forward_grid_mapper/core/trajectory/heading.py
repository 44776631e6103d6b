"""The heading of the robot over the drive, from walls that mostly stand at right angles to each other.

A hidden Markov model: the state is δ, what the yaw of odometry must be corrected by so that walls lie along the axes of
the map. It moves as odometry drifts,

    δ' = δ + bias · travel + turn_scale · turn + noise

and the votes of walls say how likely it is at each place. All values of δ are followed at once, so the heading is not
lost in a hall or a slip. Bias, turn scale and the noise are those with the largest likelihood of all votes; for them δ
is followed modulo 90°, as walls know it. Then it is followed around the full circle, where votes count less and noise
more, since echoes of one wall vote many times: so the model says by itself where a right angle may have been lost.

A building may have parts that stand askew to each other: then the state has the direction of the walls beside the robot
as well, which is one of a few, and stays the same for many metres. A direction is added where votes are much likelier
with it.

Buildings whose walls stand at any angle have votes that agree on nothing, and then nothing is said.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from .hidden_markov import forward, smooth
from .poses import Floats
from .walls import DIRECTIONS
from .windows import Windows

STATES = 2 * DIRECTIONS
"""States of δ, half a degree each."""

STEP = math.radians(90.0 / STATES)

UNIFORM_PART = 0.3
"""Weight of a vote that says nothing: boxes and people have directions too."""

SLIPS = 0.03
"""Part of the motions whose noise is three times larger."""

TURN_NOISE = math.radians(2.0)
"""Noise of a turn, radians a √radian."""

LEAST_NOISE = math.radians(0.3)

NOISES = tuple(math.radians(v) for v in (0.5, 1.0, 2.0, 4.0))
"""Noise of yaw that is tried, radians a √metre."""

BIASES = np.radians(np.arange(-4.0, 4.01, 0.25))
TURN_SCALES = np.arange(-0.08, 0.081, 0.02)
"""Calibrations that are tried, radians a metre, and parts."""

BIAS_SIGMA, TURN_SCALE_SIGMA = math.radians(1.5), 0.03

NEAR = 8
"""Degrees around the heading in which a vote is taken for one of it."""

PRECISION = 2.0
"""Times that the mean direction of a peak is known better than one vote in it."""

TEMPER, WIDER = 0.5, 1.5
"""What a vote counts, and how many times larger the noise is, where δ is followed around the full circle."""

LEAST_GAIN = 0.12
"""Nats a vote that the best heading must be likelier than chance for it to be believed."""


FEWEST_VOTES = 4

DOUBTFUL, PAUSE = 0.02, 5
"""Probability of having lost a right angle from where on a place is doubtful, and votes between two such places."""

NEGLIGIBLE = 1e-4
"""Probability of it below which a place is not named."""

PARTS_ASKEW = 2
"""Parts of a building that stand askew to the first, at the most."""

ASKEW, FINER = np.radians(np.arange(6.0, 85.0, 3.0)), np.radians([-2.0, -1.0, 1.0, 2.0])
"""Directions of walls that are tried, radians from those of the first part, and around the best of these."""

LEAST_APART = math.radians(6.0)
"""Radians between the directions of two parts: less, and matching takes care of it."""

ENTERED = 0.02
"""How often the robot comes to walls of any direction, a metre."""

LEAST_ASKEW = 8.0
"""Nats by which votes must be likelier with another direction of walls. In 64 drives through buildings at right angles
they were so by 5.1 at the most. In 5 of 12 drives through buildings with a kink they were so by 10 to 21, in the others
by less than 7."""


class Drifts(NamedTuple):
    """How the yaw of odometry drifts: radians a metre, parts, and radians a √metre. The signs are those of δ."""

    bias: float
    turn_scale: float
    noise: float


@dataclass(frozen=True)
class Heading:
    """What walls say about the yaw.

    Attributes
    ----------
    at : int64, shape (B,)
        Nodes with votes.
    correction : float64, shape (B,)
        Of the yaw of odometry, radians, without jumps.
    measured : float64, shape (B,)
        The same from the votes of this place alone, near `correction`.
    information : float64, shape (B,)
        Of `measured`, in 1/rad²; 0 where the votes say nothing.
    drifts : Drifts
    gain : float
        Nats a vote, over votes that agree on nothing.
    certainty : float
        Least probability, over the drive, that no right angle was lost.
    over_odometry : float
        Nats by which all votes are likelier than if odometry had no error of yaw.
    askew : float64, shape (B,)
        Direction of the walls at each place, radians, modulo a right angle: 0 in the first part of the building.
    doubts : tuple of (int, float)
        Nodes where a right angle may have been lost, and the probability of it.
    slight : tuple of (int, float)
        Other nodes, and how little probable it is there.
    """

    at: NDArray[np.int64]
    correction: Floats
    measured: Floats
    information: Floats
    drifts: Drifts
    gain: float
    certainty: float
    over_odometry: float
    askew: Floats
    doubts: tuple[tuple[int, float], ...] = ()
    slight: tuple[tuple[int, float], ...] = ()

    def turned(self, node: int, angle: float) -> Heading:
        """Return the same with what comes from a node on turned by `angle`, radians."""
        more = np.where(self.at >= node, angle, 0.0)
        return replace(self, correction=self.correction + more, measured=self.measured + more)


class _Chain:
    """The votes along a drive, and how likely they are given how odometry drifts.

    Parameters
    ----------
    askew : sequence of float
        Directions that walls have, radians; the first is 0.
    around : int
        Right angles that the states of δ go around: 1 or 4.
    temper, wider : float
        What a vote counts, and what the noise is multiplied with.

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
        askew: Sequence[float] = (0.0,),
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
        seen = np.degrees(np.array(askew)[:, None] - (yaw[:, None, None] + self.grid)) % DIRECTIONS
        ends = np.column_stack([votes, votes[:, :1]])
        places = np.arange(DIRECTIONS + 1)
        rows = np.stack([np.interp(place, places, row) for place, row in zip(seen, ends, strict=True)])
        self.likelihood: Floats = (UNIFORM_PART + (1.0 - UNIFORM_PART) * rows) ** temper
        self._anywhere = np.full(self.states, 1 / self.states)
        self._other = -np.expm1(-ENTERED * self.length) if len(askew) > 1 else np.zeros(len(self.length))

    def drift(self, drifts: Drifts) -> Floats:
        """Return by how much δ changes without noise from place to place."""
        out: Floats = drifts.bias * self.length + drifts.turn_scale * self.turn
        return out

    def off(self, value: Any) -> Floats:
        """Return how far the states lie from a value, the shorter way around."""
        period = self.states * STEP
        out: Floats = (self.grid - value + period / 2) % period - period / 2
        return out

    def _densities(self, drifts: Drifts) -> Floats:
        """Return the densities that δ moves with from place to place, shape (B - 1, states)."""
        noise = self._wider * drifts.noise
        sigma = np.sqrt(noise**2 * self.length + TURN_NOISE**2 * self.turned + LEAST_NOISE**2)[:, None]
        x = self.off(self.drift(drifts)[:, None])
        density = (1 - SLIPS) * np.exp(-0.5 * (x / sigma) ** 2) + SLIPS / 3 * np.exp(-0.5 * (x / sigma / 3) ** 2)
        out: Floats = density / density.sum(1, keepdims=True)
        return out

    def log_likelihood(self, drifts: Drifts) -> float:
        """Return that of all votes, in nats."""
        return forward(self.likelihood, self._densities(drifts), self._other, self._anywhere)[0]

    def smooth(self, drifts: Drifts, start: Floats | None = None) -> Floats:
        """Return what all votes say of direction and δ at each place, shape (B, D, states).

        Parameters
        ----------
        drifts : Drifts
        start : float64, shape (states,), optional
            How likely each δ is before any vote; by default all are equally likely.
        """
        begin = self._anywhere if start is None else start
        return smooth(self.likelihood, self._densities(drifts), self._other, begin)

    def without_drift(self) -> float:
        """Return the log-likelihood of all votes if δ is the same everywhere."""
        each = np.log(self.likelihood.mean(1)).sum(0)
        return float(each.max() + math.log(np.exp(each - each.max()).mean()))


def _most_probable(chain: _Chain, belief: Floats) -> tuple[Floats, Floats]:
    """Return the most probable right angle's mean δ at each place, without jumps, and its probability."""
    half = (np.abs(chain.off(0.0)) < math.pi / 4).astype(np.float64)
    masses = np.fft.irfft(np.fft.rfft(belief, axis=1) * np.conj(np.fft.rfft(half)), chain.states, axis=1)
    middle = chain.grid[masses.argmax(1)]
    off = chain.off(middle[:, None])
    inside = belief * (np.abs(off) < math.pi / 4)
    mass = inside.sum(1)
    return np.unwrap(middle + (inside * off).sum(1) / mass), mass


def doubts(at: NDArray[np.int64], certain: Floats) -> tuple[tuple[int, float], ...]:
    """Return the nodes at which the probability of having lost no right angle falls, and by how much.

    Parameters
    ----------
    at : int64, shape (B,)
    certain : float64, shape (B,)
        That probability from the begin of the drive to each node.
    """
    falls = _falls(certain)
    out = []
    for part in _doubtful(falls):
        sums = np.cumsum(falls[part])
        out.append((int(at[part[np.searchsorted(sums, sums[-1] / 2)]]), float(sums[-1])))
    return tuple(out)


def slight(at: NDArray[np.int64], certain: Floats) -> tuple[tuple[int, float], ...]:
    """Return the other nodes at which that probability falls, and by how much; the parameters are those of `doubts`."""
    falls = _falls(certain)
    for part in _doubtful(falls):
        falls[part] = 0.0
    return tuple((int(at[k]), float(falls[k])) for k in np.flatnonzero(falls > NEGLIGIBLE))


def _falls(certain: Floats) -> Floats:
    """Return by how much the least probability so far falls at each place, shape (B,)."""
    out: Floats = -np.diff(np.minimum.accumulate(certain), prepend=certain[0])
    return out


def _doubtful(falls: Floats) -> list[NDArray[np.int64]]:
    """Return the runs of places that are doubtful."""
    falling = np.flatnonzero(falls > DOUBTFUL / 10)
    runs = np.split(falling, np.flatnonzero(np.diff(falling) > PAUSE) + 1)
    return [run for run in runs if falls[run].sum() >= DOUBTFUL]


def yaws_of_votes(votes: Floats, yaw: Floats, correction: Floats) -> tuple[Floats, Floats]:
    """Return the correction that the votes of each place say by themselves near `correction`, and its information."""
    off = np.arange(-NEAR, NEAR + 1)
    seen = np.degrees(-(yaw + correction))[:, None] - off
    places = np.arange(DIRECTIONS + 1)
    ends = np.column_stack([votes, votes[:, :1]])
    rows = np.stack([np.interp(place % DIRECTIONS, places, row) for place, row in zip(seen, ends, strict=True)])
    excess = np.maximum(rows - 1.0, 0.0)
    mass = excess.sum(1)
    mean = (excess * off).sum(1) / np.maximum(mass, 1e-9)
    spread = (excess * (off - mean[:, None]) ** 2).sum(1) / np.maximum(mass, 1e-9)
    # a wall is told from chance where votes for it are several times the mean
    weight = np.clip((rows.max(1) - 1.5) / 1.5, 0.0, 1.0)
    information = PRECISION * weight / np.radians(np.sqrt(spread + 2.0)) ** 2
    return correction + np.radians(mean), np.where(mass > 0, information, 0.0)


def heading(windows: Windows, at: NDArray[np.int64], votes: Floats, noises: Sequence[float] = NOISES) -> Heading | None:
    """Return what walls say about the yaw; None where they agree on nothing.

    Parameters
    ----------
    windows : Windows
    at, votes
        Those of `wall_votes`.
    noises : sequence of float
        Noise of yaw that is tried, radians a √metre.
    """
    if len(at) < FEWEST_VOTES:
        return None
    askew = [0.0]
    chain = _Chain(windows, at, votes)
    best, value = _fitted(chain, Drifts(0.0, 0.0, noises[len(noises) // 2]), noises)
    while len(askew) <= PARTS_ASKEW:
        angle, noise, likelier = _further_direction(windows, at, votes, askew, best, noises)
        if likelier <= value:
            break
        other = _Chain(windows, at, votes, [*askew, angle])
        found, now = _fitted(other, best._replace(noise=noise), noises)
        if now - value < LEAST_ASKEW:
            break
        askew, chain, best, value = [*askew, angle], other, found, now
    total = chain.log_likelihood(best)
    if total < LEAST_GAIN * len(at):
        return None
    circle = _Chain(windows, at, votes, askew, 4, TEMPER, WIDER)
    # where the drive begins any right angle will do
    first = chain.grid[int(chain.smooth(best)[0].sum(0).argmax())]
    start = (np.abs(circle.off(first)) < math.pi / 4).astype(np.float64)
    belief = circle.smooth(best, start)
    correction, certain = _most_probable(circle, belief.sum(1))
    direction = np.array(askew)[belief.sum(2).argmax(1)]
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
    """Return the log-likelihood of all votes, with the prior of a calibration."""
    prior = (drifts.bias / BIAS_SIGMA) ** 2 + (drifts.turn_scale / TURN_SCALE_SIGMA) ** 2
    return chain.log_likelihood(drifts) - 0.5 * prior


def _fitted(chain: _Chain, drifts: Drifts, noises: Sequence[float]) -> tuple[Drifts, float]:
    """Return the likeliest drift, one figure after the other, and its value."""
    for name, values in (('bias', BIASES), ('turn_scale', TURN_SCALES), ('noise', noises)):
        tried = [drifts._replace(**{name: float(value)}) for value in values]
        drifts = max(tried, key=lambda each: _log_posterior(chain, each))
    return drifts, _log_posterior(chain, drifts)


def _further_direction(
    windows: Windows,
    at: NDArray[np.int64],
    votes: Floats,
    askew: Sequence[float],
    drifts: Drifts,
    noises: Sequence[float],
) -> tuple[float, float, float]:
    """Return the direction of walls that is likeliest beside those known, radians, the noise with it, and its value."""
    # where walls explain what looked like drift, odometry strays less
    some = [noise for noise in noises if noise <= drifts.noise][-2:] or [drifts.noise]

    def best(angles: list[float], noises: Sequence[float]) -> tuple[float, float, float]:
        tried = []
        for angle in angles:
            chain = _Chain(windows, at, votes, [*askew, angle])
            tried += [(angle, noise, _log_posterior(chain, drifts._replace(noise=noise))) for noise in noises]
        return max(tried, key=lambda each: each[2])

    quarter = math.pi / 2
    apart = [min(abs(math.remainder(angle - known, quarter)) for known in askew) for angle in ASKEW]
    angle, noise, _ = best([float(a) for a, least in zip(ASKEW, apart, strict=True) if least >= LEAST_APART], some)
    return best([angle, *(angle + FINER).tolist()], [noise])
