"""The pose of the robot after jumps of odometry.

After a restart, odometry does not tell where the robot is on the map, but it still measures how the robot moves. So the
part between two jumps is a drive of its own. Its start is searched around two guesses: where the robot stood before the
jump, and where odometry has it, which is right if only messages are missing. There its readings are matched with the
map of what was driven before. The same comparison tells whether a doubtful step is a jump.
"""

from __future__ import annotations

import itertools
import math
from collections.abc import Sequence
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from ..common.parameters import Parameters
from ..common.readings import Floats, Readings, of_drives
from .holding_out import LEAST_SIGMAS, Gain, gain
from .jumps import FASTEST_TURN, LONGEST_TURN, doubtful_steps, too_far
from .poses import compose, inverse, relative
from .registration import SILENT, OnMap, moved_to, readings_moved
from .windows import Odometry

MOST_DOUBTFUL = 20
"""Most doubtful steps that are examined: if there are more, the robot does move so."""

LOOKED_BACK = 20.0
"""Metres of travel before such a step whose readings make the map."""

FEWEST_READINGS = 100
"""Fewest readings before a jump, and after it, to find the pose of the robot."""

SIGMA = np.array([0.25, 0.25, math.radians(10.0)])
"""σ of both guesses: metres, metres, radians."""

BLOCK = 0.8
"""Metres of travel of each block whose predictions are compared."""

FIRST_METRES, OWN_MAP = 1.0, 8.0
"""Metres of travel after a jump: the readings of the first ones must fit on the map, since sonars in front soon see new
territory; those of the second make a map of their own for comparison."""

GOOD, GOOD_AT_REST = 0.65, 0.4
"""Least score of readings at a place, as a fraction of that on a map of their own: as for a loop closure; and where the
robot stood, if it cannot have driven, because a restart of odometry is far more frequent than a robot that is carried.
The fraction was 0.5 to 0.9 where the robot stood, and 0.0 to 0.66 elsewhere in the building."""

LEAST_KNOWN, FEWEST_KNOWN = 0.2, 30
"""Fraction of the first readings, and their number, that must lie on the map."""

SAME = 0.25
"""Metres up to which two places are the same."""

MOST_REPORTED = 3
"""Most jumps that are listed in words."""


class Part(NamedTuple):
    """The part of a drive between two jumps, or between one and an end of the drive.

    Attributes
    ----------
    readings : Readings
        Placed by `path`.
    odometry, path : Odometry
        The odometry, and the trajectory, which begins at the first pose of the odometry.
    lost : bool
        Whether the heading was lost, so that the part cannot be registered.
    """

    readings: Readings
    odometry: Odometry
    path: Odometry
    lost: bool


class Begin(NamedTuple):
    """The pose at the start of a part on the map, shape (3,), and where it was found."""

    pose: Floats
    how: str


FIRST, STOOD, DRIVEN, UNKNOWN = 'first', 'stood', 'driven', 'unknown'
"""Values of `Begin.how`: the first part with enough readings; near the pose before the jump; at the pose by odometry,
which readings confirm; at the pose by odometry, which they do not confirm."""


def with_doubtful(
    readings: Readings,
    odometry: Odometry,
    jumped_to: NDArray[np.int64],
    parameters: Parameters,
    stop: NDArray[np.uint8],
) -> NDArray[np.int64]:
    """Return the jumps, and those doubtful steps that are jumps by the readings.

    Parameters
    ----------
    readings : Readings
        Placed by `odometry`.
    odometry : Odometry
    jumped_to : int64, shape (J,)
        As `jumps` returns them.
    parameters, stop
        As in `begins_of`.

    Raises
    ------
    Cancelled
        If `stop` was set.
    """
    doubtful = doubtful_steps(odometry).tolist()
    if not 0 < len(doubtful) <= MOST_DOUBTFUL:
        return jumped_to
    out, travel = set(jumped_to.tolist()), odometry.travel
    for at in doubtful:
        begin = max((k for k in out if k < at), default=0)
        end = min((k for k in out if k > at), default=len(odometry.stamp))
        begin = max(begin, int(np.searchsorted(travel, travel[at - 1] - LOOKED_BACK)))
        end = min(end, int(np.searchsorted(travel, travel[at] + OWN_MAP)))
        before, after = _piece(odometry, begin, at), _piece(odometry, at, end)
        part = Part(_read_along(readings, after), after, after, False)
        on_map = _read_along(readings, before)
        if min(len(part.readings), len(on_map)) < FEWEST_READINGS:
            continue
        # odometry does not drift in a single step, so no search is needed
        around = OnMap(part.readings, after.pose[0], on_map, parameters, stop)
        check = _FitCheck(part, parameters, stop)
        fits_before, fits_after = (check.fits(around, pose, GOOD_AT_REST) for pose in (before.pose[-1], after.pose[0]))
        if fits_before and not fits_after:
            out.add(at)
    return np.array(sorted(out), np.int64)


