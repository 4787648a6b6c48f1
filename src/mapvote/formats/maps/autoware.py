"""Autoware's tiled maps: pointcloud_map_metadata.yaml with integer corners, one PCD a tile, 20 m by default.

Points are in the map frame, not relative to their tile, as autoware_map_loader expects them.

A folder that a running stack reads (``export --follow``) changes while versions come and go. Autoware's differential
loader takes the path of a tile for its identity, and reads the metadata once, when it starts. So a tile's name changes
with its content (X_Y_HASH8.pcd), the metadata is replaced last and atomically, and tiles of the last few versions stay
for loaders that still go by older metadata.
"""

from __future__ import annotations

import hashlib
import logging
import re
from collections.abc import Collection, Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Annotated

import msgspec
import numpy as np

from mapvote.core.types import MapvoteError
from mapvote.formats.atomic import folder_beside, whole_file, whole_folder, write_whole
from mapvote.formats.geo.frame import PROJECTOR, MapFrame, frame_of_projector, projector_of
from mapvote.formats.listing import entry, files_like, plain_name
from mapvote.formats.maps.cloud import Cloud, CloudPieces, joined, warn_of_float32
from mapvote.formats.maps.pcd import save_pcd, stream_pcd
from mapvote.formats.maps.tiling import Spill
from mapvote.formats.reading import read_text, read_whole, read_yaml

log = logging.getLogger("mapvote.formats")

METADATA = "pointcloud_map_metadata.yaml"
TILES = "pointcloud_map.pcd"
"""The folder of tiles really is called so, by Autoware's convention."""
_TILE_SIDE_M = 20
HISTORY = ".mapvote_versions.json"
"""Beside tiles that ``mapvote export --follow`` wrote: which version has which."""
FOLLOWED = re.compile(r"-?\d+_-?\d+_[0-9a-f]{8}\.pcd")
"""How it names them: X_Y_HASH8.pcd."""


def is_autoware(path: Path) -> bool:
    return (path / METADATA).is_file()


def stream_autoware(path: Path) -> Iterator[Cloud]:
    """The tiles that the metadata lists, in its order; every point is checked to lie in its tile. A warning names tiles
    that lie there unlisted, but for those that ``mapvote export --follow`` keeps of versions before.

    MapvoteError names a tile that is missing, broken, or whose points lie outside it by more than a centimetre.
    """
    file = path / METADATA
    table = read_yaml(file)
    content = "it lists x_resolution, y_resolution and NAME.pcd: [x, y] for every tile"
    if not isinstance(table, dict):
        raise MapvoteError(f"{file}: not Autoware's metadata; {content}")
    try:
        size = np.array([float(table.pop("x_resolution")), float(table.pop("y_resolution"))])
        corners = {str(name): np.array([float(v) for v in corner]) for name, corner in table.items()}
        if not corners or (size <= 0).any() or any(c.shape != (2,) for c in corners.values()):
            raise ValueError("no tiles, or a corner that is not [x, y]")
    except (KeyError, TypeError, ValueError, OverflowError, RecursionError) as error:
        raise MapvoteError(f"{file}: not Autoware's metadata ({error}); {content}") from error
    for name in corners:
        plain_name(name, file)
    frame = _frame(path)
    _warn_of_unlisted(path, set(corners))
    for name, corner in corners.items():
        tile = next((f for f in (entry(path, name), entry(path / TILES, name)) if f.is_file()), None)
        if tile is None:
            raise MapvoteError(f"{path / name}: missing, but {METADATA} lists it; copy the map again")
        cloud = joined(stream_pcd(tile))
        outside = ((cloud.points[:, :2] < corner - 0.01) | (cloud.points[:, :2] > corner + size + 0.01)).any(axis=1)
        if outside.any():
            raise MapvoteError(
                f"{tile}: {int(outside.sum())} of {len(outside)} points lie outside its square at {corner.tolist()}; "
                f"are its points relative to the tile, or is the corner wrong?"
            )
        yield replace(cloud, frame=frame)


