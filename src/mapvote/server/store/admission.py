"""Admission of ballots. ``examine`` decodes a ballot and checks it without a database. ``Intake`` checks it against the
map, the policy and the quota of its vehicle, within the transaction that writes it.

Where a vehicle can have been is checked too: near the map, on one path, at heights that the map allows.
"""

from __future__ import annotations

import hashlib
import threading
from collections.abc import Callable, Collection, Mapping, Sequence
from dataclasses import dataclass, replace
from functools import partial
from typing import NamedTuple

import numpy as np
import sqlalchemy as sa

from mapvote.codec.ballot import Ballot, decode, tile_key
from mapvote.codec.manifest import TileHashes
from mapvote.codec.path import check_path
from mapvote.codec.tile_planes import unpack_ground_plane
from mapvote.core.grid import CELL_SIZE, TILE_CELLS, TileIndex
from mapvote.core.types import F64, Bool, MapvoteError
from mapvote.fusion.fuse import rule_of
from mapvote.fusion.tile_vote import DAY_NS, TileVote
from mapvote.server.errors import Conflict, TooMany, Unauthorised, Unavailable
from mapvote.server.store import keys, schema
from mapvote.server.store.ballots import Incoming, Receipt, Votes, write_ballots
from mapvote.server.store.policy import RoundPolicy, policy_in
from mapvote.server.store.queries import (
    current_number,
    load_blob,
    load_memory,
    memory_of,
    names,
    tile_of,
    tiles_of,
    tiles_set_between,
)
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
    """An upload: the ballot's bytes, vehicle and drive of its URL, and the hash of the key that sent it."""

    data: bytes
    vehicle: str
    drive: str
    key_hash: str | None


def examine(data: bytes) -> Incoming:
    """Decode a ballot and unpack every plane, once; MapvoteError on the first defect. Touches no database."""
    ballot = decode(data)
    if not ballot.tiles:
        raise MapvoteError("ballot: votes on no tile")
    _check_founded(ballot)
    rule_of(ballot.method)
    if any((tile.states is None) != (ballot.tiles[0].states is None) for tile in ballot.tiles):
        raise MapvoteError("ballot: some tiles hold states and some a tally; a ballot is either two-stage or one-stage")
    if ballot.path is not None:
        check_path(ballot.path, [tile.tile for tile in ballot.tiles])
    votes, size = [], 0
    for tile in ballot.tiles:
        vote = TileVote.unpack(tile)
        size += vote.nbytes
        if size > MAX_UNPACKED_BYTES:
            raise MapvoteError(
                f"ballot: larger than {MAX_UNPACKED_BYTES} bytes when decompressed; send a shorter drive"
            )
        votes.append(_votes_of(tile.tile, vote))
    cast_by = f"{ballot.method}, {ballot.stage}"
    return Incoming(ballot, votes, hashlib.sha256(data).hexdigest(), cast_by, len(data))


def sound(sent: Sent) -> Incoming:
    """A ballot decoded; MapvoteError if it is unsound, or of another vehicle or drive than its URL. The key is not
    checked."""
    incoming = examine(sent.data)
    if incoming.drive != (sent.vehicle, sent.drive):
        address = f"{sent.vehicle[:64]}/{sent.drive[:64]}"
        raise MapvoteError(f"the ballot is of {'/'.join(incoming.drive)}, not {address}")
    return replace(incoming, key_hash=sent.key_hash)


