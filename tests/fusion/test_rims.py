"""A cell that holds no more than the noise of the wall beside it did not change, and its points go with the wall."""

from __future__ import annotations

import numpy as np
from hypothesis import given
from hypothesis import strategies as st
from hypothesis.extra.numpy import arrays

from mapvote.codec.odds import UNSAID
from mapvote.core.grid import CELLS, TILE_CELLS, Lattice
from mapvote.core.tile import Tile
from mapvote.core.types import I8, U8, CellState
from mapvote.fusion.odds import Odds
from mapvote.fusion.rims import rims, without_rims

CE, CO, UO = CellState.CHANGED_EMPTY, CellState.CHANGED_OCCUPIED, CellState.UNCHANGED_OCCUPIED
SURE, UNSURE = 12, -12
BARE = Tile.empty(Lattice().tile((0, 0)))
"""Without points, so that only what is said of cells tells of rims."""


def tile_of(cells: dict[tuple[int, int], tuple[int, int]]) -> tuple[U8, Odds]:
    """States and odds of a tile in which some cells (row, col) have a state, and steps of log-odds."""
    states = np.full((TILE_CELLS, TILE_CELLS), CellState.UNCHANGED_EMPTY, np.uint8)
    flat = sorted((r * TILE_CELLS + c, state, steps) for (r, c), (state, steps) in cells.items())
    for cell, state, _ in flat:
        states.reshape(-1)[cell] = state
    changed = [(cell, steps) for cell, state, steps in flat if state in (CE, CO)]
    return states, Odds(np.array([c for c, _ in changed], np.int64), np.array([s for _, s in changed], np.int8))


def test_an_unlikely_cell_beside_a_likely_one_of_its_kind_is_a_rim_and_told_as_unchanged() -> None:
    states, odds = tile_of({(9, 9): (CE, SURE), (9, 10): (CE, UNSURE), (30, 30): (CO, SURE), (31, 31): (CO, UNSURE)})
    assert rims(states, odds).tolist() == [9 * TILE_CELLS + 10, 31 * TILE_CELLS + 31]
    told = without_rims(states, odds, BARE, [])
    assert told[9, 10] == told[31, 31] == CellState.UNCHANGED_EMPTY
    assert told[9, 9] == CE
    assert told[30, 30] == CO
    assert states[9, 10] == CE, "what was voted stays"


def test_a_pole_of_which_no_cell_is_likely_is_a_change_as_voted() -> None:
    states, odds = tile_of({(9, 9): (CE, UNSURE), (9, 10): (CE, UNSURE), (9, 11): (CO, SURE), (8, 8): (UO, 0)})
    assert without_rims(states, odds, BARE, []) is states


def test_where_nobody_says_how_sure_he_is_there_is_no_rim() -> None:
    states, odds = tile_of({(9, 9): (CE, SURE), (9, 10): (CE, UNSAID), (50, 50): (CO, UNSAID)})
    assert without_rims(states, odds, BARE, []) is states
    assert without_rims(states, Odds.none(), BARE, []) is states


def test_a_rim_touches_a_likely_cell_on_any_side_and_two_cells_away_is_none() -> None:
    for row, col in [(i, j) for i in range(7, 12) for j in range(7, 12) if (i, j) != (9, 9)]:
        states, odds = tile_of({(9, 9): (CE, SURE), (row, col): (CE, UNSURE)})
        beside = max(abs(row - 9), abs(col - 9)) == 1
        assert rims(states, odds).tolist() == ([row * TILE_CELLS + col] if beside else [])


def test_across_a_tiles_border_nothing_is_a_rim_and_its_corners_are_no_trouble() -> None:
    end = TILE_CELLS - 1
    states, odds = tile_of({(0, 0): (CE, UNSURE), (end, end): (CE, SURE), (0, end): (CO, UNSURE), (end, 0): (CO, SURE)})
    assert without_rims(states, odds, BARE, []) is states


@given(
    arrays(np.uint8, (6, 6), elements=st.sampled_from([CE, CO, UO, CellState.UNCHANGED_EMPTY])),
    arrays(np.int8, (6, 6), elements=st.integers(-20, 20)),
)
def test_rims_are_unlikely_changes_beside_likely_ones_and_telling_them_twice_tells_no_more(
    small: U8, steps: I8
) -> None:
    states, odds = tile_of({(r, c): (int(small[r, c]), int(steps[r, c])) for r in range(6) for c in range(6)})
    found = np.zeros(CELLS, np.bool_)
    found[rims(states, odds)] = True
    assert not (found & ~np.isin(states.reshape(-1), [CE, CO])).any()
    told = without_rims(states, odds, BARE, [])
    assert (told.reshape(-1)[~found] == states.reshape(-1)[~found]).all()
    assert without_rims(told, odds, BARE, []) is told, "what is left beside a likely cell is likely"
