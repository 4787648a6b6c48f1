"""Why a cell is as it is: what the votes said, which of them counted, and a tie."""

from __future__ import annotations

from collections import Counter
from typing import Any

import numpy as np
import pytest
import sqlalchemy as sa

from hand_made import Say, make_ballot, states_plane, two_walls, wall
from mapvote.config import FuseSettings
from mapvote.core.types import N_STATES, NO_VOTE, CellState
from mapvote.core.voting import VOTE_UNIT
from mapvote.fusion.fuse import decide_tile
from mapvote.fusion.tile_vote import DAY_NS, REASONS
from mapvote_server.questions import explain
from mapvote_server.questions.explain import CellDecision, CellStory, ExplainSizes, LeftOut, evidence, explain_cell
from mapvote_server.questions.history import last_events
from mapvote_server.store import schema
from mapvote_server.store.keys import issue, revoke
from mapvote_server.store.policy import Policy, RoundPolicy
from mapvote_server.store.publish import preview, publish
from mapvote_server.store.store import Store
from mapvote_server.store.votes import withdraw
from stores import Clock, NewStore, send

WALL, LAWN = (10, 10), (20, 20)
START_NS = 1_700_000_000 * 10**9


@pytest.fixture
def clock() -> Clock:
    return Clock(START_NS)


@pytest.fixture
def store(new_store: NewStore, clock: Clock) -> Store:
    policy = Policy(fuse=FuseSettings(max_deleted_share=1.0, prior_stay_days=10.0))
    return new_store(two_walls(), policy, clock=clock)


def say(store: Store, vehicles: str, state: CellState, cell: tuple[int, int] = WALL) -> None:
    """These vehicles, a letter each, vote so on one cell."""
    points = wall([cell], [0.45, 0.75]) if state == CellState.CHANGED_OCCUPIED else None
    now, base = store.clock(), store.point_map()
    says = {(0, 0): Say(states_plane({cell: state}), new_points=points)}
    send(store, *[make_ballot(base, says, vehicle, f"d{now}", now) for vehicle in vehicles])


def story(store: Store, cell: tuple[int, int] = WALL) -> CellStory:
    return explain_cell(store, (cell[1] + 0.5) * 0.3, (cell[0] + 0.5) * 0.3)


def test_a_vote_that_a_version_counted_stays_in_the_story_when_it_is_taken_back(store: Store, clock: Clock) -> None:
    say(store, "abc", CellState.CHANGED_EMPTY)
    assert publish(store).version == 2
    withdraw(store, "a", by="a")
    issue(store, "b", "vehicle")
    revoke(store, "b")
    found = {vote.vehicle: vote for vote in story(store).votes}
    assert [(found[name].state, found[name].counted_in, found[name].counts) for name in "abc"] == [
        ("changed_empty", (2,), False)
    ] * 3
    assert (found["a"].why, found["b"].why) == ("withdrawn", "its vehicle's key was revoked")
    assert found["c"].why.startswith("spent")
    with store.database.writing() as connection:
        connection.execute(schema.ballot_tiles.update().values(votes=b"rot"))
    assert [vote.state for vote in story(store).votes] == ["unreadable"], "of those that stand"


def test_a_vote_is_named_with_the_version_that_counted_it_or_why_it_does_not_count(store: Store, clock: Clock) -> None:
    say(store, "ab", CellState.CHANGED_EMPTY)
    assert [(v.counts, v.counted_in) for v in story(store).votes] == [(True, ()), (True, ())]
    assert publish(store).version == 2
    clock.now += DAY_NS
    say(store, "c", CellState.UNCHANGED_EMPTY)
    told = story(store)
    assert [(v.vehicle, v.version, v.counted_in, v.counts) for v in told.votes] == [
        ("a", 1, (2,), False), ("b", 1, (2,), False), ("c", 2, (), True)
    ]  # fmt: skip
    assert told.votes[0].why == "spent: version 2 has changed the cell since"
    assert told.decisions == [CellDecision(2, "changed_empty")]
    assert told.probability is not None
    assert 0.0 < told.probability < 1.0


