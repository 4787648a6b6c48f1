"""Liars say what their names promise, in ballots that any server would take."""

from __future__ import annotations

import numpy as np
import pytest

from hand_made import SHAPE, Say, make_ballot, states_plane, two_walls, wall, words_plane
from mapvote.codec.ballot import MOST_OFF_M, Ballot, BallotTile, decode, encode, unpack_points, unpack_states
from mapvote.codec.sparse_columns import unpack_words
from mapvote.config import FuseSettings
from mapvote.core.point_map import PointMap
from mapvote.core.types import NO_VOTE, U8, CellState
from mapvote.fusion.fuse import update_map
from mapvote_lab.evaluation.conditions import ATTACKS

TILE = (0, 0)
STANDS, FREE, BUILT, GONE = (10, 10), (40, 40), (50, 50), (10, 12)
HONEST = {STANDS: 0, FREE: 1, BUILT: 2, GONE: 3, (60, 60): 4}


def honest(point_map: PointMap, vehicle: str) -> Ballot:
    """The wall's last cell is gone, and a new one stands at (50, 50)."""
    say = Say(
        states_plane(HONEST),
        gone=words_plane({GONE: 0b1110}),
        new_points=wall([BUILT], [0.45, 0.75, 1.05]),
        free=words_plane({FREE: 0b1110}),
    )
    return make_ballot(point_map, {TILE: say}, vehicle=vehicle)


def lie(name: str) -> BallotTile:
    """What vehicle v sends of the tile instead of its honest ballot; w is honest."""
    point_map = two_walls()
    ballot = ATTACKS[name](honest(point_map, "v"), point_map, honest(point_map, "w"))
    assert ballot.vehicle == "v"
    assert decode(encode(ballot)) == ballot
    return ballot.tiles[0]


def states_of(tile: BallotTile) -> U8:
    assert tile.states is not None
    return unpack_states(tile.states)


@pytest.mark.parametrize(
    ("name", "said"), [("inverting", [3, 2, 1, 0, 4]), ("replaying the old street", [0, 1, 1, 0, 4])]
)
def test_other_states_are_said_of_what_was_determined_and_nothing_elsewhere(name: str, said: list[int]) -> None:
    states = states_of(lie(name))
    assert [states[cell] for cell in HONEST] == said
    assert states[0, 0] == NO_VOTE


def test_everything_changed_is_every_cell_of_the_tile() -> None:
    states = states_of(lie("everything changed"))
    assert np.count_nonzero(states == CellState.CHANGED_EMPTY) == 3  # the wall's cells
    assert np.count_nonzero(states == CellState.CHANGED_OCCUPIED) == SHAPE[0] * SHAPE[1] - 3


def test_a_replayed_ballot_is_the_other_vehicles_under_ones_own_name() -> None:
    point_map = two_walls()
    mine = make_ballot(point_map, {TILE: Say(states_plane())}, vehicle="liar", drive="d9")
    copy = ATTACKS["replaying another vehicle"](mine, point_map, honest(point_map, "v1"))
    assert (copy.vehicle, copy.drive) == ("liar", "d9")
    assert copy.tiles == honest(point_map, "v1").tiles


@pytest.mark.parametrize(("name", "k"), [("shifting by 3 cells", 3), ("replaying another vehicle, moved by a cell", 1)])
def test_shifting_moves_states_masks_and_points_together(name: str, k: int) -> None:
    tile = lie(name)
    assert tile.gone is not None
    assert tile.new_points is not None
    assert states_of(tile)[BUILT[0] + k, BUILT[1] + k] == CellState.CHANGED_OCCUPIED
    assert unpack_words(tile.gone, "gone")[GONE[0] + k, GONE[1] + k] == 0b1110
    moved = unpack_points(tile.new_points) - wall([BUILT], [0.45, 0.75, 1.05])
    np.testing.assert_allclose(moved, np.tile([0.3 * k, 0.3 * k, 0.0], (3, 1)), atol=MOST_OFF_M + 1e-4)


def test_false_points_leave_the_states_right_and_delete_whole_columns() -> None:
    tile = lie("right states, false points")
    assert tile.gone is not None
    assert tile.new_points is not None
    np.testing.assert_array_equal(states_of(tile), states_of(honest(two_walls(), "v").tiles[0]))
    assert unpack_words(tile.gone, "gone")[GONE] == ~np.uint64(0)
    assert len(unpack_points(tile.new_points)) == 5


@pytest.mark.parametrize("name", ATTACKS)
@pytest.mark.parametrize("k", [1, 2, pytest.param(3, marks=pytest.mark.slow)])
def test_k_liars_decide_nothing_among_k_plus_1_honest_vehicles_that_agree(name: str, k: int) -> None:
    """Where all honest vehicles say the same, min_votes = k + 1 decides and deletes as without the liars.

    What liars can still do is to add a point in the voxel above or below one that the honest saw: a voxel counts as
    supported by whoever saw its neighbour.
    """
    point_map, settings = two_walls(), FuseSettings(min_votes=k + 1)
    true = [honest(point_map, f"v{i}") for i in range(k + 1)]
    lies = [ATTACKS[name](honest(point_map, f"liar{i}"), point_map, true[0]) for i in range(k)]
    alone, before = update_map(point_map, true, settings)
    updated, after = update_map(point_map, [*true, *lies], settings)
    changes = [np.isin(d[TILE].states, (CellState.CHANGED_OCCUPIED, CellState.CHANGED_EMPTY)) for d in (before, after)]
    np.testing.assert_array_equal(changes[0], changes[1])
    was, now = (set(map(tuple, m.tiles[TILE].points.tolist())) for m in (alone, updated))
    assert was <= now
    honest_z = [0.45, 0.75, 1.05]
    for x, y, z in now - was:
        assert (int(y / 0.3), int(x / 0.3)) == BUILT
        assert min(abs(z - other) for other in honest_z) < 0.31
