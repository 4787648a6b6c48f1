"""Figures of a store, and its log."""

from __future__ import annotations

from collections.abc import Iterable
from itertools import islice
from typing import Any

import sqlalchemy as sa

from mapvote.codec.manifest import TileHashes
from mapvote.codec.tile_planes import names_in_plane
from mapvote.core.types import MapvoteError
from mapvote.server.errors import Unavailable
from mapvote.server.store import schema
from mapvote.server.store.integrity import set_aside
from mapvote.server.store.queries import current_version, load_blob, oldest_kept, tiles_of
from mapvote.server.store.store import Store
from mapvote.server.views.events import last_events

_LOOKED_AT = 3


def overview(store: Store) -> dict[str, Any]:
    """The figures of `mapvote info`."""
    b, t = schema.ballots, schema.ballot_tiles
    standing = sa.select(sa.func.count(), sa.func.count(sa.distinct(b.c.vehicle))).where(b.c.gone_seq.is_(None))
    with store.database.reading() as connection:
        newest = current_version(connection)
        ballots, vehicles = connection.execute(standing).one()
        planes, size = connection.execute(
            sa.select(sa.func.count(), sa.func.coalesce(sa.func.sum(sa.func.length(schema.blobs.c.data)), 0))
        ).one()
        votes = connection.execute(sa.select(sa.func.count()).select_from(t)).scalar_one()
        tiles = tiles_of(connection, newest.number)
        return {
            "map_id": store.map_id,
            "version": newest.number,
            "published_ns": newest.created_ns,
            "oldest_version": oldest_kept(connection),
            "tiles": len(tiles),
            "fields": _fields(connection, tiles.values()),
            "ballots": ballots,
            "vehicles": vehicles,
            "votes_on_tiles": votes,
            "planes": planes,
            "plane_bytes": int(size),
            "quarantined": len(set_aside(connection)),
        }


def _fields(connection: sa.Connection, tiles: Iterable[TileHashes]) -> str:
    """Names of the point fields, by the first readable tiles that have any."""
    names: dict[str, None] = {}
    for digest in islice((hashes.fields for hashes in tiles if hashes.fields is not None), _LOOKED_AT):
        try:
            names |= dict.fromkeys(names_in_plane(load_blob(connection, digest), digest))
        except Unavailable:
            raise
        except MapvoteError:
            continue
    return ", ".join(names) or "none"


def log_of(store: Store, last: int) -> dict[str, Any]:
    """The versions, oldest first, and the ``last`` so many events, newest first."""
    columns = ("number", "parent", "kind", "target", "created_ns", "published_by", "reason")
    versions = [{name: getattr(version, name) for name in columns} for version in store.versions()]
    return {"versions": versions, "events": last_events(store, last) if last else []}
