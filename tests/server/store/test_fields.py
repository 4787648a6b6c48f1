"""Attributes of points (intensity, colours, classes, times) go with them through a store."""

from __future__ import annotations

from collections import Counter
from collections.abc import Iterator, Mapping
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import sqlalchemy as sa
from fastapi.testclient import TestClient
from hypothesis import given, settings
from hypothesis import strategies as st
from numpy.typing import NDArray
from pypcd4 import PointCloud

from hand_made import Say, make_ballot, states_plane, wall
from mapvote.cli.files import follow_once
from mapvote.client import MapClient
from mapvote.codec.ballot import Ballot, pack_points, unpack_points
from mapvote.codec.fields import FIELD_TYPES, pack_fields, unpack_fields
from mapvote.codec.tile_planes import pack_tile
from mapvote.config import FuseSettings
from mapvote.core.point_map import LazyTiles, PointMap, all_fields, all_points, map_from_points
from mapvote.core.tile import Tile
from mapvote.core.types import CellState, MapvoteError
from mapvote.formats import export_map, read_map
from mapvote.fusion.fuse import update_map
from mapvote_server.api.app import create_app
from mapvote_server.questions.history import overview
from mapvote_server.store import schema
from mapvote_server.store.integrity import check, restore_plane, set_aside
from mapvote_server.store.policy import Policy
from mapvote_server.store.publish import publish
from mapvote_server.store.retention import clear
from mapvote_server.store.rollback import replay, rollback
from mapvote_server.store.store import Store
from stores import send

POLICY = Policy(fuse=FuseSettings(max_deleted_share=1.0))
BUILT = unpack_points(pack_points(wall([(200, 200)], [0.45, 0.75])))
BRIGHT = np.array([51, 204], dtype=np.uint8)
KINDS = {"intensity": "u2", "red": "u2", "green": "u2", "blue": "u2", "classification": "u1", "gps_time": "f8"}


def street(seed: int = 0, kinds: Mapping[str, str] = KINDS) -> PointMap:
    """Ground and posts in two tiles; no two points carry the same."""
    rng = np.random.default_rng(seed)
    xy = rng.uniform((0.0, 0.0), (140.0, 70.0), (1500, 2))
    posts = np.repeat(rng.uniform((1.0, 1.0), (140.0, 55.0), (40, 2)), 10, axis=0)
    points = np.concatenate([np.c_[xy, rng.normal(0, 0.01, 1500)], np.c_[posts, np.tile(np.arange(0.4, 3.4, 0.3), 40)]])
    fields = {name: rng.integers(0, 60000, len(points)).astype(kind) for name, kind in kinds.items()}
    if "classification" in fields:
        fields["classification"] = rng.choice([1, 2, 5, 6, 17], len(points)).astype(kinds["classification"])  # no noise
    return map_from_points(points, map_id="street", fields=fields)


def ballots(point_map: PointMap, vehicles: str = "ab") -> list[Ballot]:
    """Every second post of tile (0, 0) has gone, and something was built that the sensor saw darkly and brightly."""
    tile = point_map.tiles[0, 0]
    cells = np.unique(tile.cells[tile.columns[1]])[::2]
    states = states_plane({(200, 200): CellState.CHANGED_OCCUPIED})
    states.reshape(-1)[cells] = CellState.CHANGED_EMPTY
    say = Say(states, new_points=BUILT, fields={"intensity": BRIGHT})
    return [make_ballot(point_map, {(0, 0): say}, vehicle) for vehicle in vehicles]


def carried(tile: Tile) -> Counter[tuple[Any, ...]]:
    """The points of a tile, each with all that it carries."""
    names = sorted(tile.fields)
    return Counter(zip(map(tuple, tile.points.tolist()), *(tile.fields[name].tolist() for name in names), strict=True))


def all_carried(point_map: PointMap) -> Counter[tuple[Any, ...]]:
    return sum((Counter({(i, *p): n for p, n in carried(t).items()}) for i, t in point_map.tiles.items()), Counter())


@pytest.fixture
def store(database_url: str) -> Iterator[Store]:
    store = Store.create(database_url, street(), POLICY)
    yield store
    store.close()


def vote(store: Store, vehicles: str = "ab") -> None:
    send(store, *ballots(store.point_map(1), vehicles))


