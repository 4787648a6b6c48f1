"""A drive's evidence surface by surface: what is gone, what is new, what is too little, and how sure the vehicle is."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from hypothesis.extra.numpy import arrays

from hand_made import Cell, at_least, make_map, make_tile, one_scan, states_plane, wall
from mapvote.config import VotingSettings
from mapvote.core.grid import CELL_SIZE, TILE_CELLS, Lattice
from mapvote.core.point_map import PointMap
from mapvote.core.types import F64, I32, NO_VOTE, U8, U64, CellState
from mapvote.rules.evidence import SURFACE_RULE
from mapvote.rules.surfaces import CHANGE_ODDS, N_FEATURES, SurfaceVoter, blocks, depths_m, log_odds, looks
from mapvote.rules.voter import Counted

ROW, COLUMNS = 100, range(100, 112)
HEIGHTS = [0.75, 1.05, 1.35, 1.65]
UO, CO, CE, UN = (
    CellState.UNCHANGED_OCCUPIED, CellState.CHANGED_OCCUPIED, CellState.CHANGED_EMPTY, CellState.UNDETERMINED,
)  # fmt: skip
WALL = [(ROW, c) for c in COLUMNS]
POLE = (ROW, 105)
OLD_Y = (ROW + 0.5) * CELL_SIZE
BOLLARD = [0.45, 0.75]
TWIG = [1.65 + 0.3 * k for k in range(SURFACE_RULE.support - 1)]
"""Heights of something that does not stand on the ground."""


def town(*things: tuple[list[Cell], list[float]], first_row: int = 85) -> PointMap:
    """Things of these cells and heights on flat ground."""
    ground = wall([(r, c) for r in range(first_row, 125) for c in range(85, 135)], [0.0])
    return make_map({(0, 0): make_tile(np.concatenate([*(wall(*thing) for thing in things), ground]))})


def standing_at(y: float, heights: list[float] = HEIGHTS) -> F64:
    """(n, 3) points of a wall along x at ``y``."""
    return np.array([((c + 0.5) * CELL_SIZE, y, z) for c in COLUMNS for z in heights])


AWAY = standing_at(OLD_Y + 9)


@dataclass(frozen=True)
class Dense:
    """The votes on a tile, each plane (256, 256)."""

    states: U8
    gone: U64
    new: U64
    free: U64


def dense(counted: Counted) -> Dense:
    planes = counted.planes
    assert planes.states is not None
    assert planes.gone is not None
    assert planes.free is not None
    return Dense(planes.states, at_least([planes.gone], 1), counted.new, at_least([planes.free], 1))


def after(
    point_map: PointMap,
    points: F64 = AWAY,
    scans: int = 8,
    passed: Callable[[int, U64], object] = lambda scan, words: None,
) -> Dense:
    """Votes of a drive that saw ``points`` in so many scans; ``passed`` takes away of what the rays passed."""
    voter = SurfaceVoter(VotingSettings(), point_map)
    for scan in range(scans):
        seen = one_scan(point_map, points)
        passed(scan, seen.view.passed)
        voter.observe(seen)
    return dense(dict(voter.each())[0, 0])


def test_a_wall_set_back_by_half_a_metre_is_a_deleted_wall_and_a_new_one() -> None:
    votes = after(town((WALL, HEIGHTS)), standing_at(OLD_Y + 0.6))
    assert all(votes.states[cell] == CE for cell in WALL)
    assert all(votes.states[ROW + 2, c] == CO for c in COLUMNS)
    assert votes.gone[POLE] == votes.new[ROW + 2, 105] == np.uint64(0b111100)
    assert not votes.new[votes.states != CO].any()


def test_a_wall_hit_some_centimetres_off_its_place_stands() -> None:
    votes = after(town((WALL, HEIGHTS)), standing_at(OLD_Y + 0.5 * CELL_SIZE + 0.5 * SURFACE_RULE.hit_reach_m))
    assert all(votes.states[cell] == UO for cell in WALL)
    assert not (votes.states == CO).any()


@pytest.mark.parametrize(
    ("heights", "row", "state"),
    [
        pytest.param([0.45 + 0.3 * k for k in range(SURFACE_RULE.support)], ROW, CE, id="a pole"),
        pytest.param(TWIG, ROW, UN, id="a twig"),
        pytest.param(BOLLARD, ROW, CE, id="a bollard, which stands on the ground and on its own"),
        pytest.param(BOLLARD, 0, CE, id="a bollard at the end of the map"),
        pytest.param(BOLLARD[1:], ROW, UN, id="one voxel"),
        pytest.param([0.45], ROW, UN, id="what is no higher than a kerb"),
    ],
)
def test_voxels_that_are_enough_for_a_change(heights: list[float], row: int, state: CellState) -> None:
    assert after(town(([(row, 105)], heights), first_row=min(row, 85))).states[row, 105] == state


def test_a_bollard_that_came_is_a_change_and_one_voxel_is_none() -> None:
    came = [np.array([(105.5 * CELL_SIZE, OLD_Y, z) for z in heights]) for heights in (BOLLARD, BOLLARD[1:])]
    assert [after(town(), np.concatenate([AWAY, points])).states[POLE] == CO for points in came] == [True, False]


def test_twigs_fall_neither_with_a_wall_near_by_nor_together_at_the_edge_of_all_that_is_known() -> None:
    near = after(town((WALL, HEIGHTS), ([(ROW + 4, 105)], TWIG))).states
    assert [near[POLE], near[ROW + 4, 105]] == [CE, UN]
    edge = after(town(([(0, 105), (0, 107)], TWIG), first_row=0)).states
    assert [int(edge[0, c]) for c in (105, 107)] == [UN, UN]


def test_a_return_that_the_wall_explains_is_not_new_in_the_cell_beside_it() -> None:
    """Range noise puts every second hit behind the wall's face, into voxels that the map knows to be free."""
    beside = OLD_Y + 0.5 * CELL_SIZE + 0.8 * SURFACE_RULE.hit_reach_m
    voter = SurfaceVoter(VotingSettings(), town((WALL, HEIGHTS)))
    struck = [voter.observe(one_scan(voter.point_map, standing_at(y)))[ROW + 1].any() for y in (beside, beside + 0.1)]
    assert struck == [False, True]


