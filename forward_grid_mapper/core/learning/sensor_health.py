"""The health of each sensor: statistics of its readings, and which sensors are suspect.

Fractions of the readings of a sensor, given the maximum likelihood map:

    random    a random measurement is the likeliest cause (e_* above one half)
    no echo   max-range readings
    missed    no echo, though the map has an obstacle within 3/4 of max range in the cone
    short     a random echo, nearer than half the way to the first obstacle of the cone, or to max range if none
    same      echoes within the most frequent 0.2 m of range, independent of the map
    alike     of the short readings, those within their most frequent 0.2 m of range

A sensor that detects its own robot repeats one range, and the map may even explain it. So if a sensor repeats a range
of less than half of the usual one of the others, a live map of the others' echoes is used as well: an echo from where
this is free is short, too. Their max-range readings do not count: in a corridor of smooth walls, sensors that look
along it meet its walls at a slant and get no echo, while those at the sides hear them at one range all the time.

A parked robot repeats a range for as long as it stands, so the fractions of the places with such readings must be
suspect as well.

Only echoes can be random. A sensor that seldom has one may have a wrong pose although few of its readings are random,
so the fraction of its echoes counts as well.

Fractions are compared with those of the other sensors, since all have no echoes in a hall of smooth walls, and all have
random ones in a crowd. A fraction is suspect if it is large *and* well above the median of the others.
"""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from ..common.readings import Floats, Readings
from ..maps.log_odds_map import LogOddsMap
from ..maps.map_set import MapSet
from ..runtime.jit import kernel
from ..sensor.cone import make_cone, rows_of, runs_of
from ..sensor.forward_model import ForwardModel

FRACTIONS = ('random', 'no_echo', 'missed', 'short')
"""Counts by sensor of which the table has the fractions."""
SHORT_WITHIN = 0.5
"""A random echo is short if it is nearer than this fraction of the distance to the first obstacle."""
MISSED_WITHIN = 0.75
"""A max-range reading is missed if there is an obstacle within this fraction of max range."""
LEAST_READINGS = 30
"""A sensor with fewer readings is not judged, and one with fewer echoes not by their random part."""
LEAST_SHARE_OF_OTHERS = 0.1
"""Nor is one with less than this fraction of the median number of the others."""
DEAF_NO_ECHO, DEAF_MISSED = 0.95, 0.2
"""A sensor that detects nothing has at least these fractions of max-range readings and of missed obstacles."""
DEAF_RANDOM_ECHOES = 0.5
"""At least this fraction of its few echoes is random."""
RANDOM_VERDICTS = ('mostly random', 'often random')
"""Verdicts that drift of odometry gives as well."""
SUSPECT_SHORT = 0.5
SUSPECT_RANDOM = 0.5
SUSPECT_RANDOM_WITH_OTHERS = 0.3
"""A sensor with others to compare with is suspect from this fraction of random readings on: if its pose is wrong, the
walls along which the robot drives still explain many."""
SUSPECT_OF_ECHOES, LEAST_RANDOM = 0.4, 0.1
"""A sensor is suspect from the first fraction of random echoes on as well, if at least the second one of its readings
is random: a sensor that has hardly any echo hears the random ones above all."""
SUSPECT_SAME, WINDOW = 0.8, 0.2
"""A sensor that repeats one range has at least this fraction of its readings, or of its short readings, within this
many metres: it may hear its robot only now and then."""
PERSON_SHORT_SHARE = 0.7
"""If at least this fraction of the random readings is short, but not at one range, a person moves near the sensor."""
BIN, BINS = 0.05, 400
"""Size, metres, and number of the bins of ranges, if readings are counted in portions."""
PLACE_SIZE = 0.1
"""Metres, and radians, from one place to the next. The fraction of the places with such readings must be as large,
since whatever stands near a parked robot is no fault of its sensors."""
ABOVE_MEDIAN = 0.25
"""A suspect fraction is at least this much above the median of the others."""
FREE_PROBABILITY = 0.35
"""Cells of the live map of the others' echoes are free below this probability."""


