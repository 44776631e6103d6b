"""Jumps of odometry: where they are, and where the robot was after one.

Odometry that begins anew, as a driver that is started again, says nothing of where the robot is on the map, but all the
same how it moves from there on. So what lies between two jumps is a drive of its own, and two guesses say where it
begins: where the robot stood before the jump, or where odometry has it, as where messages are missing. Around both its
readings are compared with the map of what was driven before.

Two kinds of steps are most often right, and jumps only if readings say that the robot stood. A turn that is too fast
for a robot is most often one of a simulated robot; else a gyroscope began anew. A step that is long, but no faster than
this robot drives, is most often one of odometry with few messages.
"""

from __future__ import annotations

import itertools
import math
from collections.abc import Sequence
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from ..common.parameters import Parameters
from ..common.readings import Readings, of_drives
from .holding_out import LEAST_SIGMAS, Gain, gain
from .poses import Floats, compose, inverse, relative, wrapped
from .registration import SILENT, OnMap, moved_to, readings_moved
from .windows import Odometry

LONGEST_STEP = 1.0
"""Metres between two poses of odometry up to which nothing is asked."""

USUAL, TIMES_USUAL, FEWEST_STEPS = 0.9, 2.0, 20
"""Quantile of the lengths and speeds of all steps that is usual; how often as long, or as fast, a step may be; and
steps from which on that is known."""

FEW_STEPS = 5
"""Steps from which on the median is usual: of so few the quantile may be a jump. Of fewer nothing is usual."""

STANDING = 0.01
"""Metres a second up to which a robot stands: poses of a filter tremble meanwhile, and say nothing of how it drives."""

LONGEST_GAP, TIMES_GAP = 2.0, 4.0
"""Seconds between two poses, and how often the median of all, up to either of which no driver was started again."""

LONGEST_TURN, FASTEST_TURN = 0.5, 2 * math.pi
"""Radians between two poses, and radians a second, beyond both of which no robot turns."""

MOST_DOUBTFUL = 20
"""Doubtful steps that are looked at: a robot that moves so more often does."""

LOOKED_BACK = 20.0
"""Metres before such a step that the map is made of on which readings are compared."""

LONGEST_OUTLIER = 0.5
"""Seconds between the poses before and after others that are outliers."""

FASTEST = 3.0
"""Metres a second that a robot may have driven across a jump."""

MOST_JUMPS = 20
"""Jumps from which on it is no wheel odometry."""

FEWEST_READINGS = 100
"""Readings before a jump, and after it, that it takes to tell where the robot was."""

SIGMA = np.array([0.25, 0.25, math.radians(10.0)])
"""σ of both guesses: metres, and radians."""

BLOCK = 0.8
"""Metres of the drive that are compared as one."""

FIRST_WAY, OWN = 1.0, 8.0
"""Metres after a jump whose readings must fit, before sonars in front see what is new, and those that they are on a map
of their own with."""

GOOD, GOOD_AT_REST = 0.65, 0.4
"""Part of the score that readings have on a map of their own which a place must have, as a place that is recognised
while driving; and which it must have where the robot stood, if it cannot have driven: odometry begins anew far more
often than a robot is carried. Where it stood readings had 0.5 to 0.9 of it, elsewhere in the building 0.0 to 0.66."""

LEAST_KNOWN, FEWEST_KNOWN = 0.2, 30
"""Part of the first readings, and how many, that must lie on the map."""

SAME = 0.25
"""Metres between two places that are one."""

MOST_SAID = 3
"""Jumps that are told of."""


def jumps(odometry: Odometry) -> NDArray[np.int64]:
    """Return the numbers of the poses that odometry jumps to; those of doubtful steps are not among them."""
    found, doubtful = _found(odometry)
    return found[~doubtful]


def doubtful_steps(odometry: Odometry) -> NDArray[np.int64]:
    """Return the numbers of the poses that odometry turns to faster than a robot can, or drives far to in one step."""
    found, doubtful = _found(odometry)
    return found[doubtful]


