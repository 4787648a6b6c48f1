"""New points of a drive: one to a voxel, of what stands still, near enough, and where the map holds nothing."""

from __future__ import annotations

import numpy as np
from hypothesis import given, settings
from hypothesis import strategies as st

from mapvote.core.geometry import rows_from
from mapvote.core.grid import CELL_SIZE, Lattice
from mapvote.core.types import F64
from mapvote.rules.voter import REACH_M, NewPoints, NewPointsRule, _beyond, points_in, select

LATTICE = Lattice()


@settings(max_examples=10)
@given(st.integers(0, 2**32 - 1))
def test_points_are_taken_from_the_voxels_of_a_word_and_of_what_stands_still(seed: int) -> None:
    rng = np.random.default_rng(seed)
    points = rng.uniform(-3.0, 25.0, (60, 3)).astype(np.float32).astype(np.float64)
    cell = rng.integers(-1, 4, 60).astype(np.int32)
    stationary = rng.random(60) < 0.7
    words = rng.integers(0, 2**63, 4).astype(np.uint64)
    words[0] = 0
    base = rng.integers(-5, 5, 4).astype(np.int32)
    moving = rng.random(60) < 0.1
    found = np.zeros(60, dtype=np.bool_)
    found[select(points[:, 2].astype(np.float32), 0.0, cell, stationary, moving, words, base)] = True
    for i in range(60):
        if cell[i] < 0 or moving[i] or not stationary[i]:
            assert not found[i]
            continue
        bit = min(max(int(np.floor(points[i, 2] / CELL_SIZE)) - int(base[cell[i]]), 0), 63)
        assert found[i] == bool(int(words[cell[i]]) >> bit & 1)


def voxels(points: F64) -> set[tuple[int, int, int]]:
    return {tuple(voxel) for voxel in np.floor(points / CELL_SIZE).astype(int).tolist()}


@settings(max_examples=6)
@given(st.integers(0, 2**32 - 1), st.sampled_from([30, 100_000]))
def test_the_first_point_offered_in_each_voxel_is_kept_whenever_points_are_sorted(seed: int, at: int) -> None:
    rng = np.random.default_rng(seed)
    offered = [rng.uniform((-1.0, -1.0, 1.0), (1.0, 1.0, 3.0), (20, 3)) for _ in range(6)]
    new = NewPoints(LATTICE, numbers=NewPointsRule(sorted_together=at))
    for points in offered:
        new.offer(points)
    assert (len(new._runs[0, 0]) > 1) == (at == 30)
    kept = np.concatenate([new.by_tile()(tile) for tile in ((-1, -1), (-1, 0), (0, -1), (0, 0))])
    everything = np.concatenate(offered)
    assert len(kept) == len(voxels(kept)) == len(voxels(everything))
    for point in kept:
        same = [p for p in everything if voxels(p[None]) == voxels(point[None])]
        assert point.tobytes() == same[0].tobytes()


def test_points_come_back_by_tile_in_ascending_order_and_asking_twice_changes_nothing() -> None:
    new = NewPoints(LATTICE)
    new.offer(np.array([[80.0, 1.0, 1.0], [1.0, 1.0, 2.0], [1.0, 1.0, 1.0], [-1.0, 1.0, 1.0]]))
    new.offer(np.zeros((0, 3)))
    first, again = new.by_tile(), new.by_tile()
    assert [len(first((0, col))) for col in range(-2, 3)] == [0, 1, 2, 1, 0]
    assert first((0, 0))[:, 2].tolist() == [1.0, 2.0]
    for col in range(-1, 2):
        np.testing.assert_array_equal(again((0, col)), first((0, col)))
    assert NewPoints(LATTICE).by_tile()((0, 0)).shape == (0, 3)


def test_points_of_a_tile_are_cut_to_a_word_and_told_from_its_corner() -> None:
    window = LATTICE.tile((1, 2))
    words, base = np.zeros(window.shape, np.uint64), np.zeros(window.shape, np.int32)
    words[3, 4] = 0b100
    inside = [2 * 76.8 + 4.5 * CELL_SIZE, 76.8 + 3.5 * CELL_SIZE]
    points = np.array([[*inside, 0.75], [*inside, 1.05], [inside[0] + 0.3, inside[1], 0.75]])
    found, fields = points_in(window, points, words, base)
    assert fields == {}
    assert found.dtype == np.float32
    np.testing.assert_allclose(found, [[1.35, 1.05, 0.75]], atol=1e-5)


def test_points_beyond_the_local_grid_are_new_where_they_are_near_and_unmapped() -> None:
    """The kernel, against the same rule written out for arrays."""
    rng = np.random.default_rng(2)
    points = rng.uniform((-5.0, -5.0, 0.0), (95.0, 95.0, 6.0), (4000, 3))
    cell = rng.integers(-1, 1, 4000).astype(np.int32)
    ground_z = np.where(rng.random((300, 300)) < 0.2, np.nan, rng.uniform(0.0, 1.0, (300, 300))).astype(np.float32)
    base = np.floor(np.nan_to_num(ground_z) / CELL_SIZE).astype(np.int32)
    occupied = rng.integers(0, 2**63, (300, 300), dtype=np.uint64)
    origin = np.array([20.0, 30.0, 1.8])
    found = np.empty(len(points), np.int64)
    found = found[
        : _beyond(rows_from(points, origin), cell, origin, ground_z, base, occupied, (0.0, 0.0), (0, 0), found)
    ]
    cols, rows = np.floor(points[:, :2] / CELL_SIZE).astype(int).T
    inside = (rows >= 0) & (rows < 300) & (cols >= 0) & (cols < 300)
    rows, cols, z = np.clip(rows, 0, 299), np.clip(cols, 0, 299), points[:, 2]
    foot = np.where(np.isnan(ground_z), base * CELL_SIZE, ground_z)[rows, cols]
    bit = np.clip(np.floor(z / CELL_SIZE).astype(int) - base[rows, cols], 0, 63).astype(np.uint64)
    unmapped = occupied[rows, cols] >> bit & np.uint64(1) == 0
    near = ((points - origin)[:, :2] ** 2).sum(axis=1) < REACH_M**2
    np.testing.assert_array_equal(found, np.flatnonzero(inside & (cell < 0) & near & (z - foot >= 0.3) & unmapped))
    assert len(found) > 100
