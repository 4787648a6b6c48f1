"""Cells that move together: components of the plane, and which of them move."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from scipy import ndimage

from mapvote.core.types import I32, Bool
from mapvote.perception.moving_kernels import cells_in_plane, decidable, flood, moving_components, voxels
from mapvote.perception.range_image import BOTH_SIDES, Counts

SIDE = 10


def plane(inner: Bool) -> Bool:
    """(SIDE, SIDE) with a rim of nothing."""
    return np.pad(inner, 1)


@pytest.mark.parametrize("seed", range(8))
def test_wanted_cells_are_of_one_component_that_touch_or_are_joined_by_other_wanted_ones(seed: int) -> None:
    """As scipy labels a picture, in which a third of the cells are wanted."""
    held, want = np.random.default_rng(seed).random((2, SIDE - 2, SIDE - 2)) < 0.55
    cells = np.flatnonzero(plane(held))
    wanted = plane(want).ravel()[cells]
    expected = ndimage.label(plane(held & want), structure=np.ones((3, 3)))[0].ravel()[cells] - 1
    np.testing.assert_array_equal(flood(cells, wanted, SIDE), expected)


def moving(at: list[tuple[int, int]], brief: list[bool], voxel_of: I32, min_voxels: int = 4) -> list[bool]:
    rows, cols = np.array(at).T
    seen = np.ones(len(at), np.bool_)
    found: Bool = moving_components(rows, cols, SIDE, seen, np.array(brief), min_voxels, 0.5, 0.6, voxel_of)
    return list(found.tolist())


def test_the_voxels_over_one_cell_count_together_and_all_their_points_move() -> None:
    walker, post = [(2, 3)] * 4, [(7, 7)] * 4
    points = np.array([-1, 0, 3, 3, 4, 7], np.int32)
    assert moving(walker + post, [True] * 4 + [False] * 4, points) == [False, True, True, True, False, False]
    assert moving(post + walker, [False] * 4 + [True] * 4, points) == [False, False, False, False, True, True]
    assert not any(moving(walker + post, [True] * 4 + [False] * 4, points, min_voxels=5))


def test_two_things_with_a_free_cell_between_them_move_each_by_itself() -> None:
    car, wall = [(r, c) for r in (2, 3) for c in (2, 3)], [(r, 5) for r in range(1, 9)]
    brief = [True] * len(car) + [False] * len(wall)
    assert moving(car + wall, brief, np.arange(len(brief), dtype=np.int32)) == brief


def test_a_walker_who_touches_a_wall_moves_without_it_though_something_of_the_wall_was_brief_too() -> None:
    touched, wall, walker = [(4, 4)] * 4, [(4, c) for c in range(1, 9)] * 3, [(5, 4)] * 4
    brief = [True] + [False] * (len(touched) - 1 + len(wall)) + [True] * len(walker)
    moves = moving(touched + wall + walker, brief, np.arange(len(brief), dtype=np.int32))
    assert moves == [False] * (len(touched) + len(wall)) + [True] * len(walker)


@given(
    st.lists(
        st.tuples(st.integers(0, 13), st.integers(0, 13), st.integers(0, int(BOTH_SIDES))), min_size=1, max_size=30
    ),
    st.integers(1, 5),
)
def test_what_was_brief_was_seen_often_enough_mostly_free_and_from_both_sides(
    told: list[tuple[int, int, int]], min_free: int
) -> None:
    free, hit, sides = (np.array(part, np.int32) for part in zip(*told, strict=True))
    seen, brief = decidable(Counts(free=free, hit=hit, sides=sides.astype(np.uint8)), min_free, 0.75)
    for i, (f, h, s) in enumerate(told):
        assert seen[i] == (f + h >= min_free)
        assert brief[i] == (s == BOTH_SIDES and f >= min_free and f >= 0.75 * (f + h))


def test_places_lie_in_the_cells_of_a_plane_counted_from_its_lowest() -> None:
    places = np.array([[-0.1, 0.2, 5.0], [0.0, -0.7, 1.0], [3.05, 1.6, 0.0]])
    rows, cols = cells_in_plane(places, np.array([-3, -5]), 0.3)
    assert rows.tolist() == [5, 2, 10]
    assert cols.tolist() == [2, 3, 13]


@pytest.mark.parametrize("count", [0, 50, 20_000])
def test_voxels_are_numbered_by_their_first_points_however_many_there_are(count: int) -> None:
    """The last has more than the table that is tried first holds."""
    rng = np.random.default_rng(count)
    origin = np.array([500.0, -300.0, 8.0])
    points, obstacle = origin + rng.uniform(-12.0, 12.0, (3 * count, 3)), rng.random(3 * count) < 0.7
    voxel_of, samples = voxels(points, obstacle, origin, 11.0, 0.3)
    chosen = np.flatnonzero(obstacle & (np.hypot(*(points - origin)[:, :2].T) <= 11.0))
    _, at, number = np.unique(np.floor(points[chosen] / 0.3), axis=0, return_index=True, return_inverse=True)
    in_order = np.argsort(at)
    np.testing.assert_array_equal(samples, points[chosen[at[in_order]]])
    assert count < 1000 or len(samples) > 8192
    expected = np.full(len(points), -1)
    expected[chosen] = np.argsort(in_order)[number.ravel()]
    np.testing.assert_array_equal(voxel_of, expected)
