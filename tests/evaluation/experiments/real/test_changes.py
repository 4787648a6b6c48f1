"""What was cast into the scans is scored thing by thing, kind by kind."""

from __future__ import annotations

import numpy as np

from mapvote.core.grid import Grid, Lattice
from mapvote.core.types import Bool, CellState
from mapvote_lab.evaluation.experiments.real_bench import Asked, precision_near, score

GRID = Grid(Lattice(), 0, 0, 40, 40)


def cells(row: int, col: int, rows: int, cols: int) -> Bool:
    out = np.zeros(GRID.shape, dtype=np.bool_)
    out[row : row + rows, col : col + cols] = True
    return out


def test_a_thing_is_found_by_half_of_its_cells_and_touched_by_one_beside_it() -> None:
    wall = Asked("wall built", CellState.CHANGED_OCCUPIED, cells(5, 5, 1, 10))
    beside = Asked("wall built", CellState.CHANGED_OCCUPIED, cells(20, 5, 1, 10))
    hidden = Asked("wall built", CellState.CHANGED_OCCUPIED, cells(0, 0, 0, 0))
    states = np.full(GRID.shape, CellState.UNCHANGED_EMPTY, dtype=np.uint8)
    states[5, 5:10] = CellState.CHANGED_OCCUPIED
    states[21, 7] = CellState.CHANGED_OCCUPIED
    (found,) = score([wall, beside, hidden], states)
    assert (found.things, found.half, found.touched) == (2, 1, 2)
    assert found.cell_recall == 5 / 20


def test_the_wrong_change_is_none() -> None:
    gone = Asked("pole gone", CellState.CHANGED_EMPTY, cells(10, 10, 1, 1))
    states = np.full(GRID.shape, CellState.CHANGED_OCCUPIED, dtype=np.uint8)
    (found,) = score([gone], states)
    assert (found.half, found.touched, found.cell_recall) == (0, 0, 0.0)


def test_false_changes_near_a_thing_cost_precision_and_far_ones_do_not() -> None:
    wall = Asked("wall built", CellState.CHANGED_OCCUPIED, cells(10, 10, 1, 6))
    states = np.full(GRID.shape, CellState.UNCHANGED_EMPTY, dtype=np.uint8)
    states[10, 10:16] = CellState.CHANGED_OCCUPIED
    states[35, 35] = CellState.CHANGED_EMPTY
    assert precision_near([wall], states, GRID) == 1.0
    states[13, 10:12] = CellState.CHANGED_EMPTY
    assert precision_near([wall], states, GRID) == 6 / 8
