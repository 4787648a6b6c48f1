"""Ballots in and out of the store: idempotent, one standing ballot per drive, nothing overwritten."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import sqlalchemy as sa

from mapvote.codec.ballot import Ballot, BallotTile, tile_key
from mapvote.core.types import MapvoteError
from mapvote.server.errors import Conflict, NotFound, Unauthorised
from mapvote.server.store import keys, schema
from mapvote.server.store.database import insert_rows
from mapvote.server.store.policy import RoundPolicy, policy_in
from mapvote.server.store.queries import log_event, next_seq
from mapvote.server.store.store import Store


@dataclass(frozen=True, slots=True)
class Incoming:
    """A ballot that is sound in itself."""

    ballot: Ballot
    digest: str
    cast_by: str
    """Method and stage: all ballots of a round agree on them."""
    size: int
    """Bytes."""
    key_hash: str | None = None
    """Of the key that it came with."""


@dataclass(frozen=True, slots=True)
class Receipt:
    """The answer to a stored ballot. ``created``: this drive had no standing ballot before."""

    vehicle: str
    drive: str
    created: bool
    repeated: bool
    """The very same ballot stood already: nothing was written."""
    seq: int


def put_in(connection: sa.Connection, ballots: Sequence[Incoming], now: int) -> list[Receipt | Exception]:
    """Write ballots within a transaction: a receipt each, or Conflict where one votes otherwise than the round,
    Unauthorised where its key was revoked since it was looked at."""
    b = schema.ballots
    asked_keys = {incoming.key_hash for incoming in ballots if incoming.key_hash is not None}
    valid = keys.of(connection, asked_keys, now)
    asked = policy_in(connection).round
    drives = sa.tuple_(b.c.vehicle, b.c.drive).in_({(i.ballot.vehicle, i.ballot.drive) for i in ballots})
    query = sa.select(b.c.vehicle, b.c.drive, b.c.seq, b.c.first_seq, b.c.gone_seq, b.c.digest).where(drives)
    first: dict[tuple[str, str], int] = {}
    standing: dict[tuple[str, str], tuple[int, str]] = {}
    for row in connection.execute(query.order_by(b.c.seq)):
        first.setdefault((row.vehicle, row.drive), row.first_seq)
        if row.gone_seq is None:
            standing[row.vehicle, row.drive] = row.seq, row.digest
    seq = next_seq(connection)
    results: list[Receipt | Exception] = []
    log: list[tuple[Any, ...]] = []
    rows: list[tuple[Any, ...]] = []
    tiles: list[tuple[Any, ...]] = []
    paths: list[tuple[Any, ...]] = []
    replaced: list[dict[str, int]] = []
    for incoming in ballots:
        ballot, key = incoming.ballot, (incoming.ballot.vehicle, incoming.ballot.drive)
        old = standing.get(key)
        if old is not None and old[1] == incoming.digest:
            results.append(Receipt(*key, created=False, repeated=True, seq=old[0]))
            continue
        why = unlike(asked, incoming)
        if incoming.key_hash is not None and incoming.key_hash not in valid:
            why = Unauthorised(keys.UNKNOWN)
        if why is not None:
            results.append(why)
            continue
        if old is not None:
            replaced.append({"old": old[0], "by": seq})
        first.setdefault(key, seq)
        standing[key] = seq, incoming.digest
        log.append((seq, now, "ballot", *key))
        times = ballot.start_ns, ballot.end_ns, now
        how = ballot.settings_hash[:128], incoming.cast_by, incoming.size, ballot.version
        rows.append((seq, first[key], None, *key, incoming.digest, *times, *how))
        tiles += [_tile_row(seq, ballot, tile) for tile in ballot.tiles]
        if ballot.path is not None:
            paths.append((seq, ballot.path))
        results.append(Receipt(*key, created=old is None, repeated=False, seq=seq))
        seq += 1
    if rows:
        insert_rows(connection, schema.events, log)
        insert_rows(connection, b, rows)
        insert_rows(connection, schema.ballot_tiles, tiles)
    if paths:
        insert_rows(connection, schema.paths, paths)
    if replaced:
        mark = b.update().where(b.c.seq == sa.bindparam("old")).values(gone_seq=sa.bindparam("by"))
        connection.execute(mark, replaced)
    return results


def unlike(asked: RoundPolicy, incoming: Incoming) -> MapvoteError | None:
    """Why a ballot does not fit the round that the policy asks for; None if it does."""
    settings = incoming.ballot.settings_hash
    if asked.cast_by == incoming.cast_by and settings.startswith(asked.settings_hash):
        return None
    theirs = f"{incoming.cast_by}, settings {settings[:16]}"
    ours = f"{asked.cast_by}, settings {asked.settings_hash[:16] or 'of any kind'}"
    mend = "vote again with the fleet's configuration (mapvote config)"
    return Conflict(f"this round votes by {ours}, the ballot by {theirs}: one round never mixes them; {mend}")


def _tile_row(seq: int, ballot: Ballot, tile: BallotTile) -> tuple[Any, ...]:
    """In the order of the table's columns."""
    planes = [getattr(tile, plane) for plane in schema.BALLOT_PLANES]
    return *tile.tile, seq, ballot.base[tile_key(tile.tile)], *planes


def withdraw(store: Store, vehicle: str | None, drive: str | None = None, *, by: str) -> int:
    """Un-vote before publication: one drive of a vehicle, or all, or (None) every vehicle's; how many ballots.

    NotFound if there is none. What earlier versions made of them stays: see
    :func:`mapvote.server.store.replay.replay`.
    """
    b = schema.ballots
    whose = f"{vehicle or '*'}/{drive or '*'}"
    mine: sa.ColumnElement[bool] = b.c.gone_seq.is_(None)
    if vehicle is not None:
        mine &= b.c.vehicle == vehicle
    if drive is not None:
        mine &= b.c.drive == drive
    with store.database.writing() as connection:
        if connection.execute(sa.select(b.c.seq).where(mine)).first() is None:
            raise NotFound(f"there is no standing ballot {whose}")
        seq = log_event(connection, store.clock(), "withdraw", by, whose)
        withdrawn = connection.execute(b.update().where(mine).values(gone_seq=seq)).rowcount
    return int(withdrawn)
