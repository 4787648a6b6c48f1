"""A vote is spent once its cell has changed since the version that its vehicle drove with."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from hypothesis import example, given, settings
from hypothesis import strategies as st

from hand_made import SHAPE, make_tile, states_plane, wall, words_plane
from mapvote.codec.sparse_columns import Words
from mapvote.core.grid import CELL_SIZE
from mapvote.core.tile import Memory, Tile
from mapvote.core.types import NO_VOTE, CellState
from mapvote.fusion.fuse import differing, unspent
from mapvote.fusion.tile_vote import TileVote

CE = int(CellState.CHANGED_EMPTY)
CELL, OTHER, THIRD = (10, 10), (200, 3), (255, 255)
TILE = make_tile(wall([CELL, OTHER], [0.45, 0.75]))


def changed(**versions: int) -> Tile:
    planes = Memory.none().planes.copy()
    for cell, version in zip((CELL, OTHER, THIRD), versions.values(), strict=False):
        planes[0][cell] = version
    return replace(TILE, memory=Memory.of(planes))


def vote(version: int) -> TileVote:
    free = Words.of(words_plane({CELL: 0b100, OTHER: 0b1}))
    return TileVote("v", 0, "v", states=states_plane({CELL: CE, OTHER: CE}), free=free, version=version)


def spoken(cast: TileVote) -> list[list[int]]:
    assert cast.states is not None
    return np.argwhere(cast.states != NO_VOTE).tolist()


def test_a_vote_counts_where_its_cell_is_as_old_as_its_map_and_nowhere_else() -> None:
    tile = changed(cell=3, other=5)
    assert spoken(unspent(vote(5), tile)) == [list(CELL), list(OTHER)]
    assert spoken(unspent(vote(4), tile)) == [list(CELL)]
    assert spoken(unspent(vote(3), tile)) == [list(CELL)]
    assert spoken(unspent(vote(2), tile)) == []
    assert spoken(unspent(vote(0), TILE)) == [list(CELL), list(OTHER)], "on a tile that never changed every vote counts"


def test_what_a_version_showed_wrongly_is_no_ground_for_a_vote() -> None:
    """After a replay: the vehicle saw a map that has been taken back."""
    wrong = np.zeros(SHAPE, dtype=np.bool_)
    wrong[CELL] = True
    assert spoken(unspent(vote(3), TILE, {3: wrong})) == [list(OTHER)]
    assert spoken(unspent(vote(3), TILE, {2: wrong})) == [list(CELL), list(OTHER)]
    assert spoken(unspent(vote(3), changed(cell=0, other=4), {3: wrong})) == []
    assert spoken(unspent(vote(3), changed(cell=4, other=3), {3: wrong})) == [list(OTHER)]


def cells_of(found: np.ndarray) -> list[list[int]]:
    assert found.shape == SHAPE
    return np.argwhere(found).tolist()


@given(st.integers(0, 2), st.sampled_from([CELL, OTHER]))
@settings(max_examples=10)
def test_the_last_bit_of_any_coordinate_is_a_difference(axis: int, cell: tuple[int, int]) -> None:
    points = TILE.points.copy()
    mine = [i for i, p in enumerate(points) if (int(p[1] / CELL_SIZE), int(p[0] / CELL_SIZE)) == cell]
    points[mine[0], axis] = np.nextafter(points[mine[0], axis], np.float32(np.inf))
    assert cells_of(differing(TILE, make_tile(points))) == [list(cell)]


Point = tuple[float, float, float]
POINTS = st.lists(st.tuples(*map(st.sampled_from, ([0.1, 0.4], [0.1, 0.2, 0.4], [0.1, 0.2]))), max_size=4)


@given(POINTS, POINTS)
@example([], [(0.0, 0.0, 0.0)])  # all its bits are zero, as those of nothing are
@settings(max_examples=20, deadline=None)
@example([(0.1, 0.1, 0.2)], [(0.1, 0.2, 0.2)])
@example([(0.1, 0.1, 0.2), (0.1, 0.4, 0.1)], [(0.1, 0.1, 0.1), (0.1, 0.4, 0.1)])
def test_cells_differ_that_hold_other_points_whatever_coordinates_these_share(a: list[Point], b: list[Point]) -> None:
    def of_cell(points: list[Point], r: int, c: int) -> list[Point]:
        return [p for p in points if (p[1] >= CELL_SIZE, p[0] >= CELL_SIZE) == (r, c)]

    one, other = (make_tile(np.array(points, np.float32).reshape(-1, 3)) for points in (a, b))
    cells = [[r, c] for r in (0, 1) for c in (0, 1) if of_cell(a, r, c) != of_cell(b, r, c)]
    assert cells_of(differing(one, other)) == cells_of(differing(other, one)) == cells


@pytest.mark.parametrize(
    ("one", "other", "differ"),
    [
        (None, None, []),
        (None, {}, []),  # learning that nothing is free is no difference
        (None, {CELL: 1}, [CELL]),
        ({CELL: 1}, None, [CELL]),
        ({CELL: 1}, {CELL: 1}, []),
        ({CELL: 1}, {CELL: 3, OTHER: 1}, [CELL, OTHER]),
    ],
)
def test_what_is_known_to_be_free_makes_a_difference(
    one: dict[tuple[int, int], int] | None, other: dict[tuple[int, int], int] | None, differ: list[tuple[int, int]]
) -> None:
    a, b = (replace(TILE, free=None if cells is None else words_plane(cells)) for cells in (one, other))
    assert cells_of(differing(a, b)) == [list(cell) for cell in differ]
    more = replace(b, points=np.concatenate([TILE.points, wall([THIRD], [9.0])]))
    assert cells_of(differing(a, more)) == [*(list(cell) for cell in differ), list(THIRD)], "and other points add to it"
