"""Cleared rows; everything from the oldest kept version on works as before."""

from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path

import pytest
import sqlalchemy as sa

from hand_made import Say, make_ballot, states_plane, two_walls, wall
from mapvote.codec.tile_planes import pack_tile
from mapvote.config import FuseSettings
from mapvote.core.types import CellState
from mapvote.fusion.tile_vote import DAY_NS
from mapvote_server.errors import NotFound
from mapvote_server.questions.explain import explain_cell
from mapvote_server.store import schema
from mapvote_server.store.integrity import check
from mapvote_server.store.policy import KeepPolicy, Policy
from mapvote_server.store.publish import publish
from mapvote_server.store.retention import clear
from mapvote_server.store.rollback import replay, rollback
from mapvote_server.store.store import Store
from stores import Clock, send

CELL = (20, 20)
START_NS = 1_700_000_000 * 10**9
FUSE = FuseSettings(max_deleted_share=1.0, prior_stay_days=1e6)


@pytest.fixture
def clock() -> Clock:
    return Clock(START_NS)


@pytest.fixture
def store(database_url: str, clock: Clock) -> Iterator[Store]:
    store = Store.create(database_url, two_walls(), Policy(fuse=FUSE, keep=KeepPolicy(versions=3)), clock=clock)
    yield store
    store.close()


def come_and_go(store: Store, clock: Clock, times: int, days: float = 20.0) -> None:
    """Something is put on the lawn, or taken away again, by two vehicles every so many days: a version each time."""
    for _ in range(times):
        clock.now += round(days * DAY_NS)
        base, there = store.point_map(), store.current() % 2 == 0
        state = CellState.CHANGED_EMPTY if there else CellState.CHANGED_OCCUPIED
        say = Say(states_plane({CELL: state}), new_points=None if there else wall([CELL], [0.45, 0.75]))
        for vehicle in ("a", "b"):
            ballot = make_ballot(base, {(0, 0): say}, vehicle, f"d{clock.now}", clock.now)
            send(store, ballot)
        assert publish(store).published


def rows(store: Store, table: sa.Table) -> int:
    with store.database.reading() as connection:
        return int(connection.execute(sa.select(sa.func.count()).select_from(table)).scalar_one())


def test_a_dry_run_says_what_would_go_and_takes_nothing(store: Store, clock: Clock) -> None:
    come_and_go(store, clock, 8)
    tables = schema.blobs, schema.decisions, schema.ballot_tiles
    before = [rows(store, table) for table in tables]
    said = clear(store)
    assert (said.oldest, said.versions) == (7, 6)
    assert min(said.planes, said.decisions, said.ballots, said.size) > 0
    assert [rows(store, table) for table in tables] == before
    assert clear(store, dry_run=False) == said
    after = [rows(store, table) for table in tables]
    gone = [b - a for b, a in zip(before, after, strict=True)]
    assert gone == [said.planes, said.decisions, said.ballots]
    again = clear(store, dry_run=False)
    assert (again.versions, again.planes, again.decisions, again.ballots, again.size) == (0, 0, 0, 0, 0)
    with store.database.reading() as connection:
        b = schema.ballots
        taken = connection.execute(sa.select(b.c.bytes > 0).order_by(b.c.seq)).scalars().all()
    assert (taken[0], taken[-1]) == (False, True), "a vehicle gets its quota back"
    assert len(taken) == 16, "that they voted stays"
    replay(store, "a", dry_run=False)
    assert store.versions()[-1].target == 7, "a replay begins at the oldest version that is left"


