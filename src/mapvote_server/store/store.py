"""The store: versions of one map in SQL, the only system of record.

    store = Store.open("sqlite:///street.db")          # or Store.create(url, point_map)
    store.current(); store.manifest(n); store.tile(n, (0, 0)); store.point_map(n)

The modules beside it change it: ``admission``, ``votes``, ``publish``, ``rollback``, ``reviews``, ``keys``, ``policy``.
:mod:`mapvote_server.questions` explains it.
"""

from __future__ import annotations

import secrets
import time
from collections.abc import Callable, Mapping
from dataclasses import asdict
from pathlib import Path
from threading import Lock
from typing import Any, Generic, TypeVar
from weakref import WeakKeyDictionary

import sqlalchemy as sa

from mapvote.codec.ballot import tile_key
from mapvote.codec.manifest import DIGESTS, Manifest, TileHashes, digests_of, shown
from mapvote.codec.tile_planes import pack_tile
from mapvote.core.grid import Lattice, TileIndex
from mapvote.core.point_map import MAP_SIZES, LazyTiles, PointMap, held_points
from mapvote.core.tile import Tile
from mapvote.core.types import MapvoteError
from mapvote_server.errors import Unavailable
from mapvote_server.store import migrate, schema
from mapvote_server.store.database import Database
from mapvote_server.store.policy import Policy, PolicyChange, changed, policy_in, write_policy
from mapvote_server.store.queries import (
    VERSION_COLUMNS,
    Version,
    add_blobs,
    current_number,
    load_blob,
    load_tile,
    log_event,
    points_of,
    set_tiles,
    tile_of,
    tiles_of,
    tiles_set_between,
    version_of,
)

Kept = TypeVar("Kept")


def _digests_of(tiles: Mapping[TileIndex, TileHashes]) -> tuple[int, int]:
    return digests_of((tile_key(index), hashes) for index, hashes in tiles.items())


def url_of(store: str) -> str:
    """The database URL of what the command line calls STORE: a URL, or the path of an SQLite file.

    The path is made absolute: workers may run in another folder.
    """
    return store if "://" in store else f"sqlite:///{Path(store).absolute()}"


def existing(url: str) -> Database:
    """The database at ``url``; MapvoteError if that is an SQLite file which is not there."""
    database = Database(url)
    file = database.url.database
    if database.is_sqlite and file and file != ":memory:" and not Path(file).exists():
        raise MapvoteError(f"{file}: no such store; create one with `mapvote serve {file} --map MAP`")
    return database


