"""Which value of an intensity means full brightness: one rule, whatever the type, in one piece or many."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from mapvote.core.brightness import Brightness, from_counts, full_scale, in_bytes, shares, unit_intensity

U = np.random.default_rng(0).random(4000)


@pytest.mark.parametrize("bits", [8, 12, 16])
@pytest.mark.parametrize("kind", ["u2", "i4", "f4", "f8"])
def test_whole_numbers_are_on_the_smallest_scale_that_holds_them(bits: int, kind: str) -> None:
    assert full_scale(np.floor(U * 2**bits).astype(kind)) == 2**bits - 1


@given(st.sampled_from([1.0, 255.0, 4095.0, 65535.0]), st.integers(0, 39), st.floats(1.0, 1e9))
def test_rounding_and_outliers_darken_nobody(scale: float, outliers: int, beyond: float) -> None:
    """Up to a hundredth of the reals may be anything."""
    values = U * scale * 1.0001
    values[:outliers] = scale * beyond
    assert full_scale(values) == scale
    counted = Brightness.of(values)
    assert counted.above == (outliers if beyond > 1.05 * (1 + 1e-9) else 0) or beyond < 1.06


@given(st.lists(st.integers(0, 4000), max_size=6), st.floats(0.001, 1e5))
def test_pieces_are_judged_as_the_whole(cuts: list[int], most: float) -> None:
    whole, counted = Brightness.of(U * most), Brightness()
    for piece in np.split(U * most, sorted(cuts)):
        counted.add(piece)
    assert counted.full == whole.full
    assert (counted.n, counted.highest, counted.above) == (whole.n, whole.highest, whole.above)


def test_reals_that_fill_no_scale_are_on_their_own() -> None:
    """Twice 1, read as 8 bits, would be black."""
    assert np.isclose(full_scale(U * 2.0), 2.0, rtol=0.1)
    assert shares(U * 2.0).max() > 0.9


def test_a_value_that_is_no_brightness_is_dark_and_counted() -> None:
    values = np.array([np.nan, np.inf, -np.inf, -2.5, 0.5, 1.0])
    counted = Brightness.of(values)
    assert (counted.n, counted.undefined, counted.negative) == (3, 3, 1)
    assert unit_intensity(values).tolist() == [0, 0, 0, 0, 0.5, 1.0]
    assert full_scale(np.zeros(0)) == full_scale(np.full(3, np.nan)) == 1.0


@given(st.integers(0, 255), st.sampled_from(["u1", "u2", "f4"]), st.sampled_from([1.0, 255.0, 4095.0, 65535.0]))
def test_a_ballot_gives_brightness_back_on_the_scale_of_the_map(byte: int, kind: str, scale: float) -> None:
    if kind == "u1" or (scale == 1.0 and kind != "f4"):
        scale = 255.0
    column = np.array([0.0, scale, 0.25 * scale]).astype(kind)
    back = from_counts(np.array([byte], np.uint8), 255.0, column)
    assert back.dtype == column.dtype
    assert in_bytes(np.concatenate([column, back]))[-1] == byte
