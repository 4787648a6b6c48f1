"""Whatever bytes arrive, reading a ballot ends in a ballot or in one clear refusal, quickly and in little memory."""

from __future__ import annotations

import time
import tracemalloc

import msgspec
import pytest

from hand_made import Say, make_ballot, states_plane, two_walls, wall, words_plane
from mapvote.codec.ballot import encode
from mapvote.core.types import CellState, MapvoteError
from mapvote.server.store.admission import examine
from mutants import bomb, mutants


def honest() -> bytes:
    states = states_plane({(10, 10): CellState.CHANGED_EMPTY, (3, 3): CellState.CHANGED_OCCUPIED})
    say = Say(states=states, gone=words_plane({(10, 10): 7}), new_points=wall([(3, 3)], [0.5]), free=words_plane({}))
    return encode(make_ballot(two_walls(), {(0, 0): say, (0, 1): Say(states=states_plane())}))


def read(data: bytes) -> str | None:
    """Why a server refuses this, None if it can count it; MapvoteError is the only way to say no."""
    try:
        examine(data)
    except MapvoteError as error:
        return str(error)
    return None


def test_an_honest_ballot_is_read() -> None:
    assert read(honest()) is None


def test_500_mutants_end_in_a_ballot_or_a_refusal() -> None:
    answers = [read(data) for data in mutants(honest(), 500)]
    refusals = [answer for answer in answers if answer is not None]
    assert 250 < len(refusals) < 500, "most are refused; a plane of the future and a harmless flip are not"
    assert all(refusal.startswith("ballot") and len(refusal) < 500 for refusal in refusals)


def test_a_bomb_of_a_gigabyte_costs_neither_time_nor_memory() -> None:
    small = msgspec.msgpack.decode(honest())
    small["tiles"][0]["new_points"] = bomb(1 << 30)
    data = msgspec.msgpack.encode(small)
    assert len(data) < 200_000
    start = time.perf_counter()
    tracemalloc.start()
    with pytest.raises(MapvoteError, match="larger than"):
        examine(data)
    _, peak = tracemalloc.get_traced_memory()
    tracemalloc.stop()
    assert time.perf_counter() - start < 5.0
    assert peak < 120e6
