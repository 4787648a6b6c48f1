"""Ballots in and out of the store: idempotent, one standing ballot per drive, nothing overwritten."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, field
from typing import Any, NamedTuple

import sqlalchemy as sa

from mapvote.codec.ballot import Ballot, BallotTile, tile_key
from mapvote.core.grid import TileIndex
from mapvote.core.types import MapvoteError
from mapvote.server.errors import NotFound
from mapvote.server.store import schema
from mapvote.server.store.database import insert_rows
from mapvote.server.store.queries import log_event, next_seq
from mapvote.server.store.store import Store


class Votes(NamedTuple):
    """The facts about a ballot's votes on one tile that admission needs. The unpacked planes are not kept."""

    tile: TileIndex
    spoken: bytes
    """The cells that it votes on: 65536 bits, row by row."""
    lowest_m: float | None
    """Height of its lowest new point, map metres; None: it brings none."""
    highest_m: float | None


@dataclass(frozen=True, slots=True)
class Incoming:
    """A ballot that is sound in itself."""

    ballot: Ballot
    votes: Sequence[Votes]
    """The votes on each of its tiles."""
    digest: str
    """SHA-256 of the bytes that the vehicle sent."""
    cast_by: str
    """Method and stage: all ballots of a round agree on them."""
    size: int
    """Bytes."""
    key_hash: str | None = None
    """Hash of the key that sent the ballot."""

    @property
    def drive(self) -> tuple[str, str]:
        """(vehicle, drive)."""
        return self.ballot.vehicle, self.ballot.drive


@dataclass(frozen=True, slots=True)
class Receipt:
    """The answer to a stored ballot. ``created``: this drive had no standing ballot before."""

    vehicle: str
    drive: str
    created: bool
    repeated: bool
    """The identical ballot was stored already: nothing was written."""
    seq: int


def write_ballots(
    connection: sa.Connection,
    ballots: Sequence[Incoming],
    now: int,
    refusal: Callable[[Incoming], MapvoteError | None],
) -> list[Receipt | MapvoteError]:
    """Write ballots within a transaction. Returns for each a receipt, or the error with which ``refusal`` rejects it. A
    ballot that is stored already is not judged again, so a vehicle that got no answer may send it again."""
    first, standing = _heard_of(connection, ballots)
    seq, rows = next_seq(connection), _Rows()
    results: list[Receipt | MapvoteError] = []
    for incoming in ballots:
        old = standing.get(incoming.drive)
        if old is not None and old[1] == incoming.digest:
            results.append(Receipt(*incoming.drive, created=False, repeated=True, seq=old[0]))
            continue
        why = refusal(incoming)
        if why is not None:
            results.append(why)
            continue
        first.setdefault(incoming.drive, seq)
        rows.add(incoming, seq, first[incoming.drive], now, None if old is None else old[0])
        standing[incoming.drive] = seq, incoming.digest
        results.append(Receipt(*incoming.drive, created=old is None, repeated=False, seq=seq))
        seq += 1
    rows.insert(connection)
    return results


def _heard_of(
    connection: sa.Connection, ballots: Sequence[Incoming]
) -> tuple[dict[tuple[str, str], int], dict[tuple[str, str], tuple[int, str]]]:
    """For the drives of these ballots: ({drive: its first event}, {drive: (number, digest) of its standing ballot})."""
    b = schema.ballots
    drives = sa.tuple_(b.c.vehicle, b.c.drive).in_({incoming.drive for incoming in ballots})
    query = sa.select(b.c.vehicle, b.c.drive, b.c.seq, b.c.first_seq, b.c.gone_seq, b.c.digest).where(drives)
    first: dict[tuple[str, str], int] = {}
    standing: dict[tuple[str, str], tuple[int, str]] = {}
    for row in connection.execute(query.order_by(b.c.seq)):
        first.setdefault((row.vehicle, row.drive), row.first_seq)
        if row.gone_seq is None:
            standing[row.vehicle, row.drive] = row.seq, row.digest
    return first, standing


@dataclass(slots=True)
class _Rows:
    """The rows of several ballots, each in the order of its table's columns."""

    log: list[tuple[Any, ...]] = field(default_factory=list)
    ballots: list[tuple[Any, ...]] = field(default_factory=list)
    tiles: list[tuple[Any, ...]] = field(default_factory=list)
    paths: list[tuple[Any, ...]] = field(default_factory=list)
    replaced: list[dict[str, int]] = field(default_factory=list)

    def add(self, incoming: Incoming, seq: int, first_seq: int, now: int, old: int | None) -> None:
        """A ballot that replaces ``old``, if there is one."""
        ballot = incoming.ballot
        self.log.append((seq, now, "ballot", *incoming.drive))
        times = ballot.start_ns, ballot.end_ns, now
        how = ballot.settings_hash[:128], incoming.cast_by, incoming.size, ballot.version
        self.ballots.append((seq, first_seq, None, *incoming.drive, incoming.digest, *times, *how))
        self.tiles += [_tile_row(seq, ballot, tile) for tile in ballot.tiles]
        if ballot.path is not None:
            self.paths.append((seq, ballot.path))
        if old is not None:
            self.replaced.append({"old": old, "by": seq})

    def insert(self, connection: sa.Connection) -> None:
        b = schema.ballots
        for table, rows in (
            (schema.events, self.log), (b, self.ballots), (schema.ballot_tiles, self.tiles), (schema.paths, self.paths)
        ):  # fmt: skip
            if rows:
                insert_rows(connection, table, rows)
        if self.replaced:
            mark = b.update().where(b.c.seq == sa.bindparam("old")).values(gone_seq=sa.bindparam("by"))
            connection.execute(mark, self.replaced)


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