def _votes_of(tile: TileIndex, vote: TileVote) -> Votes:
    spoken = np.packbits(vote.spoken()).tobytes()
    if vote.new_points is None or not len(vote.new_points):
        return Votes(tile, spoken, None, None)
    heights = vote.new_points[:, 2]
    return Votes(tile, spoken, float(heights.min()), float(heights.max()))


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
    """Admits ballots to a store: what fits the map is decided within the transaction that writes it. Remembers the
    newest version's tiles.

    ``quota``: what one vehicle may leave in the store; None: as much as it likes.
    """

    def __init__(self, store: Store, quota: Quota | None = None) -> None:
        self._store = store
        self._quotas = None if quota is None else Quotas(quota)
        self._current: tuple[int, Mapping[TileIndex, TileHashes]] = (0, {})
        self._lowest = LowestGround()

    def write(self, ballots: Sequence[Incoming]) -> list[Receipt | MapvoteError]:
        """Store the ballots that are admitted, in one durable transaction: a receipt, or why not.

        Conflict: another map, method, settings or base than the store's, or no cell that still counts. Unauthorised:
        its key was revoked meanwhile. TooMany: beyond its vehicle's quota. MapvoteError: from the future, or from where
        its vehicle cannot have been. Unavailable is raised for all.
        """
        if not ballots:
            return []
        now = self._store.clock()
        with self._store.database.writing() as connection:
            newest = current_number(connection)
            self._current = newest, _brought_up(connection, newest, *self._current)
            asked = policy_in(connection).round
            came_with = {ballot.key_hash for ballot in ballots if ballot.key_hash is not None}
            valid = keys.of(connection, came_with, now)

            def refusal(one: Incoming) -> MapvoteError | None:
                if _unknown(one.key_hash, valid):
                    return Unauthorised(keys.UNKNOWN)
                misfit = _unlike(asked, one) or self._misfit(connection, one, now)
                if misfit is None and self._quotas is not None:
                    return self._quotas.refusal(connection, one, now)
                return misfit

            return write_ballots(connection, ballots, now, refusal)

    def _misfit(self, connection: sa.Connection, one: Incoming, now: int) -> MapvoteError | None:
        """Why a ballot does not fit the map as it is; None if it does."""
        ballot, (newest, current) = one.ballot, self._current
        if ballot.map_id != self._store.map_id:
            return Conflict(f"this server keeps map {self._store.map_id!r}, the ballot votes on {ballot.map_id!r}")
        impossible = self._wrong_time(ballot, now) or refuse_out_of_reach(one.votes, current.keys())
        impossible = impossible or refuse_out_of_height(one.votes, current, partial(self._lowest.look_up, connection))
        if impossible is not None:
            return impossible
        if ballot.version > newest:
            return Conflict(f"there is no version {ballot.version} yet; the newest is {newest}: fetch it")
        counts = ballot.version == newest
        for votes in one.votes:
            base, now_there = ballot.base[tile_key(votes.tile)], current.get(votes.tile)
            then = now_there if ballot.version == newest else tile_of(connection, ballot.version, votes.tile)
            if base != ("" if then is None else then.points):
                known = f"the base of tile {tile_key(votes.tile)} is not that of version {ballot.version}"
                return Conflict(f"{known}: fetch the map and vote again")
            counts = counts or _counts_somewhere(connection, votes, ballot.version, now_there)
        if not counts:
            stale = names(votes.tile for votes in one.votes)
            return Conflict(
                f"every cell voted on has changed since version {ballot.version}: fetch tiles {stale} and vote again"
            )
        return None

    def _wrong_time(self, ballot: Ballot, now: int) -> MapvoteError | None:
        if ballot.end_ns > now + MAX_CLOCK_AHEAD_NS:
            return MapvoteError("ballot: the drive ends in the future; set the vehicle's clock")
        if self._store.surveyed_ns is not None and ballot.end_ns < self._store.surveyed_ns:
            return MapvoteError("ballot: the drive ended before the map was surveyed; set the vehicle's clock")
        return None


def _unknown(key_hash: str | None, valid: Collection[str]) -> bool:
    """Whether a ballot came with a key that opens nothing; by a client of this machine it may come without one."""
    return key_hash is not None and key_hash not in valid


def _unlike(asked: RoundPolicy, incoming: Incoming) -> MapvoteError | None:
    """Why a ballot does not fit the round that the policy asks for; None if it does."""
    settings = incoming.ballot.settings_hash
    if asked.cast_by == incoming.cast_by and settings.startswith(asked.settings_hash):
        return None
    theirs = f"{incoming.cast_by}, settings {settings[:16]}"
    ours = f"{asked.cast_by}, settings {asked.settings_hash[:16] or 'of any kind'}"
    mend = "vote again with the fleet's configuration (mapvote config)"
    return Conflict(f"this round votes by {ours}, the ballot by {theirs}: one round never mixes them; {mend}")


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