def _piece(odometry: Odometry, begin: int, end: int) -> Odometry:
    return Odometry(odometry.stamp[begin:end], odometry.pose[begin:end])


def _read_along(readings: Readings, path: Odometry) -> Readings:
    return readings.select((readings.stamp >= path.stamp[0]) & (readings.stamp <= path.stamp[-1]))


def parts_at(readings: Readings, odometry: Odometry, jumped_to: NDArray[np.int64]) -> list[tuple[Readings, Odometry]]:
    """Return the readings and the odometry of each part; readings taken during a jump belong to none."""
    parts = []
    for begin, end in itertools.pairwise([0, *jumped_to.tolist(), len(odometry.stamp)]):
        part = _piece(odometry, begin, end)
        parts.append((_read_along(readings, part), part))
    return parts


def begins_of(parts: Sequence[Part], parameters: Parameters, stop: NDArray[np.uint8]) -> list[Begin]:
    """Return the start of each part on the map of those before it.

    Raises
    ------
    Cancelled
        If `stop` was set.
    """
    out: list[Begin] = []
    on_map: list[Readings] = []
    # the odometry frames on the map, the latest last, and the last pose of the robot and its stamp
    frames, end, stamp = [np.zeros(3)], np.zeros(3), 0
    for part in parts:
        seconds = (int(part.odometry.stamp[0]) - stamp) * 1e-9
        driven = [compose(frame, part.path.pose[0]) for frame in reversed(frames)]
        begin = Begin(driven[0], FIRST if len(part.readings) >= FEWEST_READINGS else UNKNOWN)
        stood = driven[0]
        if on_map:
            # odometry may have returned to an earlier frame
            guess = next((pose for pose in driven if not _too_fast(end, pose, seconds)), None)
            stood, other = end, driven[0] if guess is None else guess
            begin = _begin_after(part, (stood, other), guess is None, of_drives(on_map), parameters, stop)
        out.append(begin)
        known = begin.how != UNKNOWN
        path = moved_to(begin.pose if known else stood, part.path.pose)
        end, stamp = path[-1], int(part.odometry.stamp[-1])
        if known:
            frames.append(compose(end, inverse(part.odometry.pose[-1])))
            on_map.append(readings_moved(part.readings, part.path.pose[0], begin.pose))
    return out


def _too_fast(before: Floats, after: Floats, seconds: float) -> bool:
    x, y, turn = relative(before, after).tolist()
    return bool(too_far(math.hypot(x, y), seconds)) or abs(turn) > LONGEST_TURN + FASTEST_TURN * seconds


