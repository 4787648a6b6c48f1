"""Objects cast into the scans are scored one by one and by kind, dry and in rain side by side."""

from __future__ import annotations

from types import SimpleNamespace
from typing import Any, cast

import numpy as np

from mapvote.core.grid import Grid, Lattice
from mapvote.core.types import Bool, CellState
from mapvote_lab.evaluation.real_bench import (
    Asked,
    Bench,
    Changed,
    ChangedRun,
    Ground,
    precision_near,
    score,
)
from mapvote_lab.evaluation.real_report import real_tables

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
    (wrong,) = score([Asked("pole gone", CellState.CHANGED_EMPTY, cells(5, 5, 1, 1))], states)
    assert (wrong.half, wrong.touched, wrong.cell_recall) == (0, 0, 0.0)


def test_false_changes_near_a_thing_cost_precision_and_far_ones_do_not() -> None:
    wall = Asked("wall built", CellState.CHANGED_OCCUPIED, cells(10, 10, 1, 6))
    states = np.full(GRID.shape, CellState.UNCHANGED_EMPTY, dtype=np.uint8)
    states[10, 10:16] = CellState.CHANGED_OCCUPIED
    states[35, 35] = CellState.CHANGED_EMPTY
    assert precision_near([wall], states, GRID) == 1.0
    states[13, 10:12] = CellState.CHANGED_EMPTY
    assert precision_near([wall], states, GRID) == 6 / 8


def changed(kind: str, state: CellState, found: int) -> Changed:
    """A run on which one thing of four cells was asked for, of which so many were ``found``."""
    states = np.full(GRID.shape, CellState.UNCHANGED_EMPTY, dtype=np.uint8)
    states[5, 2 : 2 + found] = state
    run = SimpleNamespace(states={"5": states}, street=SimpleNamespace(grid=GRID))
    return cast("Changed", (run, [Asked(kind, state, cells(5, 2, 1, 4), 7.0)]))


def test_objects_found_in_rain_stand_beside_those_found_dry() -> None:
    dry = changed("wall built", CellState.CHANGED_OCCUPIED, 4)
    wet, gone = changed("wall built", CellState.CHANGED_OCCUPIED, 1), changed("wall gone", CellState.CHANGED_EMPTY, 2)
    runs: dict[str, Any] = {ChangedRun.BUILT: dry, ChangedRun.BUILT_IN_RAIN: wet, ChangedRun.DEMOLISHED: gone}
    _, cast_into, in_rain = real_tables(Bench("street", 30, Ground(1.7, 0.0, 0.0, 0.0), changed=runs), "5")
    assert cast_into.title.endswith("1.00 (built), 1.00 (built in rain, 10 % of the rays), 1.00 (demolished)")
    assert cast_into.rows == [("wall built", "1", "1", "1", "1.00", "7"), ("wall gone", "1", "1", "1", "0.50", "7")]
    assert in_rain.title == "street: built in rain, 10 % of the rays, 5, beside the dry run"
    assert in_rain.rows == [("wall built", "1", "1", "0", "1.00", "0.25")]
