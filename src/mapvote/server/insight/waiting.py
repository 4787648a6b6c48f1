"""Deletions beyond the policy's budget, thing by thing: why they wait, and where somebody should drive by."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np

from mapvote.core.columns import EVERY_BIT
from mapvote.core.grid import CELL_SIZE, CELLS, TILE_CELLS, TileIndex
from mapvote.core.tile import Tile
from mapvote.fusion.edit import delete_points
from mapvote.fusion.pending import Pending
from mapvote.server.insight.changes import ChangeObject, change_objects, changed_cells
from mapvote.server.insight.geojson import to_geojson
from mapvote.server.store.fusion_jobs import Fused
from mapvote.server.store.queries import load_tile, tile_of
from mapvote.server.store.store import Store

_WAITS = "waits."


def waiting_features(store: Store, version: int, fused: Sequence[Fused], budget: float) -> list[dict[str, Any]]:
    """What would go from a version's tiles but for the ``budget``, as GeoJSON features in map metres.

    With "waits", the reason; "false_deletion", the largest of its cells' probabilities that something that stands goes;
    "drive_by", the middle of its cells.
    """
    waits = {one.index: one.pending for one in fused if len(one.pending.cells)}
    tiles = {}
    for index in waits:
        window = store.lattice.tile(index)
        with store.database.reading() as connection:
            tiles[index] = load_tile(connection, window, tile_of(connection, version, index))
    objects = change_objects(changed_cells(tile, _emptied(tile, waits[index])) for index, tile in tiles.items())
    features: list[dict[str, Any]] = to_geojson(objects, store.lattice, map_id=store.map_id)["features"]
    for change, feature in zip(objects, features, strict=True):
        rows, cols = change.where
        likeliest = _likeliest(change, waits)
        middle = [store.lattice.x0, store.lattice.y0] + CELL_SIZE * (np.array([cols.mean(), rows.mean()]) + 0.5)
        feature["id"] = _WAITS + change.id
        feature["properties"] |= {
            "verdict": None,
            "waits": f"deleting it takes something that stands with a probability of up to {likeliest:.2g}; "
            f"the policy allows {budget:g}",
            "false_deletion": round(likeliest, 6),
            "drive_by": [round(float(value), 2) for value in middle],
        }
    return features


def _emptied(tile: Tile, waits: Pending) -> Tile:
    words = np.zeros(CELLS, dtype=np.uint64)
    words[waits.cells] = EVERY_BIT
    return delete_points(tile, words.reshape(TILE_CELLS, TILE_CELLS))[0]


def _likeliest(change: ChangeObject, waits: Mapping[TileIndex, Pending]) -> float:
    """Of the probabilities of its cells the largest."""
    rows, cols = change.where
    largest = 0.0
    for index, pending in waits.items():
        mine = (rows // TILE_CELLS == index[0]) & (cols // TILE_CELLS == index[1])
        cells = rows[mine] % TILE_CELLS * TILE_CELLS + cols[mine] % TILE_CELLS
        largest = max(largest, float(pending.probability[np.isin(pending.cells, cells)].max(initial=0.0)))
    return largest
