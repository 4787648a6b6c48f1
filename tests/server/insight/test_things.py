"""What belongs together: the pieces of one building, and not the house next door."""

from __future__ import annotations

import numpy as np
from hypothesis import given
from hypothesis import strategies as st

from mapvote.server.insight.polygons import pieces
from mapvote.server.insight.things import group


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


def test_what_was_built_beside_what_was_demolished_stays_apart() -> None:
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
