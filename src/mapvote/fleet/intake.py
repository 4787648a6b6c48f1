"""Ballots in and out of the store: idempotent, one standing ballot per drive, nothing overwritten (DESIGN 4)."""

from __future__ import annotations

import hashlib
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import sqlalchemy as sa

from mapvote.core.ballot import Ballot, BallotTile, decode, tile_key, validate
from mapvote.core.grid import TileIndex, tile_grid
from mapvote.core.types import MapvoteError
from mapvote.fleet import keys, schema
from mapvote.fleet.content import TileHashes, same_cells, unpack_points_plane
from mapvote.fleet.database import insert_rows
from mapvote.fleet.errors import Conflict, NotFound, Unauthorised
from mapvote.fleet.fuse import DAY_NS
from mapvote.fleet.store import Store, current_number, load_blob, log_event, names, next_seq, tiles_of
from mapvote.fleet.update import rule_of, staged, tile_vote

MAX_CLOCK_AHEAD_NS = DAY_NS
"""A drive may end this much after the server's own time: clocks differ, but a vehicle from the future would make all
other votes look old."""
MAX_UNPACKED_BYTES = 512 << 20
"""All planes of one ballot together, decompressed: some ten kilometres of street."""


@dataclass(frozen=True, slots=True)
class Incoming:
    """A ballot that is sound in itself, ready to be stored."""

    ballot: Ballot
    digest: str
    cast_by: str
    """Method, stage and settings: all ballots of a round agree on them."""
    key_hash: str | None = None
    """Of the key that it came with; None where no key is needed."""


@dataclass(frozen=True, slots=True)
class Receipt:
    """The answer to a stored ballot. ``created``: this drive had no standing ballot before."""

    vehicle: str
    drive: str
    created: bool
    repeated: bool
    """The very same ballot stood already: nothing was written."""
    seq: int


def examine(data: bytes, key_hash: str | None = None) -> Incoming:
    """Decode a ballot and unpack every plane once; MapvoteError on the first defect. Touches no database."""
    ballot = decode(data)
    validate(ballot, MAX_UNPACKED_BYTES)
    if not ballot.tiles:
        raise MapvoteError("ballot: votes on no tile")
    rule_of(ballot.method)
    if any((tile.states is None) != (ballot.tiles[0].states is None) for tile in ballot.tiles):
        raise MapvoteError("ballot: some tiles hold states and some a tally; a ballot is either two-stage or one-stage")
    cast_by = f"{ballot.method}, {staged(ballot)}, settings {ballot.settings_hash[:32]}"
    return Incoming(ballot, hashlib.sha256(data).hexdigest(), cast_by, key_hash)


def examine_all(received: Sequence[tuple[bytes, str | None]]) -> list[Incoming | Exception]:
    """:func:`examine` for each; what was wrong in the place of one that is unsound."""
    found: list[Incoming | Exception] = []
    for data, key_hash in received:
        try:
            found.append(examine(data, key_hash))
        except MapvoteError as error:
            found.append(error)
    return found


class Intake:
    """Takes ballots into a store; remembers the newest version's tiles, which never change.

    ``settings_hash``: refuse ballots cast by other settings; without it the first ballot of a round decides.
    """

    def __init__(self, store: Store, settings_hash: str = "") -> None:
        self._store = store
        self._settings_hash = settings_hash
        self._current: tuple[int, Mapping[TileIndex, TileHashes]] = (0, {})

    def accept(self, ballots: Sequence[Incoming]) -> list[Receipt | Exception]:
        """Store ballots in one durable transaction, each on its own merits: a receipt, or why it was refused.

        Unauthorised: its key was revoked meanwhile. Conflict: other map, method or settings, unknown base, or no cell
        counts any more. Unavailable is raised for all.
        """
        store, results = self._store, list[Receipt | Exception | None]()
        with store.database.reading() as connection:
            newest = current_number(connection)
            if newest != self._current[0]:
                self._current = newest, tiles_of(connection, newest)
            valid = keys.of(connection, {ballot.key_hash for ballot in ballots if ballot.key_hash is not None})
            for ballot in ballots:
                if ballot.key_hash is not None and ballot.key_hash not in valid:
                    results.append(Unauthorised(keys.UNKNOWN))
                elif not ballot.ballot.settings_hash.startswith(self._settings_hash):
                    ours, theirs = self._settings_hash[:16], ballot.ballot.settings_hash[:16]
                    why = f"this server's fleet votes by settings {ours}, the ballot was cast by {theirs}"
                    results.append(Conflict(f"{why}: vote again with the fleet's configuration (mapvote config)"))
                else:
                    results.append(_refusal(store, connection, ballot, self._current[1]))
        sound = [i for i, error in enumerate(results) if error is None]
        if sound:
            with store.database.writing() as connection:
                receipts = _insert(connection, [ballots[i] for i in sound], store.clock())
            for i, receipt in zip(sound, receipts, strict=True):
                results[i] = receipt
        return [result for result in results if result is not None]


