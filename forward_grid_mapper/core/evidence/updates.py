"""Flips of single cells: the M-step with an exact mini E-step in both directions, and what every cell would gain by it.

Write p(z_t | m) = c + T, where c gathers the causes that no map changes and T the obstacles and max range. For a cell
at distance d, let A be the share of T from occupied cells before it, W = share · (1 − p_hit)^(occupied cells before it)
and g = N(z; d, σ). Then flipping the cell makes of T

    occupy   T' = A + W p_hit g + (T − A) (1 − p_hit)
    free     T' = A + (T − A − W p_hit g) / (1 − p_hit)

and multiplies p(z_t | m) by (c + T') / (c + T) (ALGORITHM §5; eq 37-40 of the paper with its constants mended). The log
of this ratio is the same for all free cells of the free zone (A = 0, g = 0), and for the free cells between two
occupied ones of the band it is that of a straight line in g.

The sum of these logs over the readings of a cell is its evidence: what flipping it gains. It is kept for every cell at
once. A flip recomputes the readings that see the cell and pushes the differences to their cells, so that to know what
any other flip gains takes nothing but a look.
"""

from __future__ import annotations

from typing import Any

import numpy as np

from ..runtime.jit import kernel
from ..sensor.cone import row_runs, within
from ..sensor.cone_table import cone_of
from ..sensor.surface_normals import grazes
from .fixed_point import Ratios, quantise_logs
from .neighbourhood import note_flip
from .pairs import WORDS_PER_RUN, Lattice, Pairs, make
from .state import Maps, Model, State
from .tile_index import CHUNK, SHIFT

EDGE = 1e-6
"""Cells; nearer to a cone's edge than this, it takes the cone's own arithmetic to tell which side a cell is on."""

LEAST_RATIO = 1e-30
"""What rounding must leave of a likelihood ratio."""


@kernel
def explain(model: Model, share: Any, occupied: Any, pairs: Pairs, at: int, ratios: Ratios, out: Any) -> None:
    """Compute the log ratios of a reading from the map into `out`, in the order of its band.

    Those of occupying and freeing a cell of the free zone, and the log-likelihood of the reading, come after them.

    Parameters
    ----------
    share : record of SHARE
        Of which `through` must be right.
    pairs, at
        Where its pairs begin.
    """
    # unsigned, so that an index need not be asked whether it counts from the end
    one, m = np.uint64(1), np.uint64(share.bands)
    cell = np.uint64(at + WORDS_PER_RUN * share.runs)
    density = cell + m
    p, q = model.p_hit, 1.0 - model.p_hit
    floor, ratio = share.floor, ratios.ratio
    weight, total = share.through, 0.0
    obstacles = np.uint64(0)
    for k in range(m):
        if occupied[pairs.cell[cell + k]]:
            # the places of obstacles, which are needed until their logs are written here
            out[obstacles] = k
            obstacles += one
            total += weight * p * pairs.density[density + k]
            weight *= q
    total += weight * share.no_echo
    scale = 1.0 / (floor + total)
    before, weight = 0.0, share.through
    begin = np.uint64(0)
    for i in range(obstacles + one):
        end = np.uint64(out[i]) if i < obstacles else m
        base = np.float32(max((floor + before + max(total - before, 0.0) * q) * scale, LEAST_RATIO))
        slope = np.float32(weight * p * scale)
        for k in range(begin, end):
            ratio[k] = base + slope * pairs.density[density + k]
        if i < obstacles:
            term = weight * p * pairs.density[density + end]
            ratio[end] = max((floor + before + max(total - before - term, 0.0) / q) * scale, LEAST_RATIO)
            before += term
            weight *= q
            begin = end + one
    ratio[m] = (floor + total * q) * scale
    ratio[m + one] = (floor + total / q) * scale
    ratio[m + one + one] = floor + total
    quantise_logs(ratios, share.bands + 3, out)