def test_every_point_that_stays_keeps_its_fields_and_new_ones_have_the_sensors_intensity(store: Store) -> None:
    before = store.point_map()
    assert all_carried(before) == all_carried(street())
    vote(store)
    done = publish(store)
    assert (done.points_added, done.points_deleted > 50) == (2, True)
    after, offline = store.point_map(), update_map(before, ballots(before), POLICY.fuse)[0]
    for index, tile in offline.tiles.items():
        assert pack_tile(tile) == pack_tile(after.tiles[index]), "as `mapvote update` makes it on files"
    new = all_carried(after) - all_carried(before)
    assert sorted(point[1] for point in new) == sorted(map(tuple, BUILT.tolist()))
    assert len(all_carried(before) - all_carried(after)) == done.points_deleted
    tile = after.tiles[0, 0]
    assert tile.fields["intensity"][-2:].tolist() == [51 * 257, 204 * 257]
    assert not any(column[-2:].any() for name, column in tile.fields.items() if name != "intensity")


@pytest.mark.contract
def test_rolled_back_replayed_and_cleared_they_are_what_they_were_bit_for_bit(store: Store) -> None:
    first = store.manifest(1)
    vote(store)
    publish(store)
    changed = store.manifest()
    assert changed.tiles["0,0"].fields != first.tiles["0,0"].fields
    assert (changed.digest, changed.fields_digest) == _digests_afresh(store)
    rollback(store, 1)
    assert store.manifest().tiles == first.tiles
    assert (store.manifest().digest, store.manifest().fields_digest) == (first.digest, first.fields_digest)
    rollback(store, 2)
    replay(store, "a", dry_run=False)
    assert store.manifest().tiles == first.tiles, "one vehicle is too few"
    store.change_policy({"keep.versions": 1}, by="test")
    assert clear(store, dry_run=False).planes > 0
    assert all_carried(store.point_map()) == all_carried(street())
    assert check(store) == []


def _digests_afresh(store: Store) -> tuple[str, str]:
    again = Store(store.database).manifest()
    return again.digest, again.fields_digest


def test_a_flipped_bit_in_them_is_found_and_the_tile_waits_until_it_is_mended(store: Store) -> None:
    vote(store)
    digest = store.tiles()[0, 0].fields
    b = schema.blobs
    with store.database.writing() as connection:
        sound = bytes(connection.execute(sa.select(b.c.data).where(b.c.hash == digest)).scalar_one())
        broken = sound[:-20] + bytes([sound[-20] ^ 4]) + sound[-19:]
        connection.execute(b.update().where(b.c.hash == digest).values(data=broken))
    assert [(damage.kind, damage.name) for damage in check(store)] == [("plane", digest)]
    assert not publish(store).published, "its points would lose them"
    assert overview(store).fields == ", ".join(KINDS), "the other tile's"
    with store.database.reading() as connection:
        assert list(set_aside(connection)) == [("plane", digest)]
    assert digest is not None
    assert restore_plane(store, digest, pack_fields(street().tiles[0, 0].fields), by="boss")
    with store.database.reading() as connection:
        assert not set_aside(connection), "mended, it is in quarantine no more"
    assert publish(store).published
    t = schema.ballot_tiles
    with store.database.writing() as connection:
        connection.execute(t.update().values(votes=b""))
    assert {damage.kind for damage in check(store)} == {"ballot"}, "what a ballot said of it is covered too"


@settings(max_examples=25, deadline=None)
@given(st.data())
def test_packed_fields_come_back_in_their_type_and_order(data: st.DataObject) -> None:
    n = data.draw(st.integers(0, 20))
    names = data.draw(st.lists(st.text(max_size=8), unique=True, max_size=4))
    values, kinds = st.binary(min_size=8 * n, max_size=8 * n), st.sampled_from(FIELD_TYPES)
    fields: dict[str, NDArray[Any]] = {name: np.frombuffer(data.draw(values), data.draw(kinds))[:n] for name in names}
    back = unpack_fields(pack_fields(fields), n, "tile")
    assert list(back) == names
    assert all(back[name].dtype == c.dtype and back[name].tobytes() == c.tobytes() for name, c in fields.items())
    if fields:
        with pytest.raises(MapvoteError, match="points; fetch or send it again"):
            unpack_fields(pack_fields(fields), n + 1, "tile")


