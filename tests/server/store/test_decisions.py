"""The decision record says who counted and who did not, as fusing the version once more finds it."""

from __future__ import annotations

from collections.abc import Iterator
from functools import partial
from pathlib import Path

import numpy as np
import pytest
import sqlalchemy as sa
from numpy.typing import DTypeLike

from hand_made import Say, make_ballot, two_walls
from histories import START_S, WALL, History, seen_along, street
from mapvote.codec.planes import unpack_bytes
from mapvote.config import FuseSettings
from mapvote.core.grid import CELLS, TILE_CELLS
from mapvote.core.rule import rule_named
from mapvote.core.types import N_STATES, CellState
from mapvote.core.voting import VOTE_UNIT
from mapvote.fusion.decision_record import Record, pack_standings, pack_tally, unpack_standings, unpack_votes
from mapvote.fusion.fuse import decide_tile
from mapvote.fusion.tile_vote import REASONS, Vote
from mapvote_server.store import schema
from mapvote_server.store.policy import Policy
from mapvote_server.store.publish import publish
from mapvote_server.store.queries import Version, oldest_kept, records_of, tile_as_of
from mapvote_server.store.reviews import decide
from mapvote_server.store.store import Store
from mapvote_server.store.votes import Electorate, from_sound_ballots, judged_on, read_votes, stored_votes
from stores import Clock, send

HERE = (0, 0)
CELL, OTHER = WALL[0], WALL[1]
FLAT = CELL[0] * 256 + CELL[1]
CE = int(CellState.CHANGED_EMPTY)


@pytest.fixture
def clock() -> Clock:
    return Clock(START_S * 10**9)


@pytest.fixture
def store(tmp_path: Path, clock: Clock) -> Iterator[Store]:
    policy = Policy(fuse=FuseSettings(max_deleted_share=1.0, max_freed_share=1.0))
    store = Store.create(f"sqlite:///{tmp_path / 'store.db'}", two_walls(), policy, clock=clock)
    yield store
    store.close()


def cast(store: Store, clock: Clock, vehicle: str, cell: tuple[int, int] = CELL, way: str = "", by: int = 0) -> int:
    """A vehicle says that a cell of the wall is empty, now; the ballot's number."""
    clock.now += 10**9
    states = seen_along(way, by)
    states[cell] = CE
    base = {HERE: store.tiles(1)[HERE].points}
    ballot = make_ballot(two_walls(), {HERE: Say(states)}, vehicle, f"d{clock.now}", clock.now, base=base, version=1)
    (receipt,) = send(store, ballot)
    return receipt.seq


def records(store: Store) -> list[Record]:
    with store.database.reading() as connection:
        return records_of(connection, HERE)


def test_a_record_names_those_that_counted_and_why_the_others_did_not(store: Store, clock: Clock) -> None:
    store.change_policy({"fuse.latest_vehicles": 3, "fuse.min_age_s": 60})
    old, a, b = (cast(store, clock, name) for name in ("old", "a", "b"))
    c = cast(store, clock, "c")
    clock.now += 120 * 10**9
    young = cast(store, clock, "young")
    assert publish(store).version == 2
    (record,) = records(store)
    assert {s.ballot: s.why for s in record.standings} == {old: "window", a: "", b: "", c: "", young: "young"}
    assert record.states[CELL] == CE
    assert record.votes[CELL].sum() > 0


def test_of_a_spent_and_of_a_reviewed_cell_the_record_says_so(store: Store, clock: Clock) -> None:
    first = [cast(store, clock, name) for name in "ab"]
    assert publish(store).published
    cells = np.zeros((256, 256), dtype=np.bool_)
    cells[OTHER] = True
    feature = {"id": "x", "properties": {"kind": "demolished"}}
    late = [cast(store, clock, name, OTHER) for name in "cd"]
    decide(store, "held", feature, {HERE: cells}, by="anna")
    last = [cast(store, clock, name, WALL[2]) for name in "ef"]
    assert publish(store).published
    record = records(store)[-1]
    found = {s.ballot: s for s in record.standings}
    assert [found[seq].why_not(FLAT) for seq in first] == ["spent"] * 2
    assert [found[seq].why_not(OTHER[0] * 256 + OTHER[1]) for seq in late] == ["reviewed"] * 2
    assert [found[seq].why_not(WALL[2][0] * 256 + WALL[2][1]) for seq in last] == [""] * 2