@kernel
def _push_free(share: Any, pairs: Pairs, at: int, maps: Maps, steps: tuple[int, int]) -> None:
    """Add steps[0] to the evidence of the free cells of the free zone, steps[1] to that of the occupied."""
    for k in range(np.uint64(at), np.uint64(at + WORDS_PER_RUN * share.runs), np.uint64(WORDS_PER_RUN)):
        for c in range(np.uint64(pairs.cell[k]), np.uint64(pairs.cell[k + np.uint64(1)]) + np.uint64(1)):
            maps.evidence[c] += steps[1] if maps.occupied[c] else steps[0]


@kernel
def _note(share: Any, new: Any) -> None:
    """Keep what `explain` left after the band."""
    m = share.bands
    share.occupy, share.release, share.likelihood = new[m], new[m + 1], new[m + 2]


@kernel
def _enter(model: Model, share: Any, maps: Maps, pairs: Pairs, at: int, room: tuple[Ratios, Any]) -> None:
    """Explain a reading, and add all that it says to the evidence."""
    ratios, new = room
    blocking = 0
    for k in range(np.uint64(at), np.uint64(at + WORDS_PER_RUN * share.runs), np.uint64(WORDS_PER_RUN)):
        for c in range(np.uint64(pairs.cell[k]), np.uint64(pairs.cell[k + np.uint64(1)]) + np.uint64(1)):
            blocking += maps.occupied[c]
    share.blocking = blocking
    share.through = model.share * (1.0 - model.p_hit) ** blocking
    explain(model, share, maps.occupied, pairs, at, ratios, new)
    _note(share, new)
    weight = share.weight
    _push_free(share, pairs, at, maps, (weight * share.occupy, weight * share.release))
    cell = np.uint64(at + WORDS_PER_RUN * share.runs)
    log = cell + np.uint64(2 * share.bands)
    for k in range(np.uint64(share.bands)):
        maps.evidence[pairs.cell[cell + k]] += weight * new[k]
        pairs.log[log + k] = new[k]


@kernel
def enter_all(s: State, begin: int, end: int, new: bool) -> None:
    """Explain the readings `begin` to `end` by the map, and add all that they say to the evidence.

    The pairs of new ones are made first.
    """
    room = (s.ratios, s.bench.new)
    for t in range(begin, end):
        if s.stop[0]:
            break
        share = s.shares[t]
        pairs, at = (s.pairs, share.at) if share.stored else (s.bench.pairs, 0)
        if new or not share.stored:
            share.runs, share.bands = make(s.cones, s.lattice, s.facing, t, pairs, at, s.bench)
        _enter(s.model, share, s.maps, pairs, at, room)
        share.changed = s.clock[0]


@kernel
def weigh(s: State, readings: Any) -> None:
    """Let each of `readings` stand for one more that says the same."""
    maps, bench = s.maps, s.bench
    for t in readings:
        share = s.shares[t]
        share.weight += 1
        share.changed = s.clock[0]
        pairs, at = (s.pairs, share.at) if share.stored else (bench.pairs, 0)
        if not share.stored:
            make(s.cones, s.lattice, s.facing, t, bench.pairs, 0, bench)
        explain(s.model, share, maps.occupied, pairs, at, s.ratios, bench.new)
        _push_free(share, pairs, at, maps, (share.occupy, share.release))
        cell = np.uint64(at + WORDS_PER_RUN * share.runs)
        for k in range(np.uint64(share.bands)):
            maps.evidence[pairs.cell[cell + k]] += bench.new[k]
            maps.seen[pairs.cell[cell + k]] += 1
        for k in range(at, at + WORDS_PER_RUN * share.runs, WORDS_PER_RUN):
            for c in range(np.uint64(pairs.cell[k]), np.uint64(pairs.cell[k + 1]) + np.uint64(1)):
                maps.seen[c] += 1


