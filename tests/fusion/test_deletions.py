"""Which voxels lose their points: whose marks count, how many it takes, and what lies beside what stays."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from hand_made import SHAPE, Cell, make_tile, states_plane, wall, words_plane
from mapvote.core.grid import TILE_CELLS
from mapvote.core.tile import Tile
from mapvote.core.types import NO_VOTE, CellState
from mapvote.fusion.deletions import words_gone
from mapvote.fusion.edit import delete_points
from mapvote.fusion.sparse_columns import Words
from mapvote.fusion.tile_vote import TileVote, silenced

UO, UE, CO, CE, UN = CellState
CELL = (10, 10)
APART = [0.45, 1.05, 1.65]
"""Heights of voxels 1, 3 and 5, none of which touches another."""


def says(masks: Sequence[int], states: Sequence[int], cell: Cell = CELL) -> list[TileVote]:
    return [
        TileVote(f"v{i}", 0, f"d{i}", states=states_plane({cell: state}), gone=Words.of(words_plane({cell: mask})))
        for i, (mask, state) in enumerate(zip(masks, states, strict=True))
    ]


def gone(tile: Tile, votes: list[TileVote], decided: int = UO, cell: Cell = CELL) -> int:
    """The voxels of a cell that go, of those that the tile has points in."""
    words = words_gone(votes, states_plane({cell: decided}), 2, tile)
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


def test_nobody_alone_takes_what_touches_what_stays() -> None:
    for heights, goes in (([0.45, 0.75], 0), ([0.45, 1.05], 0b1000)):
        tile, votes = make_tile(wall([CELL], heights)), says([0b1100], [UO])
        words = words_gone(votes, states_plane({CELL: UO}), 1, tile)
        assert words is not None
        assert int(words[CELL] & tile.obstacle_words[CELL]) == goes


def test_what_touches_what_stays_in_the_next_cell_only_touches_it_too() -> None:
    twig, votes = wall([CELL], APART), says([0b1010] * 2 + [0], [UO] * 3)
    for beside, other, stays in (
        ((10, 11), UO, True),
        ((11, 9), UO, True),
        ((10, 12), UO, False),
        ((10, 11), UN, True),
        ((10, 11), CE, False),
    ):
        tile = make_tile(np.concatenate([twig, wall([beside], [0.75])]))
        decided = states_plane({CELL: UO, beside: other})
        words = words_gone(votes, decided, 2, tile)
        assert words is not None
        assert words[CELL] == (0 if stays else 0b1010)


def test_of_two_voxels_that_go_together_neither_holds_the_other() -> None:
    assert of_standing([0b110] * 2 + [0], [0.45, 0.75, 1.65]) == 0b110


@pytest.mark.parametrize("cell", [(0, 10), (TILE_CELLS - 1, 10), (10, 0), (10, TILE_CELLS - 1)])
def test_at_the_tile_s_edge_all_may_touch_what_stays_beyond_it(cell: Cell) -> None:
    assert of_standing([0b1010] * 2 + [0], cell=cell) == 0
    assert of_standing([0b1010] * 3, cell=cell) == 0b1010


def test_who_has_the_whole_cell_empty_counts_among_two_thirds_but_not_among_half() -> None:
    for heights, mask in (([0.45, 0.75], 0b100), (APART, 0b1010)):
        tile = make_tile(wall([CELL], heights))
        assert gone(tile, says([mask, mask, 0b111110], [UO, UO, CE])) == mask, "all three say so"
        assert gone(tile, says([mask, 0b111110, 0], [UO, CE, UO])) == 0, "two of three, of whom one saw nothing stand"
        whole = TileVote("w", 0, "w", states=states_plane({CELL: CE}))
        assert gone(tile, [*says([mask, mask], [UO, UO]), whole]) == mask, "no mask is all of an emptied cell"


def test_marks_count_of_nobody_who_says_anything_else_and_only_if_the_cell_stands() -> None:
    tile = make_tile(wall([CELL], [0.45]))
    for other in (UN, UE, NO_VOTE):
        assert gone(tile, says([0b10, 0, 0, 0b10], [UO, UO, UO, other])) == 0
    assert gone(tile, says([0b10] * 3, [UN] * 3), UN) == 0
    whole = [TileVote(v, 0, v, states=states_plane({CELL: UO})) for v in "abc"]
    assert gone(tile, whole) == 0, "no mask marks nothing in a cell that stands"


def test_in_one_stage_a_mask_of_a_cell_that_may_be_empty_says_nothing_of_one_that_stands() -> None:
    tile, votes = make_tile(wall([CELL], APART)), []
    for i, counts in enumerate(([3, 0, 0, 1, 0], [3, 0, 0, 0, 0], [3, 0, 0, 0, 0])):
        tally = np.zeros((*SHAPE, 5), np.uint16)
        tally[CELL] = counts
        votes.append(TileVote(f"v{i}", 0, "d", tally=tally, gone=Words.of(words_plane({CELL: 0b1010}))))
    assert gone(tile, votes) == 0b1010
    votes[1].tally[CELL] = [3, 0, 0, 1, 0]  # type: ignore[index]
    assert gone(tile, votes) == 0


@given(
    masks=st.lists(st.integers(0, 0b111110), min_size=1, max_size=6),
    states=st.lists(st.sampled_from([UO, CE, UE, UN]), min_size=6, max_size=6),
    layers=st.sets(st.integers(1, 5), min_size=1),
    more=st.integers(0, 0b111110),
)
@settings(max_examples=60, deadline=None)
def test_the_order_of_votes_is_nothing_and_one_mark_more_never_takes_less(
    masks: list[int], states: list[int], layers: set[int], more: int
) -> None:
    tile = make_tile(wall([CELL], [0.3 * layer + 0.15 for layer in sorted(layers)]))
    votes = says(masks, states[: len(masks)])
    before = gone(tile, votes)
    assert gone(tile, votes[::-1]) == before
    assert gone(tile, says([masks[0] | more, *masks[1:]], states[: len(masks)])) & before == before


def test_a_mapped_neighbour_that_nobody_decides_stays_and_keeps_what_touches_it() -> None:
    """Its votes are spent: it stands as before. Else a publish without new votes would delete more."""
    beside = (CELL[0], CELL[1] + 1)
    tile = make_tile(wall([CELL, beside], [0.45]))
    votes = says([0b10, 0b10, 0], [UO, UO, UO])
    assert gone(tile, votes) == 0
    assert gone(make_tile(wall([CELL], [0.45])), votes) == 0b10, "alone it is a remnant"


@settings(max_examples=60)
@given(st.data())
def test_the_same_votes_delete_nothing_more_where_their_cells_have_not_changed(data: st.DataObject) -> None:
    """Votes on a cell are spent once its points change. The other votes delete nothing in a second publish."""
    block = [(20 + r, 20 + c) for r in range(3) for c in range(3)]
    heights = {
        cell: data.draw(st.lists(st.sampled_from([0.45, 0.75, 1.05]), max_size=3, unique=True)) for cell in block
    }
    mapped = [cell for cell in block if heights[cell]]
    if not mapped:
        return
    tile = make_tile(np.concatenate([wall([cell], heights[cell]) for cell in mapped]))
    decided = {cell: data.draw(st.sampled_from([UO, CE, UN, None])) for cell in mapped}
    votes = []
    for i in range(3):
        masks = {cell: data.draw(st.sampled_from([0, 0b10, 0b100, 0b1110])) for cell in mapped}
        agree = {cell: state for cell, state in decided.items() if state is not None}
        votes.append(TileVote(f"v{i}", 0, f"d{i}", states=states_plane(agree), gone=Words.of(words_plane(masks))))
    states = states_plane({cell: state for cell, state in decided.items() if state is not None})
    first = words_gone(votes, states, 2, tile)
    if first is None:
        return
    deleted = np.asarray(first & tile.obstacle_words)
    after, _ = delete_points(tile, first)
    spent = np.flatnonzero(deleted)
    again = [silenced(vote, spent) for vote in votes]
    states = states.copy()
    states.reshape(-1)[spent] = NO_VOTE
    second = words_gone(again, states, 2, after)
    assert second is None or not (second & after.obstacle_words).any()
