"""Ballots in and out of the store: idempotent, one standing ballot per drive, nothing overwritten (DESIGN 4)."""

from __future__ import annotations

import hashlib
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import sqlalchemy as sa

from mapvote.core.ballot import Ballot, BallotTile, decode, tile_key, validate
from mapvote.core.grid import TileIndex, tile_grid
from mapvote.core.types import MapvoteError
from mapvote.fleet import schema
from mapvote.fleet.content import same_cells, unpack_points_plane
from mapvote.fleet.errors import Conflict, NotFound
from mapvote.fleet.fuse import DAY_NS
from mapvote.fleet.store import Store, current_version, load_blob, log_event, names, tiles_of
from mapvote.fleet.update import rule_of, staged, tile_vote

MAX_CLOCK_AHEAD_NS = DAY_NS
"""A drive may end this much after the server's own time: clocks differ, but a vehicle from the future would make all
other votes look old."""


@dataclass(frozen=True, slots=True)
class Incoming:
    """A ballot that is sound in itself, ready to be stored."""

    ballot: Ballot
    digest: str
    method: str


@dataclass(frozen=True, slots=True)
class Receipt:
    """The answer to a stored ballot. ``created``: this drive had no standing ballot before."""

    vehicle: str
    drive: str
    created: bool
    repeated: bool
    """The very same ballot stood already: nothing was written."""
    seq: int


def examine(data: bytes) -> Incoming:
    """Decode a ballot and unpack every plane once; MapvoteError on the first defect. Touches no database."""
    ballot = decode(data)
    validate(ballot)
    if not ballot.tiles:
        raise MapvoteError("ballot: votes on no tile")
    rule_of(ballot.method)
    if any((tile.states is None) != (ballot.tiles[0].states is None) for tile in ballot.tiles):
        raise MapvoteError("ballot: some tiles hold states and some a tally; a ballot is either two-stage or one-stage")
    return Incoming(ballot, hashlib.sha256(data).hexdigest(), f"{ballot.method}, {staged(ballot)}")


def accept(store: Store, ballots: Sequence[Incoming]) -> list[Receipt | MapvoteError]:
    """Store ballots in one durable transaction, each on its own merits: a receipt, or why it was refused.

    Conflict: other map or method, unknown base, or no cell counts any more. Unavailable is raised for all.
    """
    with store.database.reading() as connection:
        before = [_refusal(store, connection, incoming) for incoming in ballots]
    if all(before):
        return [error for error in before if error is not None]
    with store.database.writing() as connection:
        return [
            error if error is not None else _insert(store, connection, incoming)
            for incoming, error in zip(ballots, before, strict=True)
        ]


def withdraw(store: Store, vehicle: str, drive: str | None = None, *, by: str) -> int:
    """Un-vote before publication: one drive of a vehicle, or all; how many ballots were withdrawn.

    NotFound if there is none. What earlier versions made of them stays: see :func:`mapvote.fleet.publish.replay`.
    """
    b = schema.ballots
    mine = (b.c.vehicle == vehicle) & b.c.gone_seq.is_(None)
    if drive is not None:
        mine &= b.c.drive == drive
    with store.database.writing() as connection:
        if connection.execute(sa.select(b.c.seq).where(mine)).first() is None:
            raise NotFound(f"there is no standing ballot {vehicle}/{drive if drive is not None else '*'}")
        seq = log_event(connection, store.clock(), "withdraw", by, f"{vehicle}/{drive if drive is not None else '*'}")
        withdrawn = connection.execute(b.update().where(mine).values(gone_seq=seq)).rowcount
        if connection.execute(sa.select(b.c.seq).where(b.c.gone_seq.is_(None)).limit(1)).first() is None:
            connection.execute(schema.maps.update().values(method=None))
    return int(withdrawn)


