"""How sure a vehicle is of what it calls changed: by how much of the thing is in the cell."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from hypothesis.extra.numpy import arrays

from hand_made import make_tile, states_plane, wall
from mapvote.core.grid import CELL_SIZE, TILE_CELLS
from mapvote.core.types import I32, NO_VOTE, U8, CellState
from mapvote.detection.surfaces import LOOKS, MOST_CELLS, MOST_HEIGHT_M, depths_m, log_odds, looks

CO, CE = CellState.CHANGED_OCCUPIED, CellState.CHANGED_EMPTY
TILE = slice(1, TILE_CELLS + 1), slice(1, TILE_CELLS + 1)
"""Of a window that reaches one cell beyond it, and a tile to the right."""
LOW = np.full((TILE_CELLS + 2, 2 * TILE_CELLS + 1), 1.0, dtype=np.float32)


def windowed(left: np.ndarray, right: np.ndarray | None = None, fill: int = NO_VOTE) -> np.ndarray:
    out = np.full(LOW.shape, fill, left.dtype)
    out[1:-1, 1 : TILE_CELLS + 1] = left
    if right is not None:
        out[1:-1, TILE_CELLS + 1 :] = right
    return out


def seen(states: U8, amount: I32 | None = None) -> np.ndarray:
    full = np.ones((256, 256), dtype=np.int32) if amount is None else amount
    return looks(windowed(states), windowed(full, fill=0), LOW, TILE)


def test_a_cell_is_seen_in_its_thing_and_against_the_fullest_beside_it() -> None:
    states = states_plane({(5, 5): CE, (5, 6): CE, (6, 7): CE, (5, 7): CO, (40, 40): CE}, fill=1)
    amount = np.ones((256, 256), dtype=np.int32)
    amount[5, 6] = 9
    found = seen(states, amount)
    assert found.shape == (5, LOOKS)
    assert np.exp(found[:, 0]) - 1 == pytest.approx([3, 3, 1, 3, 1]), "cells of the thing"
    assert found[:, 1] * 8 == pytest.approx([1, 2, 0, 1, 0]), "alike around"
    assert found[:, 2] == pytest.approx([np.log(2 / 10), np.log(10 / 2), np.log(2), np.log(2 / 10), np.log(2)])
    assert found[:, 3] == pytest.approx([1.0, 1.0, 0.0, 1.0, 1.0]), "the map rises in what is gone"


def test_a_thing_goes_on_where_tiles_meet_and_is_as_large_as_any_at_last() -> None:
    left, right = (states_plane({(r, c): CE for r in range(20)}) for c in (255, 0))
    full = np.ones(LOW.shape, dtype=np.int32)
    found = looks(windowed(left, right), full, LOW, TILE)
    assert np.exp(found[:, 0]) - 1 == pytest.approx(40)
    assert found[10, 1] * 8 == pytest.approx(5)
    whole = seen(np.full((256, 256), CE, dtype=np.uint8))
    assert np.exp(whole[:, 0]) - 1 == pytest.approx(np.full(65536, MOST_CELLS))
    assert looks(windowed(left), full, 99 * LOW, TILE)[:, 3].max() == MOST_HEIGHT_M


def test_a_surface_is_as_deep_as_its_point_that_is_farthest_from_the_cells_sides() -> None:
    rim = np.array(
        [[3 * CELL_SIZE + 0.01, 2.5 * CELL_SIZE, 0.75], [3.5 * CELL_SIZE, 9.4 * CELL_SIZE, 0.75]], np.float32
    )
    middle = wall([(2, 3)], [0.75])
    states = states_plane({(2, 3): CE, (9, 3): CO, (9, 9): CO})
    assert depths_m(states, make_tile(rim[:1]), rim) == pytest.approx([0.01, 0.4 * CELL_SIZE, 0.0], abs=1e-6)
    assert depths_m(states, make_tile(np.concatenate([rim[:1], middle])), rim)[0] == pytest.approx(0.5 * CELL_SIZE)
    ground = make_tile(wall([(2, 3)], [0.05]))
    assert depths_m(states, ground, rim).tolist()[0] == 0.0, "ground is no surface that goes"
    assert depths_m(states_plane({(9, 3): CO}), None, rim) == pytest.approx([0.4 * CELL_SIZE])
    assert depths_m(states_plane(fill=NO_VOTE), None, rim[:0]).shape == (0,)
    last = np.array([[76.7, 76.6, 1.0], [76.8, 76.8, 1.0]], np.float32)
    assert depths_m(states_plane({(255, 255): CO}), None, last) == pytest.approx([0.1], abs=1e-5), "at the tile's end"


@settings(max_examples=30, deadline=None)
@given(arrays(np.float64, (2, LOOKS), elements=st.floats(0, 5)), st.floats(0, 0.15), st.sampled_from([CO, CE]))
def test_a_deeper_surface_and_a_larger_thing_make_it_surer(looked: np.ndarray, deep: float, state: CellState) -> None:
    states = np.array([state], dtype=np.uint8)
    low, high = looked.min(axis=0)[None], looked.max(axis=0)[None]
    shallow = log_odds(states, low, np.array([0.0]))[0]
    assert shallow <= log_odds(states, low, np.array([deep]))[0]
    assert shallow <= log_odds(states, high, np.array([0.0]))[0]
