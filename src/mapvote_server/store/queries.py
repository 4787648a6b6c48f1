"""Queries on versions, tiles, blobs and events that several rooms of the store share."""

from __future__ import annotations

from collections.abc import Collection, Iterable, Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Any

import sqlalchemy as sa

from mapvote.codec.ballot import tile_key
from mapvote.codec.manifest import TileHashes
from mapvote.codec.planes import FRAME_HEAD
from mapvote.codec.tile_planes import (
    points_in_plane,
    unpack_memory_plane,
    unpack_tile,
)
from mapvote.core.grid import Grid, TileIndex
from mapvote.core.tile import Memory, Tile
from mapvote.fusion.decision_record import Record
from mapvote_server.errors import NotFound
from mapvote_server.store import schema
from mapvote_server.store.database import DATABASE_SIZES, Question, insert_rows


def current_number(connection: sa.Connection) -> int:
    """Number of the newest version."""
    return int(connection.execute(sa.select(sa.func.max(schema.versions.c.number))).scalar_one())


def version_of(connection: sa.Connection, number: int | None = None, *, cleared: bool = False) -> Version:
    """One version, the newest by default; NotFound, naming the newest, if there is none of that number, or (unless
    ``cleared`` will do) it was cleared away."""
    v = schema.versions.c.number
    query = sa.select(*VERSION_COLUMNS).order_by(v.desc()).limit(1)
    row = connection.execute(query if number is None else query.where(v == number)).one_or_none()
    if row is None:
        newest = current_number(connection)
        raise NotFound(f"there is no version {number}; the newest is {newest}")
    if row.cleared_seq is not None and not cleared:
        oldest = oldest_kept(connection)
        raise NotFound(f"version {number} was cleared away; the oldest that is kept is {oldest}")
    return Version(**row._mapping)


def oldest_kept(connection: sa.Connection) -> int:
    """The first version that was not cleared away."""
    v = schema.versions
    return int(connection.execute(sa.select(sa.func.min(v.c.number)).where(v.c.cleared_seq.is_(None))).scalar_one())


def shows_in_kept(oldest: int) -> sa.ColumnElement[bool]:
    """For a row of version_tiles: whether a version from ``oldest`` on shows that tile."""
    return (schema.version_tiles.c.version >= oldest) | _shown_by(sa.literal(oldest))


def shows_in_target(oldest: int) -> sa.ColumnElement[bool]:
    """For a row of version_tiles: whether a version before ``oldest`` shows that tile to which a rollback after
    ``oldest`` went back. A replay goes through that rollback again, so it needs what the tile remembered then."""
    v = schema.versions.alias()
    back = (v.c.kind == "rollback") & (v.c.number > oldest) & (v.c.target < oldest)
    return sa.exists().where(back, _shown_by(v.c.target, v)).correlate(schema.version_tiles)


def _shown_by(number: sa.ColumnElement[int], *beside: sa.FromClause) -> sa.ColumnElement[bool]:
    """For a row of version_tiles: whether it is the last one of its tile up to version ``number``, a column of
    ``beside``."""
    t = schema.version_tiles
    later = schema.version_tiles.alias()
    same = (later.c.row == t.c.row) & (later.c.col == t.c.col) & (later.c.version > t.c.version)
    return (t.c.version <= number) & ~sa.exists().where(same, later.c.version <= number).correlate(t, *beside)


def tiles_of(
    connection: sa.Connection, number: int, only: Collection[TileIndex] | None = None
) -> dict[TileIndex, TileHashes]:
    """Hashes of a version's tiles (``only`` these), in ascending order: of each, the last row up to that version."""
    if only is not None and len(only) <= DATABASE_SIZES.one_by_one:
        hashes_of = {index: tile_of(connection, number, index) for index in sorted(only)}
        return {index: hashes for index, hashes in hashes_of.items() if hashes is not None}
    t = schema.version_tiles
    newest = sa.select(t.c.row, t.c.col, sa.func.max(t.c.version).label("version")).where(t.c.version <= number)
    last = newest.group_by(t.c.row, t.c.col).subquery()
    same = (t.c.row == last.c.row) & (t.c.col == last.c.col) & (t.c.version == last.c.version)
    rows = connection.execute(sa.select(t).join(last, same).where(t.c.points.is_not(None)).order_by(t.c.row, t.c.col))
    tiles = {(row.row, row.col): _hashes(row) for row in rows}
    return tiles if only is None else {index: tiles[index] for index in only if index in tiles}


