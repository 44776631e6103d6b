"""The gain of flipping each cell, from the likelihoods of the readings: the E-step, exact for both states of a cell.

Let p(z_t | m) = c + T, where c is the density of the causes independent of the map, and T that of obstacles and max
range. For a cell at distance d, let A be the part of T from occupied cells before it, n the number of these,
W = (1 − p_rand − p_lost) (1 − p_hit)ⁿ and g = N(z; d, σ). Flipping the cell changes T to

    occupy   T' = A + W p_hit g + (T − A) (1 − p_hit)
    free     T' = A + (T − A − W p_hit g) / (1 − p_hit)

and multiplies p(z_t | m) by (c + T') / (c + T), in place of (39) and (40) of the paper. The log of this ratio is the
same for all free cells of the free zone (A = 0, g = 0). For the free cells between two occupied ones of the band, the
ratio is linear in g.

The evidence of a cell is the sum of these logs over its readings: the gain of flipping it. The evidence of all cells is
kept up to date. After a flip (`cell_flip`), the readings that observe the cell are evaluated again, and the differences
are added to the evidence of their cells. So the gain of any flip is a table lookup.
"""

from __future__ import annotations

from typing import Any

import numpy as np

from ..runtime.jit import inlined_kernel, kernel
from ..sensor.cone import rows_of, runs_of
from ..sensor.cone_table import cone_of
from .fixed_point import quantise_logs
from .pairs import WORDS_PER_RUN, Pairs, Workspace, make
from .state import Maps, Model, State

LEAST_RATIO = 1e-30
"""Smallest likelihood ratio, because of rounding."""


@inlined_kernel
def compute_ratios(
    model: Model, reading_state: Any, occupied: Any, pairs: Pairs, at: int, workspace: Workspace
) -> None:
    """Write the likelihood ratios of a reading on the map (E-step) to `workspace.ratios`, in the order of its band.

    They are followed by those of occupying and of freeing a cell of the free zone, and the likelihood of the reading.
    Uses `workspace.new`.

    Parameters
    ----------
    reading_state : record of READING_STATE
        Its `through` must be up to date.
    pairs, at
        Its pairs, from index `at` on.
    """
    # unsigned, so that numba does not test for negative indices
    one, m = np.uint64(1), np.uint64(reading_state.bands)
    cell = np.uint64(at + WORDS_PER_RUN * reading_state.runs)
    density = cell + m
    p, q = model.p_hit, 1.0 - model.p_hit
    floor, ratio, out = reading_state.floor, workspace.ratios.ratio, workspace.new
    weight, total = reading_state.through, 0.0
    obstacles = np.uint64(0)
    for k in range(m):
        if occupied[pairs.cell[cell + k]]:
            # indices of obstacles, stored here until their logs are written
            out[obstacles] = k
            obstacles += one
            total += weight * p * pairs.density[density + k]
            weight *= q
    total += weight * reading_state.max_range
    scale = 1.0 / (floor + total)
    before, weight = 0.0, reading_state.through
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


@inlined_kernel
def evaluate(model: Model, reading_state: Any, occupied: Any, pairs: Pairs, at: int, workspace: Workspace) -> None:
    """Write the logs of the results of `compute_ratios` to `workspace.new`; the parameters are the same."""
    compute_ratios(model, reading_state, occupied, pairs, at, workspace)
    quantise_logs(workspace.ratios, reading_state.bands + 3, workspace.new)


@kernel
def _make_pairs(s: State, t: int) -> None:
    """Make the pairs of reading t in their memory, or in the workspace if they are not stored; without logs."""
    reading_state = s.reading_states[t]
    pairs, at = (s.pairs, reading_state.at) if reading_state.stored else (s.workspace.pairs, 0)
    reading_state.runs, reading_state.bands = make(s.cones, s.lattice, s.normals, t, pairs, at, s.workspace)


@inlined_kernel
def pairs_of(s: State, t: int) -> tuple[Pairs, int]:
    """Return the pairs of reading t and their index; if they are not stored, they are made, without logs."""
    reading_state = s.reading_states[t]
    if not reading_state.stored:
        _make_pairs(s, t)
    return (s.pairs, reading_state.at) if reading_state.stored else (s.workspace.pairs, 0)


