"""A mapvote map on disk: a folder of tiles and one manifest, written whole, verified when read.

``manifest.json`` holds the lattice, the georeference and of every tile its file, its content hash (points), the
hash of its known-free columns and the SHA-256 of its bytes. ``tiles/ROW_COL.tile``: see :mod:`mapvote.codec.tile_file`.
"""

from __future__ import annotations

import hashlib
from pathlib import Path

import msgspec
import numpy as np

from mapvote.codec.arrays import pack_plane, unpack_bytes
from mapvote.codec.ballot import tile_key
from mapvote.codec.tile_file import content_hash, decode_tile, encode_tile, free_hash
from mapvote.core.grid import CELL_SIZE, TILE_CELLS, Lattice, TileIndex
from mapvote.core.lazy_tiles import LazyTiles, in_memory_if_small
from mapvote.core.point_map import PointMap
from mapvote.core.tile import Tile
from mapvote.core.types import F64, MapvoteError
from mapvote.formats.atomic import whole_folder

MANIFEST = "manifest.json"
FORMAT = "mapvote-map"
FORMAT_VERSION = 1
MAX_PATH_BYTES = 240_000_000
"""Ten million scans: eleven days at 10 Hz."""


class TileEntry(msgspec.Struct, frozen=True, kw_only=True):
    tile: tuple[int, int]
    file: str
    points: int
    content_hash: str
    free_hash: str
    sha256: str


class Manifest(msgspec.Struct, frozen=True, kw_only=True):
    """manifest.json. Fields that a newer version adds are ignored; a higher ``format_version`` is refused."""

    format: str
    format_version: int
    map_id: str
    cell_size: float
    tile_cells: int
    x0: float
    y0: float
    georeference: dict[str, str]
    tiles: list[TileEntry]
    driven: list[bytes] = []
    """Positions of the sensor along each drive, (n, 3) float64, zstd."""
    version: int = 1
    """How often the map was published: ballots name it."""
    surveyed_ns: int | None = None
    """When the last drive that it was made of ended."""


_MANIFEST = msgspec.json.Decoder(Manifest)


def is_map_folder(path: Path) -> bool:
    return (path / MANIFEST).is_file()


def write_map_folder(point_map: PointMap, path: Path) -> None:
    """Write the map whole or not at all; an older mapvote map at ``path`` is replaced, anything else is not."""
    with whole_folder(path, sign=MANIFEST) as folder:
        (folder / "tiles").mkdir()
        entries = []
        for key in sorted(point_map.tiles):
            tile = point_map.tiles[key]
            data = encode_tile(tile)
            name = f"tiles/{key[0]}_{key[1]}.tile"
            (folder / name).write_bytes(data)
            entries.append(
                TileEntry(
                    tile=key,
                    file=name,
                    points=len(tile.points),
                    content_hash=content_hash(tile.points),
                    free_hash=free_hash(tile.free),
                    sha256=hashlib.sha256(data).hexdigest(),
                )
            )
        manifest = Manifest(
            format=FORMAT,
            format_version=FORMAT_VERSION,
            map_id=point_map.map_id,
            cell_size=CELL_SIZE,
            tile_cells=TILE_CELLS,
            x0=point_map.lattice.x0,
            y0=point_map.lattice.y0,
            georeference=dict(sorted(point_map.georeference.items())),
            tiles=entries,
            driven=[pack_plane(path) for path in point_map.driven],
            version=point_map.version or 1,
            surveyed_ns=point_map.surveyed_ns,
        )
        (folder / MANIFEST).write_bytes(msgspec.json.format(msgspec.json.encode(manifest), indent=1) + b"\n")


def read_manifest(path: Path) -> Manifest:
    """The manifest of a map folder, checked; no tile is opened. MapvoteError if it is not one we can read."""
    file = path / MANIFEST
    try:
        manifest = _MANIFEST.decode(file.read_bytes())
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
    return manifest


def read_map_folder(path: Path) -> PointMap:
    """The map, every tile verified against the manifest. MapvoteError names the first tile that is not whole.

    Of a map larger than memory the bytes of all files are verified now, and each tile is read when it is asked for.
    """
    manifest = read_manifest(path)
    lattice = Lattice(manifest.x0, manifest.y0)
    entries = {entry.tile: entry for entry in manifest.tiles}
    if len(entries) < len(manifest.tiles):
        raise MapvoteError(f"{path / MANIFEST}: lists a tile twice; copy the map again")

    def load(index: TileIndex) -> Tile:
        file, data = _bytes_of(path, entries[index])
        tile = decode_tile(data, lattice.tile(index), str(file))
        if (content_hash(tile.points), len(tile.points)) != (entries[index].content_hash, entries[index].points):
            raise MapvoteError(f"{path / MANIFEST}: tile {tile_key(index)} contradicts its file; copy the map again")
        return tile

    tiles = in_memory_if_small(LazyTiles(load, {index: entry.points for index, entry in entries.items()}))
    if isinstance(tiles, LazyTiles):
        for entry in manifest.tiles:
            _bytes_of(path, entry)
    driven = tuple(_positions(data, path) for data in manifest.driven)
    versioned = manifest.version, manifest.surveyed_ns
    return PointMap(manifest.map_id, lattice, tiles, manifest.georeference, driven, *versioned)


def _bytes_of(path: Path, entry: TileEntry) -> tuple[Path, bytes]:
    """The file of a tile and what is in it; MapvoteError if that is not what the manifest says."""
    file = path / f"tiles/{entry.tile[0]}_{entry.tile[1]}.tile"
    try:
        data = file.read_bytes()
    except OSError as error:
        raise MapvoteError(f"{file}: {error.strerror}, but the manifest lists it; copy the map again") from error
    if hashlib.sha256(data).hexdigest() != entry.sha256:
        raise MapvoteError(f"{file}: its bytes are not those of the manifest; copy the map again")
    return file, data


def _positions(data: bytes, path: Path) -> F64:
    """(n, 3) one driven path of the manifest of the map folder at ``path``."""
    flat = np.frombuffer(unpack_bytes(data, MAX_PATH_BYTES, f"{path / MANIFEST}: driven"), dtype="<f8")
    if len(flat) % 3 or not np.isfinite(flat).all():
        raise MapvoteError(f"{path / MANIFEST}: a driven path is not whole; copy the map again")
    return flat.reshape(-1, 3)
