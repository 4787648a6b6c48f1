"""What a ballot must be to be taken in: sound, its vehicle's own, on this map, and still about something."""

from __future__ import annotations

import hashlib
from collections.abc import Mapping, Sequence
from dataclasses import replace
from functools import partial
from typing import NamedTuple

import sqlalchemy as sa

from mapvote.codec.ballot import Ballot, BallotTile, decode, tile_key, validate
from mapvote.core.grid import TileIndex
from mapvote.core.types import MapvoteError
from mapvote.fusion.fuse import rule_of
from mapvote.fusion.offline import staged, tile_vote
from mapvote.server.errors import Conflict, Unauthorised
from mapvote.server.store import keys, schema
from mapvote.server.store.ballots import Incoming, Receipt, put_in, unlike
from mapvote.server.store.blobs import TileHashes
from mapvote.server.store.policy import policy_in
from mapvote.server.store.queries import (
    current_number,
    load_memory,
    memory_of,
    names,
    tile_of,
    tiles_of,
    tiles_set_between,
)
from mapvote.server.store.quotas import Quota, Quotas
from mapvote.server.store.reach import LowestGround, refuse_out_of_height, refuse_out_of_reach
from mapvote.server.store.store import Store

MAX_CLOCK_AHEAD_NS = 300 * 10**9
"""A drive may end this much after the server's own time: clocks differ, but a vehicle from the future would make all
other votes look old."""
MAX_UNPACKED_BYTES = 512 << 20
"""All planes of one ballot together, decompressed: some ten kilometres of street."""

MIN_SCANS = 3
"""Fewer localised scans found no ballot: their place was never confirmed by others."""
MAX_MISFIT_SIGMAS = 3.0
MISFIT_SLACK_M = 1.0
"""A drive whose fixes lie steadily farther off its priors is held back: its clock, its GNSS or its place is wrong."""


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
    _check_founded(ballot)
    rule_of(ballot.method)
    if any((tile.states is None) != (ballot.tiles[0].states is None) for tile in ballot.tiles):
        raise MapvoteError("ballot: some tiles hold states and some a tally; a ballot is either two-stage or one-stage")
    return Incoming(ballot, hashlib.sha256(data).hexdigest(), f"{ballot.method}, {staged(ballot)}", len(data))


def _check_founded(ballot: Ballot) -> None:
    if ballot.scans_localised < MIN_SCANS:
        raise MapvoteError(
            f"ballot: only {ballot.scans_localised} of {ballot.scans} scans were localised, {MIN_SCANS} are needed; "
            "drive farther on the map"
        )
    if ballot.prior_misfit_m is None or ballot.prior_sigma_m is None:
        return
    allowed = MAX_MISFIT_SIGMAS * ballot.prior_sigma_m + MISFIT_SLACK_M
    if ballot.prior_misfit_m > allowed:
        raise MapvoteError(
            f"ballot held back: fixes and priors of {ballot.vehicle}/{ballot.drive} lie {ballot.prior_misfit_m:.1f} m "
            f"apart (median), the priors claim {ballot.prior_sigma_m:.2f} m; check the vehicle's clock and GNSS, state "
            "its true sigma, or vote without a prior (--prior none)"
        )


