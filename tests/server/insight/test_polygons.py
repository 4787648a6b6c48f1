"""Polygons of cells: every fact here is plane geometry."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from hypothesis.extra.numpy import arrays

from mapvote.core.types import I64
from mapvote.server.insight.polygons import Ring, pieces, rings


def drawn(*rows: str) -> tuple[I64, I64]:
    """Cells of a picture, top row first, as (rows, cols) with row 0 at the bottom."""
    picture = np.array([[c == "#" for c in row] for row in rows])[::-1]
    cells = np.argwhere(picture).astype(np.int64)
    return cells[:, 0], cells[:, 1]


def outlines(*picture: str) -> list[list[list[tuple[int, int]]]]:
    rows, cols = drawn(*picture)
    label = pieces(rows, cols, np.zeros(len(rows), dtype=np.int64)).polygons
    return [[[(int(x), int(y)) for x, y in ring] for ring in polygon] for polygon in rings(rows, cols, label)]


def area(ring: Ring) -> float:
    """Signed area by the shoelace formula: positive counter-clockwise."""
    x, y = ring[:-1, 0], ring[:-1, 1]
    return 0.5 * float(np.sum(x * np.roll(y, -1) - np.roll(x, -1) * y))


def test_one_cell_is_a_square_counter_clockwise_from_its_lower_left_corner() -> None:
    assert outlines("#") == [[[(0, 0), (1, 0), (1, 1), (0, 1), (0, 0)]]]


def test_a_corner_house_keeps_its_corner() -> None:
    assert outlines("#.", "##") == [[[(0, 0), (2, 0), (2, 1), (1, 1), (1, 2), (0, 2), (0, 0)]]]


def test_a_courtyard_is_a_hole_and_runs_clockwise() -> None:
    outer, hole = outlines("###", "#.#", "###")[0]
    assert outer == [(0, 0), (3, 0), (3, 3), (0, 3), (0, 0)]
    assert hole == [(1, 1), (1, 2), (2, 2), (2, 1), (1, 1)]


def test_cells_that_meet_at_a_corner_are_one_object_of_two_polygons() -> None:
    rows, cols = drawn(".#", "#.")
    found = pieces(rows, cols, np.zeros(2, dtype=np.int64))
    assert found.objects.tolist() == [0, 0]
    assert found.polygons.tolist() == [0, 1]
    assert [len(polygon) for polygon in outlines(".#", "#.")] == [1, 1]


def test_a_ring_that_closes_over_a_corner_encloses_a_hole_and_does_not_touch_itself() -> None:
    outer, hole = outlines("##.", "#.#", "###")[0]
    assert outer.count((2, 2)) == 1
    assert hole.count((2, 2)) == 1


def test_kinds_never_join() -> None:
    found = pieces(np.array([0, 0, 0]), np.array([0, 1, 2]), np.array([2, 3, 3]))
    assert found.objects.tolist() == [0, 1, 1]


@settings(max_examples=150, deadline=None)
@given(
    picture=arrays(np.bool_, st.tuples(st.integers(1, 9), st.integers(1, 9))),
    shift=st.tuples(st.integers(-(2**28), 2**28), st.integers(-(2**28), 2**28)),
)
def test_outlines_cover_exactly_their_cells(picture: np.ndarray, shift: tuple[int, int]) -> None:
    rows, cols = np.nonzero(picture)
    rows, cols = rows + shift[0], cols + shift[1]
    label = pieces(rows, cols, np.zeros(len(rows), dtype=np.int64)).polygons
    drawn_rings = rings(rows, cols, label)
    assert len(drawn_rings) == (label.max() + 1 if len(label) else 0)
    for i, (outer, *holes) in enumerate(drawn_rings):
        assert area(outer) + sum(area(hole) for hole in holes) == (label == i).sum()
        assert area(outer) > 0
        assert all(area(hole) < 0 for hole in holes)
        for ring in (outer, *holes):
            assert ring[0].tolist() == ring[-1].tolist()
            assert len(np.unique(ring[:-1], axis=0)) == len(ring) - 1, "a ring touches itself"
            steps = np.diff(ring, axis=0)
            assert (np.count_nonzero(steps, axis=1) == 1).all()
            turns = steps[:, 0] != 0
            assert (turns != np.roll(turns, 1)).all(), "a corner that is none"


@settings(max_examples=60, deadline=None)
@given(picture=arrays(np.bool_, (8, 8)))
def test_objects_are_the_8_connected_components(picture: np.ndarray) -> None:
    ndimage = pytest.importorskip("scipy.ndimage")
    rows, cols = np.nonzero(picture)
    found = pieces(rows, cols, np.zeros(len(rows), dtype=np.int64))
    for labels, structure in ((found.objects, np.ones((3, 3))), (found.polygons, None)):
        expected, n = ndimage.label(picture, structure)
        assert len({(int(a), int(b)) for a, b in zip(labels, expected[rows, cols], strict=True)}) == n
        assert len(np.unique(labels)) == n
