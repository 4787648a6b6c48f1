"""Rules that look beyond a cell: what falls, across the edges of tiles too."""

from __future__ import annotations

import numpy as np
import pytest

from mapvote.core.types import U8, CellState
from mapvote.detection.surface_rules import fallen

UO, UE, CO, CE, UN = (int(state) for state in CellState)


def plane(*marks: tuple[slice | int, slice | int, int], fill: int = UE, side: int = 40) -> U8:
    out = np.full((side, side), fill, dtype=np.uint8)
    for rows, cols, state in marks:
        out[rows, cols] = state
    return out


@pytest.mark.parametrize(("gap", "falls"), [(1, True), (15, True), (16, False)])
def test_a_roof_falls_with_walls_no_farther_off_than_the_reach(gap: int, falls: bool) -> None:
    states = plane((20, 2, CE), (20, slice(2 + gap, 6 + gap), UN), (20, 39, UO))
    adrift = np.zeros(states.shape, dtype=np.bool_)
    adrift[20, 2 + gap : 6 + gap] = True
    down = fallen(states, adrift, 15)
    assert down.any() == falls


def test_of_two_roofs_that_meet_only_the_one_nearer_to_what_is_gone_falls() -> None:
    states = plane((20, 4, CE), (20, 20, UO))
    adrift = np.zeros(states.shape, dtype=np.bool_)
    adrift[20, 5:20] = True
    down = fallen(states, adrift, 15)
    assert np.flatnonzero(down[20]).tolist() == list(range(5, 12))  # 12 is as near to the one as to the other


def test_without_anything_gone_nothing_falls_and_without_anything_standing_all_of_it() -> None:
    adrift = np.zeros((40, 40), dtype=np.bool_)
    adrift[20, 5:9] = True
    assert not fallen(plane(), adrift, 15).any()
    assert fallen(plane((20, 4, CE)), adrift, 15).sum() == 4


def test_what_is_not_adrift_never_falls() -> None:
    states = plane((20, 4, CE))
    assert not fallen(states, np.zeros(states.shape, dtype=np.bool_), 15).any()
