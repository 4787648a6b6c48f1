"""What a ballot must be to be taken in: sound, its vehicle's own, on this map, and still about something."""

from __future__ import annotations

import hashlib
from collections.abc import Mapping, Sequence
from typing import NamedTuple

import sqlalchemy as sa

from mapvote.codec.ballot import Ballot, BallotTile, decode, tile_key, validate
from mapvote.core.grid import TileIndex
from mapvote.core.types import MapvoteError
from mapvote.fusion.fuse import rule_of
from mapvote.fusion.offline import staged, tile_vote
from mapvote.fusion.tile_vote import DAY_NS
from mapvote.server.errors import Conflict, Unauthorised
from mapvote.server.store import keys, schema
from mapvote.server.store.ballots import Incoming, Receipt, put_in, unlike
from mapvote.server.store.blobs import TileHashes, same_cells, unpack_points_plane
from mapvote.server.store.policy import policy_in
from mapvote.server.store.queries import current_number, load_blob, names, tiles_of
from mapvote.server.store.store import Store

MAX_CLOCK_AHEAD_NS = DAY_NS
"""A drive may end this much after the server's own time: clocks differ, but a vehicle from the future would make all
other votes look old."""
MAX_UNPACKED_BYTES = 512 << 20
"""All planes of one ballot together, decompressed: some ten kilometres of street."""


class Sent(NamedTuple):
    """What came by HTTP: a ballot's bytes, what its address says, and the hash of the key that it came with."""

    data: bytes
    vehicle: str
    drive: str
    key_hash: str | None


def examine(data: bytes) -> Incoming:
    """Decode a ballot and unpack every plane once; MapvoteError on the first defect. Touches no database."""
    ballot = decode(data)
    validate(ballot, MAX_UNPACKED_BYTES)
    if not ballot.tiles:
        raise MapvoteError("ballot: votes on no tile")
    rule_of(ballot.method)
    if any((tile.states is None) != (ballot.tiles[0].states is None) for tile in ballot.tiles):
        raise MapvoteError("ballot: some tiles hold states and some a tally; a ballot is either two-stage or one-stage")
    return Incoming(ballot, hashlib.sha256(data).hexdigest(), f"{ballot.method}, {staged(ballot)}", len(data))


class Intake:
    """Takes ballots into a store, in two steps that may run side by side; remembers the newest version's tiles."""

    def __init__(self, store: Store) -> None:
        self._store = store
        self._current: tuple[int, Mapping[TileIndex, TileHashes]] = (0, {})

    def look_at(self, received: Sequence[Sent]) -> list[Incoming | Exception]:
        """Everything but writing: each ballot, or why it is refused. Unavailable is raised for all.

        MapvoteError: unsound, or not what its address says. Unauthorised: its key is not valid. Conflict: see
        ``_misfits``.
        """
        found = [_sound(sent) for sent in received]
        with self._store.database.reading() as connection:
            asked = {sent.key_hash for sent in received if sent.key_hash is not None}
            valid = keys.of(connection, asked, self._store.clock())
            for i, sent in enumerate(received):
                if sent.key_hash is not None and sent.key_hash not in valid:
                    found[i] = Unauthorised(keys.UNKNOWN)
            sound = [incoming for incoming in found if isinstance(incoming, Incoming)]
            misfits = iter(self._misfits(connection, sound))
        return [next(misfits) or one if isinstance(one, Incoming) else one for one in found]

    def accept(self, ballots: Sequence[Incoming]) -> list[Receipt | Exception]:
        """Those that fit, written as by :meth:`write`; Conflict in the place of the others."""
        with self._store.database.reading() as connection:
            misfits = self._misfits(connection, ballots)
        fit = [ballot for ballot, misfit in zip(ballots, misfits, strict=True) if misfit is None]
        receipts = iter(self.write(fit))
        return [misfit or next(receipts) for misfit in misfits]

    def write(self, ballots: Sequence[Incoming]) -> list[Receipt | Exception]:
        """Store ballots in one durable transaction: a receipt, or Conflict where one votes by another method or other
        settings than the round. Unavailable is raised for all."""
        if not ballots:
            return []
        with self._store.database.writing() as connection:
            return put_in(connection, ballots, self._store.clock())

    def _misfits(self, connection: sa.Connection, ballots: Sequence[Incoming]) -> list[MapvoteError | None]:
        """Conflict for each ballot on another map, cast by other settings, with an unknown base or without a cell that
        still counts; MapvoteError for one from the future."""
        newest = current_number(connection)
        if newest != self._current[0]:
            self._current = newest, tiles_of(connection, newest)
        asked = policy_in(connection).round
        return [unlike(asked, ballot) or self._misfit(connection, ballot.ballot) for ballot in ballots]

    def _misfit(self, connection: sa.Connection, ballot: Ballot) -> MapvoteError | None:
        current = self._current[1]
        if ballot.map_id != self._store.map_id:
            return Conflict(f"this server keeps map {self._store.map_id!r}, the ballot votes on {ballot.map_id!r}")
        if ballot.end_ns > self._store.clock() + MAX_CLOCK_AHEAD_NS:
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
                counts = _counts_somewhere(self._store, connection, ballot, tile, base, now)
        if unknown:
            return Conflict(f"no version had the base of tile {names(unknown)}: fetch these tiles and vote again")
        if not counts:
            stale = names(tile.tile for tile in ballot.tiles)
            return Conflict(
                f"every cell voted on has changed since the ballot's base: fetch tiles {stale} and vote again"
            )
        return None


def accept(store: Store, ballots: Sequence[Incoming]) -> list[Receipt | Exception]:
    """:meth:`Intake.accept`, once."""
    return Intake(store).accept(ballots)


def _sound(sent: Sent) -> Incoming | Exception:
    try:
        incoming = examine(sent.data)
    except MapvoteError as error:
        return error
    theirs = incoming.ballot
    if (theirs.vehicle, theirs.drive) != (sent.vehicle, sent.drive):
        address = f"{sent.vehicle[:64]}/{sent.drive[:64]}"
        return MapvoteError(f"the ballot is of {theirs.vehicle}/{theirs.drive}, not {address}")
    return incoming


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
    same = same_cells(points[0], points[1], store.lattice.tile(tile.tile))
    return bool((tile_vote(ballot, tile, "").spoken() & same).any())