def tile_of(connection: sa.Connection, number: int, index: TileIndex) -> TileHashes | None:
    """Hashes of one tile of a version; None where the map has none."""
    row = _TILE.ask(connection, row=index[0], col=index[1], number=number).one_or_none()
    return None if row is None or row.points is None else _hashes(row)


def _hashes(row: Any) -> TileHashes:
    """The hashes of a row of version_tiles."""
    return TileHashes(**{plane: getattr(row, plane) for plane in schema.TILE_PLANES})


def points_of(connection: sa.Connection, tiles: Mapping[TileIndex, TileHashes]) -> dict[TileIndex, int]:
    """Number of points of each tile, read from the head of its plane: no plane is unpacked."""
    b = schema.blobs.c
    n_points = dict[str, int]()
    digests = sorted({hashes.points for hashes in tiles.values()})
    for start in range(0, len(digests), DATABASE_SIZES.variables):
        in_batch = b.hash.in_(digests[start : start + DATABASE_SIZES.variables])
        heads = sa.select(b.hash, sa.func.substr(b.data, 1, FRAME_HEAD)).where(in_batch)
        n_points |= {digest: points_in_plane(bytes(head), digest) for digest, head in connection.execute(heads)}
    return {index: n_points.get(hashes.points, 0) for index, hashes in tiles.items()}


def memory_of(connection: sa.Connection, number: int, index: TileIndex) -> Memory | None:
    """The memory of a place as of a version, also where the map has no tile any more."""
    row = _TILE.ask(connection, row=index[0], col=index[1], number=number).one_or_none()
    return None if row is None or row.memory is None else load_memory(connection, row.memory)


def tiles_set_between(connection: sa.Connection, old: int, new: int) -> list[TileIndex]:
    """The tiles that versions after ``old`` up to ``new`` set, ascending: all others are the same in both."""
    t = schema.version_tiles
    query = sa.select(t.c.row, t.c.col).distinct().where(t.c.version > old, t.c.version <= new)
    return sorted((row.row, row.col) for row in connection.execute(query))


def tiles_that_differ(
    connection: sa.Connection, old: int, new: int
) -> list[tuple[TileIndex, TileHashes | None, TileHashes | None]]:
    """(index, old hashes, new hashes) of every tile whose points differ between two versions, ascending.

    NotFound if one of the versions does not exist.
    """
    for number in (old, new):
        version_of(connection, number)
    touched = tiles_set_between(connection, min(old, new), max(old, new))
    before = tiles_of(connection, old, touched)
    after = tiles_of(connection, new, touched)
    pairs = [(index, before.get(index), after.get(index)) for index in sorted(before.keys() | after.keys())]
    return [(index, was, is_) for index, was, is_ in pairs if was is None or is_ is None or was.points != is_.points]


def load_tile(connection: sa.Connection, window: Grid, hashes: TileHashes | None) -> Tile:
    """The tile over ``window`` by its hashes; the empty one where there are none."""
    if hashes is None:
        return Tile.empty(window)
    named = hashes.planes()
    planes = {row.hash: row.data for row in _PLANES.ask(connection, **dict.fromkeys(schema.TILE_PLANES) | named)}
    return unpack_tile(window, hashes, {p: _there(planes.get(digest), digest) for p, digest in named.items()})


def tile_as_of(connection: sa.Connection, window: Grid, number: int) -> Tile:
    """A tile of a version; where the map has none, an empty one that remembers what was there."""
    hashes = tile_of(connection, number, window.tile_index)
    if hashes is not None:
        return load_tile(connection, window, hashes)
    return replace(Tile.empty(window), memory=memory_of(connection, number, window.tile_index))


def load_memory(connection: sa.Connection, digest: str) -> Memory:
    """The memory of a tile, by its hash."""
    return unpack_memory_plane(load_blob(connection, digest), digest)


def load_blob(connection: sa.Connection, digest: str) -> bytes:
    """One plane, still compressed; NotFound if no version ever held it."""
    return _there(connection.execute(_BLOB, {"digest": digest}).scalar_one_or_none(), digest)


def _there(data: bytes | None, digest: str) -> bytes:
    if data is None:
        raise NotFound(f"no tile plane has the hash {digest[:64]!r}; take the hashes from a manifest")
    return bytes(data)


def log_event(connection: sa.Connection, at_ns: int, kind: str, actor: str, detail: str) -> int:
    """Append to the log; its number. Only within a writing transaction."""
    seq = newest_seq(connection) + 1  # safe, because writers take turns
    event = {"seq": seq, "at_ns": at_ns, "kind": kind, "actor": actor[:80], "detail": detail[:400]}
    connection.execute(schema.events.insert(), [event])
    return seq