def accept(store: Store, ballots: Sequence[Incoming]) -> list[Receipt | Exception]:
    """:meth:`Intake.accept`, once."""
    return Intake(store).accept(ballots)


def withdraw(store: Store, vehicle: str | None, drive: str | None = None, *, by: str) -> int:
    """Un-vote before publication: one drive of a vehicle, or all, or (None) every vehicle's; how many ballots.

    Once no ballot stands a new round begins, which may vote by another method or other settings.
    NotFound if there is none. What earlier versions made of them stays: see :func:`mapvote.fleet.publish.replay`.
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
        if connection.execute(sa.select(b.c.seq).where(b.c.gone_seq.is_(None)).limit(1)).first() is None:
            connection.execute(schema.maps.update().values(method=None))
    return int(withdrawn)


def _refusal(
    store: Store, connection: sa.Connection, incoming: Incoming, current: Mapping[TileIndex, TileHashes]
) -> MapvoteError | None:
    ballot = incoming.ballot
    if ballot.map_id != store.map_id:
        return Conflict(f"this server keeps map {store.map_id!r}, the ballot votes on {ballot.map_id!r}")
    if ballot.end_ns > store.clock() + MAX_CLOCK_AHEAD_NS:
        return MapvoteError("ballot: the drive ends in the future; set the vehicle's clock")
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


def _insert(connection: sa.Connection, ballots: Sequence[Incoming], now: int) -> list[Receipt | Exception]:
    b = schema.ballots
    method = agreed = connection.execute(sa.select(schema.maps.c.method)).scalar_one()
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
    replaced: list[dict[str, int]] = []
    for incoming in ballots:
        ballot, key = incoming.ballot, (incoming.ballot.vehicle, incoming.ballot.drive)
        method = method or incoming.cast_by
        if method != incoming.cast_by:
            theirs = f"this round votes by {method}, the ballot by {incoming.cast_by}"
            mend = "vote again as the round does, or ask the operator for a new one (mapvote unvote STORE --all)"
            results.append(Conflict(f"{theirs}: one round never mixes methods or settings; {mend}"))
            continue
        old = standing.get(key)
        if old is not None and old[1] == incoming.digest:
            results.append(Receipt(*key, created=False, repeated=True, seq=old[0]))
            continue
        if old is not None:
            replaced.append({"old": old[0], "by": seq})
        first.setdefault(key, seq)
        standing[key] = seq, incoming.digest
        log.append((seq, now, "ballot", *key))
        times = ballot.start_ns, ballot.end_ns, now
        rows.append((seq, first[key], None, *key, incoming.digest, *times, ballot.settings_hash[:128]))
        tiles += [_tile_row(seq, ballot, tile) for tile in ballot.tiles]
        results.append(Receipt(*key, created=old is None, repeated=False, seq=seq))
        seq += 1
    if rows:
        insert_rows(connection, schema.events, log)
        insert_rows(connection, b, rows)
        insert_rows(connection, schema.ballot_tiles, tiles)
    if replaced:
        mark = b.update().where(b.c.seq == sa.bindparam("old")).values(gone_seq=sa.bindparam("by"))
        connection.execute(mark, replaced)
    if method != agreed:
        connection.execute(schema.maps.update().values(method=method))
    return results


def _tile_row(seq: int, ballot: Ballot, tile: BallotTile) -> tuple[Any, ...]:
    """In the order of the table's columns."""
    base = ballot.base[tile_key(tile.tile)]
    return *tile.tile, seq, base, tile.states, tile.tally, tile.gone, tile.new_points, tile.free