@kernel
def _make_logs(s: State, t: int, pairs: Pairs, at: int) -> None:
    """Write the logs of a reading that is not stored, for the present map; its ratios stay in the workspace."""
    reading_state = s.reading_states[t]
    evaluate(s.model, reading_state, s.maps.occupied, pairs, at, s.workspace)
    log = at + WORDS_PER_RUN * reading_state.runs + 2 * reading_state.bands
    for k in range(reading_state.bands):
        pairs.log[log + k] = s.workspace.new[k]


@inlined_kernel
def pairs_with_logs(s: State, t: int) -> tuple[Pairs, int]:
    """Do the same as `pairs_of`, with the logs for the present map."""
    pairs, at = pairs_of(s, t)
    if not s.reading_states[t].stored:
        _make_logs(s, t, pairs, at)
    return pairs, at


@inlined_kernel
def ratios_and_logs(s: State, t: int, pairs: Pairs, at: int) -> None:
    """Write the ratios for the present map to the workspace; make the logs of pairs from `pairs_of` without logs."""
    if s.reading_states[t].stored:
        compute_ratios(s.model, s.reading_states[t], s.maps.occupied, pairs, at, s.workspace)
    else:
        _make_logs(s, t, pairs, at)


@inlined_kernel
def _add_to_free_zone(reading_state: Any, pairs: Pairs, at: int, maps: Maps, steps: tuple[int, int]) -> None:
    """Add steps[0] to the evidence of the free cells of the free zone, steps[1] to that of the occupied."""
    for k in range(np.uint64(at), np.uint64(at + WORDS_PER_RUN * reading_state.runs), np.uint64(WORDS_PER_RUN)):
        for c in range(np.uint64(pairs.cell[k]), np.uint64(pairs.cell[k + np.uint64(1)]) + np.uint64(1)):
            maps.evidence[c] += steps[1] if maps.occupied[c] else steps[0]


@inlined_kernel
def add_difference(reading_state: Any, pairs: Pairs, at: int, maps: Maps, new: Any) -> None:
    """Replace the logs of a reading by those of `evaluate`, and add the differences to the evidence."""
    m, multiplicity = reading_state.bands, reading_state.multiplicity
    cell = np.uint64(at + WORDS_PER_RUN * reading_state.runs)
    log = cell + np.uint64(2 * m)
    for k in range(np.uint64(m)):
        maps.evidence[pairs.cell[cell + k]] += multiplicity * (new[k] - pairs.log[log + k])
        pairs.log[log + k] = new[k]
    steps = new[m] - reading_state.occupy, new[m + 1] - reading_state.release
    _add_to_free_zone(reading_state, pairs, at, maps, (multiplicity * steps[0], multiplicity * steps[1]))
    reading_state.occupy, reading_state.release, reading_state.likelihood = new[m], new[m + 1], new[m + 2]


@inlined_kernel
def evaluate_and_add(s: State, t: int, pairs: Pairs, at: int) -> None:
    """Evaluate reading t on the map, and add its terms to the evidence; its pairs begin at `at`."""
    maps = s.maps
    reading_state = s.reading_states[t]
    log = at + WORDS_PER_RUN * reading_state.runs + 2 * reading_state.bands
    pairs.log[log : log + reading_state.bands] = 0
    reading_state.occupy, reading_state.release = 0, 0
    blocking = 0
    for k in range(np.uint64(at), np.uint64(at + WORDS_PER_RUN * reading_state.runs), np.uint64(WORDS_PER_RUN)):
        for c in range(np.uint64(pairs.cell[k]), np.uint64(pairs.cell[k + np.uint64(1)]) + np.uint64(1)):
            blocking += maps.occupied[c]
    reading_state.blocking = blocking
    reading_state.through = s.model.mixture_weight * (1.0 - s.model.p_hit) ** blocking
    evaluate(s.model, reading_state, maps.occupied, pairs, at, s.workspace)
    add_difference(reading_state, pairs, at, maps, s.workspace.new)
    reading_state.changed = s.clock[0]


@kernel
def subtract(s: State, t: int) -> None:
    """Subtract the terms of reading t from the evidence."""
    maps = s.maps
    pairs, at = pairs_with_logs(s, t)
    reading_state = s.reading_states[t]
    times = -reading_state.multiplicity
    _add_to_free_zone(reading_state, pairs, at, maps, (times * reading_state.occupy, times * reading_state.release))
    cell = at + WORDS_PER_RUN * reading_state.runs
    log = cell + 2 * reading_state.bands
    for k in range(reading_state.bands):
        maps.evidence[pairs.cell[cell + k]] += times * pairs.log[log + k]