def test_surfaces_behind_a_deleted_wall_are_new_and_behind_a_standing_one_not() -> None:
    """Behind a wall the map knows no free space; whether what is met there is new, only the wall can tell."""
    tile, free = town((WALL, HEIGHTS)).tiles[0, 0], np.full((TILE_CELLS, TILE_CELLS), ~np.uint64(0))
    free[ROW:] = 0
    hidden, behind = make_map({(0, 0): replace(tile, free=free)}), standing_at(OLD_Y + 0.6)
    rows = [after(hidden, np.concatenate([standing_at(y), behind])).states[ROW + 2] for y in (OLD_Y + 9, OLD_Y)]
    assert all(rows[0][c] == CO for c in COLUMNS)
    assert not (rows[1] == CO).any()


def test_free_space_is_sent_for_columns_that_the_map_does_not_know_and_never_for_mapped_voxels() -> None:
    tile, known = town((WALL, HEIGHTS)).tiles[0, 0], np.zeros((TILE_CELLS, TILE_CELLS), np.uint64)
    known[:, :105] = 0b10
    free = after(make_map({(0, 0): replace(tile, free=known)}), standing_at(OLD_Y)).free
    assert [bool(free[ROW + 5, c]) for c in (100, 110)] == [False, True]
    assert not (free & tile.obstacle_words).any()
    assert free[ROW, 110], "beside and above the wall"


def test_cells_that_rays_crossed_are_deleted_with_their_wall_and_others_stay() -> None:
    def half_unseen(but: int) -> Callable[[int, U64], None]:
        """Half of the wall is out of sight in all scans but the first ones."""
        return lambda scan, words: words[:, 106:].fill(0) if scan >= but else None

    point_map = town((WALL, HEIGHTS))
    assert [after(point_map, scans=n).states[POLE] for n in (SURFACE_RULE.gone_rays - 1, SURFACE_RULE.gone_rays)] == [
        UN,
        CE,
    ]
    once, never = (after(point_map, scans=SURFACE_RULE.gone_rays, passed=half_unseen(but)).states for but in (1, 0))
    assert all(once[cell] == CE for cell in WALL)
    assert [int(never[cell]) for cell in WALL] == [CE] * 6 + [NO_VOTE] * 6


