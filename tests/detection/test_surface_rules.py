"""The rules of surfaces that look beyond a cell: what is enough, and what is a thing of its own."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from mapvote.core.types import U64, Bool
from mapvote.detection.surface_rules import (
    SUPPORT,
    on_its_own,
    supported,
)

SIDE = 20
NOTHING = np.zeros((SIDE, SIDE), np.uint64)


def words(*marks: tuple[int, int, int]) -> U64:
    out = NOTHING.copy()
    for row, col, word in marks:
        out[row, col] = word
    return out


def alone(voxels: U64, whole: U64 | None = None, others: Bool | None = None) -> bool:
    """Whether all cells with ``voxels`` are a thing of its own."""
    cells = voxels != 0
    nobody = np.zeros((SIDE, SIDE), np.bool_)
    found = on_its_own(cells, voxels, voxels if whole is None else whole, nobody if others is None else others)
    assert not found[~cells].any()
    return bool(found[cells].all())


def test_two_voxels_on_the_ground_on_top_of_each_other_are_a_thing() -> None:
    assert alone(words((5, 5, 0b110)))
    assert alone(words((5, 5, 0b110), (5, 6, 0b110))), "a bollard on the border of two cells"


@pytest.mark.parametrize(
    ("voxels", "why"),
    [
        (words((5, 5, 0b10)), "one voxel alone"),
        (words((5, 5, 0b1010)), "two that do not touch"),
        (words((5, 5, 0b110000)), "in the air"),
        (words((5, 5, 0b110), (6, 6, 0b110000)), "a part of it in the air"),
        (words((5, 5, 0b10), (5, 6, 0b10)), "no taller than a kerb"),
    ],
)
def test_specks_are_no_things(voxels: U64, why: str) -> None:
    assert not alone(voxels), why


def test_what_touches_something_else_is_no_thing_of_its_own() -> None:
    others = np.zeros((SIDE, SIDE), np.bool_)
    others[7, 7] = True
    assert alone(words((5, 5, 0b110)), others=others)
    assert not alone(words((6, 6, 0b110)), others=others)


def test_half_of_a_thing_must_have_gone_for_the_whole_to_go() -> None:
    assert alone(words((5, 5, 0b110)), whole=words((5, 5, 0b11110)))
    assert alone(words((5, 5, 0b1110)), whole=words((5, 5, 0b1111110)))
    assert not alone(words((5, 5, 0b110)), whole=words((5, 5, 0b111110)))


@given(st.lists(st.tuples(st.integers(0, 9), st.integers(0, 9), st.integers(1, 2**63)), max_size=12))
def test_support_is_asked_of_groups_and_not_of_cells(marks: list[tuple[int, int, int]]) -> None:
    voxels = words(*((2 * row, 2 * col, word) for row, col, word in marks))  # no two cells touch
    enough = supported(voxels != 0, voxels, SUPPORT)
    assert np.array_equal(enough, np.bitwise_count(voxels) >= SUPPORT)
