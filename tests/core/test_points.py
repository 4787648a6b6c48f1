"""Attributes of points keep what was measured on the way from a scan through a ballot into a map."""

from __future__ import annotations

from collections import Counter
from random import Random

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from mapvote.core import points
from mapvote.core.points import FIELDS, Field, as_numbers, joined_fields, merged_values, point_field
from mapvote.core.types import MapvoteError

CLASS = Field("|u1", spellings=("class",))
REFLECTIVITY = Field("<u2", scaled=True)


@given(st.lists(st.integers(0, 65535), min_size=1, max_size=20))
def test_sixteen_bits_of_reflectivity_come_back_in_a_map_of_sixteen_bits(values: list[int]) -> None:
    column = np.array([65535, *values], dtype=np.uint16)
    sent = REFLECTIVITY.in_ballot(REFLECTIVITY.in_scan(column))
    assert sent.dtype == np.uint16
    assert REFLECTIVITY.in_map(sent, column).tolist() == column.tolist()


@given(st.lists(st.integers(0, 255), max_size=20), st.sampled_from(["|u1", "<i4", "<f4", "<f8"]))
def test_a_class_is_the_same_number_whatever_type_a_file_has(values: list[int], kind: str) -> None:
    column = np.array(values, dtype=kind)
    sent = CLASS.in_ballot(CLASS.in_scan(column))
    assert sent.dtype == np.uint8
    assert CLASS.in_map(sent, column).tolist() == values


def test_a_class_that_is_not_finite_was_not_measured() -> None:
    assert Field("|u1", unmeasured=255).in_scan(np.array([np.nan, 3.0], "<f4")).tolist() == [255, 3]


@pytest.mark.parametrize(("value", "kind"), [(256, "<i4"), (-1, "<i2"), (1.5, "<f4"), (1e30, "<f8")])
def test_a_class_that_the_type_does_not_hold_is_refused(value: float, kind: str) -> None:
    with pytest.raises(MapvoteError, match=r"is no number of type uint8"):
        CLASS.in_scan(np.array([0, value], dtype=kind))


@pytest.mark.parametrize("values", [np.array([200], np.uint8), np.array([200.0], np.float32)])
def test_an_intensity_that_is_no_share_is_refused(values: np.ndarray) -> None:
    with pytest.raises(MapvoteError, match="reals from 0 to 1"):
        FIELDS["intensity"].in_ballot(values)


def test_clouds_of_which_one_lacks_an_attribute_are_joined_with_unmeasured_values() -> None:
    bright = np.array([7, 8], np.uint8)
    assert joined_fields([(3, {}), (2, {"intensity": bright})])["intensity"].tolist() == [0, 0, 0, 7, 8]
    assert joined_fields([(3, {})]) == {}


@given(st.lists(st.tuples(st.integers(0, 4), st.integers(0, 3)), min_size=1, max_size=40), st.randoms())
def test_the_class_of_a_voxel_is_the_one_that_most_vehicles_measured(
    offers: list[tuple[int, int]], rng: Random
) -> None:
    with pytest.MonkeyPatch.context() as patch:
        row = Field("|u1", merged="plurality")
        patch.setattr(points, "point_fields", lambda: {"classification": row, **FIELDS})
        voxel, value = np.array(offers).T.astype(np.int64)
        first = np.unique(voxel, return_index=True)[1]
        merged = merged_values("classification", value.astype(np.uint8), voxel, first)
        for v, got in zip(voxel[first].tolist(), merged.tolist(), strict=True):
            votes = Counter(c for w, c in offers if w == v and c != 0)
            assert got == min(votes, key=lambda c: (-votes[c], c), default=0)
        # In another order the points say the same.
        order = np.array(rng.sample(range(len(offers)), len(offers)))
        first = np.unique(voxel[order], return_index=True)[1]
        again = merged_values("classification", value[order].astype(np.uint8), voxel[order], first)
        assert again.tolist() == merged.tolist()


def test_equal_numbers_are_equal_values_of_any_type() -> None:
    fields: dict[str, np.ndarray] = {"a": np.array([1, 1, 2], np.uint8), "b": np.array([0.5, 0.5, -1.0], np.float32)}
    numbers = as_numbers(fields, 3)
    assert numbers.shape == (3, 2)
    assert (numbers[0] == numbers[1]).all()
    assert (numbers[0] != numbers[2]).all()
    assert as_numbers({}, 3).shape == (3, 0)


def test_an_unknown_attribute_is_named_with_those_that_are_known() -> None:
    with pytest.raises(MapvoteError, match="point attribute 'temperature' is unknown; known are intensity; or install"):
        point_field("temperature")
