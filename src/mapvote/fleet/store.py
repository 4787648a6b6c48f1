"""The store: versions of one map in SQL, the only system of record (DESIGN 4).

    store = Store.open("sqlite:///street.db")          # or Store.create(url, point_map)
    store.current(); store.manifest(n); store.tile(n, (0, 0)); store.point_map(n)

What changes it lives beside it, one concern each: ``intake`` (ballots in and out), ``publish`` (publish, roll back,
un-vote), ``keys``. What explains it: ``standing`` (which votes count), ``explain`` (cells, coverage, log).
"""

from __future__ import annotations

import time
from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import sqlalchemy as sa

from mapvote.core.ballot import Id, tile_key
from mapvote.core.grid import Lattice, TileIndex
from mapvote.core.types import MapTile, MapvoteError, PointMap
from mapvote.fleet import migrate, schema
from mapvote.fleet.content import TileHashes, pack_tile, unpack_tile
from mapvote.fleet.database import Database
from mapvote.fleet.errors import NotFound, Unavailable

__all__ = ["Id", "Manifest", "Store", "Version", "add_blobs", "log_event", "url_of"]


@dataclass(frozen=True, slots=True)
class Version:
    """One published state of the map."""

    number: int
    parent: int | None
    kind: str
    """import, publish, rollback or replay."""
    target: int | None
    created_ns: int
    published_by: str
    reason: str
    mark: int
    """The last event that the version knew of."""
    policy: Mapping[str, Any]


@dataclass(frozen=True, slots=True)
class Manifest:
    """What a version consists of: the hashes of its tiles."""

    version: int
    map_id: str
    lattice: Lattice
    georeference: Mapping[str, str]
    tiles: Mapping[TileIndex, TileHashes]
    removed: Sequence[TileIndex] = ()
    """With ``since``: tiles that the older version had and this one has not."""


_BLOB = sa.select(schema.blobs.c.data).where(schema.blobs.c.hash == sa.bindparam("digest"))


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


def now_ns() -> int:
    """The server's clock."""
    return time.time_ns()


class Store:
    """An open store. Any number may be open on one database, in any number of processes."""

    def __init__(self, database: Database, clock: Callable[[], int] = now_ns) -> None:
        self.database = database
        self.clock = clock
        with database.reading() as connection:
            migrate.check(connection)
            row = connection.execute(sa.select(schema.maps)).one()
        self.map_id: str = row.map_id
        self.lattice = Lattice(row.x0, row.y0)
        self.georeference: Mapping[str, str] = row.georeference

    @classmethod
    def create(cls, url: str, point_map: PointMap, *, by: str = "operator", clock: Callable[[], int] = now_ns) -> Store:
        """A new store whose version 1 is ``point_map``; MapvoteError if the database already holds one."""
        database = Database(url)
        try:
            with database.writing() as connection:
                if migrate.revision_of(connection) is None:
                    migrate.run_migrations(connection)
                migrate.check(connection)
                if connection.execute(sa.select(schema.maps.c.map_id)).first() is not None:
                    raise MapvoteError(f"{database.url.render_as_string()}: holds a map already; open it instead")
                origin = {"x0": point_map.lattice.x0, "y0": point_map.lattice.y0}
                georeference = dict(point_map.georeference)
                connection.execute(
                    schema.maps.insert().values(map_id=point_map.map_id, georeference=georeference, **origin)
                )
                mark = log_event(connection, clock(), "import", by, point_map.map_id)
                version = Version(1, None, "import", None, clock(), by, "first map", mark, {})
                add_version(connection, version, point_map.tiles)
        except BaseException:
            database.close()
            raise
        return cls(database, clock)

    @classmethod
    def open(cls, url: str, *, clock: Callable[[], int] = now_ns) -> Store:
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

    def current(self) -> int:
        """Number of the newest version."""
        with self.database.reading() as connection:
            return current_number(connection)

    def versions(self) -> list[Version]:
        """All versions, oldest first."""
        with self.database.reading() as connection:
            rows = connection.execute(sa.select(schema.versions).order_by(schema.versions.c.number))
            return [Version(**row._mapping) for row in rows]

    def manifest(self, number: int | None = None, *, since: int | None = None) -> Manifest:
        """Tiles of a version (the newest by default); with ``since``, only those set after that version.

        NotFound if there is no such version.
        """
        with self.database.reading() as connection:
            number = current_number(connection) if number is None else number
            for wanted in (number, since):
                if wanted is not None:
                    version_of(connection, wanted)
            tiles = tiles_of(connection, number)
            removed: list[TileIndex] = []
            if since is not None:
                old = tiles_of(connection, since)
                removed = sorted(old.keys() - tiles.keys())
                tiles = {index: hashes for index, hashes in tiles.items() if old.get(index) != hashes}
        return Manifest(number, self.map_id, self.lattice, self.georeference, tiles, removed)

    def blob(self, digest: str) -> bytes:
        """One plane of a tile, a zstd frame; NotFound if no version ever held it."""
        with self.database.reading() as connection:
            return load_blob(connection, digest)

    def tile(self, number: int, index: TileIndex) -> MapTile | None:
        """One tile of a version, None where the map has none; NotFound if there is no such version."""
        with self.database.reading() as connection:
            version_of(connection, number)
            hashes = tiles_of(connection, number, index).get(index)
            return None if hashes is None else load_tile(connection, hashes)

    def point_map(self, number: int | None = None) -> PointMap:
        """A whole version."""
        with self.database.reading() as connection:
            number = current_number(connection) if number is None else number
            version_of(connection, number)
            tiles = {index: load_tile(connection, hashes) for index, hashes in tiles_of(connection, number).items()}
        return PointMap(self.map_id, self.lattice, tiles, self.georeference)


