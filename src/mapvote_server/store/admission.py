"""Admission of ballots. :class:`Intake` checks a ballot against the map, the policy and the quota of its vehicle:
:meth:`Intake.refuse_early` by its envelope alone, before its planes are unpacked, and :meth:`Intake.write` within the
transaction that writes it: idempotent, one standing ballot per drive, nothing overwritten.

Where a vehicle can have been is checked too (:mod:`mapvote_server.store.place`).
"""

from __future__ import annotations

from collections import defaultdict
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from threading import Lock
from typing import Any, Literal

import numpy as np
import sqlalchemy as sa

from mapvote.codec.ballot import Ballot, encode_tile, tile_key
from mapvote.codec.manifest import TileHashes
from mapvote.codec.tile_planes import unpack_ground_plane
from mapvote.core.grid import TileIndex
from mapvote.core.record import record
from mapvote.core.types import MapvoteError
from mapvote.fusion.tile_vote import DAY_NS
from mapvote_server.errors import Conflict, TooMany, Unauthorised, Unavailable
from mapvote_server.store import keys, schema
from mapvote_server.store.database import Question, insert_rows
from mapvote_server.store.examination import Examination, cells_of
from mapvote_server.store.place import (
    PLACE_RULE,
    TWO_PLACES,
    apart_m,
    are_two_places,
    around,
    refuse_far_tiles,
    refuse_out_of_reach,
    touched,
)
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


@record()
@dataclass(frozen=True, slots=True)
class AdmissionRule:
    """Numbers of the admission of ballots."""

    clock_ahead_ns: int = 300 * 10**9
    """Time after the server's own by which a drive may end, nanoseconds: clocks differ, but a vehicle from the future
    would make all other votes look old."""
    compared: int = 16
    """Other drives of a vehicle at the same time that a ballot is compared with."""
    counted_again_ns: int = DAY_NS // 24
    """Time after which a vehicle's use is counted in the store again, nanoseconds."""


ADMISSION_RULE = AdmissionRule()


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


class RoundNow:
    """Demands of the newest version and the policy on ballots, as of the last :meth:`catch_up`."""

    def __init__(self, store: Store) -> None:
        self._store = store
        self._policy = 0
        """Number of the policy."""
        self._asked = RoundPolicy()
        self._cast_by = ""
        self.newest = 0
        """The newest version; 0: nothing was read yet."""
        self.tiles: dict[TileIndex, TileHashes] = {}
        """Its tiles."""

    def catch_up(self, connection: sa.Connection, newest: int, policy: int) -> None:
        """Read what has changed of the map and the policy."""
        if policy != self._policy:
            self._policy = policy
            self._asked = policy_in(connection).round
            self._cast_by = self._asked.cast_by
        if newest != self.newest:
            touched = tiles_set_between(connection, self.newest, newest) if self.newest else None
            for index in touched or ():
                self.tiles.pop(index, None)
            self.tiles |= tiles_of(connection, newest, touched)
            self.newest = newest

    def refusal(self, one: Examination, now_ns: int) -> MapvoteError | None:
        """The reason why an envelope does not fit the round, the clock or the map; None if it does."""
        ballot = one.ballot
        round_policy = self._asked
        mend = "Vote again with the fleet's configuration (mapvote config)"
        if self._cast_by != one.cast_by:
            accepted = f"the current round accepts only {self._cast_by}"
            return Conflict(f"This ballot uses method {one.cast_by}; {accepted}. {mend}")
        if not ballot.settings_hash.startswith(round_policy.settings_hash):
            accepted = f"the current round accepts only {round_policy.settings_hash[:16]}"
            return Conflict(f"This ballot uses settings {ballot.settings_hash[:16]}; {accepted}. {mend}")
        if ballot.map_id != self._store.map_id:
            return Conflict(f"this server keeps map {self._store.map_id!r}, the ballot votes on {ballot.map_id!r}")
        tiles = [tile.tile for tile in ballot.tiles]
        impossible = self._wrong_time(ballot, now_ns) or refuse_far_tiles(tiles, self.tiles.keys())
        if impossible is not None:
            return impossible
        if ballot.version > self.newest:
            return Conflict(f"there is no version {ballot.version} yet; the newest is {self.newest}: fetch it")
        if ballot.version == self.newest:
            for tile in tiles:
                refused = wrong_base(ballot, tile, self.tiles.get(tile))
                if refused is not None:
                    return refused
        return None

    def _wrong_time(self, ballot: Ballot, now_ns: int) -> MapvoteError | None:
        if ballot.start_ns < 0 or ballot.end_ns <= 0:
            return MapvoteError("ballot: the drive lies before 1970; set the vehicle's clock")
        if ballot.end_ns > now_ns + ADMISSION_RULE.clock_ahead_ns:
            return MapvoteError("ballot: the drive ends in the future; set the vehicle's clock")
        if self._store.surveyed_ns is not None and ballot.end_ns < self._store.surveyed_ns:
            return MapvoteError("ballot: the drive ended before the map was surveyed; set the vehicle's clock")
        return None