def _found(odometry: Odometry) -> tuple[NDArray[np.int64], NDArray[np.bool_]]:
    """Return the numbers of the poses that odometry may have jumped to, and of which of them that is doubtful."""
    seconds, pose = np.diff(odometry.stamp) * 1e-9, odometry.pose
    far = np.hypot(*np.diff(pose[:, :2], axis=0).T)
    moved = (far > STANDING * seconds) & (seconds > 0.0)
    longest, fastest, count = LONGEST_STEP, 0.0, np.count_nonzero(moved)
    apart = float(np.median(seconds)) if len(seconds) else 0.0
    if count >= FEW_STEPS:
        usual = USUAL if count >= FEWEST_STEPS else 0.5
        longest = max(longest, TIMES_USUAL * float(np.quantile(far[moved], usual)))
        fastest = min(TIMES_USUAL * float(np.quantile(far[moved] / seconds[moved], usual)), FASTEST)
    elif FASTEST * apart > LONGEST_STEP:
        # a robot may drive so far from one message to the next
        fastest = FASTEST
    found = np.flatnonzero((far > longest) | _turned(np.diff(pose[:, 2]), seconds))
    gap = max(LONGEST_GAP, TIMES_GAP * apart)
    driven = (far <= fastest * seconds) & (seconds <= gap)
    return found + 1, ((far <= longest) | driven)[found]


def _turned(turn: Any, seconds: Any) -> Any:
    """Return whether no robot turns so from one pose to the next: radians, and seconds."""
    turn = np.abs(wrapped(turn))
    return (turn > LONGEST_TURN) & (turn > FASTEST_TURN * np.asarray(seconds))


def too_far(metres: Any, seconds: Any) -> Any:
    """Return whether no robot drives so far in that time, though messages may be missing."""
    return metres > LONGEST_STEP + FASTEST * seconds


def since_jump(odometry: Odometry) -> Odometry:
    """Return the odometry from the last jump on; all of it if there is none."""
    found = jumps(odometry)
    first = int(found[-1]) if len(found) else 0
    return Odometry(odometry.stamp[first:], odometry.pose[first:]) if first else odometry


def without_outliers(odometry: Odometry) -> Odometry:
    """Return odometry without poses that it jumps to and soon back from, to where it goes on as if they were not there.

    The same object if there are none.
    """
    stay, found = np.ones(len(odometry.stamp), np.bool_), _found(odometry)[0].tolist()
    for begin, end in itertools.pairwise(found):
        around = [begin - 1, end]
        seconds = float(np.diff(odometry.stamp[around])[0]) * 1e-9
        x, y, turn = np.diff(odometry.pose[around], axis=0)[0].tolist()
        back = math.hypot(x, y) <= LONGEST_STEP and not _turned(turn, seconds)
        if stay[begin - 1] and seconds <= LONGEST_OUTLIER and back:
            stay[begin:end] = False
    return odometry if stay.all() else Odometry.of(odometry.stamp[stay], odometry.pose[stay])


class Part(NamedTuple):
    """What lies between two jumps, or between one and an end of the drive.

    Attributes
    ----------
    readings : Readings
        Placed by `path`.
    odometry, path : Odometry
        As odometry has it, and the trajectory, which begins where odometry does.
    lost : bool
        Whether the heading got lost, so that nothing should be fitted to it.
    """

    readings: Readings
    odometry: Odometry
    path: Odometry
    lost: bool


class Begin(NamedTuple):
    """Where a part begins on the map, shape (3,), and what that is taken from."""

    pose: Floats
    how: str


FIRST, STOOD, DRIVEN, UNKNOWN = 'first', 'stood', 'driven', 'unknown'
"""The first part that has readings; where the robot was before the jump; where odometry has it, and readings agree; and
where odometry has it, though readings do not tell."""


