"""Surface normals renewed as readings come: the result equals that of all readings at once."""

from __future__ import annotations

import math

import numpy as np
import pytest
from test_evidence import snapshot

from forward_grid_mapper.core.common.grid import Grid
from forward_grid_mapper.core.common.parameter_groups import ModelParameters
from forward_grid_mapper.core.common.readings import Readings
from forward_grid_mapper.core.evidence import evidence as module
from forward_grid_mapper.core.evidence.cell_flip import find_observing, flip
from forward_grid_mapper.core.evidence.evidence import UNUSED_WORDS, Evidence
from samples import random_readings

GRID = Grid(0.1, -7, 12, 25, 20)
MODEL = ModelParameters(sigma=0.06, p_hit=0.6, p_rand=0.1, p_lost=0.1, max_incidence_angle=0.7)


def along_wall(count: int, seed: int = 0) -> Readings:
    """Readings of a robot that passes a wall at y = 3, at all incidence angles; many have no echo of it."""
    rng = np.random.default_rng(seed)
    readings = random_readings(rng, GRID, count, z_max=2.5)
    readings.y[:] = 1.5 + 0.3 * rng.random(count)
    readings.yaw[:] = math.pi / 2 + rng.uniform(-1.3, 1.3, count)
    readings.half_angle[:] = rng.choice([0.02, 0.1, 0.25], count)
    to_wall = (3.0 - readings.y) / np.sin(readings.yaw)
    square = np.abs(readings.yaw - math.pi / 2) < 0.3
    readings.z[:] = np.where(square, to_wall, np.where(rng.random(count) < 0.5, 2.5, 2.3)).clip(0.1, 2.5)
    return readings


def portions(readings: Readings, memory: float, size: int = 7) -> Evidence:
    """Evidence of the readings in portions, with normals renewed after every third portion."""
    evidence = Evidence(GRID, MODEL, memory, renewable=True)
    for k in range(0, len(readings), size):
        evidence.extend(readings.select(slice(k, k + size)))
        if k % 3 == 0:
            evidence.renew_normals()
    evidence.renew_normals()
    return evidence


def same_normals(a: Evidence, b: Evidence) -> bool:
    return all(np.array_equal(x, y) for x, y in zip(a.state.normals, b.state.normals, strict=True))


@pytest.mark.parametrize('memory', [math.inf, 8000.0, 0.0])
@pytest.mark.parametrize('seed', range(4))
def test_portions_with_renewed_normals_give_the_state_of_all_at_once(seed: int, memory: float) -> None:
    readings = along_wall(300, seed)
    whole = Evidence(GRID, MODEL)
    whole.extend(readings)
    evidence = portions(readings, memory)
    assert whole.state.normals.known.any()
    assert same_normals(evidence, whole)
    assert snapshot(evidence, logs=False) == snapshot(whole, logs=False)
    # it stays equal after flips
    for c in np.random.default_rng(seed).permutation(GRID.size)[:30]:
        flip(evidence.state, c)
        flip(whole.state, c)
    assert snapshot(evidence, logs=False) == snapshot(whole, logs=False)
    for c in range(GRID.size):
        found = [{tuple(o) for o in e.state.observing[: find_observing(e.state, c)]} for e in (evidence, whole)]
        assert found[0] == found[1]
    if memory:
        assert evidence.state.pairs.cell.nbytes <= memory


