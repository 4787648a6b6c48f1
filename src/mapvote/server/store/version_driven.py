"""Which version of the map a ballot's vehicle drove with."""

from __future__ import annotations

import sqlalchemy as sa

from mapvote.codec.ballot import Ballot, tile_key
from mapvote.core.grid import TileIndex
from mapvote.server.store import schema
from mapvote.server.store.queries import current_number

NO_SUCH_BASE = "no version had the tiles that the ballot was cast against: fetch the map and vote again"
_E, _T = schema.events, schema.version_tiles
_POINTS = (
    sa.select(_T.c.version, _T.c.points)
    .where(_T.c.row == sa.bindparam("row"), _T.c.col == sa.bindparam("col"), _T.c.version <= sa.bindparam("number"))
    .order_by(_T.c.version.desc())
)


def version_driven(connection: sa.Connection, ballot: Ballot, heard_at: int | None = None) -> int | None:
    """The version that the ballot names, or, of an older mapvote's, the last one whose tiles have its hashes; None if
    there is none.

    ``heard_at``: the event by which this drive was first heard of; it cannot have been cast against a later version.
    """
    if ballot.version is not None:
        return ballot.version
    version: int | None = newest_at(connection, heard_at)
    while version is not None:
        last = [_last_with(connection, tile.tile, ballot.base[tile_key(tile.tile)], version) for tile in ballot.tiles]
        if all(found == version for found in last):
            return version
        version = None if None in last else min(found for found in last if found is not None)
    return None


def newest_at(connection: sa.Connection, seq: int | None) -> int:
    """The newest version as of an event; None for now."""
    newest = current_number(connection)
    if seq is None:
        return newest
    kinds = _E.c.kind.in_(("publish", "rollback", "replay"))
    later = sa.select(sa.func.count()).where(kinds, _E.c.seq >= seq)
    return newest - int(connection.execute(later).scalar_one())


def _last_with(connection: sa.Connection, tile: TileIndex, base: str, version: int) -> int | None:
    """The last version up to ``version`` in which a tile had the points ``base``."""
    until = version
    for row in connection.execute(_POINTS, {"row": tile[0], "col": tile[1], "number": version}):
        if (row.points or "") == base:
            return until
        until = row.version - 1
    return until if base == "" and until > 0 else None
