"""A drive's evidence surface by surface: what a hit speaks for, what is gone, what is new, and what is too little."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from hypothesis import example, given, settings
from hypothesis import strategies as st
from hypothesis.extra.numpy import arrays
from scipy import ndimage

from hand_made import make_map, make_tile, one_scan, wall
from mapvote.config import VotingSettings
from mapvote.core.grid import CELL_SIZE, TILE_CELLS
from mapvote.core.point_map import PointMap
from mapvote.core.types import F64, I32, NO_VOTE, Bool, CellState
from mapvote.detection.evidence import (
    CROSSED,
    GONE_RAYS,
    HIT,
    HIT_RAYS,
    HIT_REACH_M,
    NEW_ENOUGH,
    NEW_RAYS,
    PASSES,
    SUPPORT,
    TOGETHER,
    WORDS,
    Facts,
    count_scan,
    judge_window,
    weigh_voxels,
)
from mapvote.detection.packed_tiles import PLANES, Overlap, PackedTiles, count_of
from mapvote.detection.surfaces import SurfaceVoter
from mapvote.detection.voter import TileVotes

ROW, COLUMNS = 100, range(100, 112)
HEIGHTS = [0.75, 1.05, 1.35, 1.65]
UO, CO, CE, UN = (
    CellState.UNCHANGED_OCCUPIED, CellState.CHANGED_OCCUPIED, CellState.CHANGED_EMPTY, CellState.UNDETERMINED,
)  # fmt: skip


def street(standing: list[tuple[int, int]], heights: list[float]) -> PointMap:
    ground = wall([(r, c) for r in range(85, 125) for c in range(85, 135)], [0.0])
    return make_map({(0, 0): make_tile(np.concatenate([wall(standing, heights), ground]))})


def after(point_map: PointMap, points: F64, scans: int = 8) -> TileVotes:
    voter = SurfaceVoter(VotingSettings(), point_map)
    for _ in range(scans):
        voter.observe(one_scan(point_map, points))
    return dict(voter.each())[0, 0]


def standing_at(y: float, heights: list[float] = HEIGHTS) -> F64:
    """(n, 3) points of a wall along x at ``y``."""
    return np.array([((c + 0.5) * CELL_SIZE, y, z) for c in COLUMNS for z in heights])


WALL = [(ROW, c) for c in COLUMNS]
OLD_Y = (ROW + 0.5) * CELL_SIZE


def test_a_wall_set_back_by_half_a_metre_is_an_old_wall_gone_and_a_new_one_come() -> None:
    votes = after(street(WALL, HEIGHTS), standing_at(OLD_Y + 0.5))
    assert all(votes.states[cell] == CE for cell in WALL)
    assert all(votes.states[ROW + 2, c] == CO for c in COLUMNS)
    assert votes.gone is not None
    assert votes.gone[ROW, 105] == np.uint64(0b111100)


def test_of_a_new_wall_its_own_voxels_are_new_and_nothing_of_what_did_not_change() -> None:
    votes = after(street(WALL, HEIGHTS), standing_at(OLD_Y + 0.6))
    assert votes.new[ROW + 2, 105] == np.uint64(0b111100)
    assert not votes.new[votes.states != CO].any()


def test_a_wall_met_some_centimetres_off_its_place_stands() -> None:
    votes = after(street(WALL, HEIGHTS), standing_at(OLD_Y + 0.5 * CELL_SIZE + 0.5 * HIT_REACH_M))
    assert all(votes.states[cell] == UO for cell in WALL)
    assert not (votes.states == CO).any()


TWIG = [1.65 + 0.3 * k for k in range(SUPPORT - 1)]
"""Heights of something that does not stand on the ground."""
BOLLARD = [0.45, 0.75]


def test_a_pole_that_went_is_a_change_and_a_twig_is_none() -> None:
    tall = [0.45 + 0.3 * k for k in range(SUPPORT)]
    assert after(street([(ROW, 105)], tall), standing_at(OLD_Y + 9)).states[ROW, 105] == CE
    assert after(street([(ROW, 105)], TWIG), standing_at(OLD_Y + 9)).states[ROW, 105] == UN


def test_a_bollard_that_went_or_came_is_a_change_for_it_stands_on_the_ground_and_on_its_own() -> None:
    gone = after(street([(ROW, 105)], BOLLARD), standing_at(OLD_Y + 9))
    assert gone.states[ROW, 105] == CE
    here = [((105 + 0.5) * CELL_SIZE, OLD_Y, z) for z in BOLLARD]
    built = after(street([], []), np.concatenate([here, standing_at(OLD_Y + 9)]))
    assert built.states[ROW, 105] == CO


def test_a_bollard_at_the_end_of_the_map_stands_on_its_own_too() -> None:
    ground = wall([(r, c) for r in range(30) for c in range(95, 125)], [0.0])
    point_map = make_map({(0, 0): make_tile(np.concatenate([wall([(0, 105)], BOLLARD), ground]))})
    assert after(point_map, standing_at(20.5 * CELL_SIZE)).states[0, 105] == CE


def test_one_voxel_that_came_or_went_is_no_bollard() -> None:
    assert after(street([(ROW, 105)], BOLLARD[1:]), standing_at(OLD_Y + 9)).states[ROW, 105] == UN
    speck = np.array([[105.5 * CELL_SIZE, OLD_Y, BOLLARD[1]]])
    assert not (after(street([], []), speck).states == CO).any()


def test_what_a_hit_of_a_wall_explains_is_nothing_new_in_the_cell_beside_it() -> None:
    """Range noise puts every second hit behind the wall's face, into voxels that the map knows to be free."""
    beside = OLD_Y + 0.5 * CELL_SIZE + 0.8 * HIT_REACH_M
    voter = SurfaceVoter(VotingSettings(), street(WALL, HEIGHTS))
    struck = [voter.observe(one_scan(voter.point_map, standing_at(y)))[ROW + 1].any() for y in (beside, beside + 0.1)]
    assert struck == [False, True]


