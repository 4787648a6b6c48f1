"""Where a fleet should drive next: stretches of road on which one more pass would decide cells, as GeoJSON."""

from __future__ import annotations

from collections import defaultdict
from functools import partial
from typing import Any

import numpy as np
import sqlalchemy as sa

from mapvote.codec.path import unpack_path
from mapvote.core.grid import CELL_SIZE, TileIndex
from mapvote.core.types import F64
from mapvote.fusion.next_pass import Stretch, Witness, stretches
from mapvote.fusion.tile_vote import TileVote, one_each
from mapvote.server.store import schema
from mapvote.server.store.policy import policy_in
from mapvote.server.store.store import Store
from mapvote.server.store.votes import (
    FOREVER,
    Electorate,
    from_sound_ballots,
    judged_votes,
    read_votes,
    standing_tiles,
)
from mapvote.server.views.explain import said_by
from mapvote.server.views.geojson import MAP_METRES


def wanted_passes(store: Store) -> list[Stretch]:
    """Over all tiles with standing votes, those that one more pass would do most for first."""
    found: list[Stretch] = []
    with store.database.reading() as connection:
        policy = policy_in(connection)
        everybody = Electorate(FOREVER, policy, FOREVER)
        driven = _driven(connection, store)

        def said_on(index: TileIndex, asked: Electorate) -> list[TileVote]:
            chosen = [vote for vote, why in judged_votes(connection, index, asked) if not why]
            return read_votes(connection, index, chosen)

        for index in standing_tiles(connection, FOREVER):
            window = store.lattice.tile(index)
            votes = one_each(from_sound_ballots(connection, everybody, partial(said_on, index)), window)
            witnesses = [Witness(said_by(vote), driven[vote.vehicle]) for vote in votes]
            found += stretches(window, witnesses, everybody.settings.min_votes)
    return sorted(found, key=lambda stretch: (-stretch.cells, stretch.tile, stretch.heading_rad))


def _driven(connection: sa.Connection, store: Store) -> dict[str, list[F64]]:
    """By vehicle: where each of its standing drives went, (n, 2) map metres."""
    b, p = schema.ballots.c, schema.paths.c
    query = sa.select(b.vehicle, p.path).join(schema.ballots, b.seq == p.ballot).where(b.gone_seq.is_(None))
    out = defaultdict[str, list[F64]](list)
    for vehicle, path in connection.execute(query.order_by(b.seq)):
        corner = np.array([store.lattice.x0, store.lattice.y0])
        out[vehicle].append(corner + (unpack_path(path)[:, ::-1] + 0.5) * CELL_SIZE)
    return out


def as_features(wanted: list[Stretch]) -> dict[str, Any]:
    """GeoJSON lines in map metres, each in the direction to drive, with what one more pass would decide there."""
    features = [
        {
            "type": "Feature",
            "geometry": {"type": "LineString", "coordinates": np.round(stretch.path_m, 2).tolist()},
            "properties": {
                "row": stretch.tile[0],
                "col": stretch.tile[1],
                "heading_deg": round(float(np.degrees(stretch.heading_rad))),
                "cells": stretch.cells,
                "built": stretch.built,
                "gone": stretch.gone,
            },
        }
        for stretch in wanted
    ]
    return {"type": "FeatureCollection", "frame": MAP_METRES, "features": features}
