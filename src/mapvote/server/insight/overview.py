"""A store at a glance: how much there is of everything, and what happened."""

from __future__ import annotations

from typing import Any

import sqlalchemy as sa

from mapvote.server.insight.history import events
from mapvote.server.store import schema
from mapvote.server.store.quarantine import set_aside
from mapvote.server.store.queries import current_version, oldest_kept, tiles_of
from mapvote.server.store.store import Store


def overview(store: Store) -> dict[str, Any]:
    """What `mapvote info` shows of a store or a server."""
    b, t = schema.ballots, schema.ballot_tiles
    standing = sa.select(sa.func.count(), sa.func.count(sa.distinct(b.c.vehicle))).where(b.c.gone_seq.is_(None))
    with store.database.reading() as connection:
        newest = current_version(connection)
        ballots, vehicles = connection.execute(standing).one()
        planes, size = connection.execute(
            sa.select(sa.func.count(), sa.func.coalesce(sa.func.sum(sa.func.length(schema.blobs.c.data)), 0))
        ).one()
        votes = connection.execute(sa.select(sa.func.count()).select_from(t)).scalar_one()
        return {
            "map_id": store.map_id,
            "version": newest.number,
            "published_ns": newest.created_ns,
            "oldest_version": oldest_kept(connection),
            "tiles": len(tiles_of(connection, newest.number)),
            "ballots": ballots,
            "vehicles": vehicles,
            "votes_on_tiles": votes,
            "planes": planes,
            "plane_bytes": int(size),
            "quarantined": len(set_aside(connection)),
        }


def log_of(store: Store, last: int) -> dict[str, Any]:
    """What `mapvote log` shows: versions, oldest first, and the last so many events, newest first."""
    told = ("number", "parent", "kind", "target", "created_ns", "published_by", "reason")
    versions = [{name: getattr(version, name) for name in told} for version in store.versions()]
    return {"versions": versions, "events": events(store, last) if last else []}
