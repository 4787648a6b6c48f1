"""Which votes count on a tile, asked of a store as of any moment, and why the others do not."""

from __future__ import annotations

import shutil
from collections.abc import Iterator
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from hand_made import SETTINGS, Say, make_ballot, states_plane, two_walls
from mapvote.config import FuseSettings
from mapvote.core.grid import TileIndex
from mapvote.core.tile import Memory
from mapvote.core.types import NO_VOTE, CellState
from mapvote.fusion.tile_vote import DAY_NS, Vote
from mapvote_server.store import reviews
from mapvote_server.store.integrity import ballot_name
from mapvote_server.store.policy import Policy, RoundPolicy
from mapvote_server.store.store import Store
from mapvote_server.store.votes import (
    Electorate,
    judged_on,
    judged_votes,
    read_votes,
    recent_votes,
    standing_tiles,
    withdraw,
)
from stores import Clock, send

CELL, OTHER = (10, 10), (10, 11)
HERE, BESIDE = (0, 0), (0, 1)
CE, CO, UO = CellState.CHANGED_EMPTY, CellState.CHANGED_OCCUPIED, CellState.UNCHANGED_OCCUPIED
NOW_S = 1_700_000_000


@pytest.fixture
def clock() -> Clock:
    return Clock(NOW_S * 10**9)


