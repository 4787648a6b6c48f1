"""One flipped bit: named by check, set aside, and everything undamaged goes on being published."""

from __future__ import annotations

import hashlib
from collections.abc import Iterator

import numpy as np
import pytest
import sqlalchemy as sa

from hand_made import Say, make_ballot, states_plane, two_walls
from mapvote.codec.planes import unpack_bytes
from mapvote.codec.tile_planes import pack_tile
from mapvote.config import FuseSettings
from mapvote.core.tile import Tile
from mapvote.core.types import CellState, MapvoteError
from mapvote_server.errors import NotFound
from mapvote_server.questions.changes import changes_between
from mapvote_server.questions.clouds import Clouds
from mapvote_server.questions.explain import evidence
from mapvote_server.questions.history import last_events
from mapvote_server.questions.vehicles import vehicle_standings
from mapvote_server.store import schema
from mapvote_server.store.integrity import ballot_name, check, restore_plane, set_aside
from mapvote_server.store.policy import Policy
from mapvote_server.store.publish import publish
from mapvote_server.store.store import Store
from stores import send

CELL = (10, 10)
POLICY = Policy(fuse=FuseSettings(max_deleted_share=1.0))


@pytest.fixture
def store(database_url: str) -> Iterator[Store]:
    store = Store.create(database_url, two_walls(), POLICY)
    base = store.point_map()
    for vehicle in ("a", "b", "c"):
        say = Say(states_plane({CELL: CellState.CHANGED_EMPTY}))
        ballot = make_ballot(base, dict.fromkeys(base.tiles, say), vehicle)
        send(store, ballot)
    yield store
    store.close()