def test_a_wall_that_went_shows_what_stands_behind_it_and_one_that_stands_does_not() -> None:
    """Behind a wall the map knows no free space; whether what is met there is new, only the wall can tell."""
    states = []
    for where in (OLD_Y + 9, OLD_Y):
        tile = street(WALL, HEIGHTS).tiles[0, 0]
        free = np.full((TILE_CELLS, TILE_CELLS), ~np.uint64(0))
        free[ROW:] = 0
        hidden = make_map({(0, 0): replace(tile, free=free)})
        states.append(after(hidden, np.concatenate([standing_at(where), standing_at(OLD_Y + 0.6)])).states[ROW + 2])
    assert [bool((row == CO).any()) for row in states] == [True, False]
    assert all(states[0][c] == CO for c in COLUMNS)


def test_a_twig_near_a_wall_that_went_does_not_fall_with_it_for_rays_decided_what_it_is() -> None:
    ground = wall([(r, c) for r in range(85, 125) for c in range(85, 135)], [0.0])
    twig = wall([(ROW + 4, 105)], TWIG)
    votes = after(
        make_map({(0, 0): make_tile(np.concatenate([wall(WALL, HEIGHTS), twig, ground]))}), standing_at(OLD_Y + 9)
    )
    assert [votes.states[ROW, 105], votes.states[ROW + 4, 105]] == [CE, UN]


def test_twigs_at_the_edge_of_all_that_is_known_are_no_pole_together() -> None:
    ground = wall([(r, c) for r in range(30) for c in range(95, 125)], [0.0])
    twigs = wall([(0, 105), (0, 107)], TWIG)
    point_map = make_map({(0, 0): make_tile(np.concatenate([twigs, ground]))})
    states = after(point_map, standing_at(20.5 * CELL_SIZE)).states
    assert [int(states[0, c]) for c in (105, 107)] == [UN, UN]


def test_what_few_scans_crossed_is_not_gone_yet() -> None:
    few = GONE_RAYS - 1
    gone_after = [after(street(WALL, HEIGHTS), standing_at(OLD_Y + 9), n).states[ROW, 105] for n in (few, GONE_RAYS)]
    assert gone_after == [UN, CE]


def test_what_few_rays_crossed_and_none_met_goes_with_what_many_crossed_beside_it() -> None:
    point_map = street(WALL, HEIGHTS)
    voter = SurfaceVoter(VotingSettings(), point_map)
    for scan in range(GONE_RAYS):
        seen = one_scan(point_map, standing_at(OLD_Y + 9))
        if scan:
            seen.view.passed[:, 106:] = 0  # half of the wall is out of sight but once
        voter.observe(seen)
    assert all(dict(voter.each())[0, 0].states[cell] == CE for cell in WALL)


def test_what_no_ray_ever_crossed_does_not_go_with_the_rest_of_its_wall() -> None:
    voter = SurfaceVoter(VotingSettings(), street(WALL, HEIGHTS))
    for _ in range(GONE_RAYS):
        seen = one_scan(voter.point_map, standing_at(OLD_Y + 9))
        seen.view.passed[:, 106:] = 0
        voter.observe(seen)
    states = dict(voter.each())[0, 0].states
    assert [int(states[cell]) for cell in WALL] == [CE] * 6 + [NO_VOTE] * 6