def test_what_comes_and_goes_is_called_temporary_until_it_can_be_expected_to_stay(store: Store, clock: Clock) -> None:
    say(store, "ab", CellState.CHANGED_OCCUPIED, LAWN)
    assert story(store, LAWN).thing.startswith("temporary:")
    assert not publish(store).published
    clock.now += 21 * DAY_NS
    say(store, "c", CellState.CHANGED_OCCUPIED, LAWN)
    assert story(store, LAWN).thing == ""
    assert publish(store).published
    assert story(store, LAWN).thing == "stands: brought by vehicles"
    assert [v.counted_in for v in story(store, LAWN).votes] == [(2,)] * 3
    say(store, "ab", CellState.CHANGED_EMPTY, LAWN)
    assert publish(store).published
    assert story(store, LAWN).thing.startswith("1 things came and went here, after 21.0 days on average; the next can")
    assert story(store, WALL).thing == "stands: surveyed"


def test_votes_that_count_are_listed_then_the_newest_others_and_the_rest_are_a_number(
    store: Store, clock: Clock
) -> None:
    store.set_policy(Policy(fuse=FuseSettings(latest_vehicles=2)))
    for vehicle in "abcde":
        clock.now += DAY_NS
        say(store, vehicle, CellState.UNCHANGED_OCCUPIED)
    for _ in range(2):  # the second answer knows the decision of the first
        told = explain_cell(store, 3.15, 3.15, sizes=ExplainSizes(votes=3))
        assert [(vote.vehicle, vote.counts) for vote in told.votes] == [("c", False), ("d", True), ("e", True)]
        assert told.unlisted == 2
    clock.now += DAY_NS
    say(store, "a", CellState.CHANGED_EMPTY)
    told = explain_cell(store, 3.15, 3.15, sizes=ExplainSizes(votes=1))
    assert [(vote.vehicle, vote.state) for vote in told.votes] == [
        ("a", "unchanged_occupied"), ("e", "unchanged_occupied"), ("a", "changed_empty")
    ], "a vote that counts is always listed"  # fmt: skip
    assert told.unlisted == 3


def test_who_looked_last_holds_up_what_is_new(store: Store, clock: Clock) -> None:
    store.set_policy(Policy(fuse=FuseSettings()))
    for vehicle, state in (("a", "CHANGED_OCCUPIED"), ("b", "CHANGED_OCCUPIED"), ("c", "UNCHANGED_EMPTY")):
        clock.now += 3_600 * 10**9
        say(store, vehicle, CellState[state], LAWN)
    assert story(store, LAWN).thing == "waits: the last vehicle that looked says otherwise"
    assert not publish(store).published


def test_a_damaged_ballot_is_told_and_hides_no_other(store: Store) -> None:
    say(store, "abc", CellState.CHANGED_EMPTY)
    with store.database.writing() as connection:
        t = schema.ballot_tiles
        first = connection.execute(sa.select(sa.func.min(t.c.ballot))).scalar_one()
        connection.execute(t.update().where(t.c.ballot == first).values(votes=b"rot"))
    assert [(v.state, v.counts) for v in story(store).votes] == [
        ("unreadable", False), ("changed_empty", True), ("changed_empty", True)
    ]  # fmt: skip


def test_a_damaged_decision_is_told_and_hides_no_vote(store: Store) -> None:
    say(store, "ab", CellState.CHANGED_EMPTY)
    publish(store)
    with store.database.writing() as connection:
        connection.execute(schema.decisions.update().values(states=b"rot"))
    told = story(store)
    assert told.decisions == [CellDecision(2, "unreadable")]
    assert told.probability is None
    assert [vote.counted_in for vote in told.votes] == [(2,), (2,)]