def current_number(connection: sa.Connection) -> int:
    """Number of the newest version."""
    return int(connection.execute(sa.select(sa.func.max(schema.versions.c.number))).scalar_one())


def current_version(connection: sa.Connection) -> Version:
    """The newest version."""
    newest = sa.select(schema.versions).order_by(schema.versions.c.number.desc()).limit(1)
    return Version(**connection.execute(newest).one()._mapping)


def version_of(connection: sa.Connection, number: int) -> Version:
    """One version; NotFound, naming the newest, if there is none of that number."""
    row = connection.execute(sa.select(schema.versions).where(schema.versions.c.number == number)).one_or_none()
    if row is None:
        newest = current_number(connection)
        raise NotFound(f"there is no version {number}; the newest is {newest}: fetch it whole")
    return Version(**row._mapping)


def tiles_of(connection: sa.Connection, number: int, only: TileIndex | None = None) -> dict[TileIndex, TileHashes]:
    """Hashes of a version's tiles, in ascending order: of each tile, the last row up to that version."""
    t = schema.version_tiles
    newest = sa.select(t.c.row, t.c.col, sa.func.max(t.c.version).label("version")).where(t.c.version <= number)
    if only is not None:
        newest = newest.where(t.c.row == only[0], t.c.col == only[1])
    last = newest.group_by(t.c.row, t.c.col).subquery()
    same = (t.c.row == last.c.row) & (t.c.col == last.c.col) & (t.c.version == last.c.version)
    rows = connection.execute(sa.select(t).join(last, same).where(t.c.points.is_not(None)).order_by(t.c.row, t.c.col))
    return {(row.row, row.col): TileHashes(row.points, row.ground, row.free) for row in rows}


def load_tile(connection: sa.Connection, hashes: TileHashes) -> MapTile:
    """A tile by its hashes."""
    free = None if hashes.free is None else load_blob(connection, hashes.free)
    return unpack_tile(hashes, load_blob(connection, hashes.points), load_blob(connection, hashes.ground), free)


def load_blob(connection: sa.Connection, digest: str) -> bytes:
    """One plane, still compressed; NotFound if no version ever held it."""
    data = connection.execute(_BLOB, {"digest": digest}).scalar_one_or_none()
    if data is None:
        raise NotFound(f"no tile plane has the hash {digest[:64]!r}; take the hashes from a manifest")
    return bytes(data)


def log_event(connection: sa.Connection, at_ns: int, kind: str, actor: str, detail: str) -> int:
    """Append to the log; its number. Only within a writing transaction."""
    seq = next_seq(connection)
    event = {"seq": seq, "at_ns": at_ns, "kind": kind, "actor": actor[:80], "detail": detail[:400]}
    connection.execute(schema.events.insert(), [event])
    return seq


def next_seq(connection: sa.Connection) -> int:
    """The number of the next event: safe, because writers take turns."""
    return int(connection.execute(sa.select(sa.func.max(schema.events.c.seq))).scalar_one() or 0) + 1


def add_blobs(connection: sa.Connection, planes: Mapping[str, bytes]) -> None:
    """Store planes that are not there yet."""
    for digest, data in planes.items():
        known = sa.select(schema.blobs.c.hash).where(schema.blobs.c.hash == digest)
        if connection.execute(known).first() is None:
            connection.execute(schema.blobs.insert().values(hash=digest, data=data))


def add_version(connection: sa.Connection, version: Version, tiles: Mapping[TileIndex, MapTile]) -> None:
    """Insert a version that sets ``tiles``; sqlalchemy's IntegrityError if its number is taken."""
    connection.execute(schema.versions.insert().values(**version_row(version)))
    rows = []
    for index, tile in tiles.items():
        hashes, planes = pack_tile(tile)
        add_blobs(connection, planes)
        rows.append(tile_row(version.number, index, hashes))
    if rows:
        connection.execute(schema.version_tiles.insert(), rows)


def version_row(version: Version) -> dict[str, Any]:
    """A version as the columns of its table."""
    return {name: getattr(version, name) for name in schema.versions.c.keys()}  # noqa: SIM118


def tile_row(number: int, index: TileIndex, hashes: TileHashes | None) -> dict[str, Any]:
    """One row of version_tiles; None where the version has no such tile."""
    planes = ("points", "ground", "free")
    return {"version": number, "row": index[0], "col": index[1]} | {
        plane: None if hashes is None else getattr(hashes, plane) for plane in planes
    }


def names(tiles: Iterable[TileIndex]) -> str:
    """Tile keys for a message, at most five of them."""
    keys = [tile_key(tile) for tile in tiles]
    return ", ".join(keys[:5]) + (f" and {len(keys) - 5} more" if len(keys) > 5 else "")