@pytest.mark.parametrize('seed', range(6))
def test_after_a_few_readings_all_changed_normals_are_renewed(seed: int) -> None:
    wide = Grid(0.1, -60, 12, 120, 24)
    rng = np.random.default_rng(seed)
    first, later = along_wall(900, seed), along_wall(12, seed + 100)
    first.x[:] = rng.uniform(-4.5, 4.5, len(first))
    later.x[:] = rng.uniform(0.0, 0.2, len(later))
    later.yaw[:] = math.pi / 2 + rng.uniform(-0.6, 0.6, len(later))
    # so short that their changes lie in a small part of the map
    for readings, far in ((first, 2.5), (later, 1.6)):
        readings.z_max[:] = far
        readings.z[:] = np.minimum(readings.z, far)
    whole, evidence = Evidence(wide, MODEL, renewable=True), Evidence(wide, MODEL, renewable=True)
    for readings in (first, later):
        evidence.extend(readings)
    before = evidence.state.normals
    evidence.renew_normals()
    whole.extend(
        Readings.from_columns(
            first.sensor_names,
            **{
                name: np.concatenate([getattr(first, name), getattr(later, name)])
                for name in ('x', 'y', 'yaw', 'z', 'z_max', 'half_angle', 'sigma')
            },
        )
    )
    after = evidence.state.normals
    changed = np.flatnonzero((after.x != before.x) | (after.y != before.y))
    assert 0 < len(changed) < 0.5 * after.known.sum()
    assert same_normals(evidence, whole)
    assert snapshot(evidence, logs=False) == snapshot(whole, logs=False)


def test_readings_that_gain_weight_change_normals() -> None:
    readings = along_wall(60)
    whole, merged = Evidence(GRID, MODEL), Evidence(GRID, MODEL, renewable=True)
    whole.extend(readings.select(np.repeat(np.arange(60), [3] * 30 + [2] * 30)))
    merged.extend(readings.select(slice(0, 40)), np.r_[0:30])
    merged.extend(readings.select(slice(40, 60)), np.r_[0:30, 40:50])
    merged.add_multiplicity(np.r_[30:40, 50:60])
    assert not same_normals(merged, whole)
    merged.renew_normals()
    assert same_normals(merged, whole)
    for name in ('evidence', 'seen'):
        assert np.array_equal(getattr(merged.state.maps, name), getattr(whole.state.maps, name))
    assert merged.log_likelihood == whole.log_likelihood


def test_renewal_returns_a_window_that_contains_all_changes() -> None:
    readings = along_wall(200)
    evidence = Evidence(GRID, MODEL, renewable=True)
    assert evidence.renew_normals() is None
    evidence.extend(readings.select(slice(0, 60)))
    assert evidence.renew_normals() is None, 'the first ones are in it'
    evidence.extend(readings.select(slice(60, 200)))
    before = evidence.state.maps.evidence.copy()
    window = evidence.renew_normals()
    assert window is not None
    changed = (evidence.state.maps.evidence != before).reshape(GRID.shape)
    assert changed.any()
    changed[window[0] : window[1], window[2] : window[3]] = False
    assert not changed.any()
    assert evidence.renew_normals() is None


def test_normals_renewed_on_a_grown_grid_equal_those_at_once(monkeypatch: pytest.MonkeyPatch) -> None:
    readings = along_wall(200)
    inside = (np.abs(readings.x - 0.5) < 0.6) & (readings.z < 1.7)
    readings = readings.select(inside)
    large = Grid(0.1, GRID.column - 40, GRID.row - 30, GRID.width + 80, GRID.height + 70)
    larger = Grid(0.1, large.column - 11, large.row - 3, large.width + 30, large.height + 17)
    whole = Evidence(larger, MODEL)
    whole.extend(readings)
    evidence = Evidence(large, MODEL, renewable=True)
    half = len(readings) // 2
    evidence.extend(readings.select(slice(0, half)))
    evidence.extend(readings.select(slice(half, len(readings))))
    evidence.grow(larger)
    evidence.renew_normals()
    assert same_normals(evidence, whole)
    assert snapshot(evidence, logs=False) == snapshot(whole, logs=False)


def test_unused_words_of_pairs_are_removed(monkeypatch: pytest.MonkeyPatch) -> None:
    readings = along_wall(400)
    monkeypatch.setattr(module, 'MOST_UNUSED', 1.0)
    loose = portions(readings, math.inf)
    assert loose._totals[UNUSED_WORDS] > 0
    monkeypatch.setattr(module, 'MOST_UNUSED', 0.0)
    packed = portions(readings, math.inf)
    assert packed._totals[UNUSED_WORDS] == 0
    assert snapshot(loose) == snapshot(packed)
