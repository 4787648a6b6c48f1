"""What a drive's evidence amounts to, rule by rule (C to I)."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest
from hypothesis import example, given, settings
from hypothesis import strategies as st
from hypothesis.extra.numpy import arrays

from mapvote.core.types import NO_VOTE, U64, CellState
from mapvote.core.voting import VOTE_UNIT
from mapvote.detection.evidence import PLANES
from mapvote.detection.surface_rules import fallen
from mapvote_lab.evaluation.columns_v1.counters import STRUCK_ITSELF, THROUGH_ITSELF, WORDS
from mapvote_lab.evaluation.columns_v1.judged import Weighed
from mapvote_lab.evaluation.columns_v1.regions import drop_specks, remnants, unexplained
from mapvote_lab.evaluation.columns_v1.rules import ALL_RULES, Rules
from mapvote_lab.evaluation.columns_v1.weighing import CLEAR_SCANS, weigh

UO, UE, CO, CE, UN = CellState
FREE = ~np.uint64(0)


def cell(through: dict[int, int], struck: dict[int, int]) -> U64:
    """Counters (1, 1, WORDS) of one cell: scans by voxel."""
    planes = np.zeros((1, 1, WORDS), np.uint64)
    for first, counts in ((0, through), (PLANES, struck)):
        for bit, count in counts.items():
            for k in range(PLANES):
                planes[0, 0, first + k] |= np.uint64((count >> k & 1) << bit)
    return planes


def judge(through: dict[int, int], struck: dict[int, int], occupied: int = 0, **more: Any) -> Weighed:
    near, free, low_there = more.pop("near", 0), more.pop("free", int(FREE)), more.pop("low", False)
    rules = more.pop("rules", ALL_RULES)
    occupied_word, near_word, free_word = (np.full((1, 1), w, np.uint64) for w in (occupied, near, free))
    low, base = np.full((1, 1), low_there), np.zeros((3, 3), np.int32)
    planes = np.pad(cell(through, struck), ((1, 1), (1, 1), (0, 0)))
    return weigh(planes, base, occupied_word, near_word, free_word, low, rules)


def around(through: dict[int, int]) -> dict[int, int]:
    """The same rays through the voxels above and below too, as they are where nothing stands."""
    return {bit + step: n for step in (-1, 1, 0) for bit, n in through.items()}


def state(*args: Any, **more: Any) -> int:
    return int(judge(*args, **more).states()[0, 0])


def test_a_mapped_voxel_struck_is_unchanged_and_seen_through_is_gone() -> None:
    assert state({}, {3: 5}, occupied=0b1000) == UO
    assert state(around({3: 20}), {}, occupied=0b1000) == CE
    assert state({}, {}, occupied=0b1000) == NO_VOTE


@given(st.dictionaries(st.integers(0, 63), st.integers(1, 9)), st.integers(1, 2**64 - 1))
@settings(max_examples=20, deadline=None)
@example({0: 1}, 1)
def test_votes_for_what_is_mapped_are_the_pairs_of_a_scan_and_a_mapped_voxel_that_it_struck(
    struck: dict[int, int], occupied: int
) -> None:
    pairs = sum(scans for bit, scans in struck.items() if occupied >> bit & 1)
    assert judge({}, struck, occupied=occupied).tally[0, 0, UO] == VOTE_UNIT * pairs


def test_rule_a_rays_that_graze_a_slab_without_crossing_it_say_nothing() -> None:
    assert state({11: 40, 12: 20}, {}, occupied=1 << 12) == UN, "never a ray above it: an awning seen from below"
    assert state({12: 20, 13: 40}, {}, occupied=1 << 12) == UN, "never a ray below it: a hedge seen from above"
    assert state({11: 40, 12: 20, 13: 40}, {}, occupied=1 << 12) == CE
    assert state({12: 20, 13: 40}, {}, occupied=1 << 12, rules=Rules(empty_by_ray=False)) == CE
    assert state({1: 20, 2: 40}, {}, occupied=0b10) == CE, "below the lowest voxel is the ground"


def test_rule_e_a_few_hits_outweigh_many_rays_that_grazed_past() -> None:
    assert state(around({3: 20}), {3: 4}, occupied=0b1000) == UO
    assert state(around({3: 20}), {3: 4}, occupied=0b1000, rules=Rules(rays_count_less=False)) == CE


def test_rule_e_what_is_hardly_ever_seen_through_is_not_called_gone() -> None:
    through = {1: 40, **around({12: 3})}
    assert state(through, {}, occupied=1 << 12) == UN
    assert state(through, {}, occupied=1 << 12, rules=Rules(rays_count_less=False)) == CE


def test_rule_e_what_one_scan_alone_saw_through_is_not_called_gone() -> None:
    assert state(around({3: CLEAR_SCANS - 1}), {}, occupied=0b1000) == UN
    assert state(around({3: CLEAR_SCANS}), {}, occupied=0b1000) == CE
    many = around(dict.fromkeys(range(2, 30), 1))
    assert state(many, {}, occupied=(1 << 30) - 4) == UN, "nor if it saw through a whole wall"
    assert state(around({3: 1}), {}, occupied=0b1000, rules=Rules(rays_count_less=False)) == CE


def test_rule_c_sets_apart_what_lies_only_next_to_mapped_voxels() -> None:
    assert not judge({}, {4: 9}).beside[0, 0]
    assert judge({}, {4: 9}, near=1 << 4).beside[0, 0]
    assert not judge({}, {4: 9, 7: 9}, near=1 << 4).beside[0, 0], "part of it stands free"
    assert not judge({}, {4: 9}, near=1 << 4, rules=Rules(pose_explains=False)).beside[0, 0]


def test_rule_c_a_new_wall_keeps_the_cells_that_touch_an_old_one_and_a_ghost_along_it_is_dropped() -> None:
    states = np.full((12, 12), UE, np.uint8)
    states[2, 2:10] = states[8, 2:6] = CO
    beside = np.zeros(states.shape, bool)
    beside[2, 2:5] = beside[8] = True
    dropped = unexplained(states, beside, 2)
    assert list(np.flatnonzero(dropped[2])) == [2], "3 and 4 are within two cells of where it stands free"
    assert list(np.flatnonzero(dropped[8])) == [2, 3, 4, 5]
    assert dropped.sum() == 5


def test_a_cell_that_the_map_has_points_in_is_never_changed_occupied() -> None:
    assert state({}, {9: 9}, occupied=0b1000) != CO


def test_rule_d_new_only_where_the_map_knew_free_space() -> None:
    assert state({}, {4: 9}, free=0) != CO
    assert state({}, {4: 9}, free=0, rules=Rules(new_where_free=False)) == CO


def test_rule_d_the_top_of_a_new_house_comes_with_it_though_the_map_knew_nothing_up_there() -> None:
    new = judge({}, {4: 9, 30: 3}, free=1 << 4 | 1 << 40).new[0, 0]
    assert new & np.uint64(1 << 4 | 1 << 30) == 1 << 4 | 1 << 30
    assert not new & np.uint64(0b1111), "nothing below it"
    assert not new & np.uint64(1 << 40), "nor where the map knew the air to be free and nothing was struck"
    assert judge({}, {30: 9}, free=1 << 4).new[0, 0] == 0


def test_rule_f_only_rays_at_the_height_of_the_new_thing_speak_against_it() -> None:
    assert state({9: 100}, {4: 4}) == CO
    assert state({4: 100}, {4: 4}) != CO
    assert state({9: 100}, {4: 4}, rules=Rules(rays_at_height=False)) == UE


def test_rule_g_what_was_struck_in_few_of_the_scans_that_saw_through_it_has_only_passed_by() -> None:
    assert state(around({4: 12}), {4: 4}) != CO
    assert state(around({4: 12}), {4: 4}, rules=Rules(brief_is_passing=False)) == CO
    assert state(around({4: 12}), {4: 4, 5: 9}) == CO, "what is next to it was struck often: an edge"
    assert state({4: 12, 5: 30}, {4: 4}) == CO, "rays only grazed it: a slab"


@pytest.mark.parametrize(("higher", "edge"), [(-2, False), (-1, True), (0, True), (1, True), (2, False)])
def test_rule_g_on_a_slope_what_is_next_to_it_is_told_by_its_height(higher: int, edge: bool) -> None:
    """The ground of the cell beside lies two layers lower, so its voxels count from there."""
    planes, base, none = np.zeros((3, 3, WORDS), np.uint64), np.zeros((3, 3), np.int32), np.zeros((1, 1), np.uint64)
    planes[1, 1], planes[1, 2], base[1, 2] = (
        cell(around({9: 12}), {9: 4})[0, 0],
        cell({}, {9 + higher + 2: 9})[0, 0],
        -2,
    )
    weighed = weigh(planes, base, none, none, np.full((1, 1), FREE), np.zeros((1, 1), np.bool_))
    assert (int(weighed.states()[0, 0]) == CO) == edge


def test_rule_g_what_hardly_rises_above_the_ground_is_never_called_gone() -> None:
    assert state({1: 40, 2: 40}, {}, occupied=0b10) == CE
    assert state({1: 40, 2: 40}, {}, occupied=0b10, low=True) == UN
    assert state({1: 40, 2: 40}, {}, occupied=0b10, low=True, rules=Rules(brief_is_passing=False)) == CE
    assert state({}, {1: 40}, occupied=0b10, low=True) == UO


def test_rule_h_a_roof_that_hardly_any_ray_reached_is_adrift_and_one_that_was_struck_is_not() -> None:
    below = dict.fromkeys(range(1, 20), 30)
    assert judge(below, {}, occupied=1 << 20).adrift[0, 0]
    assert judge({**below, 20: 3}, {}, occupied=1 << 20).adrift[0, 0]
    assert not judge({**below, 20: 3}, {20: 1}, occupied=1 << 20).adrift[0, 0]
    assert not judge({**below, 20: 30, 21: 30}, {}, occupied=1 << 20).adrift[
        0, 0
    ]  # seen through clearly: gone by itself


def test_a_wall_keeps_its_voxels_when_the_awning_above_it_is_taken_down() -> None:
    weighed = judge({8: 30, 9: 30, 10: 30, 11: 30}, {2: 40, 3: 40}, occupied=0b110_0000_1100)
    assert weighed.states()[0, 0] == UO
    assert weighed.gone[0, 0] == 0b110_0000_0000


def test_what_no_ray_reached_goes_with_the_column_it_stood_on() -> None:
    weighed = judge({1: 30, 2: 30, 3: 30, 4: 30}, {}, occupied=0b1_0000_0000_1100)
    assert weighed.states()[0, 0] == CE
    assert weighed.gone[0, 0] == 0b1_0000_0000_1100


def test_what_is_weighed_is_a_tally_that_two_vehicles_may_add() -> None:
    one, other = judge({3: 20}, {}, occupied=0b1000), judge({}, {3: 9}, occupied=0b1000)
    assert (one.tally + other.tally).argmax() == UO


def test_rule_g_drops_components_of_fewer_than_four_cells() -> None:
    states = np.full((8, 8), UE, np.uint8)
    states[0, 0:3] = CO
    states[4:6, 4:6] = CE
    specks = drop_specks(states, 4)
    assert specks.sum() == 3
    assert specks[0, 0:3].all()


def test_rule_h_a_roof_falls_with_its_walls_but_not_beside_one_that_stands() -> None:
    adrift = np.zeros((20, 40), bool)
    adrift[8:12, 8:12] = True
    adrift[8:12, 30:34] = True
    states = np.full(adrift.shape, UN, np.uint8)
    states[8:12, 4] = CE
    assert fallen(states, adrift, 10)[8:12, 8:12].all()
    assert not fallen(states, adrift, 10)[:, 30:].any(), "too far from anything that is gone"
    states[8:12, 13] = UO
    falls = fallen(states, adrift, 10)[8:12, 8:12]
    assert falls[:, 0].all(), "nearer to what is gone"
    assert not falls[:, 1:].any(), "nearer to what still stands: the roof of the house next to it"
    assert not fallen(np.full_like(states, UN), adrift, 10).any()


def test_what_hangs_in_the_air_over_rays_is_adrift() -> None:
    assert judge(dict.fromkeys(range(10), 9), {}, occupied=1 << 12).adrift[0, 0]
    assert not judge({0: 9}, {}, occupied=1 << 12).adrift[0, 0]
    assert not judge(dict.fromkeys(range(14), 9), {}, occupied=1 << 12).adrift[0, 0]


def test_only_voxels_never_struck_and_once_seen_through_are_loose() -> None:
    planes, one = np.zeros((3, 3, WORDS), np.uint64), np.ones((1, 1), np.uint64)
    planes[1, 1, THROUGH_ITSELF], planes[1, 1, STRUCK_ITSELF] = 0b110, 0b100
    for low, loose in ((False, 0b010), (True, 0)):
        seen = weigh(planes, np.zeros((3, 3), np.int32), one, one, one, np.full((1, 1), low))
        assert seen.loose[0, 0] == loose


def test_rule_i_what_touches_a_gone_thing_goes_with_it_voxel_by_voxel() -> None:
    gone, loose, base = np.zeros((5, 9), np.uint64), np.zeros((5, 9), np.uint64), np.zeros((5, 9), np.int32)
    gone[2, 0] = 0b1000
    loose[2, 1], loose[3, 2], loose[2, 4] = 0b1010, 0b10000, 0b1000
    base[3, 2] = -1
    found = remnants(gone, loose, base)
    assert found[2, 1] == 0b1000, "next to it; two layers below it, not"
    assert found[3, 2] == 0b10000, "next to what goes: its bits count from a layer below"
    assert found[2, 4] == 0, "a gap of a cell"
    assert not remnants(np.zeros_like(gone), loose, base).any()


words = arrays(np.uint64, (6, 6), elements=st.integers(0, 255))


@given(words, words, arrays(np.int32, (6, 6), elements=st.integers(-2, 2)))
def test_remnants_are_loose_and_finding_them_twice_finds_no_more(gone: U64, loose: U64, base: Any) -> None:
    found = remnants(gone, loose, base)
    assert not (found & ~loose).any()
    assert not (found & gone).any()
    assert not remnants(gone | found, loose, base).any()
    assert np.array_equal(remnants(gone[::-1], loose[::-1], base[::-1])[::-1], found)