def wrong_base(ballot: Ballot, tile: TileIndex, then: TileHashes | None) -> Conflict | None:
    """The refusal of a vote against another tile than the version's, ``then``; None if it is the same."""
    if ballot.base[tile_key(tile)] == ("" if then is None else then.points):
        return None
    other = f"the base of tile {tile_key(tile)} is not that of version {ballot.version}"
    return Conflict(f"{other}: fetch the map and vote again")


class Intake:
    """Admits ballots to a store, one batch at a time. ``quota``: what one vehicle may leave there; None: no limit."""

    def __init__(self, store: Store, quota: Quota | None = None) -> None:
        self._store = store
        self._quota = quota
        self._used: dict[str, _Used] = {}
        self._round = RoundNow(store)
        """State of the thread that writes."""
        self._early = RoundNow(store)
        """State of the threads that examine, under this lock."""
        self._early_lock = Lock()
        self._lowest_m: dict[str, float] = {}
        """Lowest ground of a tile, by its plane's hash."""

    def refuse_early(self, one: Examination) -> MapvoteError | None:
        """The refusal of a ballot by its envelope: its round, time, tiles, base and quota. None if its planes must be
        unpacked, or if it stands already.

        Thread-safe. The store is read only before a refusal; :meth:`write` checks everything again.
        """
        now_ns = self._store.clock()
        with self._early_lock:
            used = self._used.get(one.ballot.vehicle)
            fits = self._early.newest and self._early.refusal(one, now_ns) is None
            if fits and self._over_quota(one, used) is None:
                return None
            with self._store.database.reading() as connection:
                newest, policy, _ = connection.execute(_HEAD).one()
                self._early.catch_up(connection, newest, policy)
                refused = self._early.refusal(one, now_ns)
                if refused is None and self._quota is not None:
                    refused = self._over_quota(one, _count(connection, one.ballot.vehicle, now_ns))
                if refused is None:
                    return None
                _, standing = _heard_of(connection, [one])
        return None if standing.get(one.drive, (0, ""))[1] == one.digest else refused

    def write(self, ballots: Sequence[Examination]) -> list[Receipt | MapvoteError]:
        """Store the ballots that are admitted, in one durable transaction: for each a receipt, or why not.

        Conflict: another map, method, settings or base than the store's, or no cell that still counts. Unauthorised:
        its key was revoked meanwhile. TooMany: beyond its vehicle's quota. MapvoteError: from the future, or from where
        its vehicle cannot have been. Unavailable is raised for all. A ballot that is stored already is not judged
        again, so a vehicle that got no answer may send it again.
        """
        if not ballots:
            return []
        now_ns = self._store.clock()
        results: list[Receipt | MapvoteError] = []
        replaced: list[dict[str, int]] = []
        with self._store.database.writing() as connection:
            newest, policy, seq = connection.execute(_HEAD).one()
            self._round.catch_up(connection, newest, policy)
            came_with = {ballot.key_hash for ballot in ballots if ballot.key_hash is not None}
            valid = keys.of(connection, came_with, now_ns) if came_with else {}
            first, standing = _heard_of(connection, ballots)
            rows: Rows = defaultdict(list)
            admitted: list[Examination] = []
            for one in ballots:
                old, old_digest = standing.get(one.drive, (None, ""))
                if old is not None and old_digest == one.digest:
                    results.append(Receipt(*one.drive, "repeated", old))
                    continue
                has_valid_key = one.key_hash is None or one.key_hash in valid
                refused = self._refusal(connection, one, now_ns) if has_valid_key else Unauthorised(keys.UNKNOWN)
                if refused is not None:
                    results.append(refused)
                    continue
                seq += 1
                _enter(rows, one, seq, first.setdefault(one.drive, seq), now_ns)
                if old is not None:
                    replaced.append({"old": old, "by": seq})
                standing[one.drive] = seq, one.digest
                for warning in elsewhere(connection, one, admitted):
                    seq += 1
                    rows[schema.events].append((seq, now_ns, "two places", one.ballot.vehicle, warning))
                admitted.append(one)
                results.append(Receipt(*one.drive, "created" if old is None else "replaced", seq))
            for table, new_rows in rows.items():
                insert_rows(connection, table, new_rows)
            if replaced:
                connection.execute(_REPLACED, replaced)
        return results

    def _refusal(self, connection: sa.Connection, one: Examination, now_ns: int) -> MapvoteError | None:
        """Why a ballot does not fit the round, the map as it is, or its vehicle's quota; None if it does."""
        ballot = one.ballot
        tiles = self._round.tiles
        refused = self._round.refusal(one, now_ns) or refuse_out_of_reach(one.spoken, tiles.keys())
        refused = refused or self._out_of_height(connection, one.heights_m)
        if refused is not None:
            return refused
        counts = ballot.version == self._round.newest
        for tile, spoken in one.spoken.items():
            if ballot.version != self._round.newest:
                refused = wrong_base(ballot, tile, tile_of(connection, ballot.version, tile))
                if refused is not None:
                    return refused
            counts = counts or _counts_somewhere(connection, tile, spoken, ballot.version, tiles.get(tile))
        if not counts:
            stale = names(one.tiles)
            return Conflict(
                f"every cell voted on has changed since version {ballot.version}: fetch tiles {stale} and vote again"
            )
        return self._count_in(connection, one, now_ns)

    def _out_of_height(
        self, connection: sa.Connection, heights_m: Mapping[TileIndex, tuple[float, float]]
    ) -> MapvoteError | None:
        """Why a ballot brings points deeper or higher than anything on this map can be; None if it may.

        The nearest tiles tell: itself and its neighbours, else those in reach.
        """
        tiles = self._round.tiles
        for tile, (low, high) in heights_m.items():
            near = touched(tile, tiles) or [index for index in around(tile) if index in tiles]
            ground_m = min((self._ground_m(connection, tiles[index].ground) for index in near), default=np.inf)
            if (
                np.isfinite(ground_m)
                and not ground_m - PLACE_RULE.below_m <= low <= high <= ground_m + PLACE_RULE.above_m
            ):
                span = f"{low:.1f} to {high:.1f} m on tile {tile_key(tile)}"
                below = (
                    f"{PLACE_RULE.below_m:g} m below to {PLACE_RULE.above_m:g} m above the map's lowest ground there"
                )
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

    def _over_quota(self, one: Examination, used: _Used | None) -> MapvoteError | None:
        """The refusal of a ballot that is too much of its vehicle; None if it is not. ``used``: None if unknown."""
        if self._quota is None:
            return None
        if len(one.ballot.tiles) > self._quota.tiles_a_drive:
            limit = f"the drive votes on {len(one.ballot.tiles)} tiles, the limit is {self._quota.tiles_a_drive}"
            return MapvoteError(f"{limit}: send each part of it as a drive of its own")
        return None if used is None else _exceeded(self._quota, used, one)

    def _count_in(self, connection: sa.Connection, one: Examination, now_ns: int) -> MapvoteError | None:
        """The refusal of a ballot that exceeds its vehicle's budget; None admits and counts it. A vehicle's use is
        counted in the store once an hour and before a refusal; in between, admitted ballots are added."""
        if self._quota is None:
            return None
        vehicle = one.ballot.vehicle
        used = self._used.get(vehicle)
        if (
            used is None
            or used.since_ns < now_ns - ADMISSION_RULE.counted_again_ns
            or self._over_quota(one, used) is not None
        ):
            used = self._used[vehicle] = _count(connection, vehicle, now_ns)
        refused = self._over_quota(one, used)
        if refused is None:
            used.ballots = used.ballots + 1
            used.size = used.size + one.size
        return refused


