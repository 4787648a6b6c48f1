"""Groups of cells that are too small to be a thing (rule G)."""

from __future__ import annotations

import numpy as np
import pytest
from scipy import ndimage

from mapvote.core.types import U8, CellState
from mapvote_lab.evaluation.columns_v1.regions import drop_specks
from mapvote_lab.evaluation.columns_v1.specks import small_groups

UO, UE, CO, CE, UN = (int(state) for state in CellState)


def plane(*marks: tuple[slice | int, slice | int, int], fill: int = UE, side: int = 40) -> U8:
    out = np.full((side, side), fill, dtype=np.uint8)
    for rows, cols, state in marks:
        out[rows, cols] = state
    return out


@pytest.mark.parametrize("seed", range(8))
def test_groups_are_told_by_their_size(seed: int) -> None:
    rng = np.random.default_rng(seed)
    shape = (40 + seed, 61 - seed)
    wide = ndimage.gaussian_filter(rng.normal(size=shape), 0.5 + 0.1 * seed)
    cells = (wide > 0.5 * wide.std()) ^ (rng.random(shape) < 0.02)
    label, _ = ndimage.label(cells, np.ones((3, 3)))
    size = np.bincount(label.ravel())[label]
    for least in (1, 2, 7):
        assert (small_groups(cells, least) == (cells & (size < least))).all()


@pytest.mark.parametrize("state", [CO, CE])
def test_groups_smaller_than_asked_are_specks_and_corners_join(state: int) -> None:
    states = plane((5, slice(5, 8), state), (20, 20, state), (21, 21, state), (22, 22, state), (23, 23, state))
    specks = drop_specks(states, 4)
    assert np.flatnonzero(specks.any(axis=1)).tolist() == [5]
    assert specks.sum() == 3
    assert not drop_specks(states, 3).any()


def test_two_kinds_of_change_do_not_make_one_group() -> None:
    assert drop_specks(plane((5, slice(5, 8), CO), (6, slice(5, 8), CE)), 4).sum() == 6


def test_cells_that_did_not_change_are_no_specks() -> None:
    assert not drop_specks(plane((5, 5, UO), (9, 9, UN)), 4).any()
