"""Where a vehicle can have been: near the map, and on one way. Lies about the other end of the world end here."""

from __future__ import annotations

from collections.abc import Callable, Collection, Iterator, Mapping

import numpy as np
import sqlalchemy as sa

from mapvote.codec.ballot import Ballot, BallotTile, tile_key
from mapvote.codec.points import unpack_points
from mapvote.core.grid import CELL_SIZE, TILE_CELLS, TileIndex
from mapvote.core.types import F64, Bool, MapvoteError
from mapvote.fusion.offline import tile_vote
from mapvote.server.store.blobs import TileHashes, unpack_ground_plane
from mapvote.server.store.queries import load_blob

MAX_BELOW_M, MAX_ABOVE_M = 10.0, 120.0
"""New points lie between so much below and so much above the lowest ground of the map around them."""
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


class LowestGround:
    """How deep the ground of each tile lies, by its plane's hash: looked up in the store once. For any threads."""

    def __init__(self) -> None:
        self._known: dict[str, float] = {}

    def look_up(self, connection: sa.Connection, ground: str) -> float:
        """Map metres; inf where the ground is unknown, or its plane damaged."""
        if ground not in self._known:
            try:
                plane = unpack_ground_plane(load_blob(connection, ground), ground)
            except MapvoteError:
                return np.inf
            known = plane[np.isfinite(plane)]
            self._known[ground] = float(known.min()) if len(known) else np.inf
        return self._known[ground]


def refuse_out_of_height(
    ballot: Ballot, map_tiles: Mapping[TileIndex, TileHashes], lowest_m: Callable[[str], float]
) -> MapvoteError | None:
    """Why a ballot brings points deeper or higher than anything on this map can be; None if it may.

    ``lowest_m``: of a ground plane by its hash. The nearest tiles tell: itself and its neighbours, else those in reach.
    """
    for tile in ballot.tiles:
        heights = () if tile.new_points is None else unpack_points(tile.new_points)[:, 2]
        if not len(heights):
            continue
        near = [index for index in _around(tile.tile) if index in map_tiles]
        touching = [index for index in near if max(abs(index[0] - tile.tile[0]), abs(index[1] - tile.tile[1])) <= 1]
        lowest = min((lowest_m(map_tiles[index].ground) for index in touching or near), default=np.inf)
        if np.isfinite(lowest) and not lowest - MAX_BELOW_M <= min(heights) <= max(heights) <= lowest + MAX_ABOVE_M:
            span = f"{min(heights):.1f} to {max(heights):.1f} m on tile {tile_key(tile.tile)}"
            allowed = (
                f"{MAX_BELOW_M:g} m below to {MAX_ABOVE_M:g} m above the map's lowest ground there, {lowest:.1f} m"
            )
            return MapvoteError(f"new points at {span} are not within {allowed}: is the vehicle on this level?")
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
