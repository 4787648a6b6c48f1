"""Admission of ballots. :func:`examine` decodes a ballot and unpacks its planes, beside others and without a database.
:class:`Intake` checks it against the map, the policy and the quota of its vehicle, within the transaction that writes
it: idempotent, one standing ballot per drive, nothing overwritten.

Where a vehicle can have been is checked too: near the map, on one path, at heights that the map allows.
"""

from __future__ import annotations

import hashlib
from collections import defaultdict
from collections.abc import Collection, Sequence
from dataclasses import dataclass, field
from typing import Any, Literal

import numpy as np
import sqlalchemy as sa

from mapvote.codec.ballot import Ballot, BallotTile, Planes, check_path, decode, tile_key, unpack_planes
from mapvote.codec.manifest import TileHashes
from mapvote.codec.tile_planes import unpack_ground_plane
from mapvote.core.grid import CELL_SIZE, TILE_CELLS, TileIndex
from mapvote.core.types import F64, Bool, MapvoteError
from mapvote.fusion.tile_vote import DAY_NS
from mapvote_server.errors import Conflict, TooMany, Unauthorised, Unavailable
from mapvote_server.store import keys, schema
from mapvote_server.store.database import insert_rows, remembered, sum_of
from mapvote_server.store.policy import RoundPolicy, policy_in
from mapvote_server.store.queries import (
    load_blob,
    load_memory,
    memory_of,
    names,
    tile_of,
    tiles_of,
    tiles_set_between,
)
from mapvote_server.store.store import Store

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


@dataclass(frozen=True, slots=True)
class Votes:
    """What admission needs of a ballot's votes on one tile."""

    tile: TileIndex
    spoken: bytes
    """The cells that it votes on: 65536 bits, row by row."""
    heights_m: tuple[float, float] | None
    """Of its lowest and highest new point, map metres; None: it brings none."""
    stored: tuple[Any, ...] = field(repr=False)
    """Base, planes and sum, as the last columns of ``ballot_tiles``."""


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
    """Hash of the key that sent the ballot; None: a client of this machine that needs none."""

    @property
    def drive(self) -> tuple[str, str]:
        """(vehicle, drive)."""
        return self.ballot.vehicle, self.ballot.drive


@dataclass(frozen=True, slots=True)
class Receipt:
    """A ballot is on disk."""

    vehicle: str
    drive: str
    result: Literal["created", "replaced", "repeated"]
    """``replaced``: this drive had a standing ballot before. ``repeated``: the identical one stood already, nothing was
    written."""
    seq: int
    """Its number in the log."""


def examine(data: bytes, drive: tuple[str, str] | None = None, key_hash: str | None = None) -> Incoming:
    """Decode a ballot and unpack every plane, once; MapvoteError on the first defect, or if it is of another ``drive``
    (vehicle, drive) than its URL. The key is not checked."""
    ballot = decode(data)
    if not ballot.tiles:
        raise MapvoteError("ballot: votes on no tile")
    _check_founded(ballot)
    if any((tile.states is None) != (ballot.tiles[0].states is None) for tile in ballot.tiles):
        raise MapvoteError("ballot: some tiles hold states and some a tally; a ballot is either two-stage or one-stage")
    if ballot.path is not None:
        check_path(ballot.path, [tile.tile for tile in ballot.tiles])
    votes, size = [], 0
    for tile in ballot.tiles:
        planes = unpack_planes(tile)
        size += planes.nbytes
        if size > MAX_UNPACKED_BYTES:
            raise MapvoteError(
                f"ballot: larger than {MAX_UNPACKED_BYTES} bytes when decompressed; send a shorter drive"
            )
        votes.append(_votes_of(tile, ballot.base[tile_key(tile.tile)], planes))
    cast_by = f"{ballot.method}, {ballot.stage}"
    incoming = Incoming(ballot, votes, hashlib.sha256(data).hexdigest(), cast_by, len(data), key_hash)
    if drive not in (None, incoming.drive):
        raise MapvoteError(f"the ballot is of {'/'.join(incoming.drive)}, not {drive[0][:64]}/{drive[1][:64]}")
    return incoming


