"""Cells beside cells: steps and floods, as scipy has them."""

from __future__ import annotations

import numpy as np
import pytest
from scipy import ndimage

from mapvote.core.types import Bool
from mapvote_lab.evaluation.columns_v1.spreading import flooded, steps_to

BESIDE = np.ones((3, 3))


def _patches(seed: int) -> tuple[Bool, Bool]:
    """(some cells in patches of all sizes, a few others)."""
    rng = np.random.default_rng(seed)
    shape = (40 + seed, 61 - seed)
    wide = ndimage.gaussian_filter(rng.normal(size=shape), 0.5 + 0.1 * seed)
    return wide > 0.5 * wide.std(), rng.random(shape) < 0.02


@pytest.mark.parametrize("seed", range(8))
def test_what_spreads_goes_as_far_as_its_steps_and_stays_within(seed: int) -> None:
    within, some = _patches(seed)
    seeds = within & some
    for steps in (1, 5):
        wanted = ndimage.binary_dilation(seeds, BESIDE, iterations=steps, mask=within)
        assert (flooded(seeds, within, steps) == wanted).all()
    assert (flooded(seeds, within, within.size) == ndimage.binary_propagation(seeds, BESIDE, mask=within)).all()
    assert (flooded(seeds, within, 0) == seeds).all()


@pytest.mark.parametrize("seed", range(8))
def test_steps_are_those_of_a_king_on_a_chessboard(seed: int) -> None:
    _, cells = _patches(seed)
    assert (steps_to(cells) == ndimage.distance_transform_cdt(~cells, "chessboard")).all()


def test_where_there_is_nothing_to_go_to_it_is_farther_than_any_cell() -> None:
    assert (steps_to(np.zeros((3, 4), np.bool_)) > 1000).all()
