"""Where vehicles have been: tiles that they saw, and the paths that they drove."""

from __future__ import annotations

from collections import defaultdict
from functools import cache
from typing import Any

import numpy as np
import sqlalchemy as sa

from mapvote.codec.ballot import unpack_path
from mapvote.core.grid import CELL_SIZE, TILE_CELLS, TileIndex
from mapvote.core.types import F32, F64, I64
from mapvote.fusion.next_pass import Stretch, Witness, stretches
from mapvote.server.store import schema
from mapvote.server.store.policy import policy_in
from mapvote.server.store.queries import current_version, load_tile, tiles_of
from mapvote.server.store.store import Store
from mapvote.server.views.explain import said_by, seen, votes_by_tile
from mapvote.server.views.geojson import collection, utc


def wanted_passes(store: Store) -> list[Stretch]:
    """Over all tiles with standing votes, those that one more pass would do most for first."""
    found: list[Stretch] = []
    with store.database.reading() as connection:
        policy, driven = policy_in(connection), _driven(connection, store)
        for window, votes in votes_by_tile(connection, store.lattice, policy):
            witnesses = [Witness(said_by(vote), driven[vote.vehicle]) for vote in votes]
            found += stretches(window, witnesses, policy.fuse.min_votes)
    return sorted(found, key=lambda stretch: (-stretch.cells, stretch.tile, stretch.heading_rad))


def _driven(connection: sa.Connection, store: Store) -> dict[str, list[F64]]:
    """By vehicle: the path of each of its standing drives, (n, 2) map metres."""
    b, p = schema.ballots.c, schema.paths.c
    query = sa.select(b.vehicle, p.path).join(schema.ballots, b.seq == p.ballot).where(b.gone_seq.is_(None))
    out = defaultdict[str, list[F64]](list)
    for vehicle, path in connection.execute(query.order_by(b.seq)):
        corner = np.array([store.lattice.x0, store.lattice.y0])
        out[vehicle].append(corner + (unpack_path(path)[:, ::-1] + 0.5) * CELL_SIZE)
    return out


def as_features(wanted: list[Stretch]) -> dict[str, Any]:
    """GeoJSON lines in map metres, each in the direction to drive, with what one more pass would decide there."""
    return collection(
        [
            (
                {"type": "LineString", "coordinates": np.round(stretch.path_m, 2).tolist()},
                {
                    "row": stretch.tile[0],
                    "col": stretch.tile[1],
                    "heading_deg": round(float(np.degrees(stretch.heading_rad))),
                    "cells": stretch.cells,
                    "built": stretch.built,
                    "gone": stretch.gone,
                },
            )
            for stretch in wanted
        ]
    )


def tiles_seen(store: Store, known: bool) -> list[dict[str, Any]]:
    """Per tile of the map or of a standing ballot: number of vehicles, end of the last drive past it as far as may be
    ``known``, see :func:`mapvote.server.views.explain.seen`."""
    b, t = schema.ballots, schema.ballot_tiles
    last = sa.select(t.c.row, t.c.col, sa.func.max(b.c.end_ns), sa.func.count(sa.distinct(b.c.vehicle)))
    last = last.join(b, b.c.seq == t.c.ballot).where(b.c.gone_seq.is_(None)).group_by(t.c.row, t.c.col)
    with store.database.reading() as connection:
        tiles: dict[TileIndex, tuple[int | None, int]] = dict.fromkeys(
            tiles_of(connection, current_version(connection).number), (None, 0)
        )
        tiles |= {(row[0], row[1]): (row[2], row[3]) for row in connection.execute(last)}
    return [
        {"row": index[0], "col": index[1], "vehicles": vehicles, "last_seen": utc(seen(last_ns, known))}
        for index, (last_ns, vehicles) in sorted(tiles.items())
    ]


MOST_PATHS = 500
"""The last drives."""


def paths(store: Store, vehicle: str | None = None) -> dict[str, Any]:
    """GeoJSON lines [x, y, z] in map metres of standing ballots that carry a path, the newest drive first; of one
    ``vehicle`` only, if named. Where the map has no ground height, the last one along the path is used."""
    b, p = schema.ballots.c, schema.paths.c
    query = sa.select(b.vehicle, b.drive, b.start_ns, b.end_ns, b.version, p.path)
    query = query.join(schema.ballots, b.seq == p.ballot).where(b.gone_seq.is_(None))
    if vehicle is not None:
        query = query.where(b.vehicle == vehicle)
    with store.database.reading() as connection:
        rows = connection.execute(query.order_by(b.end_ns.desc()).limit(MOST_PATHS)).all()
        driven = [unpack_path(row.path) for row in rows]
        touched = {(int(r), int(c)) for path in driven for r, c in np.unique(path // TILE_CELLS, axis=0)}
        known = tiles_of(connection, current_version(connection).number, sorted(touched)) if touched else {}

        @cache
        def ground(index: TileIndex) -> F32:
            return load_tile(connection, store.lattice.tile(index), known.get(index)).ground_z

        lines = [_line(store, path, ground) for path in driven]
    return collection(
        [
            (
                {"type": "LineString", "coordinates": line},
                {
                    "vehicle": row.vehicle,
                    "drive": row.drive,
                    "start": utc(row.start_ns),
                    "end": utc(row.end_ns),
                    "version": row.version,
                    "length_m": round(float(np.hypot(*np.diff(np.array(line)[:, :2], axis=0).T).sum()), 1),
                },
            )
            for row, line in zip(rows, lines, strict=True)
        ]
    )


def _line(store: Store, path: I64, ground: Any) -> list[list[float]]:
    rows, cols = path.T
    z = np.array(
        [ground((int(r) // TILE_CELLS, int(c) // TILE_CELLS))[r % TILE_CELLS, c % TILE_CELLS] for r, c in path]
    )
    known = np.maximum.accumulate(np.where(np.isfinite(z), np.arange(len(z)), -1))
    first = z[np.isfinite(z)][0] if np.isfinite(z).any() else 0.0
    height = np.where(known >= 0, z[known], first)
    x, y = store.lattice.x0 + (cols + 0.5) * CELL_SIZE, store.lattice.y0 + (rows + 0.5) * CELL_SIZE
    line: list[list[float]] = np.round(np.column_stack([x, y, height]), 2).tolist()
    return line
