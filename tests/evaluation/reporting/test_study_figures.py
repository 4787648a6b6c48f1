"""Ablation, robustness and reliability: drawn of what was measured, and only of that."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
import pytest

from mapvote import plots as style
from mapvote.core.grid import Grid, Lattice
from mapvote.core.types import NO_VOTE, CellState
from mapvote.core.voting import VOTE_UNIT
from mapvote.fusion.fuse import Decision
from mapvote_lab.evaluation.reporting.study_figures import ablation, reliability_diagram, robustness
from mapvote_lab.evaluation.results import MapShift, MatrixResult, RoundResult
from mapvote_lab.evaluation.scoring.cells import ByClass, Scores
from mapvote_lab.evaluation.scoring.objects import ObjectScores
from mapvote_lab.evaluation.scoring.reliability import binned, reliability


def entry(share: float) -> RoundResult:
    scores = Scores.of(ByClass(share, share, share), ByClass(share, share, share))
    return RoundResult(
        strict=scores, provenance=scores, coverage=1.0, objects=ObjectScores((), (), (), ()),
        strict_old_unchanged=scores, provenance_old_unchanged=scores, determined=1.0,
    )  # fmt: skip


def results(**rounds: float) -> dict[str, dict[int, MatrixResult]]:
    """One seed of experiments in which columns score so much."""
    shift: Any = MapShift(0.0, 0.0, 0.0, 0.0, 0.0)
    return {
        name.replace("_", " "): {
            3: MatrixResult(
                scenario="corner", seed=3, cells=1, map_shift=shift, localisation={}, ceilings={},
                rounds={"columns_v1": entry(share)},
            )
        }
        for name, share in rounds.items()
    }  # fmt: skip


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
    decision = Decision(states, tally, 3, 0, 0)
    window = Grid(lattice, 256 + 1, 0, 4, 6)  # of a tile to the north, without the last changed cell
    truth = np.zeros((4, 6), dtype=np.uint8)
    truth[1, 3], truth[1, 4] = 2, 255
    found = reliability({(1, 0): decision}, lattice, truth, window, CellState.CHANGED_EMPTY)
    assert found.cells.sum() == 2
    assert np.nansum(found.true * found.cells) == 1


def test_what_was_not_measured_is_not_drawn() -> None:
    assert ablation({"columns_v1": [entry(0.9)]}) is None
    assert robustness(results(main=0.9)) is None


def test_what_was_measured_is_drawn_in_every_format(tmp_path: Path) -> None:
    drawn = {
        "ablation": ablation({"columns_v1 A": [entry(0.4), entry(0.5)], "columns_v1": [entry(0.9), entry(0.8)]}),
        "robustness": robustness(results(main=0.9, noise=0.3)),
        "reliability": reliability_diagram({CellState.CHANGED_EMPTY: binned(np.array([0.5]), np.array([True]))}),
    }
    for name, figure in drawn.items():
        assert figure is not None
        style.save(figure, tmp_path / f"{name}.svg", "svg")
    told = (tmp_path / "robustness.svg").read_text()
    assert "poses off by 0.1 m" in told
    assert "2 scans a second" not in told
    low, high = drawn["robustness"].axes[0].get_xlim()  # type: ignore[union-attr]
    assert low <= 0.3 < high, "no figure is left out of the picture"
