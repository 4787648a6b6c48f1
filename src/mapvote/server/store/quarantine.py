"""What is damaged is set aside by name, so that everything else goes on: in the log, the metrics and /readyz.

Planes of tiles are named by their hash; planes of ballots and decisions carry a sum beside them, and so do the heads
of ballots, versions, the log and all else that is written once.
"""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass
from typing import Any

import sqlalchemy as sa

from mapvote.codec.ballot import tile_key
from mapvote.core.grid import TileIndex
from mapvote.core.types import MapvoteError
from mapvote.server.store import schema
from mapvote.server.store.queries import log_event
from mapvote.server.store.sums import sum_of_planes

MENDED = "mended"
"""The kind of the event by which a plane is again what it was."""
KINDS = ("plane", "decision", *schema.HEADS, "row", "database")


@dataclass(frozen=True, slots=True)
class Damage:
    """One thing that is not as it was written."""

    kind: str
    """One of KINDS."""
    name: str
    """The plane's hash; or ballot, version and tile."""
    why: str
    mended: str = ""
    """What was done about it; empty: nothing yet."""

    def __str__(self) -> str:
        return f"{self.kind} {self.name}: {self.why}" + (f"; {self.mended}" if self.mended else "")


class DamagedBallots(MapvoteError):
    """Votes that are not what was sent."""

    def __init__(self, found: list[Damage]) -> None:
        super().__init__("; ".join(map(str, found)))
        self.found = found


def ballot_name(seq: int, row: int, col: int) -> str:
    """One ballot's votes on one tile."""
    return f"{seq} on tile {tile_key((row, col))}"


def ballot_sum(row: Any) -> str:
    """The sum of a row of ballot_tiles."""
    return sum_of_planes(row.base, [getattr(row, plane) for plane in schema.BALLOT_PLANES])


def set_aside(connection: sa.Connection) -> dict[tuple[str, str], str]:
    """Why each thing is in quarantine, by (kind, name)."""
    q = schema.quarantine
    return {(row.kind, row.name): row.why for row in connection.execute(sa.select(q.c.kind, q.c.name, q.c.why))}


def quarantine(connection: sa.Connection, damaged: Iterable[Damage], now: int, by: str) -> None:
    """Set aside what is not yet; each is named in the log."""
    known = set(set_aside(connection))
    for damage in damaged:
        if (damage.kind, damage.name) not in known:
            seq = log_event(connection, now, "quarantine", by, str(damage))
            row = {"kind": damage.kind, "name": damage.name[:160], "seq": seq, "why": damage.why[:200]}
            connection.execute(schema.quarantine.insert().values(**row))
            known.add((damage.kind, damage.name))


def tiles_hurt_or_mended(connection: sa.Connection, since: int) -> set[TileIndex]:
    """Tiles that may be fused otherwise since an event: a ballot there was set aside, or one of their planes mended."""
    q, e, t, v = schema.quarantine.c, schema.events.c, schema.ballot_tiles.c, schema.version_tiles
    aside = connection.execute(sa.select(q.name).where(q.kind == "ballot", q.seq > since)).scalars()
    ballots = {int(name.split()[0]) for name in aside}
    mended = connection.execute(sa.select(e.detail).where(e.kind == MENDED, e.seq > since)).scalars()
    planes = {detail.removeprefix("plane ") for detail in mended}
    queries = []
    if ballots:
        queries.append(sa.select(t.row, t.col).where(t.ballot.in_(ballots)))
    if planes:
        shows = sa.or_(*(v.c[name].in_(planes) for name in schema.TILE_PLANES))
        queries.append(sa.select(v.c.row, v.c.col).where(shows))
    return {(row, col) for query in queries for row, col in connection.execute(query)}