def _votes_of(tile: BallotTile, base: str, planes: Planes) -> Votes:
    packed = base, *(getattr(tile, plane) for plane in schema.BALLOT_PLANES)
    digest = sum_of(*packed)
    remembered.put(digest, planes)
    z = () if planes.new_points is None else planes.new_points[:, 2]
    heights = (float(np.min(z)), float(np.max(z))) if len(z) else None
    return Votes(tile.tile, np.packbits(planes.spoken()).tobytes(), heights, (*packed, digest))


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
    """Admits ballots to a store, one batch at a time. ``quota``: what one vehicle may leave there; None: no limit."""

    def __init__(self, store: Store, quota: Quota | None = None) -> None:
        self._store, self._quota = store, quota
        self._used: dict[str, _Used] = {}
        self._newest, self._tiles = 0, dict[TileIndex, TileHashes]()
        """The newest version, and its tiles."""
        self._policy, self._asked, self._cast_by = 0, RoundPolicy(), ""
        """Number of the policy, and what it asks of a round's ballots."""
        self._lowest_m: dict[str, float] = {}
        """Lowest ground of a tile, by its plane's hash."""

    def write(self, ballots: Sequence[Incoming]) -> list[Receipt | MapvoteError]:
        """Store the ballots that are admitted, in one durable transaction: for each a receipt, or why not.

        Conflict: another map, method, settings or base than the store's, or no cell that still counts. Unauthorised:
        its key was revoked meanwhile. TooMany: beyond its vehicle's quota. MapvoteError: from the future, or from where
        its vehicle cannot have been. Unavailable is raised for all. A ballot that is stored already is not judged
        again, so a vehicle that got no answer may send it again.
        """
        if not ballots:
            return []
        now = self._store.clock()
        results: list[Receipt | MapvoteError] = []
        replaced: list[dict[str, int]] = []
        with self._store.database.writing() as connection:
            newest, policy, seq = connection.execute(_HEAD).one()
            self._catch_up(connection, newest, policy)
            came_with = {ballot.key_hash for ballot in ballots if ballot.key_hash is not None}
            valid = keys.of(connection, came_with, now) if came_with else {}
            first, standing = _heard_of(connection, ballots)
            rows: Rows = defaultdict(list)
            for one in ballots:
                old, old_digest = standing.get(one.drive, (None, ""))
                if old is not None and old_digest == one.digest:
                    results.append(Receipt(*one.drive, "repeated", old))
                    continue
                known = one.key_hash is None or one.key_hash in valid
                why = self._refusal(connection, one, now) if known else Unauthorised(keys.UNKNOWN)
                if why is not None:
                    results.append(why)
                    continue
                seq += 1
                _enter(rows, one, seq, first.setdefault(one.drive, seq), now)
                if old is not None:
                    replaced.append({"old": old, "by": seq})
                standing[one.drive] = seq, one.digest
                results.append(Receipt(*one.drive, "created" if old is None else "replaced", seq))
            for table, some in rows.items():
                insert_rows(connection, table, some)
            if replaced:
                connection.execute(_REPLACED, replaced)
        return results

    def _catch_up(self, connection: sa.Connection, newest: int, policy: int) -> None:
        """Read what has changed of the map and the policy since the last ballots."""
        if policy != self._policy:
            self._policy, self._asked = policy, policy_in(connection).round
            self._cast_by = self._asked.cast_by
        if newest != self._newest:
            touched = tiles_set_between(connection, self._newest, newest) if self._newest else None
            for index in touched or ():
                self._tiles.pop(index, None)
            self._tiles |= tiles_of(connection, newest, touched)
            self._newest = newest

    def _refusal(self, connection: sa.Connection, one: Incoming, now: int) -> MapvoteError | None:
        """Why a ballot does not fit the round, the map as it is, or its vehicle's quota; None if it does."""
        ballot, newest, asked = one.ballot, self._newest, self._asked
        mend = "Vote again with the fleet's configuration (mapvote config)"
        if self._cast_by != one.cast_by:
            accepted = f"the current round accepts only {self._cast_by}"
            return Conflict(f"This ballot uses method {one.cast_by}; {accepted}. {mend}")
        if not ballot.settings_hash.startswith(asked.settings_hash):
            accepted = f"the current round accepts only {asked.settings_hash[:16]}"
            return Conflict(f"This ballot uses settings {ballot.settings_hash[:16]}; {accepted}. {mend}")
        if ballot.map_id != self._store.map_id:
            return Conflict(f"this server keeps map {self._store.map_id!r}, the ballot votes on {ballot.map_id!r}")
        impossible = self._wrong_time(ballot, now) or refuse_out_of_reach(one.votes, self._tiles.keys())
        impossible = impossible or self._out_of_height(connection, one.votes)
        if impossible is not None:
            return impossible
        if ballot.version > newest:
            return Conflict(f"there is no version {ballot.version} yet; the newest is {newest}: fetch it")
        counts = ballot.version == newest
        for votes in one.votes:
            now_there = self._tiles.get(votes.tile)
            then = now_there if ballot.version == newest else tile_of(connection, ballot.version, votes.tile)
            if ballot.base[tile_key(votes.tile)] != ("" if then is None else then.points):
                known = f"the base of tile {tile_key(votes.tile)} is not that of version {ballot.version}"
                return Conflict(f"{known}: fetch the map and vote again")
            counts = counts or _counts_somewhere(connection, votes, ballot.version, now_there)
        if not counts:
            stale = names(votes.tile for votes in one.votes)
            return Conflict(
                f"every cell voted on has changed since version {ballot.version}: fetch tiles {stale} and vote again"
            )
        return None if self._quota is None else self._over_quota(connection, one, now, self._quota)

    def _wrong_time(self, ballot: Ballot, now: int) -> MapvoteError | None:
        if ballot.end_ns > now + MAX_CLOCK_AHEAD_NS:
            return MapvoteError("ballot: the drive ends in the future; set the vehicle's clock")
        if self._store.surveyed_ns is not None and ballot.end_ns < self._store.surveyed_ns:
            return MapvoteError("ballot: the drive ended before the map was surveyed; set the vehicle's clock")
        return None

    def _out_of_height(self, connection: sa.Connection, votes: Sequence[Votes]) -> MapvoteError | None:
        """Why a ballot brings points deeper or higher than anything on this map can be; None if it may.

        The nearest tiles tell: itself and its neighbours, else those in reach.
        """
        for one in votes:
            if one.heights_m is None:
                continue
            low, high = one.heights_m
            near = _touched(one.tile, self._tiles) or [index for index in _around(one.tile) if index in self._tiles]
            ground_m = min((self._ground_m(connection, self._tiles[index].ground) for index in near), default=np.inf)
            if np.isfinite(ground_m) and not ground_m - MAX_BELOW_M <= low <= high <= ground_m + MAX_ABOVE_M:
                span = f"{low:.1f} to {high:.1f} m on tile {tile_key(one.tile)}"
                below = f"{MAX_BELOW_M:g} m below to {MAX_ABOVE_M:g} m above the map's lowest ground there"
                return MapvoteError(
                    f"new points at {span} are not within {below}, {ground_m:.1f} m: is the vehicle on this level?"
                )
        return None

    def _ground_m(self, connection: sa.Connection, ground: str) -> float:
        """The lowest ground of a plane, map metres; inf where it is unknown, or its plane damaged."""
        if ground not in self._lowest_m:
            try:
                plane = unpack_ground_plane(load_blob(connection, ground), ground)
            except MapvoteError:
                return np.inf
            self._lowest_m[ground] = float(plane[np.isfinite(plane)].min(initial=np.inf))
        return self._lowest_m[ground]

    def _over_quota(self, connection: sa.Connection, one: Incoming, now: int, quota: Quota) -> MapvoteError | None:
        """Why a ballot is too much of its vehicle; None lets it through and counts it. What a vehicle has used is
        counted in the store once an hour and before a refusal, in between from what was let through."""
        vehicle, tiles = one.ballot.vehicle, len(one.ballot.tiles)
        if tiles > quota.tiles_a_drive:
            limit = f"the drive votes on {tiles} tiles, the limit is {quota.tiles_a_drive}"
            return MapvoteError(f"{limit}: send each part of it as a drive of its own")
        used = self._used.get(vehicle)
        if used is None or used.since_ns < now - _COUNTED_AGAIN_NS or _exceeded(quota, used, one) is not None:
            used = self._used[vehicle] = _count(connection, vehicle, now)
        why = _exceeded(quota, used, one)
        if why is None:
            used.ballots, used.size = used.ballots + 1, used.size + one.size
        return why