@dataclass(frozen=True)
class SensorHealth:
    """One row of the table; fractions lie in [0, 1] and are NaN without readings.

    `common` is the mean (the middle, from counts) of the most frequent 0.2 m of range, metres; that of the short
    readings, if these are alike. `verdict` is 'ok', 'few readings', 'something moves near it', 'never hears anything',
    'always short', 'mostly random' or 'often random'.
    """

    readings: int
    random: float
    no_echo: float
    missed: float
    short: float
    same: float
    alike: float
    common: float
    verdict: str

    @property
    def suspect(self) -> bool:
        """Whether the sensor seems to be broken, badly mounted or given a wrong pose."""
        return self.verdict in ('never hears anything', 'always short', *RANDOM_VERDICTS)

    @property
    def verdict_text(self) -> str:
        """The verdict, with the range that a short sensor repeats."""
        return f'{self.verdict}: {self.common:.2f} m' if self.verdict == 'always short' else self.verdict

    def __str__(self) -> str:
        if not self.readings:
            return f'no readings: {self.verdict}'
        return (
            f'{self.readings} readings, {self.random:.0%} random, {self.no_echo:.0%} max range, '
            f'{self.missed:.0%} missed, {self.short:.0%} short: {self.verdict}'
        )


@kernel
def _first_obstacles(cones: Any, occupied: Any, out: Any) -> None:
    """Write the distance of the nearest occupied cell of each cone to `out`, cells; inf for none.

    Cones are cut off at the farthest corner of the grid.
    """
    height, width = occupied.shape
    for t in range(len(cones)):
        reading = cones[t]
        across, up = max(reading.x, width - reading.x), max(reading.y, height - reading.y)
        reach = min(reading.reach, math.hypot(across, up))
        axis, half = (reading.axis_x, reading.axis_y), (reading.sine, reading.cosine)
        cone = make_cone(reading.x, reading.y, axis, half, (reach, 0.0))
        nearest = np.inf
        for row in range(*rows_of(cone, height)):
            v = row + 0.5 - cone.y
            runs = runs_of(cone, row, width)
            for first, last in ((runs.first, runs.last), (runs.first2, runs.last2)):
                for column in range(first, last + 1):
                    if occupied[row, column]:
                        u = column + 0.5 - cone.x
                        nearest = min(nearest, u * u + v * v)
        out[t] = math.sqrt(nearest)


def first_obstacles(forward: ForwardModel, ml: NDArray[np.int8]) -> Floats:
    """Return the distance of the nearest occupied cell within max range in each reading's cone, metres; inf for none.

    Every cell of the cone counts, and the distance is that of its surface, as in the forward model.
    """
    cones = forward.cones.copy()
    cones['reach'] = cones['z_max']
    out = np.empty(len(cones))
    _first_obstacles(cones, np.ascontiguousarray(ml == 1), out)
    return (out - forward.model.surface_offset) * forward.grid.resolution


def commonest_range(z: Floats) -> tuple[int, float]:
    """Return the largest number of ranges within `WINDOW` metres, and their mean; (0, NaN) without ranges."""
    if not len(z):
        return 0, math.nan
    ordered = np.sort(z)
    held = np.searchsorted(ordered, ordered + WINDOW, 'right') - np.arange(len(z))
    first = int(held.argmax())
    return int(held[first]), float(ordered[first : first + held[first]].mean())


def sensor_health(maps: MapSet) -> dict[str, SensorHealth]:
    """Return the table of all sensors, by name in the order of `Readings.sensor_names`."""
    readings = maps.readings
    obstacle = first_obstacles(maps.forward_model(), maps.ml)
    marks = _readings_by_column(readings, obstacle, maps.unexplained)
    count = len(readings.sensor_names)
    numbers = np.bincount(readings.sensor, minlength=count)[:count]
    heard = [readings.z[readings.echo & (readings.sensor == k)] for k in range(count)]
    common = [commonest_range(z) for z in heard]
    usual_range = np.array([np.median(z) if len(z) else math.nan for z in heard])
    for k, (held, middle) in enumerate(common):
        if held >= max(SUSPECT_SAME * numbers[k], 1) and middle < SHORT_WITHIN * _median(np.delete(usual_range, k)):
            marks['short'] |= _from_free_space(maps, k)
    counts = {kind: np.bincount(readings.sensor, weights=mark, minlength=count)[:count] for kind, mark in marks.items()}
    near = [commonest_range(readings.z[marks['short'] & (readings.sensor == k)]) for k in range(count)]
    return _table(readings.sensor_names, numbers, counts | _place_counts(readings, marks), common, near)