@pytest.mark.contract
def test_what_is_left_is_whole_and_bit_for_bit_as_it_was(store: Store, clock: Clock) -> None:
    come_and_go(store, clock, 8)
    before = {n: [pack_tile(tile) for tile in store.point_map(n).tiles.values()] for n in (7, 8, 9)}
    changed = store.manifest(since=2).tiles
    clear(store, dry_run=False)
    assert check(store) == []
    assert {n: [pack_tile(tile) for tile in store.point_map(n).tiles.values()] for n in (7, 8, 9)} == before
    assert store.manifest(since=2).tiles == changed, "who drives with an old version is told what changed since"
    for lost in (lambda: store.point_map(3), lambda: store.manifest(3), lambda: rollback(store, 3)):
        with pytest.raises(NotFound, match="version 3 was cleared away; the oldest that is kept is 7"):
            lost()
    assert rollback(store, 7).number == 10
    assert [v.number for v in store.versions()] == list(range(1, 11)), "that they were stays"
    story = explain_cell(store, 20.5 * 0.3, 20.5 * 0.3)
    assert [decision.version for decision in story.decisions] == [7, 8, 9]


def test_it_goes_on_as_if_nothing_had_been_cleared(store: Store, clock: Clock, tmp_path: Path) -> None:
    """The same history with and without clearing ends in the same map."""
    come_and_go(store, clock, 6)
    clear(store, dry_run=False)
    come_and_go(store, clock, 4)
    clear(store, dry_run=False)
    cleared = [pack_tile(tile) for tile in store.point_map().tiles.values()]
    other_clock = Clock(START_NS)
    other = Store.create(f"sqlite:///{tmp_path / 'other.db'}", two_walls(), Policy(fuse=FUSE), clock=other_clock)
    come_and_go(other, other_clock, 10)
    assert cleared == [pack_tile(tile) for tile in other.point_map().tiles.values()]
    other.close()


def test_the_policy_clears_by_itself_and_keeps_everything_unless_told(store: Store, clock: Clock) -> None:
    store.set_policy(Policy(fuse=FUSE))
    come_and_go(store, clock, 5)
    assert clear(store).versions == 0
    store.set_policy(Policy(fuse=FUSE, keep=KeepPolicy(versions=2, automatic=True)))
    come_and_go(store, clock, 1)
    assert clear(store).versions == 0
    with pytest.raises(NotFound, match="the oldest that is kept is 6"):
        store.point_map(5)


def go_back_behind_what_is_kept(store: Store, clock: Clock) -> None:
    """Versions 2 and 3 published, 4 back to 2, 5 published; of these the last three are kept."""
    come_and_go(store, clock, 2)
    rollback(store, 2)
    clock.now += DAY_NS
    say = Say(states_plane({(30, 30): CellState.CHANGED_OCCUPIED}), new_points=wall([(30, 30)], [0.45]))
    send(store, *(make_ballot(store.point_map(), {(0, 0): say}, name, "d", clock.now) for name in ("a", "c")))
    assert publish(store).version == 5
    clear(store, dry_run=False)


def test_a_vehicle_is_taken_out_after_a_rollback_behind_what_is_kept(
    store: Store, clock: Clock, tmp_path: Path
) -> None:
    """The map is the one of a store that keeps everything."""
    go_back_behind_what_is_kept(store, clock)
    assert check(store) == []
    replay(store, "c", dry_run=False)
    cleared = [pack_tile(tile) for tile in store.point_map().tiles.values()]
    other_clock = Clock(START_NS)
    other = Store.create(f"sqlite:///{tmp_path / 'other.db'}", two_walls(), Policy(fuse=FUSE), clock=other_clock)
    go_back_behind_what_is_kept(other, other_clock)
    assert next(v.number for v in other.versions() if v.cleared_seq is None) == 1
    replay(other, "c", dry_run=False)
    assert cleared == [pack_tile(tile) for tile in other.point_map().tiles.values()]
    other.close()


def test_a_check_names_what_a_replay_would_lack(store: Store, clock: Clock) -> None:
    go_back_behind_what_is_kept(store, clock)
    t, b = schema.version_tiles.c, schema.blobs
    with store.database.writing() as connection:
        memory = connection.execute(sa.select(t.memory).where(t.version == 2)).scalar_one()
        connection.execute(b.delete().where(b.c.hash == memory))
    damage = [str(one) for one in check(store)]
    assert damage == [f"plane {memory}: memory of tile 0,0 in version 2 is lost"]