def test_what_is_no_higher_than_a_kerb_is_never_gone() -> None:
    assert not (after(street(WALL, [0.45]), standing_at(OLD_Y + 9)).states == CE).any()


@pytest.mark.parametrize("off", [1, 2])
def test_a_kerb_stays_before_a_wall_that_was_pulled_down(off: int) -> None:
    kerb = [(ROW - off, c) for c in COLUMNS]
    ground = wall([(r, c) for r in range(85, 125) for c in range(85, 135)], [0.0])
    point_map = make_map({(0, 0): make_tile(np.concatenate([wall(WALL, HEIGHTS), wall(kerb, [0.45]), ground]))})
    states = after(point_map, standing_at(OLD_Y + 9)).states
    assert [{int(states[cell]) for cell in cells} for cells in (WALL, kerb)] == [{CE}, {UN}]


@pytest.mark.parametrize(("layers", "state"), [(12, UN), (16, CE)])
def test_a_roof_is_gone_with_the_wall_below_it_if_rays_passed_through_its_place(layers: int, state: CellState) -> None:
    roof = [(ROW + k, c) for k in range(1, 5) for c in COLUMNS]
    points = np.concatenate([wall(WALL, HEIGHTS), wall(roof, [4.65])])
    ground = wall([(r, c) for r in range(85, 125) for c in range(85, 135)], [0.0])
    point_map = make_map({(0, 0): make_tile(np.concatenate([points, ground]))})
    voter = SurfaceVoter(VotingSettings(), point_map)
    for _ in range(8):
        seen = one_scan(point_map, standing_at(OLD_Y + 9))
        seen.view.passed[:] &= np.uint64((1 << layers) - 1)
        voter.observe(seen)
    assert {int(dict(voter.each())[0, 0].states[cell]) for cell in roof} == {state}


def test_a_cell_in_which_something_stands_is_not_empty_whatever_else_of_it_is_gone() -> None:
    points = standing_at(OLD_Y, HEIGHTS[:2])  # the upper half of the wall went
    votes = after(street(WALL, HEIGHTS), points)
    assert all(votes.states[cell] == UO for cell in WALL)
    assert votes.gone is not None
    assert votes.gone[ROW, 105] == np.uint64(0b100000), "the voxel on what stands may be its upper edge"


def test_a_place_where_nothing_is_mapped_and_rays_passed_is_empty_and_one_that_none_passed_has_no_vote() -> None:
    point_map = street(WALL, HEIGHTS)
    voter = SurfaceVoter(VotingSettings(), point_map)
    for _ in range(8):
        seen = one_scan(point_map, standing_at(OLD_Y))
        seen.view.passed[:, :105] = 0
        voter.observe(seen)
    states = dict(voter.each())[0, 0].states
    assert states[ROW + 5, 110] == CellState.UNCHANGED_EMPTY
    assert states[ROW + 5, 100] == NO_VOTE
    assert states[ROW, 100] == UO, "hits need no rays beside them"


def weighed(mapped: int, free: int, **counts: int) -> Facts:
    """Of one cell whose voxel 5 has these counts; ``passes`` of the voxels above and below it too."""
    planes, bit = np.zeros((1, 1, WORDS), np.uint64), 5
    for first, name, word in ((CROSSED, "crossed", 0b010), (HIT, "met", 0b010), (PASSES, "passes", 0b111)):
        for k in range(PLANES):
            planes[0, 0, first + k] = np.uint64((counts.get(name, 0) >> k & 1) * word << bit - 1)
    words_of = [np.full((1, 1), word << bit, np.uint64) for word in (mapped, free)]
    out = Facts.none((1, 1))
    weigh_voxels(planes, Overlap(0, 1, 0, 1, 0, 0), *words_of, out)
    return out