def accept(store: Store, ballots: Sequence[Incoming]) -> list[Receipt | MapvoteError]:
    """:meth:`Intake.write`, once."""
    return Intake(store).write(ballots)


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


class Quotas:
    """What every vehicle has used of its quota: counted in the store once an hour and before a refusal, in between from
    what was let through. For any number of threads."""

    def __init__(self, quota: Quota) -> None:
        self._quota = quota
        self._lock = threading.Lock()
        self._used: dict[str, _Used] = {}

    def refusal(self, connection: sa.Connection, incoming: Incoming, now: int) -> MapvoteError | None:
        """Why a ballot is too much of its vehicle; None lets it through and counts it."""
        vehicle, tiles = incoming.ballot.vehicle, len(incoming.ballot.tiles)
        if tiles > self._quota.tiles_a_drive:
            limit = f"the drive votes on {tiles} tiles, the limit is {self._quota.tiles_a_drive}"
            return MapvoteError(f"{limit}: send each part of it as a drive of its own")
        with self._lock:
            used = self._used.get(vehicle)
            if used is None or used.since_ns < now - _COUNTED_AGAIN_NS or self._over(used, incoming) is not None:
                used = self._used[vehicle] = _count(connection, vehicle, now)
            refused = self._over(used, incoming)
            if refused is None:
                used.ballots, used.size = used.ballots + 1, used.size + incoming.size
            return refused

    def _over(self, used: _Used, incoming: Incoming) -> MapvoteError | None:
        vehicle, quota = incoming.ballot.vehicle, self._quota
        if used.ballots >= quota.drives_a_day:
            said = f"{vehicle!r} has sent {used.ballots} drives in 24 hours, its limit: try again tomorrow"
            return TooMany(said, _COUNTED_AGAIN_NS / 1e9)
        if used.size + incoming.size > quota.stored_bytes:
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


class LowestGround:
    """How deep the ground of each tile lies, by its plane's hash: looked up in the store once. For any threads."""

    def __init__(self) -> None:
        self._known: dict[str, float] = {}

    def look_up(self, connection: sa.Connection, ground: str) -> float:
        """Map metres; inf where the ground is unknown, or its plane damaged."""
        if ground not in self._known:
            try:
                plane = unpack_ground_plane(load_blob(connection, ground), ground)
            except MapvoteError:
                return np.inf
            known = plane[np.isfinite(plane)]
            self._known[ground] = float(known.min()) if len(known) else np.inf
        return self._known[ground]


def refuse_out_of_height(
    said: Sequence[Votes], map_tiles: Mapping[TileIndex, TileHashes], lowest_m: Callable[[str], float]
) -> MapvoteError | None:
    """Why a ballot brings points deeper or higher than anything on this map can be; None if it may.

    ``lowest_m``: of a ground plane by its hash. The nearest tiles tell: itself and its neighbours, else those in reach.
    """
    for tile, _, low_m, high_m in said:
        if low_m is None or high_m is None:
            continue
        near = _touched(tile, map_tiles) or [index for index in _around(tile) if index in map_tiles]
        ground_m = min((lowest_m(map_tiles[index].ground) for index in near), default=np.inf)
        if np.isfinite(ground_m) and not ground_m - MAX_BELOW_M <= low_m <= high_m <= ground_m + MAX_ABOVE_M:
            span = f"{low_m:.1f} to {high_m:.1f} m on tile {tile_key(tile)}"
            allowed = (
                f"{MAX_BELOW_M:g} m below to {MAX_ABOVE_M:g} m above the map's lowest ground there, {ground_m:.1f} m"
            )
            return MapvoteError(f"new points at {span} are not within {allowed}: is the vehicle on this level?")
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