def _warn_of_unlisted(path: Path, listed: set[str]) -> None:
    kept = (path / HISTORY).is_file()
    there = {file.name for folder in (path, path / TILES) for file in files_like(folder, "*.pcd")}
    lower = {name.lower() for name in listed}
    unlisted = sorted(name for name in there if name.lower() not in lower and not (kept and FOLLOWED.fullmatch(name)))
    if unlisted:
        problem = "%s: %s lists no corner of %d of the PCD files there (first: %s): they are left out"
        log.warning(problem, path, METADATA, len(unlisted), unlisted[0])


def is_autoware_default(path: Path) -> bool:
    """Autoware's default folder: the whole map in one file pointcloud_map.pcd, beside its lanelet2_map.osm."""
    return path.is_dir() and not is_autoware(path) and (path / TILES).is_file()


def stream_autoware_default(path: Path) -> Iterator[Cloud]:
    """The one PCD of Autoware's default folder, in the frame of the map_projector_info.yaml beside it."""
    if not (path / PROJECTOR).is_file() and (path / "lanelet2_map.osm").is_file():
        log.warning("%s: no %s, so its coordinates stay local; --projector MGRS:54SUE names them", path, PROJECTOR)
    frame = _frame(path)
    for piece in stream_pcd(path / TILES):
        yield replace(piece, frame=frame)


def _frame(path: Path) -> MapFrame:
    projector = path / PROJECTOR
    return frame_of_projector(read_text(projector), str(projector)) if projector.is_file() else MapFrame()


def write_autoware(path: Path, cloud: Cloud | CloudPieces) -> None:
    """A cloud as Autoware's folder, whole or not at all; an older one there is replaced.

    Intensity is the only field that is written. MapvoteError if Autoware has no projector for the cloud's frame
    (:func:`mapvote.formats.geo.frame.autoware_frame` chooses one that it has).
    """
    clouds = CloudPieces.of(cloud)
    projector = projector_of(clouds.frame)
    with whole_folder(path, sign=METADATA) as folder:
        (folder / TILES).mkdir()
        corners = {}
        for (x, y), tile in _squares(str(path), clouds):
            corners[f"{x}_{y}.pcd"] = x, y
            save_pcd(folder / TILES / f"{x}_{y}.pcd", tile)
        (folder / METADATA).write_text(_metadata(corners))
        (folder / PROJECTOR).write_text(projector)


def _squares(source: str, cloud: Cloud | CloudPieces) -> Iterator[tuple[tuple[int, int], Cloud]]:
    """A cloud cut along whole multiples of 20 m: (corner, float32 points and their intensity), by x, y.

    ``source``: the folder that they go to. MapvoteError if there are no points.
    """
    clouds = CloudPieces.of(cloud)
    if not clouds.n:
        raise MapvoteError(f"{source}: no points to write")
    warn_of_float32(source, clouds)
    spill = Spill(folder_beside(Path(source)))
    blocks: dict[tuple[int, int], list[int]] = {}
    for piece in clouds:
        stored = piece.points.astype(np.float32)
        columns = {"points": stored} | {n: c for n, c in piece.fields.items() if n == "intensity"}
        corner = np.floor(stored[:, :2].astype(np.float64) / _TILE_SIDE_M).astype(np.int64) * _TILE_SIDE_M
        order = np.lexsort((corner[:, 1], corner[:, 0]))
        seams = np.flatnonzero(np.diff(corner[order], axis=0).any(axis=1)) + 1
        for rows in np.split(order, seams) if len(order) else ():
            x, y = corner[rows[0]].tolist()
            blocks.setdefault((x, y), []).append(spill.add({name: column[rows] for name, column in columns.items()}))
    for at in sorted(blocks):
        fields = spill.joined(blocks[at])
        yield at, Cloud(fields.pop("points"), fields=fields)


def _corners(names: Sequence[str]) -> dict[str, tuple[int, int]]:
    """The corner of each tile, from its name X_Y_HASH8.pcd."""
    parts = {name: name.split("_") for name in names}
    return {name: (int(x), int(y)) for name, (x, y, _) in parts.items()}


