"""How sure a vehicle is travels as a byte for each changed cell, and nothing else passes for it."""

from __future__ import annotations

import msgspec
import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from hand_made import Say, make_ballot, states_plane, two_walls, unpack_all
from mapvote.codec.arrays import compress
from mapvote.codec.ballot import Ballot, decode, encode, unpack_states, unpack_sureness
from mapvote.codec.odds import MOST, STEPS, UNSAID, in_nats, in_steps, pack_odds, unpack_odds
from mapvote.core.types import I8, CellState, MapvoteError

CHANGES = (CellState.CHANGED_OCCUPIED, CellState.CHANGED_EMPTY)


def saying(cells: dict[tuple[int, int], int], odds: I8 | None) -> Ballot:
    return make_ballot(two_walls(), {(0, 0): Say(states_plane(cells), odds=odds)})


@settings(max_examples=30, deadline=None)
@given(
    st.dictionaries(
        st.tuples(st.integers(0, 255), st.integers(0, 255)),
        st.tuples(st.sampled_from(range(5)), st.integers(-MOST, MOST)),
        max_size=40,
    )
)
def test_every_changed_cell_gets_its_own_byte_back_and_no_other_cell_has_one(
    said: dict[tuple[int, int], tuple[int, int]],
) -> None:
    bytes_of = {cell: odds for cell, (state, odds) in sorted(said.items()) if state in CHANGES}
    sent = saying({cell: state for cell, (state, _) in said.items()}, np.array(list(bytes_of.values()), np.int8))
    got = decode(encode(sent))
    unpack_all(got)
    (tile,) = got.tiles
    assert tile.states is not None
    odds = unpack_sureness(tile.odds, unpack_states(tile.states))
    assert odds is not None
    assert odds.tolist() == list(bytes_of.values())


@given(st.lists(st.floats(-100, 100), max_size=20))
def test_log_odds_keep_their_sign_and_lose_half_a_step_at_most(nats: list[float]) -> None:
    back = in_nats(in_steps(np.array(nats, dtype=np.float64)))
    within = np.clip(np.array(nats), -MOST / STEPS, MOST / STEPS)
    assert np.abs(back - within).max(initial=0.0) <= 0.5 / STEPS
    assert (back * within >= 0).all()


@pytest.mark.parametrize(
    ("data", "says"),
    [
        (pack_odds(np.zeros(1, np.int8)), "1 bytes, expected 2"),
        (pack_odds(np.zeros(3, np.int8)), "larger than 2 bytes"),
        (pack_odds(np.array([0, UNSAID], np.int8)), "no log-odds"),
        (compress(b"x" * 100_000_000), "larger than 2 bytes"),
        (b"not zstd", "damaged"),
    ],
    ids=["a cell too few", "a cell too many", "a value that nobody says", "a bomb", "no frame"],
)
def test_what_no_vehicle_says_is_one_clear_error(data: bytes, says: str) -> None:
    with pytest.raises(MapvoteError, match=f"ballot: odds .*{says}"):
        unpack_odds(data, 2)
    sent = saying({(3, 3): CellState.CHANGED_EMPTY, (3, 4): CellState.CHANGED_OCCUPIED}, None)
    tile = msgspec.structs.replace(sent.tiles[0], odds=data)
    with pytest.raises(MapvoteError, match="ballot: odds"):
        unpack_all(msgspec.structs.replace(sent, tiles=[tile]))


def test_odds_are_of_states_and_a_tally_has_none() -> None:
    with pytest.raises(MapvoteError, match="no states"):
        unpack_sureness(pack_odds(np.zeros(2, np.int8)), None)
