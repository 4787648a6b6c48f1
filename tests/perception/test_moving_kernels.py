"""Cells that move together: components of the plane, and which of them move."""

from __future__ import annotations

import numpy as np
import pytest
from scipy import ndimage

from mapvote.core.types import I32, Bool
from mapvote.perception.moving_kernels import moving_components, voxels

SIDE = 10


def plane(inner: Bool) -> Bool:
    """(SIDE, SIDE) with a rim of nothing."""
    return np.pad(inner, 1)


@pytest.mark.parametrize("seed", range(8))
def test_cells_move_by_components_as_scipy_labels_them(seed: int) -> None:
    rng = np.random.default_rng(seed)
    place = np.flatnonzero(plane(rng.random((SIDE - 2, SIDE - 2)) < 0.5))
    brief = rng.random(len(place)) < 0.5
    moves, wanted = np.zeros(len(place), np.bool_), np.ones(len(place), np.bool_)
    for share in (0.5, 0.6):
        held = np.zeros(SIDE * SIDE, np.bool_)
        held[place[wanted]] = True
        label = ndimage.label(held.reshape(SIDE, SIDE), structure=np.ones((3, 3)))[0].ravel()[place]
        found = [bool(k and brief[label == k].sum() >= max(2, share * (label == k).sum())) for k in label]
        moves |= found
        wanted = ~moves & brief
    np.testing.assert_array_equal(
        moving_components(place, SIDE, np.ones(len(place), np.bool_), brief, 2, 0.5, 0.6), moves
    )


def moving(at: list[tuple[int, int]], brief: list[bool], voxel_of: I32, min_voxels: int = 4) -> list[bool]:
    rows, cols = np.array(at).T
    seen = np.ones(len(at), np.bool_)
    found = moving_components(rows * SIDE + cols, SIDE, seen, np.array(brief), min_voxels, 0.5, 0.6)
    return list(np.append(found, False)[voxel_of].tolist())


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
