"""Polygons of cells: every fact here is plane geometry.

Houses in a row: where one ends and the next begins.

Cells of one object: the pieces of one building, and not the house next door.
"""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from hypothesis.extra.numpy import arrays

from mapvote.core.types import F64, I64
from mapvote.shapes.outlines import Ring, buildings, group, pieces, rings


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


SQUARE = [(0, 0), (3, 0), (3, 3), (0, 3), (0, 0)]


@pytest.mark.parametrize(
    ("picture", "expected"),
    [
        (["#"], [[[(0, 0), (1, 0), (1, 1), (0, 1), (0, 0)]]]),
        (["#.", "##"], [[[(0, 0), (2, 0), (2, 1), (1, 1), (1, 2), (0, 2), (0, 0)]]]),
        (["###", "#.#", "###"], [[SQUARE, [(1, 1), (1, 2), (2, 2), (2, 1), (1, 1)]]]),
    ],
    ids=["a cell, from its lower left corner", "a corner house", "a courtyard runs clockwise"],
)
def test_a_ring_begins_at_its_lower_left_corner_and_turns_at_each(
    picture: list[str], expected: list[list[list[tuple[int, int]]]]
) -> None:
    assert outlines(*picture) == expected


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


def walls(x0: float, y0: float, x1: float, y1: float) -> F64:
    """Points of a front (at y1, two cells thick) and two side walls of one cell, in cells."""
    along, deep = np.arange(x0, x1, 0.25), np.arange(y0, y1, 0.25)
    sides = [np.column_stack([np.full(len(deep), x), deep]) for x in (x0, x1)]
    return np.concatenate([*sides, *(np.column_stack([along, np.full(len(along), y1 + d)]) for d in (0.0, 1.0))])


def count(*houses: F64, turn_deg: float = 0.0) -> int:
    """Number of the buildings found in houses turned about the origin."""
    c, s = np.cos(np.radians(turn_deg)), np.sin(np.radians(turn_deg))
    cells = np.unique(np.floor(np.concatenate(houses) @ np.array([[s, c], [c, -s]])).astype(np.int64), axis=0)
    rows, cols = cells.T
    return int(buildings(rows, cols, np.full(len(rows), 3)).objects.max()) + 1


BRIDGE = np.column_stack([np.arange(53.0, 58.0, 0.25), np.full(20, 30.5)])
"""Over the slot of two houses, as wide as a facade's error."""


@pytest.mark.parametrize("turn_deg", [0.0, 20.0, 45.0, 90.0])
def test_two_houses_whose_fronts_touch_are_two(turn_deg: float) -> None:
    pair = walls(0, 0, 53.5, 30), walls(57.5, 0, 110, 30), BRIDGE
    assert count(*pair, turn_deg=turn_deg) == 2


def test_each_house_of_a_row_of_four_is_one_object() -> None:
    row = [walls(58 * k, 0, 58 * k + 54.5, 30) for k in range(4)]
    assert count(*row, *(BRIDGE + np.array([58, 0]) * k for k in range(3))) == 4


@pytest.mark.parametrize("room", [8, 20, 60])
def test_a_house_of_narrow_rooms_is_one(room: int) -> None:
    inner = [np.column_stack([np.full(80, x), np.arange(10.0, 30.0, 0.25)]) for x in range(room, 120, room)]
    assert count(walls(0, 0, 120, 30), *inner) == 1


def test_objects_that_stood_apart_stay_apart() -> None:
    assert count(walls(0, 0, 40, 20), walls(60, 0, 100, 20)) == 2
    assert count(walls(0, 0, 40, 20), walls(0, 40, 40, 60)) == 2


def things(cells: list[tuple[int, int, int]]) -> dict[tuple[int, int, int], int]:
    """(row, col, kind) -> label."""
    ordered = sorted(set(cells))
    rows, cols, kinds = (np.array(values, dtype=np.int64) for values in zip(*ordered, strict=True))
    labels = group(rows, cols, kinds, pieces(rows, cols, kinds).objects)
    return dict(zip(ordered, labels.tolist(), strict=True))


def block(row: int, col: int, rows: int, cols: int, kind: int = 2) -> list[tuple[int, int, int]]:
    return [(r, c, kind) for r in range(row, row + rows) for c in range(col, col + cols)]


def test_a_wall_with_a_gap_and_what_lies_inside_it_are_one_building() -> None:
    ring = [c for c in block(0, 0, 20, 30) if c[0] in (0, 19) or c[1] in (0, 29)]
    ring = [c for c in ring if not (c[0] == 0 and 10 < c[1] < 14)]
    assert set(things(ring + block(10, 10, 2, 3)).values()) == {0}


def test_two_houses_a_cell_apart_are_two() -> None:
    found = things(block(0, 0, 20, 20) + block(0, 22, 20, 18))
    assert set(found.values()) == {0, 1}


def test_a_built_object_beside_a_demolished_one_stays_apart() -> None:
    found = things(block(0, 0, 10, 10, 2) + block(0, 11, 2, 2, 3))
    assert found[0, 0, 2] != found[0, 11, 3]


def test_a_speck_beyond_reach_is_its_own_thing() -> None:
    found = things(block(0, 0, 10, 10) + block(0, 30, 1, 1))
    assert found[0, 30, 2] != found[0, 0, 2]


@given(st.sets(st.tuples(st.integers(0, 25), st.integers(0, 25), st.integers(2, 3)), min_size=1, max_size=60))
def test_touching_cells_of_one_kind_are_never_torn_apart(cells: set[tuple[int, int, int]]) -> None:
    one_kind = {(r, c): k for r, c, k in sorted(cells)}
    found = things([(r, c, k) for (r, c), k in one_kind.items()])
    for (r, c, k), label in found.items():
        for dr in (-1, 0, 1):
            for dc in (-1, 0, 1):
                assert found.get((r + dr, c + dc, k), label) == label