_HEAD = sa.select(
    sa.select(sa.func.max(schema.versions.c.number)).scalar_subquery(),
    sa.select(sa.func.max(schema.policies.c.seq)).scalar_subquery(),
    sa.select(sa.func.max(schema.events.c.seq)).scalar_subquery(),
)
"""The newest version, policy and event."""


_REPLACED = schema.ballots.update().where(schema.ballots.c.seq == sa.bindparam("old"))
_REPLACED = _REPLACED.values(gone_seq=sa.bindparam("by"))


def _heard_of(
    connection: sa.Connection, ballots: Sequence[Examination]
) -> tuple[dict[tuple[str, str], int], dict[tuple[str, str], tuple[int, str]]]:
    """For the drives of these ballots: ({drive: its first event}, {drive: (number, digest) of its standing ballot})."""
    b = schema.ballots
    drives = sa.tuple_(b.c.vehicle, b.c.drive).in_({examined.drive for examined in ballots})
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


def _enter(rows: Rows, examined: Examination, seq: int, first_seq: int, now_ns: int) -> None:
    """Add those of a ballot."""
    ballot = examined.ballot
    rows[schema.events].append((seq, now_ns, "ballot", *examined.drive))
    times = ballot.start_ns, ballot.end_ns, now_ns
    how = ballot.settings_hash[:128], examined.cast_by, examined.size, ballot.version
    rows[schema.ballots].append((seq, first_seq, None, *examined.drive, examined.digest, *times, *how))
    for tile in ballot.tiles:
        content = ballot.base[tile_key(tile.tile)], encode_tile(tile), examined.sums[tile.tile]
        rows[schema.ballot_tiles].append((*tile.tile, seq, *content))
    if ballot.path is not None:
        rows[schema.paths].append((seq, ballot.path))


