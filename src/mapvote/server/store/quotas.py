"""How much one vehicle may leave in a store: ballots a day, tiles a drive, bytes in all."""

from __future__ import annotations

import threading
from dataclasses import dataclass

import sqlalchemy as sa

from mapvote.core.types import MapvoteError
from mapvote.fusion.tile_vote import DAY_NS
from mapvote.server.errors import TooMany
from mapvote.server.store import schema
from mapvote.server.store.ballots import Incoming

_COUNTED_AGAIN_NS = DAY_NS // 24


@dataclass(frozen=True, slots=True)
class Quota:
    """What one vehicle may leave in the store."""

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