def test_a_copy_names_the_ballot_that_counted_for_both_and_a_damaged_one_is_told(store: Store, clock: Clock) -> None:
    a, liar, b, rotten = (
        cast(store, clock, name, way=way)
        for name, way in (("a", "north"), ("liar", "north"), ("b", "south"), ("rotten", ""))
    )
    t = schema.ballot_tiles
    with store.database.writing() as connection:
        connection.execute(t.update().where(t.c.ballot == rotten).values(votes=b"rot"))
    assert publish(store).published
    found = {s.ballot: (s.why, s.alike) for s in records(store)[0].standings}
    assert sorted([found[a], found[liar]]) == [("", 0), ("copy", a if found[a] == ("", 0) else liar)]
    assert (found[b], found[rotten]) == (("", 0), ("damaged", 0))


def test_every_reason_has_words_and_a_cell_is_found_whatever_its_number() -> None:
    assert all(REASONS.values())
    assert "" not in REASONS
    (last,) = unpack_standings(pack_standings([Vote(ballot=1, spent=np.array([0, CELLS - 1]))]))
    assert [last.why_not(cell) for cell in (0, 1, CELLS - 1)] == ["spent", "", "spent"]


def heard_again(store: Store, connection: sa.Connection, version: Version) -> dict[int, list[int]]:
    """Ballot -> flat cells on which it counted, by fusing the version once more."""
    tile = tile_as_of(connection, store.lattice.tile(HERE), version.number - 1)
    asked = Electorate.of(version)
    judged = from_sound_ballots(connection, asked, partial(judged_on, connection, tile))
    votes = [vote for vote in judged if not vote.why]
    policy = asked.policy
    heard = decide_tile(tile, votes, rule_named(policy.round.method), policy.fuse)
    copies = {(copy.vehicle, copy.digest) for copy in heard.copies}
    names = {vote.vehicle for vote in heard.votes}
    return {
        vote.ballot: np.flatnonzero(vote.spoken()).tolist()
        for vote in votes
        if vote.vehicle in names and (vote.vehicle, vote.digest) not in copies
    }


@pytest.mark.parametrize("seed", [pytest.param(0, marks=pytest.mark.slow), pytest.param(1, marks=pytest.mark.slow), 3])
def test_the_records_of_a_random_history_say_what_fusing_it_again_finds(seed: int, tmp_path: Path) -> None:
    history = History(seed, lambda clock: Store.create(f"sqlite:///{tmp_path / 'store.db'}", street(), clock=clock))
    history.live(25)
    compared = 0
    with history.store.database.reading() as connection:
        found = {record.version: record for record in records_of(connection, HERE)}
        for version in history.store.versions():
            if version.kind != "publish" or version.number <= oldest_kept(connection) or version.number not in found:
                continue
            counted = [s for s in found[version.number].standings if not s.why]
            with_planes = _sent(connection, [s.ballot for s in counted])
            mine = {s.ballot: [cell for cell in with_planes[s.ballot] if not s.why_not(cell)] for s in counted}
            assert mine == heard_again(history.store, connection, version)
            compared += 1
    history.store.close()
    assert compared


def _sent(connection: sa.Connection, seqs: list[int]) -> dict[int, list[int]]:
    """Ballot -> flat cells of which it speaks, as it was sent."""
    votes = read_votes(connection, HERE, stored_votes(connection, HERE, seqs))
    return {vote.ballot: np.flatnonzero(vote.spoken()).tolist() for vote in votes}


@pytest.mark.parametrize(
    ("dtype", "unit", "most", "width"),
    [
        (np.uint8, VOTE_UNIT, 16, 1),
        (np.uint16, VOTE_UNIT, 256, 1),
        (np.uint16, VOTE_UNIT, 257, 2),
        (np.int32, VOTE_UNIT, 256, 4),
        (np.int32, 1, 2**31, 4),
    ],
    ids=["few votes", "whole votes", "more than a byte holds", "as one-stage sums them", "large sums"],
)
def test_whole_votes_come_back_as_they_were_whatever_they_are_written_in(
    dtype: DTypeLike, unit: int, most: int, width: int
) -> None:
    rng = np.random.default_rng(1)
    planes = (rng.integers(0, most, (N_STATES, TILE_CELLS, TILE_CELLS)) * unit).astype(dtype)
    planes.flat[0] = (most - 1) * unit
    packed = pack_tally(np.moveaxis(planes, 0, -1))
    assert len(unpack_bytes(packed, 4 * N_STATES * CELLS, "tally")) == width * N_STATES * CELLS
    again = unpack_votes(packed)
    assert again.dtype.itemsize == width
    np.testing.assert_array_equal(again, np.moveaxis(planes, 0, -1) // VOTE_UNIT)