_b = schema.ballots.c
_SAME_TIME = Question(
    sa.select(_b.seq, _b.drive, _b.start_ns, _b.end_ns)
    .where(_b.vehicle == sa.bindparam("vehicle"), _b.drive != sa.bindparam("drive"), _b.gone_seq.is_(None))
    .where(_b.end_ns >= sa.bindparam("after_ns"), _b.start_ns <= sa.bindparam("before_ns"))
    .limit(ADMISSION_RULE.compared)
)
"""Standing ballots of other drives of a vehicle in a span of time."""


def elsewhere(connection: sa.Connection, one: Examination, beside: Sequence[Examination]) -> list[str]:
    """Drives of the same vehicle at another place at the same time: in the store, or ``beside`` it in its batch."""
    ballot = one.ballot
    window_ns = round(TWO_PLACES.window_s * 1e9)
    span = {"after_ns": ballot.start_ns - window_ns, "before_ns": ballot.end_ns + window_ns}
    rows = _SAME_TIME.ask(connection, vehicle=ballot.vehicle, drive=ballot.drive, **span).all()
    others = [(row.drive, row.start_ns, row.end_ns, _tiles_of_ballot(connection, row.seq)) for row in rows]
    for other in beside:
        if other.ballot.vehicle == ballot.vehicle and other.ballot.drive != ballot.drive:
            others.append((other.ballot.drive, other.ballot.start_ns, other.ballot.end_ns, other.tiles))
    warnings = []
    for drive, start_ns, end_ns, tiles in others:
        pause_s = max(0, start_ns - ballot.end_ns, ballot.start_ns - end_ns) / 1e9
        distance_m = apart_m(one.tiles, tiles)
        if are_two_places(distance_m, pause_s):
            both = f"drives {ballot.drive} and {drive}, {pause_s:.0f} s apart, lie {distance_m / 1e3:.1f} km apart"
            warnings.append(f"{both}: two vehicles send with one key; revoke it if it was stolen")
    return warnings


def _tiles_of_ballot(connection: sa.Connection, seq: int) -> list[TileIndex]:
    t = schema.ballot_tiles.c
    return [(row, col) for row, col in connection.execute(sa.select(t.row, t.col).where(t.ballot == seq))]


def _counts_somewhere(
    connection: sa.Connection, tile: TileIndex, spoken: bytes, version: int, newest: TileHashes | None
) -> bool:
    """Whether a ballot votes on a cell of a tile that has not changed since ``version``. ``spoken``: the cells on which
    it votes; ``newest``: the tile of the newest version.

    If the memory of the tile is damaged this is unknown: the votes are admitted and wait until the plane is restored.
    """
    try:
        if newest is None:
            memory = memory_of(connection, (1 << 31) - 1, tile)
        else:
            memory = None if newest.memory is None else load_memory(connection, newest.memory)
    except Unavailable:
        raise
    except MapvoteError:
        return True
    if memory is None or not len(memory.changed_after(version)):
        return True
    return bool((cells_of(spoken) & (memory.changed <= version)).any())


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


def _exceeded(quota: Quota, used: _Used, one: Examination) -> TooMany | None:
    vehicle = one.ballot.vehicle
    if used.ballots >= quota.drives_a_day:
        said = f"{vehicle!r} has sent {used.ballots} drives in 24 hours, its limit: try again tomorrow"
        return TooMany(said, ADMISSION_RULE.counted_again_ns / 1e9)
    if used.size + one.size > quota.stored_bytes:
        full = f"the ballots of {vehicle!r} would take more than {quota.stored_bytes:,} bytes in the store"
        mend = "ask the operator to clear old ones away, or for a larger quota"
        return TooMany(f"{full}: {mend}", ADMISSION_RULE.counted_again_ns / 1e9)
    return None


def _count(connection: sa.Connection, vehicle: str, now_ns: int) -> _Used:
    b = schema.ballots
    today = sa.func.sum(sa.case((b.c.received_ns > now_ns - DAY_NS, 1), else_=0))
    row = connection.execute(sa.select(today, sa.func.sum(b.c.bytes)).where(b.c.vehicle == vehicle)).one()
    return _Used(now_ns, int(row[0] or 0), int(row[1] or 0))