@kernel
def evaluate_all(s: State, begin: int, end: int, new: bool) -> None:
    """Evaluate the readings `begin` to `end` on the map, and add their terms to the evidence.

    If they are `new`, their pairs are made first.
    """
    for t in range(begin, end):
        if s.stop[0]:
            break
        if new and s.reading_states[t].stored:
            _make_pairs(s, t)
        pairs, at = pairs_of(s, t)
        evaluate_and_add(s, t, pairs, at)


@inlined_kernel
def _observes_flipped(reading_state: Any, pairs: Pairs, at: int, flipped: Any) -> bool:
    """Return whether any cell of a reading is set in `flipped`."""
    begin = np.uint64(at + WORDS_PER_RUN * reading_state.runs)
    for k in range(begin, begin + np.uint64(reading_state.bands)):
        if flipped[pairs.cell[k]]:
            return True
    for k in range(np.uint64(at), begin, np.uint64(WORDS_PER_RUN)):
        for c in range(np.uint64(pairs.cell[k]), np.uint64(pairs.cell[k + np.uint64(1)]) + np.uint64(1)):
            if flipped[c]:
                return True
    return False


@kernel
def evaluate_flipped(s: State, begin: int, end: int, flipped: Any) -> None:
    """Update the evidence by those of the readings `begin` to `end` that observe flipped cells.

    Their pairs must be stored.

    Parameters
    ----------
    flipped : uint8, shape (cells,)
        1 where cells were flipped since the readings were evaluated.
    """
    maps = s.maps
    for t in range(begin, end):
        if s.stop[0]:
            break
        reading_state = s.reading_states[t]
        pairs, at = pairs_of(s, t)
        if not _observes_flipped(reading_state, pairs, at, flipped):
            continue
        times = reading_state.multiplicity
        # a flipped cell of the free zone changes from one ratio to the other; this uses the ratios before the update
        for k in range(np.uint64(at), np.uint64(at + WORDS_PER_RUN * reading_state.runs), np.uint64(WORDS_PER_RUN)):
            for c in range(np.uint64(pairs.cell[k]), np.uint64(pairs.cell[k + np.uint64(1)]) + np.uint64(1)):
                if flipped[c]:
                    step = 1 if maps.occupied[c] else -1
                    reading_state.blocking += step
                    maps.evidence[c] += step * times * (reading_state.release - reading_state.occupy)
        reading_state.through = s.model.mixture_weight * (1.0 - s.model.p_hit) ** reading_state.blocking
        evaluate(s.model, reading_state, maps.occupied, pairs, at, s.workspace)
        add_difference(reading_state, pairs, at, maps, s.workspace.new)
        reading_state.changed = s.clock[0]


@kernel
def _add_seen(s: State, t: int, times: int) -> None:
    """Add `times`, which may be negative, to the number of readings of each cell in the cone of reading t."""
    cone = cone_of(s.cones[t])
    for row in range(*rows_of(cone, s.lattice.height)):
        runs = runs_of(cone, row, s.lattice.width)
        start = row * s.lattice.width
        for first, last in ((runs.first, runs.last), (runs.first2, runs.last2)):
            for c in range(start + first, start + last + 1):
                s.maps.seen[c] += times


@kernel
def forget(s: State, begin: int, end: int) -> None:
    """Subtract the readings `begin` to `end` from the numbers of readings of all cells."""
    for t in range(begin, end):
        _add_seen(s, t, -s.reading_states[t].multiplicity)


@kernel
def add_multiplicity(s: State, readings: Any) -> None:
    """Increase the multiplicity of each of `readings` by one."""
    maps = s.maps
    for t in readings:
        pairs, at = pairs_with_logs(s, t)
        reading_state = s.reading_states[t]
        reading_state.multiplicity += 1
        steps: Any = np.int64(reading_state.occupy), np.int64(reading_state.release)
        reading_state.changed = s.clock[0]
        _add_to_free_zone(reading_state, pairs, at, maps, steps)
        begin = at + WORDS_PER_RUN * reading_state.runs
        log = begin + 2 * reading_state.bands
        for k in range(reading_state.bands):
            maps.evidence[pairs.cell[begin + k]] += pairs.log[log + k]
        _add_seen(s, t, 1)