_HEAD = sa.select(
    sa.select(sa.func.max(schema.versions.c.number)).scalar_subquery(),
    sa.select(sa.func.max(schema.policies.c.seq)).scalar_subquery(),
    sa.select(sa.func.max(schema.events.c.seq)).scalar_subquery(),
)
"""The newest version, policy and event."""


_REPLACED = schema.ballots.update().where(schema.ballots.c.seq == sa.bindparam("old"))
_REPLACED = _REPLACED.values(gone_seq=sa.bindparam("by"))


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


Rows = dict[sa.Table, list[tuple[Any, ...]]]
"""Rows to insert, each in the order of its table's columns."""


def _enter(rows: Rows, incoming: Incoming, seq: int, first_seq: int, now: int) -> None:
    """Add those of a ballot."""
    ballot = incoming.ballot
    rows[schema.events].append((seq, now, "ballot", *incoming.drive))
    times = ballot.start_ns, ballot.end_ns, now
    how = ballot.settings_hash[:128], incoming.cast_by, incoming.size, ballot.version
    rows[schema.ballots].append((seq, first_seq, None, *incoming.drive, incoming.digest, *times, *how))
    rows[schema.ballot_tiles] += [(*votes.tile, seq, *votes.stored) for votes in incoming.votes]
    if ballot.path is not None:
        rows[schema.paths].append((seq, ballot.path))


