"""Where a vehicle can have been: near the map, on one way, at heights that the map allows; and not at two places at
the same time.
"""

from __future__ import annotations

from collections.abc import Collection, Mapping, Sequence
from dataclasses import dataclass

import numpy as np

from mapvote.codec.ballot import tile_key
from mapvote.core.grid import CELL_SIZE, TILE_CELLS, TileIndex
from mapvote.core.record import record
from mapvote.core.types import F64, MapvoteError
from mapvote_server.store.examination import cells_of


@record()
@dataclass(frozen=True, slots=True)
class PlaceRule:
    """Places at which a ballot may vote."""

    below_m: float = 10.0
    """Depth of new points below the lowest ground of the map around them, metres."""
    above_m: float = 120.0
    """Height of new points above the lowest ground of the map around them, metres."""
    reach_m: float = 200.0
    """Distance of a vote from the map, metres: twice a LiDAR's range, so no vehicle that localised in the map votes
    beyond."""


PLACE_RULE = PlaceRule()
_TILE_M = TILE_CELLS * CELL_SIZE
_TILES_AWAY = int(PLACE_RULE.reach_m // _TILE_M) + 1


def refuse_far_tiles(tiles: Sequence[TileIndex], map_tiles: Collection[TileIndex]) -> MapvoteError | None:
    """The refusal of tiles on which a vehicle cannot have been: one farther than ``PlaceRule.reach_m`` from every tile
    of the map, or groups of them that lie farther apart than that. None if it may have been there."""
    for tile in tiles:
        if not any(index in map_tiles for index in around(tile)):
            return _too_far(tile)
    apart = _first_apart(list(tiles))
    if apart is not None:
        first, other = (tile_key(index) for index in apart)
        ways = f"tiles {first} and {other} lie on ways more than {PLACE_RULE.reach_m:.0f} m apart"
        return MapvoteError(f"{ways}: a drive is one way; send each part as a drive of its own")
    return None


def _too_far(tile: TileIndex) -> MapvoteError:
    far = f"tile {tile_key(tile)} has votes more than {PLACE_RULE.reach_m:.0f} m from the map"
    return MapvoteError(f"{far}: a vehicle votes on what it saw while it localised in the map")


def refuse_out_of_reach(spoken: Mapping[TileIndex, bytes], map_tiles: Collection[TileIndex]) -> MapvoteError | None:
    """The check of :func:`refuse_far_tiles`, by the cells of each tile on which a ballot votes (``spoken``, see
    :class:`mapvote_server.store.examination.Examination`)."""
    for tile, cells in spoken.items():
        if touched(tile, map_tiles):
            continue  # the whole tile is within reach
        near = [index for index in around(tile) if index in map_tiles]
        if not near or _farthest_m(tile, cells, near) > PLACE_RULE.reach_m:
            return _too_far(tile)
    return refuse_far_tiles(list(spoken), map_tiles)


_AROUND = [
    (row, col)
    for row in range(-_TILES_AWAY, _TILES_AWAY + 1)
    for col in range(-_TILES_AWAY, _TILES_AWAY + 1)
    if _TILE_M * float(np.hypot(max(abs(row) - 1, 0), max(abs(col) - 1, 0))) <= PLACE_RULE.reach_m
]
"""Steps to the tiles within reach of any part of a tile."""


def around(index: TileIndex) -> list[TileIndex]:
    """The tiles that are within reach of any part of a tile, itself too."""
    return [(index[0] + row, index[1] + col) for row, col in _AROUND]


def touched(index: TileIndex, map_tiles: Collection[TileIndex]) -> list[TileIndex]:
    """The map's tiles that touch a tile, corners included, itself too."""
    beside = ((index[0] + row, index[1] + col) for row in (-1, 0, 1) for col in (-1, 0, 1))
    return [tile for tile in beside if tile in map_tiles]


def _farthest_m(tile: TileIndex, spoken: bytes, near: Collection[TileIndex]) -> float:
    """From the map's nearest tile to the cell that is farthest from all of them, of those voted on; metres."""
    rows, cols = np.nonzero(cells_of(spoken))
    if not len(rows):
        return 0.0
    y = (tile[0] * TILE_CELLS + rows + 0.5) * CELL_SIZE
    x = (tile[1] * TILE_CELLS + cols + 0.5) * CELL_SIZE
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
        neighbours = [index for index in around(reached.pop()) if index in left]
        left.difference_update(neighbours)
        reached += neighbours
    return (tiles[0], min(left)) if left else None


@record()
@dataclass(frozen=True, slots=True)
class TwoPlaces:
    """When two drives of one vehicle cannot both be its own."""

    apart_m: float = 1000.0
    """Drives at the same time whose tiles are farther apart than this are at two places."""
    fastest_m_s: float = 70.0
    """A vehicle drives no faster from one drive to the next."""
    window_s: float = 60.0
    """Drives with a longer pause between them are not compared."""


TWO_PLACES = TwoPlaces()


def apart_m(one: Sequence[TileIndex], other: Sequence[TileIndex]) -> float:
    """The least distance between two groups of tiles, metres."""
    first = np.array(one, dtype=np.int64)
    second = np.array(other, dtype=np.int64)
    gaps = np.maximum(np.abs(first[:, None] - second[None]) - 1, 0) * _TILE_M
    return float(np.hypot(gaps[..., 0], gaps[..., 1]).min())


def are_two_places(distance_m: float, pause_s: float, numbers: TwoPlaces = TWO_PLACES) -> bool:
    """Whether no vehicle is at both ends of this distance, with this pause between its drives (0: they overlap)."""
    return distance_m > numbers.apart_m + numbers.fastest_m_s * pause_s
