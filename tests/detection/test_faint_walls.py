"""What hardly any ray crossed is gone where it is much together and too tall to have driven away."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from hypothesis.extra.numpy import arrays

from mapvote.core.types import I32, U64
from mapvote.detection.counters import add_one
from mapvote.detection.faint_walls import TALL_M, faintly_gone, often_crossed
from mapvote.detection.surface_counts import CROSSED, MET, WORDS


@given(often=arrays(np.int32, 6, elements=st.integers(0, 9)), met=arrays(np.int32, 6, elements=st.integers(0, 2)))
def test_a_cell_was_crossed_as_often_as_its_mapped_voxels_less_what_each_was_met(often: I32, met: I32) -> None:
    planes = np.zeros((1, 1, WORDS), np.uint64)
    for bit in range(6):
        for first, times in ((CROSSED, often[bit]), (MET, met[bit])):
            for _ in range(times):
                add_one(planes[0, 0], first, np.uint64(1 << bit))
    mapped: U64 = np.array([[0b101101]], np.uint64)
    expected = sum(max(int(often[bit]) - 8 * int(met[bit]), 0) for bit in (0, 2, 3, 5))
    assert often_crossed(planes, mapped, 8, 2)[0, 0] == expected


@pytest.mark.parametrize(
    ("cells", "times", "height_m", "gone"),
    [(6, 3, TALL_M, True), (5, 9, TALL_M, False), (6, 2, TALL_M, False), (6, 9, TALL_M - 0.1, False)],
    ids=["a wall", "a few cells", "too seldom", "a car's trail"],
)
def test_a_faint_wall_is_gone_if_it_is_large_and_crossed_enough_and_tall(
    cells: int, times: int, height_m: float, gone: bool
) -> None:
    faint = np.zeros((5, 8), np.bool_)
    faint[2, 1 : 1 + cells] = True
    faint[0, 7] = True  # a group of its own takes no part
    height = np.where(faint, np.float32(1.0), np.float32(0.0))
    height[2, 3] = height_m
    out = faintly_gone(faint, np.full((5, 8), times, np.int32), height, 6, 18)
    np.testing.assert_array_equal(out[2], faint[2] & gone)
    assert not out[0].any()


def test_where_no_cell_was_crossed_no_wall_is_gone() -> None:
    nothing = np.zeros((4, 5), np.bool_)
    assert not faintly_gone(nothing, np.zeros((4, 5), np.int32), np.zeros((4, 5), np.float32), 6, 18).any()