def _counts_somewhere(connection: sa.Connection, votes: Votes, version: int, now: TileHashes | None) -> bool:
    """Whether a ballot determines a cell that has not changed since ``version``.

    If the memory of the tile is damaged this is unknown: the votes are admitted and wait until the plane is restored.
    """
    try:
        if now is None:
            memory = memory_of(connection, (1 << 31) - 1, votes.tile)
        else:
            memory = None if now.memory is None else load_memory(connection, now.memory)
    except Unavailable:
        raise
    except MapvoteError:
        return True
    if memory is None or not len(memory.changed_after(version)):
        return True
    return bool((_cells(votes.spoken) & (memory.changed <= version)).any())


def _cells(spoken: bytes) -> Bool:
    """(256, 256) bool."""
    bits = np.unpackbits(np.frombuffer(spoken, dtype=np.uint8))
    return bits.astype(np.bool_).reshape(TILE_CELLS, TILE_CELLS)


_COUNTED_AGAIN_NS = DAY_NS // 24


@dataclass(frozen=True, slots=True)
class Quota:
    """The quota of one vehicle."""

    drives_a_day: int
    """Ballots in 24 hours; one that replaces another counts too."""
    tiles_a_drive: int
    stored_bytes: int
    """All its ballots together, those that were replaced or withdrawn too, until they are cleared away."""


@dataclass(slots=True)
class _Used:
    since_ns: int
    ballots: int
    size: int


def _exceeded(quota: Quota, used: _Used, one: Incoming) -> TooMany | None:
    vehicle = one.ballot.vehicle
    if used.ballots >= quota.drives_a_day:
        said = f"{vehicle!r} has sent {used.ballots} drives in 24 hours, its limit: try again tomorrow"
        return TooMany(said, _COUNTED_AGAIN_NS / 1e9)
    if used.size + one.size > quota.stored_bytes:
        full = f"the ballots of {vehicle!r} would take more than {quota.stored_bytes:,} bytes in the store"
        mend = "ask the operator to clear old ones away, or for a larger quota"
        return TooMany(f"{full}: {mend}", _COUNTED_AGAIN_NS / 1e9)
    return None