@pytest.mark.parametrize("off", [1, 2])
def test_a_kerb_stays_before_a_wall_that_was_pulled_down(off: int) -> None:
    kerb = [(ROW - off, c) for c in COLUMNS]
    states = after(town((WALL, HEIGHTS), (kerb, [0.45]))).states
    assert [{int(states[cell]) for cell in cells} for cells in (WALL, kerb)] == [{CE}, {UN}]


@pytest.mark.parametrize(("layers", "state"), [(12, UN), (16, CE)])
def test_a_roof_is_gone_with_the_wall_below_it_if_rays_passed_through_its_place(layers: int, state: CellState) -> None:
    roof, low = [(ROW + k, c) for k in range(1, 5) for c in COLUMNS], np.uint64((1 << layers) - 1)
    votes = after(town((WALL, HEIGHTS), (roof, [4.65])), passed=lambda _, words: np.bitwise_and(words, low, words))
    assert {int(votes.states[cell]) for cell in roof} == {state}


def test_a_cell_in_which_something_stands_is_not_empty_whatever_else_of_it_is_gone() -> None:
    votes = after(town((WALL, HEIGHTS)), standing_at(OLD_Y, HEIGHTS[:2]))  # the upper half of the wall went
    assert all(votes.states[cell] == UO for cell in WALL)
    assert votes.gone[POLE] == np.uint64(0b100000), "the voxel on what stands may be its upper edge"


def test_an_upper_storey_that_no_ray_reached_stays_where_the_lower_one_stands_beside_a_house_that_went() -> None:
    def passed(scan: int, words: U64) -> None:
        words &= np.uint64(0b1111111)
        words[ROW + 1] = np.uint64(2**15 - 1)  # behind it all of a house is seen to be gone

    storeys = [0.45 + 0.3 * k for k in range(14)]
    point_map = town((WALL, storeys), ([(ROW + 1, c) for c in COLUMNS], storeys))
    votes = after(point_map, standing_at(OLD_Y, [0.75, 1.05]), passed=passed)
    assert all(votes.states[cell] == UO for cell in WALL)
    assert not any(votes.gone[cell] >> np.uint64(7) for cell in WALL)


def test_an_unmapped_cell_that_rays_passed_is_empty_and_one_that_none_passed_has_no_vote() -> None:
    states = after(town((WALL, HEIGHTS)), standing_at(OLD_Y), passed=lambda _, words: words[:, :105].fill(0)).states
    assert (states[ROW + 5, 110], states[ROW + 5, 100]) == (CellState.UNCHANGED_EMPTY, NO_VOTE)
    assert states[ROW, 100] == UO, "hits need no rays beside them"


def test_a_car_that_drove_by_far_off_is_not_new_and_one_that_parked_is() -> None:
    """30 m away beams lie wider apart than voxels: nothing of the place is ever crossed from side to side."""
    point_map, found = town((WALL, HEIGHTS)), []
    for scans_there in (2, 12):
        voter = SurfaceVoter(VotingSettings(), point_map)
        for scan in range(16):
            seen = one_scan(point_map, standing_at(OLD_Y - 3.0) if scan < scans_there else AWAY)
            seen.view.passed[:] &= np.uint64(0x5555555555555555)  # every other voxel
            voter.observe(seen)
        found.append(bool((dense(dict(voter.each())[0, 0]).states == CO).any()))
    assert found == [False, True]


TILE = slice(1, TILE_CELLS + 1), slice(1, TILE_CELLS + 1)
"""A tile in a window that reaches one cell beyond it, and a tile to the right."""
LOW = np.full((TILE_CELLS + 2, 2 * TILE_CELLS + 1), 1.0, dtype=np.float32)


def windowed(left: np.ndarray, right: np.ndarray | None = None, fill: int = NO_VOTE) -> np.ndarray:
    out = np.full(LOW.shape, fill, left.dtype)
    out[1:-1, 1 : TILE_CELLS + 1] = left
    if right is not None:
        out[1:-1, TILE_CELLS + 1 :] = right
    return out


def looked_at(states: U8, amount: I32 | None = None) -> np.ndarray:
    full = np.ones((256, 256), dtype=np.int32) if amount is None else amount
    return looks(windowed(states), windowed(full, fill=0), LOW, TILE)


