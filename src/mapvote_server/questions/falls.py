"""With which demolished object the points of a cell fell (fusion/gravity.py), in words."""

from __future__ import annotations

from collections.abc import Iterator

import numpy as np
import sqlalchemy as sa

from mapvote.core.grid import TILE_CELLS, TileIndex
from mapvote.core.types import MapvoteError
from mapvote.fusion.decision_record import Record
from mapvote.fusion.gravity import lattice_cell
from mapvote.shapes.change_objects import ChangedCells, change_objects, changed_cells
from mapvote_server.store.queries import load_tile, records_of, tiles_that_differ
from mapvote_server.store.store import Store

_AROUND = 2
"""Tiles in each direction in which the object is looked for: none is longer (``Gravity.longest_object_cells``)."""


def fell_with(store: Store, connection: sa.Connection, index: TileIndex, record: Record, cell: tuple[int, int]) -> str:
    """ "fell with object N: nothing holds it" of a (row, col) of a tile, by the record of one version; "" if it did not
    fall, or if the record is damaged."""
    try:
        cells, beside = record.fell
    except MapvoteError:
        return ""
    at = np.flatnonzero(cells == cell[0] * TILE_CELLS + cell[1])
    if not len(at):
        return ""
    return f"fell with {_object_at(store, connection, index, record.version, int(beside[at[0]]))}: nothing holds it"


def _object_at(store: Store, connection: sa.Connection, index: TileIndex, version: int, key: int) -> str:
    """The id of the object that a version demolished at a cell of the lattice."""
    row, col = lattice_cell(key)
    for one in change_objects(list(_changed_around(store, connection, index, version))):
        if one.kind == "demolished" and ((one.where[0] == row) & (one.where[1] == col)).any():
            return f"object {one.id}"
    return f"an object that version {version} demolished"


def _changed_around(store: Store, connection: sa.Connection, index: TileIndex, version: int) -> Iterator[ChangedCells]:
    """The cells that a version changed in the tiles around one, without what cannot be read."""
    for other, *pair in tiles_that_differ(connection, version - 1, version):
        if max(abs(other[0] - index[0]), abs(other[1] - index[1])) > _AROUND:
            continue
        try:
            before, after = (load_tile(connection, store.lattice.tile(other), hashes) for hashes in pair)
            records = records_of(connection, other, after=version - 1, upto=version)
            yield changed_cells(before, after, [(record, ()) for record in records])
        except MapvoteError:
            continue
