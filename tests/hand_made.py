"""Small maps and ballots made by hand: tiles of a few walls, vehicles that say what a test wants them to say."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray
from pypcd4 import Encoding, PointCloud

from mapvote.codec.ballot import Ballot, BallotTile, check_path, pack_odds, pack_points, tile_key, unpack_planes
from mapvote.codec.fields import pack_fields
from mapvote.codec.planes import Words, compress, mark, nothing_reached, pack_plane, pack_words
from mapvote.codec.tile_planes import base_hash
from mapvote.core.geometry import rows_from
from mapvote.core.grid import CELL_SIZE, TILE_CELLS, Lattice, TileIndex
from mapvote.core.point_map import PointMap
from mapvote.core.points import Fields
from mapvote.core.reference import reference_window
from mapvote.core.tile import Tile
from mapvote.core.types import F32, F64, I8, NO_VOTE, U8, U16, U64, PosePrior, Scan
from mapvote.fusion.tile_vote import Vote
from mapvote.matching.odometry import Fix
from mapvote.perception.frontend import Observation, PlacedScan
from mapvote.perception.placement import find_obstacles
from mapvote.perception.raycast import ScanView

Cell = tuple[int, int]
SETTINGS = "5e771465" * 8
"""The digest of nobody's settings."""
SHAPE = (TILE_CELLS, TILE_CELLS)


def wall(cells: list[Cell], heights: list[float]) -> F32:
    """One point in the middle of each (cell, height) voxel, from the tile's corner."""
    points = [((c + 0.5) * CELL_SIZE, (r + 0.5) * CELL_SIZE, z) for r, c in cells for z in heights]
    return np.array(points, dtype=np.float32).reshape(-1, 3)


def make_tile(points: F32, ground: float = 0.0, index: TileIndex = (0, 0)) -> Tile:
    return Tile(Lattice().tile(index), points, np.full(SHAPE, ground, dtype=np.float32))


def make_map(tiles: Mapping[TileIndex, Tile]) -> PointMap:
    return PointMap("test-map", Lattice(), dict(tiles))


def one_scan(point_map: PointMap, points: F64) -> Observation:
    """A scan of the tile (0, 0): rays through everything but these points (n, 3), map metres."""
    grid = point_map.lattice.tile((0, 0))
    here = reference_window(point_map, grid)
    obstacle, cell = find_obstacles(points, here)
    hit = np.zeros(grid.shape, np.uint64)
    for k, z in zip(cell, points[:, 2], strict=True):
        hit.ravel()[k] |= np.uint64(1 << int(z // CELL_SIZE - here.base.ravel()[k]))
    still, origin = np.zeros(len(points), np.bool_), np.zeros(3)
    up, covariance = np.array([0.0, 0.0, 1.0]), 1e-4 * np.eye(3)
    scan = PlacedScan(0, rows_from(points, origin), origin, up, covariance, here, here, obstacle, cell)
    view = ScanView(grid, (hit != 0).astype(np.int32), hit, ~hit, np.zeros((0, 0), np.uint8))
    return Observation(scan, still, view, here)


def states_plane(cells: Mapping[Cell, int] | None = None, fill: int = NO_VOTE) -> U8:
    plane = np.full(SHAPE, fill, dtype=np.uint8)
    for cell, state in (cells or {}).items():
        plane[cell] = state
    return plane


def at_least(marked: Sequence[Words], k: int) -> U64:
    """(256, 256) the bits that at least ``k`` of ``marked`` set."""
    reached = nothing_reached(k)
    for mine in marked:
        mark(reached, mine.cells, mine.words)
    return np.asarray(reached[-1].reshape(SHAPE))


def words_plane(cells: Mapping[Cell, int]) -> U64:
    plane = np.zeros(SHAPE, dtype=np.uint64)
    for cell, word in cells.items():
        plane[cell] = word
    return plane


@dataclass
class Say:
    """A ballot's statement on one tile."""

    states: U8 | None = None
    tally: U16 | None = None
    gone: U64 | None = None
    new_points: F32 | None = None
    free: U64 | None = None
    fields: Fields | None = None
    odds: I8 | None = None

    def packed(self, tile: TileIndex) -> BallotTile:
        return BallotTile(
            tile=tile,
            states=None if self.states is None else pack_plane(self.states, 1),
            tally=None if self.tally is None else pack_plane(np.moveaxis(self.tally, -1, 0), 1),
            gone=None if self.gone is None else pack_words(Words.of(self.gone)),
            new_points=None if self.new_points is None else pack_points(self.new_points),
            free=None if self.free is None else pack_words(Words.of(self.free)),
            fields=compress(pack_fields(self.fields), 1) if self.fields else None,
            odds=None if self.odds is None else pack_odds(self.odds),
        )


def make_ballot(
    point_map: PointMap,
    says: Mapping[TileIndex, Say],
    vehicle: str = "v1",
    drive: str = "d1",
    end_ns: int = 1_000_000_000,
    method: str = "surfaces",
    settings_hash: str = SETTINGS,
    map_id: str | None = None,
    base: Mapping[TileIndex, str] | None = None,
    version: int | None = None,
) -> Ballot:
    hashes = {tile: base_hash(point_map.tiles.get(tile)) for tile in says} | dict(base or {})
    return Ballot(
        map_id=map_id or point_map.map_id,
        base={tile_key(tile): digest for tile, digest in hashes.items()},
        version=version or point_map.version or 1,
        vehicle=vehicle,
        drive=drive,
        start_ns=end_ns - 1_000_000_000,
        end_ns=end_ns,
        method=method,
        settings_hash=settings_hash,
        scans=10,
        scans_localised=10,
        median_sigma_m=0.01,
        tiles=[say.packed(tile) for tile, say in says.items()],
    )


def two_walls() -> PointMap:
    """Two neighbouring tiles: a wall of three cells in each, and ground points everywhere it stands."""
    cells = [(10, 10), (10, 11), (10, 12)]
    points = np.concatenate([wall(cells, [0.05]), wall(cells, [0.45, 0.75, 1.05])])
    return make_map({(0, 0): make_tile(points), (0, 1): make_tile(points.copy())})


def unpack_all(ballot: Ballot) -> list[Vote]:
    """Every plane unpacked; MapvoteError on the first that is damaged or impossible."""
    if ballot.path is not None:
        check_path(ballot.path, [tile.tile for tile in ballot.tiles])
    return [Vote().with_planes(unpack_planes(tile)) for tile in ballot.tiles]


class AtOnce:
    """A localiser that decides every scan when it comes, by a plain function."""

    def __init__(self, find: Callable[[Scan, PosePrior | None], Fix]) -> None:
        self._find = find

    def push(self, scan: Scan, prior: PosePrior | None) -> list[Fix]:
        return [self._find(scan, prior)]

    def flush(self) -> list[Fix]:
        return []


def save_pcd(path: Path, points: NDArray[np.floating], encoding: str, **fields: NDArray[Any]) -> None:
    """A PCD file of points (n, 3) and fields (n,) in their own types, by pypcd4: "ascii", "binary" or
    "binary_compressed"."""
    columns: Any = [*np.ascontiguousarray(points.T), *fields.values()]
    kinds = tuple(column.dtype.type for column in columns)
    PointCloud.from_points(columns, ("x", "y", "z", *fields), kinds).save(path, Encoding(encoding))