class Store:
    """An open store. Any number may be open on one database, in any number of processes."""

    def __init__(self, database: Database, clock: Callable[[], int] = time.time_ns) -> None:
        self.database = database
        self.clock = clock
        with database.reading() as connection:
            migrate.check(connection)
            row = connection.execute(sa.select(schema.maps)).one()
        self.map_id: str = row.map_id
        self.lattice = Lattice(row.x0, row.y0)
        self.georeference: Mapping[str, str] = row.georeference
        self.surveyed_ns: int | None = row.surveyed_ns
        self._digests: dict[int, tuple[int, int]] = {}

    @classmethod
    def create(
        cls,
        url: str,
        point_map: PointMap,
        policy: Policy | None = None,
        *,
        by: str = "operator",
        clock: Callable[[], int] = time.time_ns,
    ) -> Store:
        """A new store whose first version is ``point_map``: 1, or what the map itself says.

        MapvoteError if the database already holds a map.
        """
        database = Database(url)
        try:
            database.make_private_file()
            with database.writing() as connection:
                if migrate.revision_of(connection) is None:
                    migrate.run_migrations(connection)
                migrate.check(connection)
                if connection.execute(sa.select(schema.maps.c.map_id)).first() is not None:
                    raise MapvoteError(f"{database.url.render_as_string()}: holds a map already; open it instead")
                origin: dict[str, Any] = {"x0": point_map.lattice.x0, "y0": point_map.lattice.y0}
                about = {"georeference": dict(point_map.georeference), "secret": secrets.token_hex(32)}
                origin |= {"surveyed_ns": point_map.surveyed_ns}
                connection.execute(schema.maps.insert().values(map_id=point_map.map_id, **about, **origin))
                now_ns = clock()
                mark = log_event(connection, now_ns, "import", by, point_map.map_id)
                version = Version(point_map.version or 1, None, "import", None, now_ns, by, "first map", mark, {})
                connection.execute(schema.versions.insert().values(**asdict(version)))
                packed = {}
                for index, tile in point_map.tiles.items():
                    packed[index], planes = pack_tile(tile)
                    add_blobs(connection, planes)
                set_tiles(connection, version.number, packed)
                write_policy(connection, policy or Policy(), now_ns, by, "a new store")
        except BaseException:
            database.close()
            raise
        return cls(database, clock)

    @classmethod
    def open(cls, url: str, *, clock: Callable[[], int] = time.time_ns) -> Store:
        """An existing store; MapvoteError if there is none, or it has the schema of another mapvote."""
        database = existing(url)
        try:
            return cls(database, clock)
        except Unavailable as error:
            database.close()
            raise MapvoteError(f"{database.url.render_as_string()}: cannot be opened as a store ({error})") from error
        except BaseException:
            database.close()
            raise

    def close(self) -> None:
        """Close every connection."""
        self.database.close()

    def policy(self) -> Policy:
        """The present policy."""
        with self.database.reading() as connection:
            return policy_in(connection)

    def policy_changes(self) -> list[PolicyChange]:
        """Every change of the policy, oldest first."""
        p = schema.policies
        e = schema.events
        rows = sa.select(p.c.seq, e.c.at_ns, e.c.actor, e.c.detail, p.c.policy).join(e, e.c.seq == p.c.seq)
        with self.database.reading() as connection:
            changes = connection.execute(rows.order_by(p.c.seq)).all()
        return [PolicyChange(*row[:4], Policy.model_validate(row[4])) for row in changes]

    def set_policy(self, policy: Policy, *, by: str = "operator", reason: str = "") -> int:
        """Let another policy hold from now on; the number of the event."""
        with self.database.writing() as connection:
            return write_policy(connection, policy, self.clock(), by, reason)

    def change_policy(self, values: Mapping[str, Any], *, by: str = "operator", reason: str = "") -> int:
        """Change some values of the policy, by "section.key", in one transaction; the number of the event.

        MapvoteError as :func:`mapvote_server.store.policy.changed`.
        """
        with self.database.writing() as connection:
            return write_policy(connection, changed(policy_in(connection), values), self.clock(), by, reason)

    def current(self) -> int:
        """Number of the newest version."""
        with self.database.reading() as connection:
            return current_number(connection)

    def versions(self) -> list[Version]:
        """All versions, oldest first."""
        with self.database.reading() as connection:
            rows = connection.execute(sa.select(*VERSION_COLUMNS).order_by(schema.versions.c.number))
            return [Version(**row._mapping) for row in rows]

    def manifest(self, number: int | None = None, *, since: int | None = None) -> Manifest:
        """A version (the newest by default) as it is told: without what tiles remember. With ``since``, only the tiles
        set after that version.

        NotFound if there is no such version.
        """
        with self.database.reading() as connection:
            number = version_of(connection, number).number
            if since is not None:
                version_of(connection, since, cleared=True)
            if since is None:
                tiles = tiles_of(connection, number)
                removed = list[TileIndex]()
                self._digests[number] = _digests_of(tiles)
            else:
                tiles, removed = self._changed(connection, since, number)
            digest, fields_digest = shown(*self._digest(connection, number))
        return Manifest(
            map_id=self.map_id,
            version=number,
            lattice=self.lattice,
            georeference=dict(self.georeference),
            tiles={tile_key(index): hashes.shown() for index, hashes in tiles.items()},
            digest=digest,
            fields_digest=fields_digest,
            removed=[tile_key(index) for index in removed],
        )

    def tiles(self, number: int | None = None) -> dict[TileIndex, TileHashes]:
        """The hashes of a version's tiles, the newest version's by default; NotFound if there is no such version."""
        with self.database.reading() as connection:
            number = version_of(connection, number).number
            return tiles_of(connection, number)

    def _changed(
        self, connection: sa.Connection, since: int, number: int
    ) -> tuple[dict[TileIndex, TileHashes], list[TileIndex]]:
        """(tiles of ``number`` that are otherwise than in ``since``, tiles that only ``since`` has)."""
        touched = tiles_set_between(connection, min(since, number), max(since, number))
        then = tiles_of(connection, since, touched)
        after = tiles_of(connection, number, touched)
        changed = {index: hashes for index, hashes in after.items() if then.get(index) != hashes}
        return changed, sorted(then.keys() - after.keys())

    def _digest(self, connection: sa.Connection, number: int) -> tuple[int, int]:
        """A version as the last known one before it, and the changes since."""
        before = max((kept for kept in self._digests if kept <= number), default=None)
        if before is None:
            self._digests[number] = _digests_of(tiles_of(connection, number))
        elif before < number:
            touched = tiles_set_between(connection, before, number)
            then, after = (_digests_of(tiles_of(connection, version, touched)) for version in (before, number))
            kept = zip(self._digests[before], then, after, strict=True)
            tiles, fields = ((whole - old + new) % DIGESTS for whole, old, new in kept)
            self._digests[number] = tiles, fields
        return self._digests[number]

    def blob(self, digest: str) -> bytes:
        """One plane of a tile, a zstd frame; NotFound if no version ever held it."""
        with self.database.reading() as connection:
            return load_blob(connection, digest)

    def tile(self, number: int, index: TileIndex) -> Tile | None:
        """One tile of a version, None where the map has none; NotFound if there is no such version."""
        with self.database.reading() as connection:
            version_of(connection, number)
            hashes = tile_of(connection, number, index)
            return None if hashes is None else load_tile(connection, self.lattice.tile(index), hashes)

    def point_map(self, number: int | None = None, *, kept_points: int = MAP_SIZES.kept_points) -> PointMap:
        """A whole version. A version with more points than ``kept_points`` reads its tiles when they are used: keep the
        store open."""
        with self.database.reading() as connection:
            number = version_of(connection, number).number
            hashes = tiles_of(connection, number)
            points = points_of(connection, hashes)
            tiles: Mapping[TileIndex, Tile]
            if sum(map(held_points, points.values())) <= kept_points:
                tiles = {index: load_tile(connection, self.lattice.tile(index), h) for index, h in hashes.items()}
            else:
                tiles = LazyTiles(lambda index: self._load(index, hashes[index]), points, kept_points)
        return PointMap(self.map_id, self.lattice, tiles, self.georeference, (), number, self.surveyed_ns)

    def _load(self, index: TileIndex, hashes: TileHashes) -> Tile:
        with self.database.reading() as connection:
            return load_tile(connection, self.lattice.tile(index), hashes)


class PerStore(Generic[Kept]):
    """One object for each open store, made when it is first needed and gone with the store; thread-safe."""

    def __init__(self, make: Callable[[], Kept]) -> None:
        self._make = make
        self._lock = Lock()
        self._of: WeakKeyDictionary[Store, Kept] = WeakKeyDictionary()

    def of(self, store: Store) -> Kept:
        """The object of a store."""
        with self._lock:
            kept = self._of.get(store)
            if kept is None:
                kept = self._of[store] = self._make()
            return kept
