"""The one transaction by which a version appears."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace

from sqlalchemy.exc import IntegrityError

from mapvote.core.grid import TileIndex
from mapvote.server.errors import Conflict
from mapvote.server.store import schema
from mapvote.server.store.blobs import TileHashes
from mapvote.server.store.database import insert_rows
from mapvote.server.store.queries import (
    Version,
    add_blobs,
    current_version,
    end_votes,
    log_event,
    set_tiles,
    version_of,
    version_row,
)
from mapvote.server.store.store import Store
from mapvote.server.store.sums import sum_of_decision
from mapvote.server.store.tile_jobs import Fused


@dataclass(frozen=True, slots=True)
class NewTiles:
    """The tiles that a version sets, and all planes that the store may not hold yet."""

    tiles: Mapping[TileIndex, TileHashes]
    """A tile without points is one that the version does not have."""
    planes: Sequence[Mapping[str, bytes]]
    fused: Sequence[Fused] = field(default=(), repr=False)
    """What was decided, also where nothing came of it."""


def write_version(store: Store, version: Version, new: NewTiles, unvoted: str | None = None) -> Version:
    """Publish a version; Conflict if its parent is the newest no more. ``unvoted``: this vehicle's votes are gone."""
    try:
        with store.database.writing() as connection:
            if current_version(connection).number != version.parent:
                raise Conflict(f"version {version.number} was published by somebody else meanwhile; look at it first")
            if version.target is not None:
                version_of(connection, version.target)
            seq = log_event(connection, version.created_ns, version.kind, version.published_by, f"v{version.number}")
            if version.kind != "publish":
                version = replace(version, mark=seq)
            connection.execute(schema.versions.insert().values(**version_row(version)))
            add_blobs(connection, {digest: data for some in new.planes for digest, data in some.items()})
            set_tiles(connection, version.number, new.tiles)
            rows = [_decision_row(version.number, fused) for fused in new.fused if not fused.lost]
            if rows:
                insert_rows(connection, schema.decisions, rows)
            if unvoted is not None:
                end_votes(connection, unvoted, seq)
    except IntegrityError as error:
        raise Conflict(
            f"version {version.number} was published by somebody else meanwhile; look at it first"
        ) from error
    return version


def _decision_row(number: int, fused: Fused) -> tuple[object, ...]:
    """In the order of the table's columns."""
    counts, said = (fused.vehicles, fused.added, fused.deleted), (fused.states, fused.tally, fused.odds)
    return number, *fused.index, *said[:2], *counts, fused.odds, sum_of_decision(*said)
