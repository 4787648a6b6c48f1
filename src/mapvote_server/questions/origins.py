"""Where the points of a map come from: the version that brought each, and how many vehicles voted for it."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import replace
from typing import Any

import numpy as np
import sqlalchemy as sa
from numpy.typing import NDArray

from mapvote.codec.tile_planes import unpack_points_plane
from mapvote.core.grid import TileIndex
from mapvote.core.point_map import LazyTiles, PointMap
from mapvote.core.tile import Tile
from mapvote.core.types import F32, I64, CellState
from mapvote.core.voxels import found_among
from mapvote.fusion.decision_record import Record
from mapvote_server.store import schema
from mapvote_server.store.queries import load_blob, oldest_kept
from mapvote_server.store.store import Store
from mapvote_server.work import check_time


def with_origins(store: Store, point_map: PointMap) -> PointMap:
    """A version of the store with two more fields of each point.

    ``source_version``, uint32: the version from which on the map has it; of a point that is older than all versions
    that are kept, the oldest one that shows it. ``votes``, uint16: the vehicles that voted for it. For a point that a
    publish added, those that voted for the addition; for any other, those that confirmed its cell when its tile was
    last decided; 0 if none did.

    Tiles are read when they are used, while the store is open: TooSlow if the present work takes too long.
    """
    assert point_map.version is not None
    number = point_map.version

    def load(index: TileIndex) -> Tile:
        check_time()
        tile = point_map.tiles[index]
        with store.database.reading() as connection:
            fields = _origins(connection, tile, number)
        return tile.but(fields={**tile.fields, **fields})

    points = {index: len(tile.points) for index, tile in point_map.tiles.items()}
    if isinstance(point_map.tiles, LazyTiles):
        points = point_map.tiles.points_of
    return replace(point_map, tiles=LazyTiles(load, points))


def _origins(connection: sa.Connection, tile: Tile, number: int) -> Mapping[str, NDArray[Any]]:
    """The two fields of a tile of version ``number``."""
    source = _sources(connection, tile, number)
    records = _records(connection, tile.index, number, np.unique(source).tolist())
    votes = np.zeros(len(source), dtype=np.uint16)
    if records:
        confirmed = _votes_for(records[max(records)], CellState.UNCHANGED_OCCUPIED)
        votes = confirmed[tile.cells]
    for version, record in records.items():
        brought = np.flatnonzero(source == version)
        votes[brought] = _votes_for(record, CellState.CHANGED_OCCUPIED)[tile.cells[brought]]
    return {"source_version": source.astype(np.uint32), "votes": votes}


def _votes_for(record: Record, state: CellState) -> NDArray[np.uint16]:
    """(65536,) vehicles that voted for a state of each flat cell."""
    votes = record.votes[..., int(state)].reshape(-1)
    return np.minimum(votes, np.iinfo(np.uint16).max, dtype=np.int64).astype(np.uint16)


def _sources(connection: sa.Connection, tile: Tile, number: int) -> I64:
    """(n,) the version from which on the map has each point without a break."""
    t = schema.version_tiles
    rows = sa.select(t.c.version, t.c.points).where(t.c.row == tile.index[0], t.c.col == tile.index[1])
    history = connection.execute(rows.where(t.c.version <= number).order_by(t.c.version.desc())).all()
    oldest = oldest_kept(connection)
    source = np.zeros(len(tile.points), dtype=np.int64)
    older = np.arange(len(source))
    last = history[0]
    for before in history[1:]:
        if last.version <= oldest or not len(older):
            break
        if last.points != before.points:
            there = found_among(tile.points[older], _points(connection, before.points))
            source[older[~there]] = last.version
            older = older[there]
        last = before
    source[older] = last.version
    return source


def _points(connection: sa.Connection, digest: str | None) -> F32:
    if digest is None:
        return np.empty((0, 3), dtype=np.float32)
    return unpack_points_plane(load_blob(connection, digest), digest)


def _records(connection: sa.Connection, index: TileIndex, number: int, versions: list[int]) -> dict[int, Record]:
    """The decisions on a tile by version: those of ``versions``, and the last one up to ``number``."""
    d = schema.decisions
    here = (d.c.row == index[0]) & (d.c.col == index[1]) & (d.c.version <= number)
    last = sa.select(sa.func.max(d.c.version)).where(here).scalar_subquery()
    query = sa.select(d.c.version, d.c.states, d.c.tally, d.c.odds, d.c.standings)
    rows = connection.execute(query.where(here, d.c.version.in_(versions) | (d.c.version == last)))
    return {row.version: Record(*row) for row in rows}
