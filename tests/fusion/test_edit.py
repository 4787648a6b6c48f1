"""Editing a tile: the server reckons heights as vehicles do, and who was counted first never matters."""

from __future__ import annotations

from dataclasses import replace
from itertools import permutations

import numpy as np
from hypothesis import given, settings
from hypothesis import strategies as st

from hand_made import SHAPE, make_map, make_tile, wall
from mapvote.core.cells import flat_cells
from mapvote.core.grid import CELL_SIZE, Lattice
from mapvote.core.reference import reference_window
from mapvote.core.tile import Tile
from mapvote.core.types import F32
from mapvote.fusion.edit import add_points, delete_points

GRID = Lattice().tile((0, 0))
SEEDS = st.integers(0, 2**32 - 1)


def random_points(rng: np.random.Generator, n: int, cells: int = 256) -> F32:
    return rng.uniform([0, 0, -1], [cells * CELL_SIZE, cells * CELL_SIZE, 25], (n, 3)).astype(np.float32)


@given(seed=SEEDS, unknown=st.sampled_from([0.0, 0.3, 1.0]))
@settings(max_examples=15, deadline=None)
def test_server_and_vehicle_see_the_same_columns(seed: int, unknown: float) -> None:
    rng = np.random.default_rng(seed)
    ground = rng.uniform(-0.5, 2.0, SHAPE).astype(np.float32)
    ground[rng.random(SHAPE) < unknown] = np.nan
    tile = Tile(GRID, random_points(rng, 3000), ground)
    hill = make_tile(random_points(rng, 3000), 5.0, (0, 1))  # what lies beyond the edge must not move the columns
    wide = GRID.padded(40)
    seen = reference_window(make_map({(0, 0): tile, (0, 1): hill}), wide)
    assert np.array_equal(tile.obstacle_words, seen.occupied[GRID.slices_in(wide)]) or not tile.has_ground


@given(seed=SEEDS)
@settings(max_examples=15, deadline=None)
def test_deleting_takes_the_marked_obstacles_and_nothing_else(seed: int) -> None:
    rng = np.random.default_rng(seed)
    tile = make_tile(random_points(rng, 2000, cells=8))
    gone = rng.integers(0, 2**62, SHAPE, dtype=np.int64).astype(np.uint64)
    gone[:4] = 0
    edited, deleted = delete_points(tile, gone)
    keep = []
    for x, y, z in tile.points.tolist():
        word = int(gone[int(y / CELL_SIZE), int(x / CELL_SIZE)])
        keep.append(z < 0.3 or not word >> min(int(z / CELL_SIZE), 63) & 1)
    assert edited.points.tobytes() == tile.points[keep].tobytes()
    assert deleted == len(keep) - sum(keep)
    assert delete_points(tile, np.zeros(SHAPE, np.uint64))[0] is tile


@given(seed=SEEDS, min_votes=st.integers(1, 3))
@settings(max_examples=25, deadline=None)
def test_one_point_a_voxel_the_nearest_to_the_mean_whoever_came_first(seed: int, min_votes: int) -> None:
    rng = np.random.default_rng(seed)
    points = random_points(rng, 400, cells=3) * np.array([1, 1, 0.1], dtype=np.float32)
    points = np.concatenate([points, points[:40]])  # the same point offered twice
    voters = rng.integers(0, 4, len(points)).astype(np.int32)
    tile = make_tile(wall([(1, 1)], [0.45]))
    bright = rng.integers(0, 256, len(points)).astype(np.uint8)
    edited, added = add_points(tile, points, bright, flat_cells(GRID, points), voters, min_votes)
    order = rng.permutation(len(points))
    again, _ = add_points(tile, points[order], bright[order], flat_cells(GRID, points[order]), voters[order], min_votes)
    assert again.points.tobytes() == edited.points.tobytes()

    cell, layer = flat_cells(GRID, points), np.floor(points[:, 2].astype(np.float64) / CELL_SIZE)
    expected = 0
    for c, k in sorted(set(zip(cell.tolist(), layer.tolist(), strict=True))):
        mine = points[(cell == c) & (layer == k)].astype(np.float64)
        near = (cell == c) & (abs(layer - k) <= 1)
        if len(set(voters[near].tolist())) < min_votes or (c, k) == (257, 1):
            continue
        away = np.linalg.norm(mine - mine.mean(axis=0), axis=1)
        chosen = np.linalg.norm(edited.points[1 + expected].astype(np.float64) - mine.mean(axis=0))
        assert abs(chosen - away.min()) < 1e-5
        expected += 1
    assert added == expected == len(edited.points) - 1


def test_of_a_point_that_two_vehicles_offer_the_darker_is_taken_whoever_came_first() -> None:
    """And whatever is offered beside it, to the east and to the west."""
    tile = replace(make_tile(wall([], [])), fields={"intensity": np.empty(0, np.uint8)})
    points = wall([(5, 5), (5, 5), (5, 2), (5, 8)], [0.45])
    bright, voters = np.array([200, 100, 255, 255], np.uint8), np.array([0, 1, 0, 0], np.int32)
    for order in map(list, permutations(range(4))):
        edited, _ = add_points(tile, points[order], bright[order], flat_cells(GRID, points[order]), voters[order], 1)
        assert sorted(edited.fields["intensity"].tolist()) == [100, 255, 255]