def flip(store: Store, table: sa.Table, column: str, where: sa.ColumnElement[bool], bit: int = 77) -> None:
    """Turn one bit of a plane, as a failing disk would."""
    with store.database.writing() as connection:
        data = bytearray(connection.execute(sa.select(table.c[column]).where(where)).scalars().first() or b"")
        data[bit // 8 % len(data)] ^= 1 << bit % 8
        connection.execute(table.update().where(where).values({column: bytes(data)}))


def with_a_ground_of_its_own(store: Store) -> tuple[str, bytes]:
    """Both tiles hold the same points, so it is the ground of (0, 1) that will be damaged: its hash and plane."""
    with store.database.writing() as connection:
        t, tile = schema.version_tiles, two_walls().tiles[0, 1]
        hashes, planes = pack_tile(Tile(tile.window, tile.points, np.full((256, 256), 0.01, np.float32)))
        connection.execute(schema.blobs.insert().values(hash=hashes.ground, data=planes[hashes.ground]))
        connection.execute(t.update().where(t.c.col == 1).values(ground=hashes.ground))
    return hashes.ground, planes[hashes.ground]


def test_a_damaged_tile_is_named_all_others_are_published_and_once_mended_it_is_too(store: Store) -> None:
    assert check(store, mend=True) == []
    ground, plane = with_a_ground_of_its_own(store)
    flip(store, schema.blobs, "data", schema.blobs.c.hash == ground)
    assert [(damage.kind, damage.name) for damage in check(store)] == [("plane", ground)]
    done = publish(store)
    assert (done.published, done.tiles) == (True, ["0,0"])
    with store.database.reading() as connection:
        assert set_aside(connection), "and named"
    assert not publish(store).published
    assert restore_plane(store, ground, unpack_bytes(plane, 1 << 30, ground), by="boss")
    done = publish(store)
    assert (done.published, done.tiles) == (True, ["0,1"]), "its votes have waited"


def test_what_is_damaged_hides_nothing_else_from_whoever_looks(store: Store) -> None:
    """A ballot's vote on one tile, and the ground of the other."""
    ground, _ = with_a_ground_of_its_own(store)
    assert len(publish(store).tiles) == 2
    t = schema.ballot_tiles
    with store.database.reading() as connection:
        first = connection.execute(sa.select(sa.func.min(t.c.ballot))).scalar_one()
    flip(store, t, "votes", (t.c.ballot == first) & (t.c.col == 0))
    flip(store, schema.blobs, "data", schema.blobs.c.hash == ground)
    for _ in range(2):
        found = changes_between(store, 1, 2)
        assert (len(found.features), found.damaged) == (1, ["0,1"])
        assert [standing.vehicle for standing in vehicle_standings(store)] == ["a", "b", "c"]
        assert evidence(store, (0, 0))[CELL][0] == 2, "vehicles"
        assert np.frombuffer(Clouds(store).overview(2), "<u4")[1] == 1, "tiles"
        assert np.frombuffer(Clouds(store).changed(1, 2)[:8], "<i4").tolist() == [0, 0]
        check(store, mend=True)


def test_a_tile_whose_deciding_ballots_are_set_aside_is_decided_anew(store: Store) -> None:
    base, t = store.point_map(), schema.ballot_tiles
    deny = {(0, 0): Say(states_plane({CELL: CellState.UNCHANGED_OCCUPIED}))}
    receipts = send(store, *[make_ballot(base, deny, vehicle) for vehicle in "defg"])
    assert publish(store).tiles == ["0,1"], "three against four"
    for receipt in receipts:
        flip(store, t, "votes", t.c.ballot == receipt.seq)
    assert len(check(store, mend=True)) == 4
    assert publish(store).tiles == ["0,0"]


@pytest.mark.contract
def test_a_damaged_ballot_is_left_out_and_the_others_decide(store: Store) -> None:
    t = schema.ballot_tiles
    with store.database.reading() as connection:
        seq = connection.execute(sa.select(sa.func.min(t.c.ballot))).scalar_one()
    flip(store, t, "votes", (t.c.ballot == seq) & (t.c.col == 0))
    name = ballot_name(seq, 0, 0)
    assert [damage.name for damage in check(store)] == [name]
    done = publish(store)
    assert done.tiles == ["0,0", "0,1"]
    assert [fused.vehicles for fused in done.fused] == [2, 3]
    with store.database.reading() as connection:
        assert ("ballot", name) in set_aside(connection)


@pytest.mark.parametrize(
    ("table", "column", "kind"),
    [("ballots", "vehicle", "ballot"), ("versions", "reason", "version"), ("events", "actor", "event")],
)
def test_a_turned_letter_in_a_head_is_named(store: Store, table: str, column: str, kind: str) -> None:
    head = schema.metadata.tables[table]
    key = next(iter(head.primary_key))
    with store.database.writing() as connection:
        first = connection.execute(sa.select(sa.func.min(key))).scalar_one()
        said = connection.execute(sa.select(head.c[column]).where(key == first)).scalar_one()
        turned = chr(ord(said[0]) ^ 1) + said[1:]
        connection.execute(head.update().where(key == first).values({column: turned}))
        if table == "ballots":  # and another that ended by no event
            connection.execute(head.update().where(key == first + 1).values(gone_seq=1 << 40))
    ended = [("ballot", str(first + 1))] if table == "ballots" else []
    assert [(damage.kind, damage.name) for damage in check(store)] == [(kind, str(first)), *ended]
    with store.database.writing() as connection:
        connection.execute(schema.ballots.update().values(gone_seq=None))
    assert [(damage.kind, damage.name) for damage in check(store, mend=True)] == [(kind, str(first))]
    counted = 2 if table == "ballots" else 3
    assert [fused.vehicles for fused in publish(store).fused] == [counted, counted], "who spoke is not known any more"


def test_a_ballot_on_a_tile_whose_memory_is_damaged_is_admitted_and_waits(store: Store) -> None:
    late = make_ballot(two_walls(), {(0, 0): Say(states_plane({CELL: CellState.CHANGED_EMPTY}))}, "late", version=1)
    assert publish(store).version == 2
    memory = store.tiles(2)[0, 0].memory
    assert memory is not None
    flip(store, schema.blobs, "data", schema.blobs.c.hash == memory)
    send(store, late)
    assert not publish(store).published


def test_a_plane_is_put_back_from_another_store_and_nothing_else_is_taken(
    store: Store, tmp_path_factory: pytest.TempPathFactory
) -> None:
    other = Store.create(f"sqlite:///{tmp_path_factory.mktemp('other') / 's.db'}", two_walls())
    points = store.tiles()[0, 0].points
    sound = unpack_bytes(other.blob(points), 1 << 30, points)
    other.close()
    assert not restore_plane(store, points, sound, by="boss"), "it is as it was written"
    flip(store, schema.blobs, "data", schema.blobs.c.hash == points)
    assert not publish(store).published
    with pytest.raises(MapvoteError, match="not what this hash says"):
        restore_plane(store, points, sound[:-1], by="boss")
    with pytest.raises(NotFound, match="no version here shows"):
        restore_plane(store, hashlib.sha256(b"mine").hexdigest(), b"mine", by="boss")
    assert len(check(store)) == 1
    assert restore_plane(store, points, sound, by="boss")
    (event,) = last_events(store, 1)
    assert (event.kind, event.actor, event.detail) == ("mended", "boss", f"plane {points}")
    assert check(store) == []
    assert publish(store).published
