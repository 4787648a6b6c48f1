"""Liars who drive last, and strangers: the rules let them decide, and the operator is told, or asked."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from hand_made import Say, make_ballot, states_plane, two_walls
from mapvote.config import FuseSettings
from mapvote.core.types import NO_VOTE, CellState
from mapvote.fusion.tile_vote import DAY_NS
from mapvote_server.errors import Held
from mapvote_server.questions.desk import desk
from mapvote_server.questions.history import last_events
from mapvote_server.store.policy import Policy
from mapvote_server.store.publish import preview, publish
from mapvote_server.store.store import Store
from stores import Clock, send

CE, UO, UE = CellState.CHANGED_EMPTY, CellState.UNCHANGED_OCCUPIED, CellState.UNCHANGED_EMPTY
WALL = [(10, 10), (10, 11), (10, 12)]


@pytest.fixture
def clock() -> Clock:
    return Clock(1_700_000_000 * 10**9)


@pytest.fixture
def store(tmp_path: Path, clock: Clock) -> Store:
    made = Store.create(f"sqlite:///{tmp_path / 'fleet.db'}", two_walls(), clock=clock)
    hold(made)
    return made


def hold(store: Store, **policy: object) -> None:
    fuse = FuseSettings.model_validate({"max_deleted_share": 1.0, "newcomer_days": 0.0} | policy)
    store.set_policy(Policy(fuse=fuse))


def drive(store: Store, clock: Clock, names: list[str], state: CellState) -> None:
    for name in names:
        clock.now += 60 * 10**9
        say = Say(states_plane(dict.fromkeys(WALL, state)))
        send(store, make_ballot(store.point_map(), {(0, 0): say}, name, f"d{clock.now}", clock.now))


@pytest.mark.parametrize(("before", "after"), [(6, 3), (9, 9)])
def test_a_change_against_what_as_many_vehicles_said_is_told_and_can_be_held(
    store: Store, clock: Clock, before: int, after: int
) -> None:
    drive(store, clock, [f"honest{i}" for i in range(before)], UO)
    assert list(preview(store).doubts) == []
    drive(store, clock, [f"liar{i}" for i in range(after)], CE)
    (told,) = preview(store).doubts
    assert f"in 3 cells: {after} votes for a change where up to {before} vehicles said otherwise" in told
    assert desk(store).answer.doubts == [told]
    hold(store, hold_overturned=True)
    with pytest.raises(Held, match="overturns"):
        publish(store)
    assert desk(store).answer.held == [told]
    done = publish(store, override=True)
    assert done.points_deleted == 9
    events = [event for event in last_events(store) if event.kind == "doubt"]
    assert [event.detail for event in events] == [f"v{done.version}: {told}"]
    assert not publish(store).published
    assert list(preview(store).doubts) == []


def test_what_a_majority_decides_against_fewer_overturns_nobody(store: Store, clock: Clock) -> None:
    drive(store, clock, ["a"], UO)
    drive(store, clock, ["b", "c"], CE)
    assert preview(store).points_deleted == 9
    assert list(preview(store).doubts) == []


def test_a_change_that_newcomers_alone_decide_is_told_and_can_be_held(store: Store, clock: Clock) -> None:
    hold(store, newcomer_days=7.0)
    drive(store, clock, ["x", "y"], CE)
    assert list(preview(store).doubts) == [], "nobody has voted before: all are new"


def test_strangers_stand_out_among_vehicles_that_voted_before(store: Store, clock: Clock) -> None:
    hold(store, newcomer_days=7.0, hold_newcomers=True)
    drive(store, clock, ["old"], UE)
    clock.now += 8 * DAY_NS
    drive(store, clock, ["x", "y"], CE)
    (told,) = [doubt for doubt in preview(store).doubts if doubt.startswith("rests")]
    assert told == "rests on vehicles that first voted within the last 7 days, in 3 cells: x, y"
    with pytest.raises(Held, match="rests on vehicles"):
        publish(store)
    clock.now += 8 * DAY_NS
    drive(store, clock, ["z"], CE)
    assert not [doubt for doubt in preview(store).doubts if doubt.startswith("rests")], "x and y decide without z"
    assert publish(store).published


def test_vehicles_whose_drives_are_copies_are_told_at_the_desk(store: Store, clock: Clock) -> None:
    rng = np.random.default_rng(1)
    free = np.zeros((256, 256), dtype=np.uint64)
    free[100:110, 50:150] = rng.integers(1, 2**30, (10, 100)).astype(np.uint64)
    states = np.full((256, 256), NO_VOTE, dtype=np.uint8)
    states[100:110, 50:150] = UE
    for name in ("honest", "copier"):
        clock.now += 60 * 10**9
        send(store, make_ballot(store.point_map(), {(0, 0): Say(states, free=free)}, name, "d", clock.now))
    (told,) = desk(store).answer.doubts
    assert told == "copier sends what honest sends, on 1 tile: they count as one vehicle"