class Intake:
    """Takes ballots into a store, in two steps that may run side by side; remembers the newest version's tiles.

    ``quota``: what one vehicle may leave in the store; None: as much as it likes.
    """

    def __init__(self, store: Store, quota: Quota | None = None) -> None:
        self._store = store
        self._quotas = None if quota is None else Quotas(quota)
        self._current: tuple[int, Mapping[TileIndex, TileHashes]] = (0, {})
        self._lowest = LowestGround()

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
        still counts; MapvoteError for one from the future or from where its vehicle cannot have been, TooMany for more
        than its vehicle's quota."""
        newest = current_number(connection)
        self._current = newest, _brought_up(connection, newest, *self._current)
        asked, repeated = policy_in(connection).round, _standing(connection, ballots)
        return [
            None
            if one.digest in repeated
            else unlike(asked, one) or self._misfit(connection, one.ballot) or self._too_much(connection, one)
            for one in ballots
        ]

    def _too_much(self, connection: sa.Connection, one: Incoming) -> MapvoteError | None:
        return None if self._quotas is None else self._quotas.refusal(connection, one, self._store.clock())

    def _misfit(self, connection: sa.Connection, ballot: Ballot) -> MapvoteError | None:
        current = self._current[1]
        if ballot.map_id != self._store.map_id:
            return Conflict(f"this server keeps map {self._store.map_id!r}, the ballot votes on {ballot.map_id!r}")
        impossible = self._wrong_time(ballot) or refuse_out_of_reach(ballot, current.keys())
        impossible = impossible or refuse_out_of_height(ballot, current, partial(self._lowest.look_up, connection))
        if impossible is not None:
            return impossible
        version = ballot.version
        if version > self._current[0]:
            return Conflict(f"there is no version {version} yet; the newest is {self._current[0]}: fetch it")
        counts = False
        for tile in ballot.tiles:
            base, now = ballot.base[tile_key(tile.tile)], current.get(tile.tile)
            then = now if version == self._current[0] else tile_of(connection, version, tile.tile)
            if base != ("" if then is None else then.points):
                known = f"the base of tile {tile_key(tile.tile)} is not that of version {version}"
                return Conflict(f"{known}: fetch the map and vote again")
            counts = counts or _counts_somewhere(connection, ballot, tile, version, now)
        if not counts:
            stale = names(tile.tile for tile in ballot.tiles)
            return Conflict(
                f"every cell voted on has changed since version {version}: fetch tiles {stale} and vote again"
            )
        return None

    def _wrong_time(self, ballot: Ballot) -> MapvoteError | None:
        if ballot.end_ns > self._store.clock() + MAX_CLOCK_AHEAD_NS:
            return MapvoteError("ballot: the drive ends in the future; set the vehicle's clock")
        if self._store.surveyed_ns is not None and ballot.end_ns < self._store.surveyed_ns:
            return MapvoteError("ballot: the drive ended before the map was surveyed; set the vehicle's clock")
        return None


def _brought_up(
    connection: sa.Connection, number: int, known: int, tiles: Mapping[TileIndex, TileHashes]
) -> Mapping[TileIndex, TileHashes]:
    """The tiles of a version, of those of an older one (0: none) and what was set since."""
    if number == known:
        return tiles
    if known == 0:
        return tiles_of(connection, number)
    touched = tiles_set_between(connection, known, number)
    changed = set(touched)
    kept = {index: hashes for index, hashes in tiles.items() if index not in changed}
    return kept | tiles_of(connection, number, touched)


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
    return replace(incoming, key_hash=sent.key_hash)


def _standing(connection: sa.Connection, ballots: Sequence[Incoming]) -> set[str]:
    """Which of these stand already: sending again is harmless, whatever became of the votes."""
    b = schema.ballots
    drives = sa.tuple_(b.c.vehicle, b.c.drive).in_({(one.ballot.vehicle, one.ballot.drive) for one in ballots})
    return set(connection.execute(sa.select(b.c.digest).where(drives, b.c.gone_seq.is_(None))).scalars())


def _counts_somewhere(
    connection: sa.Connection, ballot: Ballot, tile: BallotTile, version: int, now: TileHashes | None
) -> bool:
    """Whether there is a cell that the ballot speaks of and that has not changed since."""
    memory = None
    if now is None:
        memory = memory_of(connection, (1 << 31) - 1, tile.tile)
    elif now.memory is not None:
        memory = load_memory(connection, now.memory)
    if memory is None or not len(memory.changed_after(version)):
        return True
    return bool((tile_vote(ballot, tile, "").spoken() & (memory.changed <= version)).any())
