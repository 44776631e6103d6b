"""The scale of a trajectory that was matched with itself.

Local maps are scaled as the trajectory is, so matches confirm a wrong scale of the wheels. Ranges are in metres: walls
are blurred if they do not agree with the way between the places that they were measured from. So a few metres at a time
are made shorter and longer, and J of their maps is compared. Visits of a place do not matter there. They do in the map
of the whole drive, which prefers the scale at which they were matched.

Where surfaces lie in their cells changes J as much as a per cent of scale does. So each map has axes of its own, drawn
at random.
"""

from __future__ import annotations

import math
from functools import partial
from typing import NamedTuple

import numpy as np

from ..common.errors import InputError
from ..common.readings import Floats
from ..runtime.threads import in_order
from .fitting import fitted
from .passes import Progress
from .scans import FEWEST_ON_MAP, Scans

SPAN, EVERY, MOST_PLACES, FEWEST_PLACES = 4.0, 2.0, 120, 4
"""Metres of progress before and after the middle of a place whose windows make its map, metres from one place to the
next, and most and fewest places."""

OFFSET = 0.1
"""Largest offset of the origin of a map, along each axis, metres."""

CHANGE = 0.05
"""Relative change of the scale, to both sides, that is tried."""

SAMPLES = 200
"""Number of samples of the bootstrap."""

AT_TRUE_SCALE = 0.01
"""Relative change of the scale that J prefers along true poses; it differs by a per cent and more between drives."""

LEAST_CHANGE, LEAST_SIGMAS = 0.008, 2.0
"""The scale is changed if it is off by this much, and by this many standard errors."""

ROUNDS, SETTLED = 6, 0.002
"""Most times that the scale is changed; it is right if it is off by less than this then, or by one standard error."""

NO_CHANGE = (0.0, math.inf)


class ScaleError(NamedTuple):
    """By how much a trajectory is too small, as a fraction of its size, with its standard error."""

    value: float
    sigma: float


def scale_error(scans: Scans, nodes: Floats, watch: Progress = lambda part: None) -> ScaleError:
    """Return by how much a trajectory is too small.

    J of the maps of all places is a parabola of the scale near its maximum. The standard error is that of the bootstrap
    over places. Maps of neighbouring places share readings, so it may be too small by a factor of two.

    Parameters
    ----------
    scans : Scans
    nodes : float64, shape (K, 3)
    watch : callable
        Receives the fraction of the work that is done.

    Returns
    -------
    ScaleError
        `CHANGE` at most, apart from `AT_TRUE_SCALE`; 0 ± ∞ if there are few places.
    """
    progress = scans.windows.node_progress
    middles = np.arange(progress[0] + SPAN, progress[-1] - SPAN, EVERY)
    if len(middles) > MOST_PLACES:
        middles = np.linspace(middles[0], middles[-1], MOST_PLACES)
    work = [partial(_objectives, scans, nodes, middle, k) for k, middle in enumerate(middles.tolist())]
    rows = []
    for done, row in enumerate(in_order(work, scans.threads), 1):
        watch(done / len(work))
        if row is not None:
            rows.append(row)
    if len(rows) < FEWEST_PLACES:
        return ScaleError(*NO_CHANGE)
    values, number = np.array(rows), len(rows)
    times = np.random.default_rng(0).multinomial(number, np.full(number, 1.0 / number), SAMPLES)
    return ScaleError(float(_top(values.sum(0))) - AT_TRUE_SCALE, float(_top(times @ values).std()))


def at_likeliest_scale(scans: Scans, nodes: Floats, watch: Progress = lambda part: None) -> tuple[Floats, float]:
    """Return the nodes at the scale that readings show, and the factor of it; the same nodes and 1 if it is right.

    A trajectory that was matched at one scale does not fit its map at another, and J of a few metres shows only a part
    of the error. So after each change the trajectory is fitted to its map. It is taken if J of the map of the whole
    drive is larger than that of the trajectory that was fitted but not scaled.
    """
    best, factor, least = nodes, 1.0, math.inf
    scaled, by = nodes, 1.0
    for k in range(ROUNDS):
        try:
            error = scale_error(scans, scaled, partial(_in_round, watch, k))
            if abs(error.value) < (max(SETTLED, error.sigma) if k else max(LEAST_CHANGE, LEAST_SIGMAS * error.sigma)):
                break
            if not k:
                least = scans.objective(fitted(scans, nodes))
            change = 1.0 + error.value
            scaled, by = fitted(scans, enlarged(scaled, scaled[0], change)), by * change
            if scans.objective(scaled) > least:
                best, factor = scaled, by
        except InputError:
            # a map may be too large along a larger trajectory, or in other axes
            break
        watch((k + 1) / ROUNDS)
    return best, factor


def _in_round(watch: Progress, k: int, part: float) -> None:
    """Report the progress of round k while the error is found; fitting is the other half."""
    watch((k + part / 2) / ROUNDS)


def enlarged(nodes: Floats, centre: Floats, factor: float) -> Floats:
    """Return the nodes with distances from a point multiplied by a factor; x and y of the point come first."""
    out = nodes.copy()
    out[:, :2] = centre[:2] + factor * (nodes[:, :2] - centre[:2])
    return out


def _objectives(scans: Scans, nodes: Floats, middle: float, seed: int) -> list[float] | None:
    """Return J of the map around a place if it is smaller, as it is, and larger, nats; None with few readings."""
    near = np.flatnonzero(np.abs(scans.windows.node_progress - middle) <= SPAN)
    if scans.count[near].sum() < FEWEST_ON_MAP:
        return None
    centre = nodes[near[len(near) // 2]]
    frame = centre + np.random.default_rng(seed).uniform(0.0, [OFFSET, OFFSET, math.pi / 2])
    along = [enlarged(nodes, centre, 1.0 + change) for change in (-CHANGE, 0.0, CHANGE)]
    return [scans.objective_of(near, frame, scaled) for scaled in along]


def _top(values: Floats) -> Floats:
    """Return the change of the scale at the top of the parabola through J, `CHANGE` at most; values of shape (…, 3).

    Far from the maximum, J has no top (`certainty.parabola_top` then knows nothing). There it is larger on the side of
    the maximum.
    """
    smaller, same, larger = np.moveaxis(values, -1, 0)
    curvature, slope = np.maximum(2.0 * same - smaller - larger, 1e-9), larger - smaller
    return np.asarray(CHANGE * np.clip(slope / (2.0 * curvature), -1.0, 1.0), np.float64)