def end_votes(connection: sa.Connection, vehicle: str, seq: int) -> int:
    """Withdraw a vehicle's standing ballots by the event ``seq``; returns their number. Published versions stay."""
    b = schema.ballots
    standing = b.update().where(b.c.vehicle == vehicle, b.c.gone_seq.is_(None))
    return int(connection.execute(standing.values(gone_seq=seq)).rowcount)


def newest_seq(connection: sa.Connection) -> int:
    """Number of the newest event; 0 if there is none yet."""
    return int(connection.execute(sa.select(sa.func.max(schema.events.c.seq))).scalar_one() or 0)


def add_blobs(connection: sa.Connection, planes: Mapping[str, bytes]) -> None:
    """Store planes that are not there yet."""
    digests = list(planes)
    for start in range(0, len(digests), DATABASE_SIZES.variables):
        batch = digests[start : start + DATABASE_SIZES.variables]
        stored = set(connection.execute(_KNOWN_BLOBS, {"digests": batch}).scalars())
        new = [(digest, planes[digest]) for digest in batch if digest not in stored]
        if new:
            insert_rows(connection, schema.blobs, new)


def set_tiles(connection: sa.Connection, number: int, tiles: Mapping[TileIndex, TileHashes]) -> None:
    """The tiles that a version sets: rows of version_tiles."""
    rows = [(number, *i, *(getattr(h, plane) or None for plane in schema.TILE_PLANES)) for i, h in tiles.items()]
    if rows:
        insert_rows(connection, schema.version_tiles, rows)


def names(tiles: Iterable[TileIndex]) -> str:
    """Tile keys for a message, at most five of them."""
    keys = [tile_key(tile) for tile in tiles]
    return ", ".join(keys[:5]) + (f" and {len(keys) - 5} more" if len(keys) > 5 else "")


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
    cleared_seq: int | None = None
    """The event by which its planes were cleared away; None: it is there."""


VERSION_COLUMNS = [column for column in schema.versions.c if column.name != "sum"]
"""The columns of a :class:`Version`."""
_T = schema.version_tiles
_TILE = Question(
    sa.select(*(_T.c[plane] for plane in schema.TILE_PLANES))
    .where(_T.c.row == sa.bindparam("row"), _T.c.col == sa.bindparam("col"), _T.c.version <= sa.bindparam("number"))
    .order_by(_T.c.version.desc())
    .limit(1)
)
_KNOWN_BLOBS = sa.select(schema.blobs.c.hash).where(schema.blobs.c.hash.in_(sa.bindparam("digests", expanding=True)))
_BLOB = sa.select(schema.blobs.c.data).where(schema.blobs.c.hash == sa.bindparam("digest"))
_PLANES = Question(
    sa.select(schema.blobs).where(
        schema.blobs.c.hash.in_([sa.bindparam(p, type_=sa.String) for p in schema.TILE_PLANES])
    )
)


def states_of(connection: sa.Connection, index: TileIndex) -> list[tuple[int, bytes]]:
    """(version, packed states) of every decision on a tile, oldest version first: its small part."""
    d = schema.decisions.c
    query = sa.select(d.version, d.states).where(d.row == index[0], d.col == index[1]).order_by(d.version)
    return [(version, states) for version, states in connection.execute(query).all()]


def records_in(connection: sa.Connection, index: TileIndex, versions: Sequence[int]) -> list[Record]:
    """The decision records of a tile in some versions, which ascend."""
    d = schema.decisions
    records: list[Record] = []
    for start in range(0, len(versions), DATABASE_SIZES.variables):
        part = versions[start : start + DATABASE_SIZES.variables]
        query = _records().where(d.c.row == index[0], d.c.col == index[1], d.c.version.in_(part))
        records += [Record(*row) for row in connection.execute(query.order_by(d.c.version)).all()]
    return records


def _records() -> sa.Select[Any]:
    names = ("version", "states", "tally", "odds", "standings", "edits", "fell")
    return sa.select(*(schema.decisions.c[name] for name in names))


def records_of(connection: sa.Connection, index: TileIndex, *, after: int = 0, upto: int | None = None) -> list[Record]:
    """The decision records of a tile, oldest version first: of all versions, or of those ``after`` one ``upto``
    another, the latter included."""
    d = schema.decisions
    query = _records().where(d.c.row == index[0], d.c.col == index[1]).order_by(d.c.version)
    query = query.where(d.c.version > after)
    if upto is not None:
        query = query.where(d.c.version <= upto)
    return [Record(*row) for row in connection.execute(query).all()]