def test_features_of_a_cell_follow_from_its_object_and_its_fullest_neighbour() -> None:
    states = states_plane({(5, 5): CE, (5, 6): CE, (6, 7): CE, (5, 7): CO, (40, 40): CE}, fill=1)
    amount = np.ones((256, 256), dtype=np.int32)
    amount[5, 6] = 9
    found = looked_at(states, amount)
    assert found.shape == (5, N_FEATURES)
    assert np.exp(found[:, 0]) - 1 == pytest.approx([3, 3, 1, 3, 1]), "cells of the thing"
    assert found[:, 1] * 8 == pytest.approx([1, 2, 0, 1, 0]), "alike around"
    assert found[:, 2] == pytest.approx([np.log(2 / 10), np.log(10 / 2), np.log(2), np.log(2 / 10), np.log(2)])
    assert found[:, 3] == pytest.approx([1.0, 1.0, 0.0, 1.0, 1.0]), "the map rises in what is gone"


def test_an_object_continues_across_tiles_and_its_size_is_bounded() -> None:
    left, right = (states_plane({(r, c): CE for r in range(20)}) for c in (255, 0))
    full = np.ones(LOW.shape, dtype=np.int32)
    found = looks(windowed(left, right), full, LOW, TILE)
    assert np.exp(found[:, 0]) - 1 == pytest.approx(40)
    assert found[10, 1] * 8 == pytest.approx(5)
    whole = looked_at(np.full((256, 256), CE, dtype=np.uint8))
    assert np.exp(whole[:, 0]) - 1 == pytest.approx(np.full(65536, CHANGE_ODDS.most_cells))
    assert looks(windowed(left), full, 99 * LOW, TILE)[:, 3].max() == CHANGE_ODDS.most_height_m


def test_a_surface_is_as_deep_as_its_point_that_is_farthest_from_the_cells_sides() -> None:
    rim = np.array([[3.01, 2.5, 0.75], [3.5, 9.4, 0.75]], np.float32) * np.array([CELL_SIZE, CELL_SIZE, 1], np.float32)
    middle = wall([(2, 3)], [0.75])
    states = states_plane({(2, 3): CE, (9, 3): CO, (9, 9): CO})
    assert depths_m(states, make_tile(rim[:1]), rim) == pytest.approx(CELL_SIZE * np.array([0.01, 0.4, 0.0]), abs=1e-6)
    assert depths_m(states, make_tile(np.concatenate([rim[:1], middle])), rim)[0] == pytest.approx(0.5 * CELL_SIZE)
    ground = make_tile(wall([(2, 3)], [0.05]))
    assert depths_m(states, ground, rim).tolist()[0] == 0.0, "ground is no surface that goes"
    assert depths_m(states_plane({(9, 3): CO}), None, rim) == pytest.approx([0.4 * CELL_SIZE])
    assert depths_m(states_plane(fill=NO_VOTE), None, rim[:0]).shape == (0,)
    last = np.array([[76.7, 76.6, 1.0], [76.8, 76.8, 1.0]], np.float32)
    assert depths_m(states_plane({(255, 255): CO}), None, last) == pytest.approx([0.1], abs=1e-5), "at the tile's end"


@settings(max_examples=30, deadline=None)
@given(arrays(np.float64, (2, N_FEATURES), elements=st.floats(0, 5)), st.floats(0, 0.15), st.sampled_from([CO, CE]))
def test_a_deeper_surface_and_a_larger_object_raise_the_log_odds(
    looked: np.ndarray, deep: float, state: CellState
) -> None:
    states = np.array([state], dtype=np.uint8)
    low, high = looked.min(axis=0)[None], looked.max(axis=0)[None]
    shallow = log_odds(states, low, np.array([0.0]))[0]
    assert shallow <= log_odds(states, low, np.array([deep]))[0]
    assert shallow <= log_odds(states, high, np.array([0.0]))[0]


@given(st.sets(st.tuples(st.integers(-4, 4), st.integers(-4, 4)), max_size=20))
def test_every_tile_is_judged_once_in_a_window_that_holds_it(tiles: set[tuple[int, int]]) -> None:
    found = list(blocks(Lattice(), tiles))
    assert sorted(tile for inner, _ in found for tile in inner) == sorted(tiles)
    assert all(set(inner) <= set(window.tiles()) for inner, window in found)