def _refusal(store: Store, connection: sa.Connection, incoming: Incoming) -> MapvoteError | None:
    ballot = incoming.ballot
    if ballot.map_id != store.map_id:
        return Conflict(f"this server keeps map {store.map_id!r}, the ballot votes on {ballot.map_id!r}")
    if ballot.end_ns > store.clock() + MAX_CLOCK_AHEAD_NS:
        return MapvoteError("ballot: the drive ends in the future; set the vehicle's clock")
    current = tiles_of(connection, current_version(connection).number)
    unknown: list[TileIndex] = []
    counts = False
    for tile in ballot.tiles:
        base = ballot.base[tile_key(tile.tile)]
        now = current[tile.tile].points if tile.tile in current else ""
        if base == now:
            counts = True
        elif not _was_base(connection, tile.tile, base):
            unknown.append(tile.tile)
        elif not counts:
            counts = _counts_somewhere(store, connection, ballot, tile, base, now)
    if unknown:
        return Conflict(f"no version had the base of tile {names(unknown)}: fetch these tiles and vote again")
    if not counts:
        stale = names(tile.tile for tile in ballot.tiles)
        return Conflict(f"every cell voted on has changed since the ballot's base: fetch tiles {stale} and vote again")
    return None


def _was_base(connection: sa.Connection, tile: TileIndex, base: str) -> bool:
    if base == "":
        return True
    t = schema.version_tiles
    known = sa.select(t.c.version).where(t.c.row == tile[0], t.c.col == tile[1], t.c.points == base).limit(1)
    return connection.execute(known).first() is not None


def _counts_somewhere(
    store: Store, connection: sa.Connection, ballot: Ballot, tile: BallotTile, base: str, now: str
) -> bool:
    points = [None if not h else unpack_points_plane(load_blob(connection, h), h) for h in (base, now)]
    same = same_cells(points[0], points[1], tile_grid(store.lattice, tile.tile))
    return bool((tile_vote(ballot, tile, "").spoken() & same).any())


def _insert(store: Store, connection: sa.Connection, incoming: Incoming) -> Receipt | MapvoteError:
    ballot, b = incoming.ballot, schema.ballots
    method = connection.execute(sa.select(schema.maps.c.method)).scalar_one()
    if method is None:
        connection.execute(schema.maps.update().values(method=incoming.method))
    elif method != incoming.method:
        return Conflict(f"this round votes by {method}, the ballot by {incoming.method}: one round never mixes methods")
    mine = (b.c.vehicle == ballot.vehicle) & (b.c.drive == ballot.drive)
    known = connection.execute(sa.select(b.c.seq, b.c.first_seq, b.c.gone_seq, b.c.digest).where(mine)).all()
    standing = [row for row in known if row.gone_seq is None]
    if standing and standing[0].digest == incoming.digest:
        return Receipt(ballot.vehicle, ballot.drive, False, True, standing[0].seq)
    now = store.clock()
    seq = log_event(connection, now, "ballot", ballot.vehicle, ballot.drive)
    if standing:
        connection.execute(b.update().where(b.c.seq == standing[0].seq).values(gone_seq=seq))
    row: dict[str, Any] = {
        "seq": seq,
        "first_seq": min((row.first_seq for row in known), default=seq),
        "vehicle": ballot.vehicle,
        "drive": ballot.drive,
        "digest": incoming.digest,
        "start_ns": ballot.start_ns,
        "end_ns": ballot.end_ns,
        "received_ns": now,
        "settings_hash": ballot.settings_hash[:128],
    }
    connection.execute(b.insert(), [row])
    connection.execute(schema.ballot_tiles.insert(), [_tile_row(seq, ballot, tile) for tile in ballot.tiles])
    return Receipt(ballot.vehicle, ballot.drive, not standing, False, seq)


def _tile_row(seq: int, ballot: Ballot, tile: BallotTile) -> dict[str, Any]:
    return {
        "ballot": seq,
        "row": tile.tile[0],
        "col": tile.tile[1],
        "base": ballot.base[tile_key(tile.tile)],
        "states": tile.states,
        "tally": tile.tally,
        "gone": tile.gone,
        "new_points": tile.new_points,
        "free": tile.free,
    }