@kernel
def _zone(reading: Any, lattice: Lattice, row: int, column: int) -> int:
    """Return 2 if a cell is in the free zone of a cone, 1 if in its band, 0 if in neither."""
    du, dv = column + 0.5 - reading.x, row + 0.5 - reading.y
    along = du * reading.axis_x + dv * reading.axis_y
    across = abs(dv * reading.axis_x - du * reading.axis_y)
    outside = across * reading.cosine - along * reading.sine
    if (outside > EDGE and across > 0.7072) or along > reading.reach + 1.5:
        return 0
    away = du * du + dv * dv
    if not lattice.nearest and outside < -EDGE:
        if away > (reading.reach + EDGE) ** 2:
            return 0
        if reading.free > EDGE and away < (reading.free - EDGE) ** 2:
            return 2
        if away < (reading.reach - EDGE) ** 2 and (reading.free < 0.0 or away > (reading.free + EDGE) ** 2):
            return 1
    # a cell at an edge, or one that only the axis crosses
    cone = cone_of(reading, lattice.nearest)
    a, b, c, d = row_runs(cone, row, reading.reach, lattice.width, lattice.nearest)
    if not cone.bottom <= row <= cone.top or not (a <= column <= b or c <= column <= d):
        return 0
    first, last = within(cone.x, dv, reading.free, lattice.nearest)
    return 2 if first <= column <= last else 1


@kernel
def find_seers(s: State, c: int) -> int:
    """List the readings that see cell c in `seers`; return their number."""
    row, column = c // s.lattice.width, c % s.lattice.width
    tile = (row >> SHIFT) * s.tiles.across + (column >> SHIFT)
    chunk, end = s.tiles.head[tile], s.tiles.fill[tile]
    n = 0
    while chunk >= 0:
        for k in range(end):
            t = s.tiles.chunks[chunk, k]
            reading = s.cones[t]
            zone = _zone(reading, s.lattice, row, column)
            if zone and s.facing.slant > 0.0 and s.facing.known[c]:
                slanted = grazes(s.facing, reading, c, column + 0.5 - reading.x, row + 0.5 - reading.y)
                zone = 0 if slanted else zone
            if zone:
                s.seers[n, 0] = t
                s.seers[n, 1] = zone - 1
                n += 1
        chunk, end = s.tiles.chunks[chunk, CHUNK], CHUNK
    return n


@kernel
def _renew(model: Model, share: Any, maps: Maps, pairs: Pairs, at: int, room: tuple[Ratios, Any]) -> None:
    """Explain a reading anew, and push what changed to the evidence."""
    ratios, new = room
    explain(model, share, maps.occupied, pairs, at, ratios, new)
    m, weight = share.bands, share.weight
    cell = np.uint64(at + WORDS_PER_RUN * share.runs)
    log = cell + np.uint64(2 * m)
    for k in range(np.uint64(m)):
        maps.evidence[pairs.cell[cell + k]] += weight * (new[k] - pairs.log[log + k])
        pairs.log[log + k] = new[k]
    _push_free(share, pairs, at, maps, (weight * (new[m] - share.occupy), weight * (new[m + 1] - share.release)))
    _note(share, new)


@kernel
def flip(s: State, c: int) -> None:
    """Flip cell c and bring the evidence of all cells up to date."""
    n = find_seers(s, c)
    maps, bench = s.maps, s.bench
    own = 0
    for i in range(n):
        if s.seers[i, 1]:
            share = s.shares[s.seers[i, 0]]
            own += share.weight * (share.release - share.occupy)
    # where the cell is in the free zone, its own share is that of an occupied cell from now on, or of a free one
    maps.evidence[c] += -own if maps.occupied[c] else own
    maps.occupied[c] ^= 1
    note_flip(maps.pattern, c, s.lattice.height, s.lattice.width)
    step = 1 if maps.occupied[c] else -1
    s.clock[0] += 1
    room = (s.ratios, bench.new)
    for i in range(n):
        t = s.seers[i, 0]
        share = s.shares[t]
        if not share.stored:
            make(s.cones, s.lattice, s.facing, t, bench.pairs, 0, bench)
            maps.occupied[c] ^= 1
            explain(s.model, share, maps.occupied, bench.pairs, 0, s.ratios, bench.new)
            maps.occupied[c] ^= 1
            log = WORDS_PER_RUN * share.runs + 2 * share.bands
            for k in range(share.bands):
                bench.pairs.log[log + k] = bench.new[k]
        if s.seers[i, 1]:
            share.blocking += step
            share.through = s.model.share * (1.0 - s.model.p_hit) ** share.blocking
        if share.stored:
            _renew(s.model, share, maps, s.pairs, share.at, room)
        else:
            _renew(s.model, share, maps, bench.pairs, 0, room)
        share.changed = s.clock[0]