@pytest.fixture(scope="module")
def first_store(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Made once: every test has a copy."""
    file = tmp_path_factory.mktemp("first") / "store.db"
    Store.create(f"sqlite:///{file}", two_walls(), clock=Clock(NOW_S * 10**9)).close()
    return file


@pytest.fixture
def store(first_store: Path, tmp_path: Path, clock: Clock) -> Iterator[Store]:
    store = Store.open(f"sqlite:///{shutil.copy(first_store, tmp_path)}", clock=clock)
    yield store
    store.close()


def cast(
    store: Store,
    vehicle: str,
    day: float = 0,
    drive: str = "d",
    tiles: tuple[TileIndex, ...] = (HERE,),
    say: Say | None = None,
    **more: Any,
) -> int:
    """A vehicle says that two cells of a wall are gone, or ``say``; the ballot's number."""
    say = say or Say(states_plane({CELL: CE, OTHER: CE}))
    end_ns = (NOW_S - 100 * 86_400) * 10**9 + round(day * DAY_NS)
    ballot = make_ballot(two_walls(), dict.fromkeys(tiles, say), vehicle, drive, end_ns, **more)
    stage = "one-stage" if say.tally is not None else "two-stage"
    store.set_policy(Policy(round=RoundPolicy.model_validate({"method": ballot.method, "stage": stage})))
    (receipt,) = send(store, ballot)
    return receipt.seq


def asked(store: Store, **more: object) -> Electorate:
    """Everything up to now, by a policy that asks for nothing in particular."""
    rule = more.pop("round", RoundPolicy())
    policy = Policy(fuse=more.pop("fuse", FuseSettings()), round=rule)  # type: ignore[arg-type]
    return replace(Electorate(10**9, policy, received_by_ns=store.clock()), **more)  # type: ignore[arg-type]


def judged(store: Store, question: Electorate) -> dict[str, str]:
    with store.database.reading() as connection:
        return {vote.vehicle: vote.why for vote in judged_votes(connection, HERE, question)}


def counting(store: Store, question: Electorate, **more: object) -> list[Vote]:
    tile = replace(store.point_map().tiles[HERE], **more)  # type: ignore[arg-type]
    with store.database.reading() as connection:
        return [vote for vote in judged_on(connection, tile, question) if not vote.why]


def spoken(vote: Vote) -> list[tuple[int, int]]:
    assert vote.states is not None
    return [(int(r), int(c)) for r, c in np.argwhere(vote.states != NO_VOTE)]


def test_a_tally_is_read_as_a_tally(store: Store) -> None:
    tally = np.zeros((256, 256, 5), dtype=np.uint16)
    tally[CELL] = [1, 0, 0, 7, 2]
    cast(store, "a", say=Say(tally=tally), method="paper")
    (vote,) = counting(store, asked(store, round=RoundPolicy(method="paper", stage="one-stage")))
    assert vote.tally is not None
    assert vote.tally[CELL].tolist() == [1, 0, 0, 7, 2]
    assert (vote.states, vote.gone, vote.new_points, vote.free) == (None, None, None, None)


def test_a_ballot_waits_for_its_minimum_age_and_pushes_no_other_out_of_the_window(store: Store, clock: Clock) -> None:
    cast(store, "a")
    received = clock.now
    clock.now += 10**9
    cast(store, "b", day=60)
    assert judged(store, asked(store, received_by_ns=received - 1)) == {"a": "young", "b": "young"}
    assert judged(store, asked(store, received_by_ns=received)) == {"a": "", "b": "young"}
    assert judged(store, asked(store, without=("a",))) == {"b": ""}, "who is left out is not even named"


def test_a_round_is_asked_as_of_any_moment(store: Store) -> None:
    first, second = cast(store, "a"), cast(store, "b")
    assert list(judged(store, asked(store, mark=first - 1))) == []
    assert list(judged(store, asked(store, mark=first))) == ["a"]
    assert list(judged(store, asked(store, mark=second))) == ["a", "b"]
    again = cast(store, "a", day=1)
    assert [list(judged(store, asked(store, mark=mark))) for mark in (again - 1, again)] == [["a", "b"], ["b", "a"]]
    withdraw(store, "b", by="test")
    assert list(judged(store, asked(store))) == ["a"]
    assert list(judged(store, asked(store, mark=second))) == ["a", "b"], "what was then stays what was then"


def test_ballots_cast_by_other_methods_or_settings_than_the_policy_asks_for_do_not_count(store: Store) -> None:
    cast(store, "a")
    cast(store, "b", method="paper")
    cast(store, "c", settings_hash="00" * 32)
    assert judged(store, asked(store)) == {"a": "", "b": "otherwise", "c": ""}
    by_settings = asked(store, round=RoundPolicy(settings_hash=SETTINGS[:8]))
    assert judged(store, by_settings) == {"a": "", "b": "otherwise", "c": "otherwise"}
    assert judged(store, asked(store, round=RoundPolicy(stage="one-stage"))) == dict.fromkeys("abc", "otherwise")


def test_what_is_damaged_is_set_aside_on_its_tile(store: Store) -> None:
    seq = cast(store, "a", tiles=(HERE, BESIDE))
    assert judged(store, asked(store, set_aside=(ballot_name(seq, *HERE),))) == {"a": "damaged"}
    assert judged(store, asked(store, set_aside=(ballot_name(seq, *BESIDE),))) == {"a": ""}


def test_a_vote_counts_in_the_cells_that_have_not_changed_since(store: Store) -> None:
    cast(store, "a")
    cast(store, "elsewhere", tiles=(BESIDE,))
    memory = Memory.none().with_changed(np.array([CELL[0] * 256 + CELL[1]]), 2)
    tile = replace(store.point_map().tiles[HERE], memory=memory)
    (vote,) = counting(store, asked(store), memory=memory)
    with store.database.reading() as connection:
        (lately,) = recent_votes(connection, tile, asked(store))
    assert spoken(vote) == spoken(lately) == [OTHER]


def review(store: Store, verdict: reviews.Verdict, cell: tuple[int, int] = CELL) -> int:
    cells = np.zeros((256, 256), dtype=np.bool_)
    cells[cell] = True
    feature = {"id": "x", "properties": {"kind": "demolished"}}
    return reviews.decide(store, verdict, feature, {HERE: cells}, by="anna")


def test_what_reviewers_hold_is_silent_for_all_until_they_let_go(store: Store) -> None:
    first = cast(store, "a")
    accepted = review(store, "accepted")
    beside = {BESIDE: np.ones((256, 256), dtype=np.bool_)}
    reviews.decide(store, "held", {"id": "y", "properties": {"kind": "built"}}, beside, by="bert")
    assert [spoken(vote) for vote in counting(store, asked(store))] == [[CELL, OTHER]], "accepted, or of another tile"
    reviews.undo(store, accepted, by="anna")
    seq = review(store, "held")
    assert [spoken(vote) for vote in counting(store, asked(store, mark=first))] == [[CELL, OTHER]], "as of before"
    last = cast(store, "b")
    assert [spoken(vote) for vote in counting(store, asked(store))] == [[OTHER], [OTHER]]
    reviews.undo(store, seq, by="anna")
    assert [spoken(vote) for vote in counting(store, asked(store))] == [[CELL, OTHER]] * 2
    at_once = counting(store, asked(store, mark=last + 1))
    assert [spoken(vote) for vote in at_once] == [[CELL, OTHER]] * 2, "from the moment of letting go"
    held_then = counting(store, asked(store, mark=last))
    assert [spoken(vote) for vote in held_then] == [[OTHER], [OTHER]], "as of then it was held"


def test_what_reviewers_reject_only_later_drives_can_say_again(store: Store) -> None:
    cast(store, "a")
    review(store, "rejected")
    cast(store, "b")
    assert [spoken(vote) for vote in counting(store, asked(store))] == [[OTHER], [CELL, OTHER]]
    cast(store, "a")  # the same drive once more is no new drive
    assert {vote.vehicle: spoken(vote) for vote in counting(store, asked(store))}["a"] == [OTHER]
    cast(store, "a", drive="another", day=1)
    drives = [spoken(vote) for vote in counting(store, asked(store)) if vote.vehicle == "a"]
    assert sorted(drives) == [[CELL, OTHER], [OTHER]]


def recent(store: Store, question: Electorate) -> list[str]:
    tile = store.point_map().tiles[HERE]
    with store.database.reading() as connection:
        return [vote.vehicle for vote in recent_votes(connection, tile, question)]


def test_the_recent_past_is_of_every_vehicle_within_twice_the_days_that_a_thing_must_stay(
    store: Store, clock: Clock
) -> None:
    for day, vehicle in ((0, "a"), (10, "b"), (20, "c"), (30, "d")):
        cast(store, vehicle, day=day)
    few = FuseSettings(latest_vehicles=1, stay_days=10, max_age_days=5)
    assert recent(store, asked(store, fuse=few)) == ["b", "c", "d"], "as old as the days, and just so"
    assert [vote.vehicle for vote in counting(store, asked(store, fuse=few))] == ["d"]
    assert judged(store, asked(store, fuse=few)) == {**dict.fromkeys("abc", "window"), "d": ""}
    received = clock.now
    clock.now += 10**9
    damaged = cast(store, "e", day=30)
    cast(store, "f", day=30, method="paper")
    question = asked(store, fuse=few, received_by_ns=received, set_aside=(ballot_name(damaged, *HERE),))
    assert recent(store, question) == ["b", "c", "d"], "none that is not ready"


def test_votes_are_read_in_the_order_asked_for_and_no_tile_has_too_many(store: Store) -> None:
    cast(store, "a", say=Say(states_plane({CELL: CE})))
    cast(store, "b", say=Say(states_plane({OTHER: UO})))
    with store.database.reading() as connection:
        stored = judged_votes(connection, HERE, asked(store))
        backwards = read_votes(connection, HERE, stored[::-1])
        many = read_votes(connection, HERE, stored * 600)  # more than one statement may ask for
        assert read_votes(connection, HERE, []) == []
    assert [(vote.vehicle, spoken(vote)) for vote in backwards] == [("b", [OTHER]), ("a", [CELL])]
    assert [vote.vehicle for vote in many] == ["a", "b"] * 600
    assert spoken(many[-2]) == [CELL]


def tiles(store: Store, mark: int = 10**9, since: int | None = None) -> list[tuple[int, int]]:
    with store.database.reading() as connection:
        return standing_tiles(connection, mark, since)


def test_tiles_are_asked_about_where_ballots_stand(store: Store) -> None:
    assert tiles(store) == []
    first = cast(store, "a", tiles=(BESIDE, HERE))
    second = cast(store, "b")
    assert tiles(store) == [HERE, BESIDE]
    assert tiles(store, mark=first - 1) == []
    withdraw(store, "a", by="test")
    assert tiles(store) == [HERE]
    assert tiles(store, mark=second) == [HERE, BESIDE]


def test_tiles_are_asked_about_again_where_a_ballot_came_or_went_or_a_reviewer_spoke(store: Store) -> None:
    seq = cast(store, "a", tiles=(BESIDE,))
    assert tiles(store, since=seq - 1) == [BESIDE]
    assert tiles(store, since=seq) == []
    withdraw(store, "a", by="test")
    assert tiles(store, since=seq) == [BESIDE], "it went"
    verdict = review(store, "held")
    assert tiles(store, since=seq) == [HERE, BESIDE]
    assert tiles(store, since=verdict) == []
    assert tiles(store, mark=verdict - 1, since=seq) == [BESIDE]
    reviews.undo(store, verdict, by="anna")
    assert tiles(store, since=verdict) == [HERE]