def _count(connection: sa.Connection, vehicle: str, now: int) -> _Used:
    b = schema.ballots
    today = sa.func.sum(sa.case((b.c.received_ns > now - DAY_NS, 1), else_=0))
    row = connection.execute(sa.select(today, sa.func.sum(b.c.bytes)).where(b.c.vehicle == vehicle)).one()
    return _Used(now, int(row[0] or 0), int(row[1] or 0))


MAX_BELOW_M, MAX_ABOVE_M = 10.0, 120.0
"""New points lie between so much below and so much above the lowest ground of the map around them."""
MAX_REACH_M = 200.0
"""Twice what a LiDAR sees: a vote farther from the map than this cannot come from a vehicle that localised in it."""
_TILE_M = TILE_CELLS * CELL_SIZE
_TILES_AWAY = int(MAX_REACH_M // _TILE_M) + 1


def refuse_out_of_reach(said: Sequence[Votes], map_tiles: Collection[TileIndex]) -> MapvoteError | None:
    """Why a ballot votes where its vehicle cannot have been: on a cell more than MAX_REACH_M from every tile of the
    map, or on tiles in groups that lie farther apart than that. None if it may have been there."""
    for votes in said:
        if _touched(votes.tile, map_tiles):
            continue  # the whole tile is within reach
        near = [index for index in _around(votes.tile) if index in map_tiles]
        if not near or _farthest_m(votes, near) > MAX_REACH_M:
            where = f"tile {tile_key(votes.tile)} has votes more than {MAX_REACH_M:.0f} m from the map"
            return MapvoteError(f"{where}: a vehicle votes on what it saw while it localised in the map")
    apart = _first_apart([votes.tile for votes in said])
    if apart is not None:
        first, other = (tile_key(index) for index in apart)
        why = f"tiles {first} and {other} lie on ways more than {MAX_REACH_M:.0f} m apart"
        return MapvoteError(f"{why}: a drive is one way; send each part as a drive of its own")
    return None


_AROUND = [
    (row, col)
    for row in range(-_TILES_AWAY, _TILES_AWAY + 1)
    for col in range(-_TILES_AWAY, _TILES_AWAY + 1)
    if _TILE_M * float(np.hypot(max(abs(row) - 1, 0), max(abs(col) - 1, 0))) <= MAX_REACH_M
]
"""Steps to the tiles within reach of any part of a tile."""


def _around(index: TileIndex) -> list[TileIndex]:
    """The tiles that are within reach of any part of a tile, itself too."""
    return [(index[0] + row, index[1] + col) for row, col in _AROUND]


def _touched(index: TileIndex, map_tiles: Collection[TileIndex]) -> list[TileIndex]:
    """The map's tiles that touch a tile, corners included, itself too."""
    beside = ((index[0] + row, index[1] + col) for row in (-1, 0, 1) for col in (-1, 0, 1))
    return [tile for tile in beside if tile in map_tiles]


def _farthest_m(votes: Votes, near: Collection[TileIndex]) -> float:
    """From the map's nearest tile to the cell that is farthest from all of them, of those voted on; metres."""
    rows, cols = np.nonzero(_cells(votes.spoken))
    if not len(rows):
        return 0.0
    y = (votes.tile[0] * TILE_CELLS + rows + 0.5) * CELL_SIZE
    x = (votes.tile[1] * TILE_CELLS + cols + 0.5) * CELL_SIZE
    least: F64 = np.full(len(rows), np.inf)
    for row, col in near:
        dy = np.maximum(np.maximum(row * _TILE_M - y, y - (row + 1) * _TILE_M), 0.0)
        dx = np.maximum(np.maximum(col * _TILE_M - x, x - (col + 1) * _TILE_M), 0.0)
        least = np.minimum(least, np.hypot(dx, dy))
    return float(least.max())


def _first_apart(tiles: list[TileIndex]) -> tuple[TileIndex, TileIndex] | None:
    """The first tile, and one that cannot be reached from it over the others; None if there is none."""
    left = set(tiles[1:]) - {tiles[0]}
    reached = [tiles[0]]
    while reached and left:
        found = [index for index in _around(reached.pop()) if index in left]
        left.difference_update(found)
        reached += found
    return (tiles[0], min(left)) if left else None
