"""An Autoware folder that a running stack reads while versions come and go.

Autoware's differential loader takes the path of a tile for its identity, and reads the metadata once, when it starts.
So a tile's name changes with its content (X_Y_HASH8.pcd), the metadata is replaced last and atomically, and tiles of
the last few versions stay for loaders that still go by older metadata.
"""

from __future__ import annotations

import hashlib
from collections.abc import Collection
from dataclasses import dataclass
from pathlib import Path

import msgspec
import numpy as np

from mapvote.core.types import MapvoteError
from mapvote.formats.atomic import whole_file
from mapvote.formats.geo.projector import PROJECTOR, projector_of
from mapvote.formats.maps.autoware import FOLLOWED, HISTORY, METADATA, SIDE_M, TILES, metadata, squares
from mapvote.formats.maps.cloud import Cloud, CloudPieces
from mapvote.formats.maps.pcd import save_pcd


class _Laid(msgspec.Struct):
    """One version in the folder's history."""

    version: int
    tiles: list[str]


@dataclass(frozen=True, slots=True)
class Change:
    """What laying a version did to the folder."""

    version: int
    tiles: int
    written: int
    deleted: int


def laid_version(folder: Path) -> int | None:
    """The version that the folder's metadata shows; None if none was laid there."""
    history = _history(folder)
    return history[-1].version if history and (folder / METADATA).is_file() else None


def names_of(where: str, cloud: Cloud | CloudPieces, side_m: int = SIDE_M) -> list[str]:
    """The files that a cloud's tiles would be; ``where`` is for messages."""
    return [f"{x}_{y}_{_hash8(tile)}.pcd" for (x, y), tile in squares(where, cloud, side_m)]


def lay_version(
    folder: Path,
    cloud: Cloud | CloudPieces,
    version: int,
    *,
    keep: int = 3,
    side_m: int = SIDE_M,
    known: Collection[str] = (),
) -> Change:
    """Show ``cloud`` (map metres, in a frame that Autoware knows) in ``folder``; only tiles that it lacks are written,
    and of those none that is ``known`` where the folder goes.

    Tiles of the ``keep`` versions before stay. At every moment the metadata there names only whole tiles. MapvoteError
    if the folder holds a map of somebody else.
    """
    if (folder / METADATA).is_file() and not (folder / HISTORY).is_file():
        raise MapvoteError(f"{folder}: holds an Autoware map that mapvote follow did not make; choose another folder")
    if keep < 0:
        raise MapvoteError(f"--keep {keep}: a number of versions, 0 or more")
    tiles = folder / TILES
    tiles.mkdir(parents=True, exist_ok=True)
    corners: dict[str, tuple[int, int]] = {}
    written = 0
    for (x, y), tile in squares(str(folder), cloud, side_m):
        name = f"{x}_{y}_{_hash8(tile)}.pcd"
        corners[name] = x, y
        if name not in known and not (tiles / name).is_file():
            with whole_file(tiles / name) as partial:
                save_pcd(partial, tile.points, tile.fields)
            written += 1
    history = [laid for laid in _history(folder) if laid.version != version] + [_Laid(version, list(corners))]
    _write(folder / HISTORY, msgspec.json.encode(history[-keep - 1 :]))
    _write(folder / PROJECTOR, projector_of(cloud.frame).encode())
    _write(folder / METADATA, metadata(corners, side_m).encode())
    needed = {name for laid in history[-keep - 1 :] for name in laid.tiles}
    stale = [file for file in tiles.iterdir() if FOLLOWED.fullmatch(file.name) and file.name not in needed]
    for file in stale:
        file.unlink()
    return Change(version, len(corners), written, len(stale))


def _hash8(tile: Cloud) -> str:
    digest = hashlib.sha256(np.ascontiguousarray(tile.points, dtype="<f4").tobytes())
    for name in sorted(tile.fields):
        digest.update(name.encode() + np.ascontiguousarray(tile.fields[name]).tobytes())
    return digest.hexdigest()[:8]


def _history(folder: Path) -> list[_Laid]:
    file = folder / HISTORY
    if not file.is_file():
        return []
    try:
        return msgspec.json.decode(file.read_bytes(), type=list[_Laid])
    except (OSError, msgspec.DecodeError) as error:
        raise MapvoteError(f"{file}: cannot be read ({error}); empty the folder and follow again") from error


def _write(file: Path, content: bytes) -> None:
    if not (file.is_file() and file.read_bytes() == content):
        with whole_file(file) as partial:
            partial.write_bytes(content)
