"""Where a vehicle can have been: near the map, and on one way. Lies about the other end of the world end here."""

from __future__ import annotations

from collections.abc import Collection, Iterator

import numpy as np

from mapvote.codec.ballot import Ballot, BallotTile, tile_key
from mapvote.core.grid import CELL_SIZE, TILE_CELLS, TileIndex
from mapvote.core.types import F64, Bool, MapvoteError
from mapvote.fusion.offline import tile_vote

MAX_REACH_M = 200.0
"""Twice what a LiDAR sees: a vote farther from the map than this cannot come from a vehicle that localised in it."""
_TILE_M = TILE_CELLS * CELL_SIZE
_TILES_AWAY = int(MAX_REACH_M // _TILE_M) + 1


def refuse_out_of_reach(ballot: Ballot, map_tiles: Collection[TileIndex]) -> MapvoteError | None:
    """Why a ballot votes where its vehicle cannot have been: on a cell more than MAX_REACH_M from every tile of the
    map, or on tiles in groups that lie farther apart than that. None if it may have been there."""
    for tile in ballot.tiles:
        near = [index for index in _around(tile.tile) if index in map_tiles]
        if _within(tile.tile, near):
            continue
        if not near or _farthest_m(ballot, tile, near) > MAX_REACH_M:
            where = f"tile {tile_key(tile.tile)} has votes more than {MAX_REACH_M:.0f} m from the map"
            return MapvoteError(f"{where}: a vehicle votes on what it saw while it localised in the map")
    apart = _first_apart([tile.tile for tile in ballot.tiles])
    if apart is not None:
        first, other = (tile_key(index) for index in apart)
        why = f"tiles {first} and {other} lie on ways more than {MAX_REACH_M:.0f} m apart"
        return MapvoteError(f"{why}: a drive is one way; send each part as a drive of its own")
    return None


def _around(index: TileIndex) -> Iterator[TileIndex]:
    """The tiles that are within reach of any part of a tile, itself too."""
    for row in range(-_TILES_AWAY, _TILES_AWAY + 1):
        for col in range(-_TILES_AWAY, _TILES_AWAY + 1):
            if _TILE_M * float(np.hypot(max(abs(row) - 1, 0), max(abs(col) - 1, 0))) <= MAX_REACH_M:
                yield index[0] + row, index[1] + col


def _within(index: TileIndex, near: Collection[TileIndex]) -> bool:
    """Whether the whole tile is within reach, since it, or one that it touches, is in the map."""
    return any(abs(index[0] - row) <= 1 and abs(index[1] - col) <= 1 for row, col in near)


def _farthest_m(ballot: Ballot, tile: BallotTile, near: Collection[TileIndex]) -> float:
    """From the map's nearest tile to the cell that is farthest from all of them, of those voted on; metres."""
    spoken: Bool = tile_vote(ballot, tile, "").spoken()
    rows, cols = np.nonzero(spoken)
    if not len(rows):
        return 0.0
    y = (tile.tile[0] * TILE_CELLS + rows + 0.5) * CELL_SIZE
    x = (tile.tile[1] * TILE_CELLS + cols + 0.5) * CELL_SIZE
    least: F64 = np.full(len(rows), np.inf)
    for row, col in near:
        dy = np.maximum(np.maximum(row * _TILE_M - y, y - (row + 1) * _TILE_M), 0.0)
        dx = np.maximum(np.maximum(col * _TILE_M - x, x - (col + 1) * _TILE_M), 0.0)
        least = np.minimum(least, np.hypot(dx, dy))
    return float(least.max())


def _first_apart(tiles: list[TileIndex]) -> tuple[TileIndex, TileIndex] | None:
    """The first tile, and one that cannot be reached from it over the others; None if there is none."""
    left = set(tiles[1:]) - {tiles[0]}
    reached = [tiles[0]]
    while reached and left:
        found = [index for index in _around(reached.pop()) if index in left]
        left.difference_update(found)
        reached += found
    return (tiles[0], min(left)) if left else None
