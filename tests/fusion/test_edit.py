"""Points come and go: which are taken, which are deleted."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from itertools import permutations

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from hand_made import SHAPE, Cell, make_map, make_tile, states_plane, wall, words_plane
from mapvote.codec.planes import Words
from mapvote.core.columns import flat_cells
from mapvote.core.grid import CELL_SIZE, TILE_CELLS, Lattice
from mapvote.core.reference import reference_window
from mapvote.core.tile import Tile
from mapvote.core.types import F32, CellState
from mapvote.fusion.edit import add_points, delete_points, words_gone
from mapvote.fusion.tile_vote import Vote

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
    bright = {"intensity": rng.integers(0, 256, len(points)).astype(np.uint8)}
    edited, added = add_points(tile, points, bright, flat_cells(GRID, points), voters, min_votes)
    order = rng.permutation(len(points))
    other = {"intensity": bright["intensity"][order]}
    again, _ = add_points(tile, points[order], other, flat_cells(GRID, points[order]), voters[order], min_votes)
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
        sent = {"intensity": bright[order]}
        edited, _ = add_points(tile, points[order], sent, flat_cells(GRID, points[order]), voters[order], 1)
        assert sorted(edited.fields["intensity"].tolist()) == [100, 255, 255]


UO, UE, CO, CE, UN = CellState
CELL = (10, 10)
APART = [0.45, 1.05, 1.65]
"""Heights of voxels 1, 3 and 5, none of which touches another."""


def says(masks: Sequence[int], states: Sequence[int], cell: Cell = CELL) -> list[Vote]:
    return [
        Vote(f"v{i}", 0, f"d{i}", states=states_plane({cell: state}), gone=Words.of(words_plane({cell: mask})))
        for i, (mask, state) in enumerate(zip(masks, states, strict=True))
    ]


def gone(tile: Tile, votes: list[Vote], decided: int = UO, cell: Cell = CELL) -> int:
    """The voxels of a cell that go, of those that the tile has points in."""
    words, _ = words_gone(votes, states_plane({cell: decided}), 2, tile)
    return 0 if words is None else int(words[cell] & tile.obstacle_words[cell])


def of_standing(masks: Sequence[int], heights: list[float] = APART, cell: Cell = CELL) -> int:
    return gone(make_tile(wall([cell], heights)), says(masks, [UO] * len(masks), cell), UO, cell)


@pytest.mark.parametrize(
    ("masks", "goes"),
    [
        ([0b1010, 0b1010, 0], 0b1010),
        ([0b1010, 0, 0], 0),
        ([0b1010, 0b1000, 0], 0b1000),
        ([0b1010, 0b1010, 0, 0], 0),
        ([0b1010, 0b1010, 0b1010, 0, 0], 0b1010),
    ],
)
def test_what_stands_apart_goes_from_a_cell_that_stands_if_most_vehicles_mark_it(masks: list[int], goes: int) -> None:
    assert of_standing(masks) == goes


@pytest.mark.parametrize(
    ("marking", "of", "goes"), [(2, 2, True), (2, 3, False), (3, 3, True), (3, 4, True), (4, 6, False), (5, 7, True)]
)
def test_what_touches_what_stays_goes_if_more_than_two_thirds_mark_it(marking: int, of: int, goes: bool) -> None:
    assert of_standing([0b100] * marking + [0] * (of - marking), [0.45, 0.75]) == (0b100 if goes else 0)


@pytest.mark.parametrize(
    ("beside", "other", "gone_there", "stays"),
    [
        ((10, 11), UO, 0, True),
        ((11, 9), UO, 0, True),
        ((10, 12), UO, 0, False),
        ((10, 11), UN, 0, True),
        ((10, 11), CE, 0b100, False),
        ((10, 11), CE, 0b1000, True),
    ],
)
def test_a_voxel_that_stays_protects_what_touches_it_in_the_next_cell(
    beside: Cell, other: int, gone_there: int, stays: bool
) -> None:
    """Two of three vehicles mark voxels of a cell that stands. An emptied cell loses only the points that the vehicles
    mark; the rest stays, and protects its neighbours too."""
    tile = make_tile(np.concatenate([wall([CELL], APART), wall([beside], [0.75])]))
    masks, states = {CELL: 0b1010, beside: gone_there}, {CELL: UO, beside: other}
    votes = [
        Vote(f"v{i}", 0, f"d{i}", states=states_plane(states), gone=Words.of(words_plane(masks if i else {})))
        for i in range(3)
    ]
    words, _ = words_gone(votes, states_plane(states), 2, tile)
    assert words is not None
    assert words[CELL] == (0 if stays else 0b1010)


def test_without_ground_any_mark_empties_the_column_so_that_nothing_of_it_protects() -> None:
    beside, tile = (10, 11), make_tile(np.concatenate([wall([CELL], APART), wall([(10, 11)], [0.75])]))
    bare = replace(tile, ground_z=np.full(SHAPE, np.nan, dtype=np.float32))
    states = {CELL: UO, beside: CE}
    marks = {CELL: 0b1010, beside: 0b1000}
    votes = [
        Vote(f"v{i}", 0, f"d{i}", states=states_plane(states), gone=Words.of(words_plane(marks if i else {})))
        for i in range(3)
    ]
    words, _ = words_gone(votes, states_plane(states), 2, bare)
    assert words is not None
    assert words[CELL] & bare.obstacle_words[CELL]


@pytest.mark.parametrize("cell", [(0, 10), (TILE_CELLS - 1, 10), (10, 0), (10, TILE_CELLS - 1)])
def test_at_the_tile_s_edge_all_may_touch_what_stays_beyond_it(cell: Cell) -> None:
    assert of_standing([0b1010] * 2 + [0], cell=cell) == 0
    assert of_standing([0b1010] * 3, cell=cell) == 0b1010


def test_who_has_the_whole_cell_empty_counts_among_two_thirds_but_not_among_half() -> None:
    for heights, mask in (([0.45, 0.75], 0b100), (APART, 0b1010)):
        tile = make_tile(wall([CELL], heights))
        assert gone(tile, says([mask, mask, 0b111110], [UO, UO, CE])) == mask, "all three say so"
        assert gone(tile, says([mask, 0b111110, 0], [UO, CE, UO])) == 0, "two of three, of whom one saw nothing stand"
        whole = Vote("w", 0, "w", states=states_plane({CELL: CE}))
        assert gone(tile, [*says([mask, mask], [UO, UO]), whole]) == mask, "no mask is all of an emptied cell"


def test_in_one_stage_a_mask_of_a_cell_that_may_be_empty_says_nothing_of_one_that_stands() -> None:
    tile, votes = make_tile(wall([CELL], APART)), []
    for i, counts in enumerate(([3, 0, 0, 1, 0], [3, 0, 0, 0, 0], [3, 0, 0, 0, 0])):
        tally = np.zeros((*SHAPE, 5), np.uint16)
        tally[CELL] = counts
        votes.append(Vote(f"v{i}", 0, "d", tally=tally, gone=Words.of(words_plane({CELL: 0b1010}))))
    assert gone(tile, votes) == 0b1010
    votes[1].tally[CELL] = [3, 0, 0, 1, 0]  # type: ignore[index]
    assert gone(tile, votes) == 0
