"""What is told of a recorded street: things found dry and in rain stand side by side."""

from __future__ import annotations

from types import SimpleNamespace
from typing import cast

import numpy as np

from mapvote.core.grid import Grid, Lattice
from mapvote.core.types import CellState
from mapvote_lab.evaluation.experiments.real_bench import (
    BUILT,
    BUILT_IN_RAIN,
    DEMOLISHED,
    Asked,
    Bench,
    Changed,
    Ground,
)
from mapvote_lab.evaluation.reporting.real_report import real_tables
from mapvote_lab.evaluation.reporting.tables import Sheet

GRID = Grid(Lattice(), 0, 0, 10, 10)


def changed(kind: str, state: CellState, found: int) -> Changed:
    """A run on which one thing of four cells was asked for, of which so many were ``found``."""
    cells = np.zeros(GRID.shape, dtype=np.bool_)
    cells[5, 2:6] = True
    states = np.full(GRID.shape, CellState.UNCHANGED_EMPTY, dtype=np.uint8)
    states[5, 2 : 2 + found] = state
    run = SimpleNamespace(states={"5": states}, street=SimpleNamespace(grid=GRID))
    return cast("Changed", (run, [Asked(kind, state, cells, 7.0)]))


def sheets_of(runs: dict[str, Changed]) -> list[Sheet]:
    """Those of the things cast, after the one of the ground."""
    sheets = real_tables(Bench("street", 30, Ground(1.7, 0.0, 0.0, 0.0), changed=runs), "5")
    assert all(len(row) == len(sheet.headings) for sheet in sheets for row in sheet.rows)
    return sheets[1:]


def test_what_was_found_in_rain_stands_beside_what_was_found_dry() -> None:
    cast_into, in_rain = sheets_of(
        {
            BUILT: changed("wall built", CellState.CHANGED_OCCUPIED, 4),
            BUILT_IN_RAIN: changed("wall built", CellState.CHANGED_OCCUPIED, 1),
            DEMOLISHED: changed("wall gone", CellState.CHANGED_EMPTY, 2),
        }
    )
    assert cast_into.title.endswith("1.00 (built), 1.00 (built in rain, 10 % of the rays), 1.00 (demolished)")
    assert cast_into.rows == [("wall built", "1", "1", "1", "1.00", "7"), ("wall gone", "1", "1", "1", "0.50", "7")]
    assert in_rain.title == "street: built in rain, 10 % of the rays, 5, beside the dry run"
    assert in_rain.rows == [("wall built", "1", "1", "0", "1.00", "0.25")]


def test_where_it_did_not_rain_no_table_says_so() -> None:
    assert len(sheets_of({BUILT: changed("wall built", CellState.CHANGED_OCCUPIED, 4)})) == 1
