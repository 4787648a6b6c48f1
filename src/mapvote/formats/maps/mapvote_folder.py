"""A mapvote map on disk: what a server sends, in a folder. Written whole, verified when read.

``manifest.json`` is a server's manifest (:mod:`mapvote.codec.manifest`), and other properties of the map.
``planes/HASH``: see :mod:`mapvote.codec.tile_planes`.
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from contextlib import contextmanager
from pathlib import Path

import msgspec
import numpy as np

from mapvote.codec.ballot import tile_index, tile_key
from mapvote.codec.manifest import Manifest, TileHashes, digests_of, shown
from mapvote.codec.planes import FRAME_HEAD, pack_plane, unpack_bytes
from mapvote.codec.tile_planes import check_plane, pack_tile, points_in_plane, unpack_tile
from mapvote.core.grid import CELL_SIZE, TILE_CELLS, TileIndex
from mapvote.core.point_map import LazyTiles, PointMap, held_points
from mapvote.core.tile import Tile
from mapvote.core.types import F64, MapvoteError
from mapvote.formats.atomic import whole_folder
from mapvote.formats.maps.cloud import READ_SIZES, ReadSizes
from mapvote.formats.reading import FILE_LIMITS, first_bytes, read_whole

MANIFEST = "manifest.json"
FORMAT = "mapvote-map"
FORMAT_VERSION = 1


class FolderManifest(Manifest, kw_only=True):
    """manifest.json. Members that a newer version adds are ignored; a higher ``format_version`` is refused."""

    format: str
    format_version: int
    cell_size: float
    tile_cells: int
    driven: tuple[bytes, ...] = ()
    """Positions of the sensor along each drive, (n, 3) float64, zstd."""
    surveyed_ns: int | None = None
    """When the last drive that it was made of ended."""


_DECODER = msgspec.json.Decoder(FolderManifest)


def is_map_folder(path: Path) -> bool:
    return (path / MANIFEST).is_file()


def write_map(point_map: PointMap, path: Path | str) -> None:
    """Write a mapvote map folder, whole or not at all. An older mapvote map there is replaced, anything else is not."""
    with whole_folder(path, sign=MANIFEST) as folder:
        (folder / "planes").mkdir()
        tiles = {}
        for index in sorted(point_map.tiles):
            hashes, planes = pack_tile(point_map.tiles[index])
            tiles[tile_key(index)] = hashes
            for digest, frame in planes.items():
                (folder / "planes" / digest).write_bytes(frame)
        digest, fields_digest = shown(*digests_of(tiles.items()))
        manifest = FolderManifest(
            format=FORMAT,
            format_version=FORMAT_VERSION,
            map_id=point_map.map_id,
            version=point_map.version or 1,
            cell_size=CELL_SIZE,
            tile_cells=TILE_CELLS,
            lattice=point_map.lattice,
            georeference=dict(sorted(point_map.georeference.items())),
            tiles=tiles,
            digest=digest,
            fields_digest=fields_digest,
            removed=[],
            driven=tuple(pack_plane(path) for path in point_map.driven),
            surveyed_ns=point_map.surveyed_ns,
        )
        (folder / MANIFEST).write_bytes(msgspec.json.format(msgspec.json.encode(manifest), indent=1) + b"\n")


def read_manifest(path: Path) -> FolderManifest:
    """The manifest of a map folder, checked; no tile is opened. MapvoteError if it is not one we can read."""
    file = path / MANIFEST
    try:
        manifest = _DECODER.decode(read_whole(file))
    except (OSError, msgspec.DecodeError, UnicodeDecodeError, RecursionError) as error:
        raise MapvoteError(f"{file}: not a readable map manifest ({error}); copy the map again") from error
    if manifest.format != FORMAT or not 1 <= manifest.format_version <= FORMAT_VERSION:
        raise MapvoteError(
            f"{file}: {manifest.format} {manifest.format_version}, but this mapvote reads {FORMAT} up to "
            f"{FORMAT_VERSION}; update mapvote"
        )
    if (manifest.cell_size, manifest.tile_cells) != (CELL_SIZE, TILE_CELLS):
        raise MapvoteError(
            f"{file}: cells of {manifest.cell_size} m in tiles of {manifest.tile_cells}; this mapvote works with "
            f"{CELL_SIZE} m and {TILE_CELLS}: export the points to PCD and import them"
        )
    if not manifest.is_whole():
        raise MapvoteError(f"{file}: its tiles are not those of its digest; copy the map again")
    return manifest


def read_map_folder(path: Path, sizes: ReadSizes = READ_SIZES) -> PointMap:
    """The map, every plane verified against the manifest. MapvoteError names the first tile that is not whole.

    A map larger than memory has all its planes verified now; each tile is read when it is used.
    """
    manifest = read_manifest(path)
    try:
        named = {tile_index(key): hashes for key, hashes in manifest.tiles.items()}
    except ValueError as error:
        raise MapvoteError(f"{path / MANIFEST}: the name of a tile is no row and column ({error})") from error

    side_m = np.float32(TILE_CELLS * CELL_SIZE)

    def load(index: TileIndex) -> Tile:
        with _whole(path, index):
            tile = unpack_tile(manifest.lattice.tile(index), named[index], _planes(path, named[index]))
        if not (np.isfinite(tile.points).all() and ((tile.points[:, :2] >= 0) & (tile.points[:, :2] < side_m)).all()):
            raise MapvoteError(f"{path}: tile {tile_key(index)} holds a point outside it or not finite; copy it again")
        return tile

    n_points = {}
    for index, hashes in named.items():
        with _whole(path, index):
            n_points[index] = points_in_plane(first_bytes(path / "planes" / hashes.points, FRAME_HEAD), hashes.points)
    # A small map is read at once. Of a large one only the planes' frames are checked.
    small = sum(map(held_points, n_points.values())) <= sizes.kept_points
    tiles: Mapping[TileIndex, Tile] = LazyTiles(load, n_points, sizes.kept_points)
    if small:
        tiles = {index: load(index) for index in named}
    for index, hashes in named.items() if not small else ():
        with _whole(path, index):
            for name, frame in _planes(path, hashes).items():
                check_plane(frame, hashes.planes()[name])
    driven = tuple(_positions(data, path) for data in manifest.driven)
    about = manifest.georeference, driven, manifest.version, manifest.surveyed_ns
    return PointMap(manifest.map_id, manifest.lattice, tiles, *about)


@contextmanager
def _whole(path: Path, index: TileIndex) -> Iterator[None]:
    """Whatever is wrong within is one MapvoteError that names a tile of the map at ``path``, or the file."""
    try:
        yield
    except OSError as error:
        problem = f"{error.filename}: {error.strerror}, but the manifest lists it; copy the map again"
        raise MapvoteError(problem) from error
    except MapvoteError as error:
        raise MapvoteError(f"{path}: tile {tile_key(index)}: {error}; copy the map again") from error


def _planes(path: Path, hashes: TileHashes) -> dict[str, bytes]:
    """The frames of a tile's planes, by name."""
    return {name: read_whole(path / "planes" / digest) for name, digest in hashes.planes().items()}


def _positions(data: bytes, path: Path) -> F64:
    """(n, 3) one driven path of the manifest of the map folder at ``path``."""
    flat = np.frombuffer(unpack_bytes(data, FILE_LIMITS.path_bytes, f"{path / MANIFEST}: driven"), dtype="<f8")
    if len(flat) % 3 or not np.isfinite(flat).all():
        raise MapvoteError(f"{path / MANIFEST}: a driven path is not whole; copy the map again")
    return flat.reshape(-1, 3)