def with_doubtful(
    readings: Readings,
    odometry: Odometry,
    jumped_to: NDArray[np.int64],
    parameters: Parameters,
    stop: NDArray[np.uint8],
) -> NDArray[np.int64]:
    """Return the jumps, and with them those doubtful steps that the robot did not make, as its readings say.

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
        end = min(end, int(np.searchsorted(travel, travel[at] + OWN)))
        before, after = _piece(odometry, begin, at), _piece(odometry, at, end)
        part = Part(_read_along(readings, after), after, after, False)
        on_map = _read_along(readings, before)
        if min(len(part.readings), len(on_map)) < FEWEST_READINGS:
            continue
        # right at the step odometry has not drifted yet, so nothing is searched
        around = OnMap(part.readings, after.pose[0], on_map, parameters, stop)
        usual = _Usual(part, parameters, stop)
        stood, went = (usual.fits(around, pose, GOOD_AT_REST) for pose in (before.pose[-1], after.pose[0]))
        if stood and not went:
            out.add(at)
    return np.array(sorted(out), np.int64)


def _piece(odometry: Odometry, begin: int, end: int) -> Odometry:
    return Odometry(odometry.stamp[begin:end], odometry.pose[begin:end])


def _read_along(readings: Readings, path: Odometry) -> Readings:
    return readings.select((readings.stamp >= path.stamp[0]) & (readings.stamp <= path.stamp[-1]))


def parts_at(readings: Readings, odometry: Odometry, jumped_to: NDArray[np.int64]) -> list[tuple[Readings, Odometry]]:
    """Return the readings and the odometry of each part; readings of the time of a jump are of none."""
    parts = []
    for begin, end in itertools.pairwise([0, *jumped_to.tolist(), len(odometry.stamp)]):
        part = _piece(odometry, begin, end)
        parts.append((_read_along(readings, part), part))
    return parts


def begins_of(parts: Sequence[Part], parameters: Parameters, stop: NDArray[np.uint8]) -> list[Begin]:
    """Return where each part begins on the map of those before it.

    Raises
    ------
    Cancelled
        If `stop` was set.
    """
    out: list[Begin] = []
    on_map: list[Readings] = []
    # the frames of odometry on the map, the latest last, and where and when the robot was
    frames, end, stamp = [np.zeros(3)], np.zeros(3), 0
    for part in parts:
        seconds = (int(part.odometry.stamp[0]) - stamp) * 1e-9
        driven = [compose(frame, part.path.pose[0]) for frame in reversed(frames)]
        begin = Begin(driven[0], FIRST if len(part.readings) >= FEWEST_READINGS else UNKNOWN)
        stood = driven[0]
        if on_map:
            # odometry may be back in a frame that it was in before
            guess = next((pose for pose in driven if not _too_fast(end, pose, seconds)), None)
            stood, other = end, driven[0] if guess is None else guess
            begin = _begin_after(part, (stood, other), guess is None, of_drives(on_map), parameters, stop)
        out.append(begin)
        known = begin.how != UNKNOWN
        path = moved_to(begin.pose if known else stood, part.path.pose)
        end, stamp = path[-1], int(part.odometry.stamp[-1])
        if known:
            frame = compose(end, inverse(part.odometry.pose[-1]))
            frames = [*(each for each in frames if not _same(each, frame)), frame]
            on_map.append(readings_moved(part.readings, part.path.pose[0], begin.pose))
    return out


def _same(one: Floats, other: Floats) -> bool:
    return bool(np.all(np.abs(relative(one, other)) < SIGMA))


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
    """Return where a part begins that follows a jump.

    Parameters
    ----------
    part : Part
    guesses : (float64, float64), both of shape (3,)
        The begin on the map if the robot stood, and as odometry has it.
    fast : bool
        Whether the robot cannot have driven from one to the other.
    others : Readings
        Of the parts before, on the map.
    parameters, stop
        As in `begins_of`.
    """
    unknown = Begin(guesses[1], UNKNOWN)
    if part.lost or len(part.readings) < FEWEST_READINGS:
        return unknown
    around = OnMap(part.readings, part.path.pose[0], others, parameters, stop)
    blocks = max(int(part.path.travel[-1] / BLOCK), 1)
    found = [around.search(guess, SIGMA, blocks) for guess in guesses]
    usual = _Usual(part, parameters, stop)
    stood, driven, exactly = (_said(around.predicted(pose, blocks)) for pose in (*found, guesses[1]))
    better = compared(driven, stood).sigmas
    if usual.fits(around, found[0], GOOD_AT_REST if fast else GOOD) and (fast or better >= LEAST_SIGMAS):
        return Begin(found[0], STOOD)
    # both guesses may lead to one place
    same = np.hypot(*relative(found[1], found[0])[:2]) < SAME
    if usual.fits(around, found[1], GOOD) and not fast and (-better >= LEAST_SIGMAS or same):
        return Begin(found[1] if compared(exactly, driven).sigmas >= LEAST_SIGMAS else guesses[1], DRIVEN)
    return unknown


class _Usual:
    """How well the first readings of a part fit on a map, beside how well they fit on their own."""

    def __init__(self, part: Part, parameters: Parameters, stop: NDArray[np.uint8]) -> None:
        readings, path = part.readings, part.path
        travel = np.interp(readings.stamp - path.stamp[0], path.stamp - path.stamp[0], path.travel)
        own = readings.select(travel <= OWN)
        self._count = int(np.count_nonzero(travel <= FIRST_WAY))
        begin = path.pose[0]
        self._own = OnMap(own, begin, own, parameters, stop).of_each(begin, self._count)

    def fits(self, around: OnMap, begin: Floats, least: float) -> bool:
        """Return whether they fit so well, in parts of that, as far as they are on the map: a part of them must be."""
        there = around.of_each(begin, self._count)
        known = np.abs(there) > SILENT
        if np.count_nonzero(known) < max(LEAST_KNOWN * len(known), FEWEST_KNOWN):
            return False
        return bool(there[known].sum() >= least * self._own[known].sum() > 0.0)


def _said(values: Floats) -> Floats:
    """Return what blocks say, NaN where all they read is new."""
    out: Floats = np.where(np.abs(values) > SILENT, values, np.nan)
    return out


def compared(before: Floats, after: Floats) -> Gain:
    """Return the gain of `after` over blocks that say something in either place; what is new says nothing."""
    some = np.isfinite(before) | np.isfinite(after)
    return gain(np.nan_to_num(before[some]), np.nan_to_num(after[some]))


def words(begins: Sequence[Begin], parts: Sequence[Part]) -> str:
    """Return what became of each jump."""
    said = []
    for k, ((before, part), begin) in enumerate(zip(itertools.pairwise(parts), begins[1:], strict=True), 1):
        far = math.dist(before.odometry.pose[-1, :2].tolist(), part.odometry.pose[0, :2].tolist())
        driven = sum(float(each.odometry.travel[-1]) for each in parts[:k])
        said.append(f'odometry jumps by {far:.1f} m after {driven:.0f} m of driving{BECAME[begin.how]}')
    more = f'; and {len(said) - MOST_SAID} more' if len(said) > MOST_SAID else ''
    return '; '.join(said[:MOST_SAID]) + more


BECAME = {
    FIRST: ', with hardly any readings before it',
    STOOD: ': the readings fit the pose of the robot before it, and mapping continues from that pose',
    DRIVEN: ', and the readings after it fit the poses of odometry',
    UNKNOWN: (
        ', and the readings after it do not determine the pose of the robot: they are mapped with the poses of '
        'odometry, which may be wrong; after a jump call reset, or map the rest of the drive separately'
    ),
}
"""What became of a jump."""
