"""Reliability of probabilities: by bins, over scored cells, and drawn."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from mapvote import plots as style
from mapvote.core.grid import Grid, Lattice
from mapvote.core.types import NO_VOTE, CellState
from mapvote.core.voting import VOTE_UNIT
from mapvote.fusion.fuse import Decision
from mapvote_lab.evaluation.figures import reliability_diagram
from mapvote_lab.evaluation.scores import binned, reliability


def test_a_bin_tells_how_often_what_it_speaks_of_was_so() -> None:
    found = binned(np.array([0.05, 0.92, 0.94, 0.96, 1.0]), np.array([False, True, True, False, True]))
    assert found.cells.tolist() == [1, 0, 0, 0, 0, 0, 0, 0, 0, 4]
    assert found.true[-1] == pytest.approx(0.75)
    assert found.predicted[-1] == pytest.approx(0.955)
    assert np.isnan(found.true[1:-1]).all()
    assert found.calibration_error == pytest.approx((0.05 + 4 * 0.205) / 5)


def test_only_cells_that_are_scored_count_wherever_their_tile_lies() -> None:
    lattice = Lattice()
    states = np.full((256, 256), NO_VOTE, dtype=np.uint8)
    states[2, 3:7] = CellState.CHANGED_EMPTY
    tally = np.zeros((256, 256, 5), dtype=np.int32)
    tally[..., CellState.CHANGED_EMPTY] = 3 * VOTE_UNIT
    decision = Decision(states, tally, states, 1)
    window = Grid(lattice, 256 + 1, 0, 4, 6)  # of a tile to the north, without the last changed cell
    truth = np.zeros((4, 6), dtype=np.uint8)
    truth[1, 3], truth[1, 4] = 2, 255
    found = reliability({(1, 0): decision}, lattice, truth, window, CellState.CHANGED_EMPTY)
    assert found.cells.sum() == 2
    assert np.nansum(found.true * found.cells) == 1


def test_a_diagram_can_be_saved(tmp_path: Path) -> None:
    figure = reliability_diagram({CellState.CHANGED_EMPTY: binned(np.array([0.5]), np.array([True]))})
    style.save(figure, tmp_path / "reliability.svg", "svg")
    assert "calibration error" in (tmp_path / "reliability.svg").read_text()
