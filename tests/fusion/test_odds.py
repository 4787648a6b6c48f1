"""Of those who voted for a change so many must be so sure as the quorum has: one who lies talks nothing up."""

from __future__ import annotations

import itertools
from dataclasses import replace

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from hand_made import states_plane
from mapvote.codec.odds import MOST, UNSAID
from mapvote.core.grid import Lattice
from mapvote.core.types import NO_VOTE, CellState, MapvoteError
from mapvote.fusion.odds import Odds, agreed_odds, pack_agreed, unpack_agreed
from mapvote.fusion.tile_vote import TileVote, fold, silenced

CELL, FLAT = (10, 10), 10 * 256 + 10
EMPTY, STANDS = CellState.CHANGED_EMPTY, CellState.UNCHANGED_OCCUPIED
GRID = Lattice().tile((0, 0))
DECIDED = states_plane({CELL: EMPTY})


def vote(vehicle: str, steps: int | None, state: int = EMPTY) -> TileVote:
    odds = None if steps is None or state != EMPTY else Odds(np.array([FLAT]), np.array([steps], np.int8))
    return TileVote(vehicle, 0, vehicle, states=states_plane({CELL: state}), odds=odds)


def taken(says: list[int | None], quorum: int, against: int = 0) -> int:
    """What is taken of what voters say of CELL."""
    votes = [vote(f"v{i}", steps) for i, steps in enumerate(says)]
    votes += [vote(f"w{i}", None, STANDS) for i in range(against)]
    return int(agreed_odds(votes, DECIDED, quorum).at(np.array([FLAT]))[0])


@pytest.mark.parametrize(
    ("says", "quorum", "told"),
    [
        ([10, 20, 30], 2, 20),
        ([10, 30], 2, 10),
        ([10, 20, 30, 40], 2, 20),
        ([10, 20, 30, 40, 50], 2, 30),
        ([10, 20, 30], 3, 10),
        ([7], 1, 7),
        ([10, None], 2, UNSAID),
        ([10, None, 30], 2, 10),
        ([None, None], 1, UNSAID),
    ],
)
def test_the_median_is_taken_and_never_more_than_the_quorum_says(
    says: list[int | None], quorum: int, told: int
) -> None:
    assert {taken(list(order), quorum) for order in itertools.permutations(says)} == {told}
    assert taken(says, quorum, against=2) == told, "who votes otherwise is not asked"


@settings(max_examples=50, deadline=None)
@given(st.integers(1, 3), st.data())
def test_liars_fewer_than_the_quorum_never_talk_it_above_what_an_honest_vehicle_says(
    k: int, data: st.DataObject
) -> None:
    honest = data.draw(st.lists(st.integers(-MOST, MOST), min_size=1, max_size=5))
    if len(honest) + k >= k + 1:
        assert taken([*honest, *[MOST] * k], k + 1) <= max(honest)


def test_a_later_drive_says_how_sure_its_vehicle_is_and_a_silent_one_overrides_nothing() -> None:
    early, late = vote("a", 5), replace(vote("a", 50), end_ns=1, digest="late")
    silent = TileVote("a", 2, "silent", states=states_plane({}, fill=NO_VOTE))
    folded = fold([late, silent, early], GRID)
    assert folded.odds is not None
    assert folded.odds.at(np.array([FLAT])).tolist() == [50]
    assert fold([silent, replace(silent, digest="other")], GRID).odds is None


def test_a_vote_that_is_silenced_says_nothing_either() -> None:
    votes = [silenced(vote(name, 9), np.array([FLAT])) for name in "ab"]
    assert agreed_odds(votes, DECIDED, 2).at(np.array([FLAT])).tolist() == [UNSAID]


def test_what_was_taken_is_stored_a_byte_a_changed_cell() -> None:
    other = (20, 20)
    states = states_plane({CELL: EMPTY, other: CellState.CHANGED_OCCUPIED})
    data = pack_agreed(Odds(np.array([FLAT]), np.array([-3], np.int8)), states)
    assert unpack_agreed(data, states).at(np.array([FLAT, 20 * 256 + 20, 0])).tolist() == [-3, UNSAID, UNSAID]
    assert pack_agreed(Odds.none(), states) is None
    assert not len(unpack_agreed(None, states).cells)
    with pytest.raises(MapvoteError, match="decision: odds"):
        unpack_agreed(data, states_plane())