def test_of_copies_the_story_says_that_one_counts_and_the_log_whose_they_are_once(store: Store, clock: Clock) -> None:
    wandering = np.random.default_rng(1).integers(-5, 6, (4, 256)).cumsum(axis=1).clip(-30, 30)
    for name, way in (("a", wandering[:2]), ("liar", wandering[:2]), ("b", wandering[2:])):
        rows = np.arange(256)[:, None]
        seen = (rows > 60 + way[0]) & (rows < 180 + way[1])
        states = np.where(seen, CellState.UNCHANGED_EMPTY, CellState.UNDETERMINED).astype(np.uint8)
        states[WALL] = CellState.CHANGED_EMPTY
        ballot = make_ballot(store.point_map(), {(0, 0): Say(states)}, name, "d", clock.now - ord(name[0]))
        send(store, ballot)
    assert {vote.vehicle: vote.why for vote in story(store).votes} == {"a": REASONS["copy"], "b": "", "liar": ""}
    assert publish(store).published
    publish(store)
    assert {vote.vehicle: vote.counted_in for vote in story(store).votes} == {"a": (), "b": (2,), "liar": (2,)}
    assert {vote.vehicle: vote.left_out_of for vote in story(store).votes} == {
        "a": (LeftOut(2, REASONS["copy"]),), "b": (), "liar": ()
    }  # fmt: skip
    (told,) = [event for event in last_events(store) if event.kind == "copy"]
    assert told.detail.startswith("a's ballot ")
    assert "is a copy of liar's " in told.detail


def test_the_story_of_a_cell_of_many_versions_decides_its_tile_once(
    store: Store, clock: Clock, monkeypatch: pytest.MonkeyPatch
) -> None:
    store.set_policy(Policy(fuse=FuseSettings(max_deleted_share=1.0, prior_stay_days=1000.0)))
    for k in range(4):
        clock.now += 40 * DAY_NS
        say(store, "ab", CellState.CHANGED_EMPTY if k % 2 == 0 else CellState.CHANGED_OCCUPIED)
        assert publish(store).published
    decided, statements = Counter[str](), list[object]()

    def decide(*given: Any) -> Any:
        decided["tile"] += 1
        return decide_tile(*given)

    monkeypatch.setattr(explain, "decide_tile", decide)
    sa.event.listen(store.database.engine, "before_cursor_execute", lambda *given: statements.append(given[2]))
    told = story(store)
    assert [decision.version for decision in told.decisions] == [2, 3, 4, 5]
    assert [vote.counted_in for vote in told.votes] == [(k,) for k in range(2, 6) for _ in "ab"]
    assert (decided["tile"], len(statements) <= 20) == (1, True), len(statements)


def test_where_as_many_vehicles_say_one_thing_as_another_the_page_shows_undetermined(store: Store) -> None:
    say(store, "a", CellState.CHANGED_EMPTY)
    assert evidence(store, (0, 0))[WALL][3] == CellState.CHANGED_EMPTY
    say(store, "b", CellState.UNCHANGED_OCCUPIED)
    assert evidence(store, (0, 0))[WALL].tolist()[::3] == [2, CellState.UNDETERMINED]


TIE, CLEAR = (10, 10), (10, 11)


def test_a_tie_of_a_one_stage_ballot_is_undetermined_everywhere(new_store: NewStore) -> None:
    store = new_store(two_walls(), Policy(round=RoundPolicy(stage="one-stage")))
    tally = np.zeros((256, 256, N_STATES), dtype=np.uint16)
    for state in (CellState.UNCHANGED_OCCUPIED, CellState.CHANGED_EMPTY):
        tally[TIE][state] = 3 * VOTE_UNIT
    tally[CLEAR][CellState.CHANGED_EMPTY] = 3 * VOTE_UNIT
    ballot = make_ballot(store.point_map(), {(0, 0): Say(tally=tally)}, end_ns=store.clock())
    send(store, ballot)
    said = [explain_cell(store, (c + 0.5) * 0.3, (r + 0.5) * 0.3).votes[0].state for r, c in (TIE, CLEAR)]
    assert said == ["undetermined", "changed_empty"]
    page = evidence(store, (0, 0))
    assert [page[TIE][3], page[CLEAR][3]] == [NO_VOTE, CellState.CHANGED_EMPTY]
    (fused,) = preview(store).fused
    assert fused.record is not None
    assert fused.record.votes[TIE].any()
    assert fused.record.states[TIE] == CellState.UNDETERMINED