@pytest.mark.parametrize("damaged", [b"", b"\x81", pack_fields({"a": np.zeros(2, "S3")}), b"\xc0"])
def test_what_holds_no_fields_is_one_clear_error(damaged: bytes) -> None:
    with pytest.raises(MapvoteError, match="fetch or send it again"):
        unpack_fields(damaged, 2, "tile")


def client_of(app: TestClient, home: Path, **more: Any) -> MapClient:
    client = MapClient("http://localhost", home=home, **more)
    client._server._http = app
    return client


def test_vehicles_and_exports_get_them_and_of_a_map_without_nothing_is_told(tmp_path: Path) -> None:
    store = Store.create(f"sqlite:///{tmp_path / 'a.db'}", street(), POLICY)
    with TestClient(create_app(store, opened=True), base_url="http://localhost") as app:
        client = client_of(app, tmp_path / "home")
        assert all_carried(client.fetch()) == all_carried(street())
        vote(store)
        publish(store)
        asked = app.get("/v1/map?since=1").json()
        assert list(asked["tiles"]["0,0"]) == ["points", "ground", "free", "fields"]
        fetched = client.fetch()
        assert all_carried(fetched) == all_carried(store.point_map())
        export_map(fetched, tmp_path / "a.ply")
        back = read_map(tmp_path / "a.ply")
        assert {name: sorted(c.tolist()) for name, c in all_fields(back).items()} == {
            name: sorted(c.tolist()) for name, c in all_fields(store.point_map()).items()
        }
    store.close()
    plain = Store.create(f"sqlite:///{tmp_path / 'b.db'}", street(kinds={}), POLICY)
    with TestClient(create_app(plain, opened=True), base_url="http://localhost") as app:
        told = app.get("/v1/map").json()
        assert list(told) == ["map_id", "version", "lattice", "georeference", "tiles", "digest", "removed"]
        assert list(told["tiles"]["0,0"]) == ["points", "ground", "free"]
        fetched = client_of(app, tmp_path / "home_b").fetch()
        assert fetched.field_names == []
        assert np.array_equal(all_points(fetched), all_points(street()))
    plain.close()


def test_of_a_map_larger_than_memory_tiles_are_read_one_by_one_and_the_files_are_the_same(
    tmp_path: Path,
) -> None:
    store = Store.create(f"sqlite:///{tmp_path / 'a.db'}", street(), POLICY)
    vote(store)
    found = []
    for limit, kind in ((10_000_000, dict), (100, LazyTiles)):
        with TestClient(create_app(store, opened=True), base_url="http://localhost") as app:
            client = client_of(app, tmp_path / f"home{limit}", kept_points=limit)
            maps = store.point_map(kept_points=limit), client.fetch()
            change = follow_once(client, tmp_path / f"follow{limit}", None, 3)
        assert all(type(point_map.tiles) is kind for point_map in maps)
        assert all(all_carried(point_map) == all_carried(street()) for point_map in maps)
        assert change is not None
        assert change.tiles > 10
        for i, point_map in enumerate(maps):
            export_map(point_map, tmp_path / f"{limit}_{i}.las")
        out = sorted((tmp_path / f"follow{limit}").glob("pointcloud_map.pcd/*"))
        files = [*out, *(tmp_path / f"{limit}_{i}.las" for i in range(2))]
        found.append([file.read_bytes() for file in files])
        names = PointCloud.from_path(out[0]).fields
        assert tuple(names) == ("x", "y", "z", "intensity")
    assert found[0] == found[1]
    assert publish(store).published
    store.close()


def test_a_manifest_kept_before_fields_were_known_is_not_taken_for_whole(tmp_path: Path) -> None:
    """A map server that was set up again, with the same points and now their fields."""
    home = tmp_path / "home"
    for name, kinds in (("a", {}), ("b", KINDS)):
        store = Store.create(f"sqlite:///{tmp_path / name}.db", street(kinds=kinds), POLICY)
        with TestClient(create_app(store, opened=True), base_url="http://localhost") as app:
            client = client_of(app, home)
            if kinds:
                vote(store)
                publish(store)
            assert all_carried(client.fetch()) == all_carried(store.point_map())
        store.close()