def _readings_by_column(
    readings: Readings, obstacle: Floats, unexplained: NDArray[np.bool_]
) -> dict[str, NDArray[np.bool_]]:
    """Return which readings belong to each column of the table, shape (N,)."""
    echo = readings.echo
    return {
        'random': unexplained,
        'no_echo': ~echo,
        'missed': ~echo & (obstacle < MISSED_WITHIN * readings.z_max),
        'short': echo & unexplained & (readings.z < SHORT_WITHIN * np.minimum(obstacle, readings.z_max)),
    }


def _place_counts(readings: Readings, marks: Mapping[str, NDArray[np.bool_]]) -> dict[str, NDArray[np.int64]]:
    """Return from how many places and directions each sensor has readings, random and short ones, shape (S,)."""
    # after a full turn the direction is the same
    pose = readings.x, readings.y, np.remainder(readings.yaw, 2 * math.pi)
    poses = np.column_stack([readings.sensor, *(np.floor(v / PLACE_SIZE) for v in pose)])
    # sorted once, by columns, since np.unique takes seconds for a million rows
    order = np.lexsort(poses.T)
    poses = poses[order]
    other = (poses[1:] != poses[:-1]).any(axis=1)
    place = np.concatenate([np.zeros(min(len(poses), 1), np.int64), np.cumsum(other)])
    sensor = poses[np.flatnonzero(np.diff(place, prepend=-1)), 0].astype(np.int64)
    out = {}
    every = np.ones(len(readings), np.bool_)
    for kind, mine in (('places', every), ('places_random', marks['random']), ('places_short', marks['short'])):
        there = np.bincount(place[mine[order]], minlength=len(sensor)) > 0
        out[kind] = np.bincount(sensor[there], minlength=len(readings.sensor_names))
    return out


def _table(
    names: tuple[str, ...],
    numbers: NDArray[np.int64],
    counts: Mapping[str, NDArray[Any]],
    common: Sequence[tuple[int, float]],
    near: Sequence[tuple[int, float]],
) -> dict[str, SensorHealth]:
    """Return the table from counts by sensor, shape (S,), and `commonest_range` of each and of its short readings."""
    with np.errstate(divide='ignore', invalid='ignore'):
        shares: dict[str, Floats] = {kind: counts[kind] / numbers for kind in FRACTIONS}
        shares |= {kind: counts[kind] / counts['places'] for kind in ('places_random', 'places_short')}
        echoes = numbers - counts['no_echo']
        shares['of_echoes'] = np.where(echoes >= LEAST_READINGS, counts['random'] / echoes, np.nan)
        shares['same'] = np.array([held for held, _ in common], np.float64) / numbers
        shares['alike'] = np.array([held for held, _ in near], np.float64) / counts['short']
    made = {}
    for k, name in enumerate(names):
        mine = {kind: float(share[k]) for kind, share in shares.items()}
        others = {kind: _median(np.delete(share, k)) for kind, share in shares.items()}
        usual = _median(np.delete(numbers, k).astype(np.float64))
        verdict = _verdict(int(numbers[k]), usual, mine, others)
        middle = near[k][1] if mine['alike'] >= SUSPECT_SAME else common[k][1]
        columns = {kind: mine[kind] for kind in (*FRACTIONS, 'same', 'alike')}
        made[name] = SensorHealth(int(numbers[k]), **columns, common=middle, verdict=verdict)
    return made


# ---- the same from portions of the readings, whose counts are added


def health_counts(
    readings: Readings, forward: ForwardModel, ml: NDArray[np.int8], unexplained: NDArray[np.bool_]
) -> dict[str, NDArray[np.int64]]:
    """Return counts by sensor of a portion of the readings, int64, shape (S,), for `health_of_counts`.

    `ranges` and `short_ranges`, shape (S, B), are histograms of the ranges of echoes, and of short ones, with bins of
    `BIN` metres; the last bin has all longer ones.
    """
    size = len(readings.sensor_names)
    marks = _readings_by_column(readings, first_obstacles(forward, ml), unexplained)
    counts = {kind: np.bincount(readings.sensor[mark], minlength=size) for kind, mark in marks.items()}
    counts |= _place_counts(readings, marks)
    counts['readings'] = np.bincount(readings.sensor, minlength=size)
    for kind, chosen in (('ranges', readings.echo), ('short_ranges', marks['short'])):
        counts[kind] = np.zeros((size, BINS), np.int64)
        bins = np.minimum(readings.z[chosen] / BIN, BINS - 1).astype(np.int64)
        np.add.at(counts[kind], (readings.sensor[chosen], bins), 1)
    return counts


