"""The five states of paper Figure 3, cell by cell, and case 5."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest

from mapvote.config import VotingSettings
from mapvote.core.columns import below_top, span_of
from mapvote.core.grid import Grid, Lattice
from mapvote.core.sensors import SENSORS
from mapvote.core.types import NO_VOTE, CellState, Reference
from mapvote.core.voting import VOTE_UNIT, vote_weight
from mapvote.detection.paper import classify_paper
from mapvote.perception.raycast import ScanView, Sight

ORIGIN = np.array([0.15, 0.15, 1.8])
SENSOR = SENSORS["hdl32e"]


def one_cell(
    n: int, sight: Sight, map_bits: int = 0, passed: int = 0, hit: int = 0, bottom_z: float = 0.5, far: int = 30
) -> tuple[ScanView, Reference]:
    """A window of one row in which only the last cell, ``far`` cells away, holds anything."""
    grid = Grid(Lattice(), 0, 0, 1, far + 1)

    def plane(value: float, dtype: type, fill: float = 0) -> np.ndarray:
        out: np.ndarray = np.full(grid.shape, fill, dtype)
        out[0, far] = value
        return out

    view = ScanView(
        grid, plane(n, np.int32), plane(hit, np.uint64), plane(passed, np.uint64), plane(int(sight), np.uint8)
    )
    mapped = int(map_bits != 0)
    zero = np.zeros(grid.shape, np.float32)
    reference = Reference(
        grid,
        zero,
        zero.astype(np.int32),
        plane(map_bits, np.uint64),
        plane(mapped, np.int32),
        plane(bottom_z, np.float32, np.inf),
        plane(bottom_z + 1, np.float32, -np.inf),
        None,
    )
    return view, reference


def vote(view: ScanView, reference: Reference, **settings: Any) -> tuple[int, int]:
    states, weights = classify_paper(
        view, reference, ORIGIN, SENSOR, VotingSettings.model_validate({"skip_tall_cells": False, **settings})
    )
    return int(states[0, -1]), int(weights[0, -1])


@pytest.mark.parametrize(
    ("n", "sight", "map_bits", "state"),
    [
        (7, Sight.CLEAR, 0b1110, CellState.UNCHANGED_OCCUPIED),
        (7, Sight.CLEAR, 0, CellState.CHANGED_OCCUPIED),
        (0, Sight.CLEAR, 0, CellState.UNCHANGED_EMPTY),
        (0, Sight.CLEAR, 0b1110, CellState.CHANGED_EMPTY),
        (0, Sight.BEHIND, 0b1110, CellState.UNDETERMINED),
        (0, Sight.BEYOND, 0, CellState.UNDETERMINED),
        (4, Sight.CLEAR, 0b1110, CellState.UNDETERMINED),
        (4, Sight.CLEAR, 0, CellState.UNDETERMINED),
        (0, Sight.NEVER, 0b1110, NO_VOTE),
    ],
)
def test_the_five_states_of_figure_3(n: int, sight: Sight, map_bits: int, state: int) -> None:
    assert vote(*one_cell(n, sight, map_bits))[0] == state


def test_occupied_cells_have_the_votes_of_equation_1_and_others_one() -> None:
    assert vote(*one_cell(10, Sight.CLEAR))[1] == round(float(vote_weight(10)) * VOTE_UNIT)
    assert vote(*one_cell(10, Sight.CLEAR), weighted=False)[1] == VOTE_UNIT
    assert vote(*one_cell(0, Sight.CLEAR))[1] == VOTE_UNIT
    assert vote(*one_cell(3, Sight.CLEAR))[1] == VOTE_UNIT


def test_the_three_occlusion_rules() -> None:
    behind_a_fence = one_cell(0, Sight.BEHIND, map_bits=0b1010_0000, passed=0b100_0000)
    assert vote(*behind_a_fence, occlusion="first_hit")[0] == CellState.UNDETERMINED
    assert vote(*behind_a_fence, occlusion="farthest_return")[0] == CellState.CHANGED_EMPTY
    assert vote(*behind_a_fence, occlusion="column")[0] == CellState.CHANGED_EMPTY  # through the span, not a voxel
    over_it = one_cell(0, Sight.CLEAR, map_bits=0b1010_0000, passed=0b1_0000)
    assert vote(*over_it, occlusion="column")[0] == CellState.UNDETERMINED


def test_case_5_skips_cells_whose_map_begins_above_the_view_at_that_range() -> None:
    # 9 m away, the view of an HDL-32E at 1.8 m ends at 1.8 + 9 tan(10.67 deg) = 3.50 m.
    for bottom_z, state in ((3.4, CellState.CHANGED_EMPTY), (3.6, NO_VOTE)):
        cell = one_cell(0, Sight.CLEAR, map_bits=1 << 12, bottom_z=bottom_z)
        assert vote(*cell, skip_tall_cells=True)[0] == state
        assert vote(*cell)[0] == CellState.CHANGED_EMPTY


def test_case_5_read_literally_skips_cells_where_the_map_is_higher_than_the_scan() -> None:
    literal: dict[str, Any] = {"skip_tall_cells": True, "tall_rule": "height"}
    assert vote(*one_cell(0, Sight.CLEAR, map_bits=0b10), **literal)[0] == NO_VOTE
    assert vote(*one_cell(9, Sight.CLEAR, map_bits=0b110, hit=0b10), **literal)[0] == NO_VOTE
    assert vote(*one_cell(9, Sight.CLEAR, map_bits=0b110, hit=0b101), **literal)[0] == CellState.UNCHANGED_OCCUPIED


def test_bits_of_a_column() -> None:
    assert span_of(np.uint64(0b0100_1000)) == 0b0111_1000
    assert span_of(np.uint64(0)) == 0
    assert span_of(np.uint64(1 << 63)) == 1 << 63
    assert below_top(np.uint64(0b0100_1000)) == 0b0111_1111