def _begin_after(
    part: Part,
    guesses: tuple[Floats, Floats],
    fast: bool,
    others: Readings,
    parameters: Parameters,
    stop: NDArray[np.uint8],
) -> Begin:
    """Return the start of a part that follows a jump.

    Parameters
    ----------
    part : Part
    guesses : (float64, float64), both of shape (3,)
        The pose on the map if the robot stood still, and the one by odometry.
    fast : bool
        Whether the distance between the two is too far for a robot.
    others : Readings
        Of the parts before, in the map frame.
    parameters, stop
        As in `begins_of`.
    """
    unknown = Begin(guesses[1], UNKNOWN)
    if part.lost or len(part.readings) < FEWEST_READINGS:
        return unknown
    around = OnMap(part.readings, part.path.pose[0], others, parameters, stop)
    blocks = max(int(part.path.travel[-1] / BLOCK), 1)
    found = [around.search(guess, SIGMA, blocks) for guess in guesses]
    check = _FitCheck(part, parameters, stop)
    stood, driven, exactly = (_nan_if_new(around.predicted(pose, blocks)) for pose in (*found, guesses[1]))
    better = compared(driven, stood).sigmas
    if check.fits(around, found[0], GOOD_AT_REST if fast else GOOD) and (fast or better >= LEAST_SIGMAS):
        return Begin(found[0], STOOD)
    # both guesses may lead to the same place
    same = np.hypot(*relative(found[1], found[0])[:2]) < SAME
    if check.fits(around, found[1], GOOD) and not fast and (-better >= LEAST_SIGMAS or same):
        return Begin(found[1] if compared(exactly, driven).sigmas >= LEAST_SIGMAS else guesses[1], DRIVEN)
    return unknown


class _FitCheck:
    """Compares the fit of the first readings of a part on a map with that on a map of their own."""

    def __init__(self, part: Part, parameters: Parameters, stop: NDArray[np.uint8]) -> None:
        readings, path = part.readings, part.path
        travel = np.interp(readings.stamp - path.stamp[0], path.stamp - path.stamp[0], path.travel)
        own, begin = readings.select(travel <= OWN_MAP), path.pose[0]
        self._count = int(np.count_nonzero(travel <= FIRST_METRES))
        # there are none if other readings of the place were kept (`max_readings`)
        if self._count >= FEWEST_KNOWN:
            self._own = OnMap(own, begin, own, parameters, stop).of_each(begin, self._count)

    def fits(self, around: OnMap, begin: Floats, least: float) -> bool:
        """Return whether the score of readings on the map is at least a fraction `least` of that on their own map.

        Enough of the readings must lie on the map.
        """
        if self._count < FEWEST_KNOWN:
            return False
        there = around.of_each(begin, self._count)
        known = np.abs(there) > SILENT
        if np.count_nonzero(known) < max(LEAST_KNOWN * len(known), FEWEST_KNOWN):
            return False
        return bool(there[known].sum() >= least * self._own[known].sum() > 0.0)


def _nan_if_new(values: Floats) -> Floats:
    """Return the values of blocks, with NaN for blocks in new territory."""
    out: Floats = np.where(np.abs(values) > SILENT, values, np.nan)
    return out


def compared(before: Floats, after: Floats) -> Gain:
    """Return the gain of `after` over `before`, by blocks that are on the map at either place; NaN counts as 0."""
    some = np.isfinite(before) | np.isfinite(after)
    return gain(np.nan_to_num(before[some]), np.nan_to_num(after[some]))


def jump_words(begins: Sequence[Begin], parts: Sequence[Part]) -> str:
    """Return the result for each jump in words."""
    texts = []
    for k, ((before, part), begin) in enumerate(zip(itertools.pairwise(parts), begins[1:], strict=True), 1):
        far = math.dist(before.odometry.pose[-1, :2].tolist(), part.odometry.pose[0, :2].tolist())
        driven = sum(float(each.odometry.travel[-1]) for each in parts[:k])
        texts.append(f'odometry jumps by {far:.1f} m after {driven:.0f} m of driving{OUTCOME_WORDS[begin.how]}')
    more = f'; and {len(texts) - MOST_REPORTED} more' if len(texts) > MOST_REPORTED else ''
    return '; '.join(texts[:MOST_REPORTED]) + more


OUTCOME_WORDS = {
    FIRST: ', with hardly any readings before it',
    STOOD: ': the readings fit the pose of the robot before it, and mapping continues from that pose',
    DRIVEN: ', and the readings after it fit the poses of odometry',
    UNKNOWN: (
        ', and the readings after it do not determine the pose of the robot: they are mapped with the poses of '
        'odometry, which may be wrong; map the rest of the drive separately (in the node: call reset after a jump)'
    ),
}
"""The result for a jump in words, by `Begin.how`."""