def _metadata(corners: Mapping[str, tuple[int, int]]) -> str:
    """The text of pointcloud_map_metadata.yaml: the size of tiles, and the corner of each file."""
    lines = [f"x_resolution: {_TILE_SIDE_M:.1f}", f"y_resolution: {_TILE_SIDE_M:.1f}"]
    return "\n".join([*lines, *(f"{name}: [{x}, {y}]" for name, (x, y) in corners.items())]) + "\n"


class _Laid(msgspec.Struct):
    """One version in the folder's history."""

    version: int
    tiles: list[Annotated[str, msgspec.Meta(pattern=rf"^{FOLLOWED.pattern}\Z")]]
    map_id: str = ""
    """Identifier of the map; "" where the caller did not name it."""


_HISTORY = msgspec.json.Decoder(list[_Laid])


@dataclass(frozen=True, slots=True)
class Change:
    """Changes to the folder by one version."""

    version: int
    tiles: int
    written: int
    deleted: int


def laid_version(folder: Path) -> int | None:
    """The version that the folder's metadata shows; None if it shows none, or lacks one of the version's tiles."""
    history = _history(folder)
    if not history or not is_autoware(folder):
        return None
    newest = history[-1]
    tiles = folder / TILES
    present = {file.name for file in tiles.iterdir()} if tiles.is_dir() else set()
    shown = (folder / METADATA).read_bytes() == _metadata(_corners(newest.tiles)).encode()
    return newest.version if shown and present.issuperset(newest.tiles) else None


def check_followed(folder: Path, map_id: str = "") -> None:
    """MapvoteError if the folder holds a map that mapvote did not write, or another map than ``map_id``."""
    if is_autoware(folder) and not (folder / HISTORY).is_file():
        raise MapvoteError(
            f"{folder}: holds an Autoware map that mapvote did not make; choose another folder, which may be new"
        )
    history = _history(folder)
    held = history[-1].map_id if history else ""
    if held and map_id and held != map_id:
        raise MapvoteError(
            f"{folder}: holds map {held}, but the server has map {map_id} now. A vehicle must not change maps on the "
            "road: name another folder for the other map"
        )


def names_of(source: str, cloud: Cloud | CloudPieces) -> list[str]:
    """The files that a cloud's tiles would be; ``source``: the name of the cloud in messages."""
    return [f"{x}_{y}_{_hash8(tile)}.pcd" for (x, y), tile in _squares(source, cloud)]


def lay_version(
    folder: Path,
    cloud: Cloud | CloudPieces,
    version: int,
    *,
    keep: int = 3,
    present: Collection[str] = (),
    map_id: str = "",
) -> Change:
    """Show ``cloud`` (map metres, in a frame that Autoware supports) in ``folder``; only tiles that it lacks are
    written, and of those none that is ``present`` where the folder goes.

    Tiles of the ``keep`` versions before stay. At every moment the metadata there names only whole tiles. MapvoteError
    if the folder holds a map that mapvote did not write, or another map than ``map_id``.
    """
    check_followed(folder, map_id)
    if keep < 0:
        raise MapvoteError(f"--keep {keep}: a number of versions, 0 or more")
    tiles = folder / TILES
    tiles.mkdir(parents=True, exist_ok=True)
    corners: dict[str, tuple[int, int]] = {}
    written = 0
    for (x, y), tile in _squares(str(folder), cloud):
        name = f"{x}_{y}_{_hash8(tile)}.pcd"
        corners[name] = x, y
        if name not in present and not (tiles / name).is_file():
            with whole_file(tiles / name) as partial:
                save_pcd(partial, tile)
            written += 1
    earlier = [laid for laid in _history(folder) if laid.version != version]
    history = [*earlier, _Laid(version, list(corners), map_id)]
    _write(folder / HISTORY, msgspec.json.encode(history[-keep - 1 :]))
    _write(folder / PROJECTOR, projector_of(cloud.frame).encode())
    _write(folder / METADATA, _metadata(corners).encode())
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
        return _HISTORY.decode(read_whole(file))
    except (OSError, msgspec.DecodeError, UnicodeDecodeError, RecursionError) as error:
        raise MapvoteError(f"{file}: cannot be read ({error}); empty the folder and follow again") from error


def _write(file: Path, content: bytes) -> None:
    if not (file.is_file() and file.read_bytes() == content):
        write_whole(file, content)