def health_of_counts(names: tuple[str, ...], counts: Mapping[str, NDArray[np.int64]]) -> dict[str, SensorHealth]:
    """Return the table from sums of `health_counts`: like `sensor_health`, but without the echoes of the others."""
    return _table(
        names,
        counts['readings'],
        counts,
        _commonest_ranges(counts['ranges']),
        _commonest_ranges(counts['short_ranges']),
    )


def _commonest_ranges(rows: NDArray[np.int64]) -> list[tuple[int, float]]:
    """Return the `commonest_range` of each row, from a histogram of its ranges."""
    width = round(WINDOW / BIN)
    common = []
    for row in rows:
        held = np.convolve(row, np.ones(width, np.int64), 'valid')
        best = int(held.argmax())
        common.append((int(held[best]), (best + width / 2) * BIN if held[best] else math.nan))
    return common


def _from_free_space(maps: MapSet, sensor: int) -> NDArray[np.bool_]:
    """Return which echoes of a sensor come from where echoes of the others show free space, shape (N,)."""
    readings = maps.readings
    mine = (readings.sensor == sensor) & readings.echo
    live = LogOddsMap(maps.parameters)
    live.add(readings.select((readings.sensor != sensor) & readings.echo))
    chosen = readings.select(mine)
    rows, columns = live.grid.cells_of(
        chosen.x + chosen.z * np.cos(chosen.yaw), chosen.y + chosen.z * np.sin(chosen.yaw)
    )
    inside = (rows >= 0) & (rows < live.grid.height) & (columns >= 0) & (columns < live.grid.width)
    probability = live.probability()
    free = np.zeros(len(readings), bool)
    there = np.flatnonzero(mine)[inside]
    # NaN, where the others have no echoes, is not free
    free[there] = probability[rows[inside], columns[inside]] < FREE_PROBABILITY
    return free


def _median(values: Floats) -> float:
    """Return the median of the finite values, NaN if there are none."""
    known = values[np.isfinite(values)]
    return float(np.median(known)) if len(known) else math.nan


def _verdict(number: int, usual: float, mine: dict[str, float], others: dict[str, float]) -> str:
    if number < LEAST_READINGS or number < LEAST_SHARE_OF_OTHERS * usual:
        return 'few readings'

    def above(kind: str) -> bool:
        # a single sensor has no others to compare with
        return not math.isfinite(others[kind]) or mine[kind] >= others[kind] + ABOVE_MEDIAN

    # a robot may stand for hours in front of something that returns no echo, but then some echoes are explained
    phantoms = mine['random'] >= DEAF_RANDOM_ECHOES * (1.0 - mine['no_echo'])
    if mine['no_echo'] >= DEAF_NO_ECHO and mine['missed'] >= DEAF_MISSED and phantoms and above('no_echo'):
        return 'never hears anything'
    repeats = max(mine['same'], mine['alike']) >= SUSPECT_SAME
    if min(mine['short'], mine['places_short']) >= SUSPECT_SHORT and repeats and above('short'):
        return 'always short'
    random = min(mine['random'], mine['places_random'])
    often = random >= SUSPECT_RANDOM_WITH_OTHERS and math.isfinite(others['random']) and above('random')
    if random >= LEAST_RANDOM and mine['of_echoes'] >= SUSPECT_OF_ECHOES:
        often = often or (math.isfinite(others['of_echoes']) and above('of_echoes'))
    if (often or mine['random'] >= SUSPECT_RANDOM) and mine['short'] >= PERSON_SHORT_SHARE * mine['random']:
        return 'something moves near it'
    if random >= SUSPECT_RANDOM and above('random'):
        return 'mostly random'
    return 'often random' if often else 'ok'


def health_warning(table: dict[str, SensorHealth]) -> str:
    """Return one line that names the suspect sensors, or ''."""
    suspects = [f'{name} ({row.verdict_text})' for name, row in table.items() if row.suspect]
    if not suspects:
        return ''
    if len(table) == 1:
        finding = 'the only sensor does not fit the map'
    else:
        finding = f'{"a sensor stands" if len(suspects) == 1 else f"{len(suspects)} sensors stand"} out from the others'
    causes = 'broken, covered, or with a wrong pose?'
    if sum(row.suspect and row.verdict in RANDOM_VERDICTS for row in table.values()) > 1:
        causes = (
            'broken, covered, or with a wrong pose, or does odometry drift (refine_poses)? It shows first in sensors '
            'that look along walls'
        )
    return f'{finding}: {", ".join(suspects)}; {causes}'
