"""A publish is decided once: a click with nothing new costs no fusion, and few statements, however large the round."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import numpy as np
import pytest
import sqlalchemy as sa

from hand_made import Say, make_ballot, make_map, make_tile, states_plane, wall
from mapvote.codec.ballot import Ballot
from mapvote.config import FuseSettings
from mapvote.core.grid import TileIndex
from mapvote.core.point_map import PointMap
from mapvote.core.types import CellState
from mapvote_server.errors import Held
from mapvote_server.questions.desk import desk, review
from mapvote_server.store import fusion_jobs
from mapvote_server.store.policy import Policy
from mapvote_server.store.publish import preview, publish
from mapvote_server.store.store import Store
from mapvote_server.store.votes import withdraw
from stores import Clock, NewStore, send

MOST_STATEMENTS = 20
FREE = FuseSettings(max_deleted_share=1.0, max_change_m2=1e6, max_freed_share=1.0)
DAY_NS = 86_400 * 10**9


def town(side: int) -> PointMap:
    """``side`` x ``side`` tiles, each with two walls of three cells."""
    cells = [(10, 10), (10, 11), (10, 12), (99, 40), (99, 41), (99, 42)]
    points = np.concatenate([wall(cells, [0.05]), wall(cells, [0.45, 0.75, 1.05])])
    return make_map({(r, c): make_tile(points, index=(r, c)) for r in range(side) for c in range(side)})


@pytest.fixture
def clock() -> Clock:
    return Clock(100 * DAY_NS)


@pytest.fixture
def make(new_store: NewStore, clock: Clock) -> Callable[..., Store]:
    return lambda side=2, fuse=FREE, **more: new_store(town(side), Policy(fuse=fuse), clock=clock, **more)


def says(store: Store, base: PointMap, tiles: list[TileIndex], vehicle: str, drive: str = "d1") -> Ballot:
    """The vehicle says that both walls of these tiles are gone."""
    cells = [(10, 10), (10, 11), (10, 12), (99, 40), (99, 41), (99, 42)]
    say = Say(states_plane(dict.fromkeys(cells, CellState.CHANGED_EMPTY)), odds=np.full(len(cells), 20, np.int8))
    return make_ballot(base, dict.fromkeys(tiles, say), vehicle, drive, end_ns=store.clock())


def vote(store: Store, tiles: list[TileIndex], vehicle: str, drive: str = "d1") -> None:
    send(store, says(store, store.point_map(), tiles, vehicle, drive))


class Counted:
    """Tiles fused and statements asked, while it is open."""

    def __init__(self, store: Store, monkeypatch: pytest.MonkeyPatch) -> None:
        self.fused, self.statements = 0, 0
        self._engine = store.database.engine
        really = fusion_jobs._fuse

        def fuse(*given: Any) -> Any:
            self.fused += 1
            return really(*given)

        monkeypatch.setattr(fusion_jobs, "_fuse", fuse)
        sa.event.listen(self._engine, "before_cursor_execute", self._asked)

    def _asked(self, *_: Any) -> None:
        self.statements += 1

    def of(self, act: Callable[[], object]) -> tuple[int, int]:
        """(tiles fused, statements) of one act."""
        self.fused = self.statements = 0
        act()
        return self.fused, self.statements


@pytest.mark.slow
def test_a_click_with_nothing_new_fuses_nothing_on_64_tiles_with_200_ballots(
    make: Callable[..., Store], monkeypatch: pytest.MonkeyPatch
) -> None:
    store = make(side=8)
    every = sorted(store.tiles())
    base = store.point_map()
    send(store, *[says(store, base, every[k % 16 * 4 : k % 16 * 4 + 4], f"v{k // 16}", f"d{k}") for k in range(200)])
    counted = Counted(store, monkeypatch)
    assert counted.of(lambda: desk(store))[0] == 64
    ids = [feature.id for feature in desk(store).answer.pending.features]
    assert len(ids) == 128
    for click in (lambda: desk(store), lambda: preview(store)):
        fused, statements = counted.of(click)
        assert (fused, statements <= MOST_STATEMENTS) == (0, True), statements
    fused, statements = counted.of(lambda: review(store, ids[7], "accepted", by="anna"))
    assert (fused, statements <= MOST_STATEMENTS) == (0, True), statements
    assert counted.of(lambda: desk(store))[0] == 1, "the tile with the verdict"
    vote(store, every[:1], "late")
    assert counted.of(lambda: desk(store))[0] == 1, "the tile with the vote"
    done: list[Any] = []
    assert counted.of(lambda: done.append(publish(store)))[0] == 0, "what was looked at is what is published"
    assert (len(done[0].tiles), done[0].points_deleted) == (64, 64 * 18)


def test_a_publish_of_what_was_looked_at_is_the_publish_of_who_never_looked(
    make: Callable[..., Store],
) -> None:
    looked, other = make(), make(name="o.db")
    for store in (looked, other):
        for vehicle in "ab":
            vote(store, [(0, 0), (0, 1)], vehicle)
            if store is looked:
                desk(store)
        withdraw(store, "b", by="boss")
        if store is looked:
            assert desk(store).answer.pending.features == []
        vote(store, [(0, 1), (1, 1)], "c")
        vote(store, [(1, 1)], "b", "d2")
        if store is looked:
            desk(store)
        publish(store)
    assert looked.tiles() == other.tiles()
    assert looked.manifest().digest == other.manifest().digest
    assert [(v.number, v.mark) for v in looked.versions()] == [(v.number, v.mark) for v in other.versions()]


def test_a_round_ends_with_the_policy_and_with_a_version(make: Callable[..., Store]) -> None:
    store = make()
    for vehicle in "ab":
        vote(store, [(0, 0)], vehicle)
    assert preview(store).points_deleted == 18
    store.change_policy({"fuse.min_votes": "3"})
    assert preview(store).points_deleted == 0
    store.change_policy({"fuse.min_votes": "2", "fuse.max_deleted_share": "0.01"})
    with pytest.raises(Held):
        publish(store)
    store.change_policy({"fuse.max_deleted_share": "1"})
    assert publish(store).version == 2
    assert preview(store).points_deleted == 0


def test_with_a_minimum_age_a_round_ends_when_the_next_vote_is_old_enough(
    make: Callable[..., Store], clock: Clock, monkeypatch: pytest.MonkeyPatch
) -> None:
    store = make(fuse=FREE.model_copy(update={"min_age_s": 3600.0}))
    vote(store, [(0, 0)], "a")
    clock.now += 600 * 10**9
    vote(store, [(0, 0)], "b")
    counted = Counted(store, monkeypatch)
    found: list[int] = []
    fusions = []
    for minutes in (0, 49, 5, 6):
        clock.now += minutes * 60 * 10**9
        fusions.append(counted.of(lambda: found.append(preview(store).points_deleted))[0])
    assert found == [0, 0, 0, 18], "an hour after the second vote came"
    assert fusions == [1, 0, 1, 1], "none where no vote came of age"
    clock.now += 60 * 10**9
    assert publish(store).points_deleted == 18
    assert store.versions()[-1].created_ns == clock.now


def test_what_the_newest_version_edited_is_fused_again_for_votes_were_spent_there(make: Callable[..., Store]) -> None:
    store = make()
    for vehicle in "ab":
        vote(store, [(0, 0), (0, 1)], vehicle)
    assert publish(store).tiles == ["0,0", "0,1"]
    assert [fused.index for fused in preview(store).fused] == [(0, 0), (0, 1)]