@given(crossed=st.integers(0, 120), passes=st.integers(0, 120), met=st.integers(0, 20))
def test_one_hit_outweighs_as_many_rays_as_is_said(crossed: int, passes: int, met: int) -> None:
    said = weighed(1, 0, crossed=crossed, passes=passes, met=met)
    assert (said.gone[0, 0] != 0) == (max(crossed, passes // TOGETHER) >= GONE_RAYS + HIT_RAYS * met)
    assert (said.stands[0, 0] != 0) == (met > 0 and said.gone[0, 0] == 0)
    assert not (said.new | said.beyond).any()


@given(crossed=st.integers(0, 120), met=st.integers(0, 60), passes=st.integers(0, 127))
@example(crossed=0, met=1, passes=0)
def test_a_free_voxel_is_new_by_hits_against_crossings_and_tells_how_often_rays_passed(
    crossed: int, met: int, passes: int
) -> None:
    said = weighed(0, 1, crossed=crossed, met=met, passes=passes)
    new = said.new[0, 0] != 0
    assert new == (met >= 1 + NEW_RAYS * crossed)
    assert [said.hits[0, 0], said.balance[0, 0]] == ([met, met - passes] if new else [0, 0])
    assert not (said.gone | said.stands | said.beyond).any()


@given(
    cells=arrays(np.bool_, (6, 6)),
    met=arrays(np.int32, (6, 6), elements=st.integers(0, 50)),
    passes=arrays(np.int32, (6, 6), elements=st.integers(0, 50)),
)
def test_what_was_passed_more_often_than_hit_is_nothing_new(cells: Bool, met: I32, passes: I32) -> None:
    ground = np.zeros(cells.shape, np.uint64)
    pole = np.where(cells, np.uint64(2 * (1 << NEW_ENOUGH) - 2), np.uint64(0))
    facts = Facts.none(cells.shape)._replace(new=pole, balance=np.where(cells, met - passes, 0))
    came = judge_window(facts, ground, np.full(cells.shape, np.nan, np.float32), 0.5)[0] == CO
    groups, count = ndimage.label(cells, np.ones((3, 3)))
    for k in range(1, count + 1):
        group = groups == k
        assert came[group].all() if met[group].sum() >= passes[group].sum() else not came[group].any()
    assert not came[~cells].any()


def test_a_car_that_drove_by_far_off_is_nothing_new_and_one_that_parked_is() -> None:
    """30 m away beams lie wider apart than voxels: nothing of the place is ever crossed from side to side."""
    point_map = street(WALL, HEIGHTS)
    car = standing_at(OLD_Y - 3.0)
    states = []
    for scans_there in (2, 12):
        voter = SurfaceVoter(VotingSettings(), point_map)
        for scan in range(16):
            seen = one_scan(point_map, car if scan < scans_there else standing_at(OLD_Y + 9))
            seen.view.passed[:] &= np.uint64(0x5555555555555555)  # every other voxel
            voter.observe(seen)
        states.append(dict(voter.each())[0, 0].states)
    assert [(s == CO).any() for s in states] == [False, True]


def test_an_upper_storey_that_no_ray_reached_stays_where_the_lower_one_stands_beside_a_house_that_went() -> None:
    storeys = [0.45 + 0.3 * k for k in range(14)]
    ground = wall([(r, c) for r in range(85, 125) for c in range(85, 135)], [0.0])
    gone_too = [(ROW + 1, c) for c in COLUMNS]
    mapped = np.concatenate([wall(WALL, storeys), wall(gone_too, storeys), ground])
    point_map = make_map({(0, 0): make_tile(mapped)})
    voter = SurfaceVoter(VotingSettings(), point_map)
    for _ in range(8):
        seen = one_scan(point_map, standing_at(OLD_Y, [0.75, 1.05]))
        seen.view.passed[:] &= np.uint64(0b1111111)
        seen.view.passed[ROW + 1] = np.uint64(2**15 - 1)  # behind it all of a house is seen to be gone
        voter.observe(seen)
    votes = dict(voter.each())[0, 0]
    assert all(votes.states[cell] == UO for cell in WALL)
    assert votes.gone is not None
    assert not any(votes.gone[cell] >> np.uint64(7) for cell in WALL)


@given(st.lists(st.tuples(*[st.floats(0.6, 3.0)] * 3), min_size=1, max_size=6))
@settings(max_examples=25, deadline=None)
def test_a_hit_meets_exactly_the_mapped_voxels_within_its_reach(offsets: list[tuple[float, float, float]]) -> None:
    cells = [(r, c) for r in range(98, 114) for c in range(98, 114)]
    point_map = street(cells, [0.45 + 0.3 * k for k in range(12)])
    points = np.array(offsets) + np.array([30.0, 30.0, 0.0])
    evidence = PackedTiles(point_map.lattice, WORDS)
    count_scan(evidence, one_scan(point_map, points))
    for r, c in cells[::7]:
        for bit in range(1, 12):
            low = np.array([c, r, bit]) * CELL_SIZE
            apart = np.maximum(low - points, points - low - CELL_SIZE).max(axis=1).min()
            if abs(apart - HIT_REACH_M) > 1e-6 and abs(apart) > 1e-6:
                assert count_of(evidence[0, 0][r, c], HIT, bit) == (apart < HIT_REACH_M)
