"""Liars, all with the same lie, the worst for a vote: where the honest agree, too few of them decide nothing."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import replace

import numpy as np
import pytest

from hand_made import Say, make_ballot, states_plane, two_walls, wall, words_plane
from mapvote.codec.ballot import MOST_STEPS
from mapvote.config import FuseSettings
from mapvote.core.types import NO_VOTE, U8, U64, CellState
from mapvote.fusion.fuse import update_map

TILE = (0, 0)
STANDS, FREE, BUILT, GONE = (10, 10), (40, 40), (50, 50), (10, 12)
HEIGHTS = [0.45, 0.75, 1.05]


def honest() -> Say:
    """The wall's last cell is gone, and a new one stands at (50, 50)."""
    return Say(
        states_plane({STANDS: 0, FREE: 1, BUILT: 2, GONE: 3, (60, 60): 4}),
        gone=words_plane({GONE: 0b1110}),
        new_points=wall([BUILT], HEIGHTS),
        free=words_plane({FREE: 0b1110}),
    )


def claim(states: U8) -> Say:
    """The largest confidence; all that is mapped gone, poles of false points where something is said to be new."""
    gone = np.where(two_walls().tiles[TILE].obstacle_words != 0, ~np.uint64(0), np.uint64(0))
    gone[states == CellState.CHANGED_EMPTY] = ~np.uint64(0)
    cells = [(int(r), int(c)) for r, c in np.argwhere(states == CellState.CHANGED_OCCUPIED)]
    changed = (states == CellState.CHANGED_OCCUPIED) | (states == CellState.CHANGED_EMPTY)
    odds = np.full(np.count_nonzero(changed), MOST_STEPS, dtype=np.int8)
    return Say(states, gone=gone, new_points=wall(cells, [*HEIGHTS, 1.35, 1.65]) if cells else None, odds=odds)


def instead(of_each: Sequence[int]) -> Say:
    """Other states of what was determined."""
    table = np.full(256, NO_VOTE, dtype=np.uint8)
    table[:5] = of_each
    states = honest().states
    assert states is not None
    return claim(table[states])


def everything_changed() -> Say:
    occupied = two_walls().tiles[TILE].obstacle_words != 0
    return claim(np.where(occupied, CellState.CHANGED_EMPTY, CellState.CHANGED_OCCUPIED).astype(np.uint8))


def moved(by: int) -> Say:
    """Everything so many cells to the north-east of where it is."""
    say = honest()

    def shifted(plane: U8 | U64 | None, vacated: int) -> np.ndarray:
        assert plane is not None
        out = np.full_like(plane, vacated)
        out[by:, by:] = plane[:-by, :-by]
        return out

    points = wall([(BUILT[0] + by, BUILT[1] + by)], HEIGHTS)
    return replace(
        say,
        states=shifted(say.states, NO_VOTE),
        gone=shifted(say.gone, 0),
        free=shifted(say.free, 0),
        new_points=points,
    )


LIES: Mapping[str, Callable[[], Say]] = {
    "inverting": lambda: instead((3, 2, 1, 0, 4)),
    "everything changed": everything_changed,
    "replaying the old street": lambda: instead((0, 1, 1, 0, 4)),
    "replaying another vehicle": honest,
    "replaying another vehicle, moved by a cell": lambda: moved(1),
    "shifting by 3 cells": lambda: moved(3),
    "right states, false points": lambda: instead((0, 1, 2, 3, 4)),
}


@pytest.mark.parametrize("name", LIES)
@pytest.mark.parametrize("k", [1, 2, pytest.param(3, marks=pytest.mark.slow)])
def test_k_liars_decide_nothing_among_k_plus_1_honest_vehicles_that_agree(name: str, k: int) -> None:
    """Where all honest vehicles say the same, min_votes = k + 1 decides and deletes as without the liars.

    Liars can still add a point in the voxel above or below one that the honest saw: a voxel counts as supported by
    whoever saw its neighbour.
    """
    point_map, settings = two_walls(), FuseSettings(min_votes=k + 1)
    true = [make_ballot(point_map, {TILE: honest()}, vehicle=f"v{i}") for i in range(k + 1)]
    lies = [make_ballot(point_map, {TILE: LIES[name]()}, vehicle=f"liar{i}") for i in range(k)]
    alone, before = update_map(point_map, true, settings)
    updated, after = update_map(point_map, [*true, *lies], settings)
    changes = [np.isin(d[TILE].states, (CellState.CHANGED_OCCUPIED, CellState.CHANGED_EMPTY)) for d in (before, after)]
    np.testing.assert_array_equal(changes[0], changes[1])
    was, now = (set(map(tuple, m.tiles[TILE].points.tolist())) for m in (alone, updated))
    assert was <= now
    for x, y, z in now - was:
        assert (int(y / 0.3), int(x / 0.3)) == BUILT
        assert min(abs(z - other) for other in HEIGHTS) < 0.31


def test_as_many_liars_as_the_quorum_do_decide() -> None:
    """So the lies are ballots that a server takes."""
    point_map = two_walls()
    lies = [make_ballot(point_map, {TILE: everything_changed()}, vehicle=f"liar{i}") for i in range(2)]
    _, decisions = update_map(point_map, lies, FuseSettings(min_votes=2, min_difference=0.0))
    assert (decisions[TILE].states == CellState.CHANGED_EMPTY).sum() == 3
