"""Autoware's tiled maps: pointcloud_map_metadata.yaml with integer corners, one PCD a tile, 20 m by default.

Points are in the map frame, not relative to their tile, as autoware_map_loader expects them.
"""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
import yaml
from numpy.typing import NDArray

from mapvote.core.types import F64, MapvoteError
from mapvote.formats.atomic import whole_folder
from mapvote.formats.extras import read_text
from mapvote.formats.maps.cloud import Cloud, warn_of_float32
from mapvote.formats.maps.pcd import read_pcd, save_pcd

METADATA = "pointcloud_map_metadata.yaml"
PROJECTOR = "map_projector_info.yaml"
TILES = "pointcloud_map.pcd"
"""The folder of tiles really is called so, by Autoware's convention."""
SIDE_M = 20
CONTENT = "it lists x_resolution, y_resolution and NAME.pcd: [x, y] for every tile"


def is_autoware(path: Path) -> bool:
    return (path / METADATA).is_file()


def read_autoware(path: Path) -> Cloud:
    """All tiles that the metadata lists, in its order, as one cloud; every point is checked to lie in its tile.

    MapvoteError names a tile that is missing, broken, or whose points lie outside it by more than a centimetre.
    """
    file = path / METADATA
    table = _read_yaml(file)
    try:
        size = np.array([float(table.pop("x_resolution")), float(table.pop("y_resolution"))])
        corners = {str(name): np.array([float(v) for v in corner]) for name, corner in table.items()}
        if not corners or (size <= 0).any() or any(c.shape != (2,) for c in corners.values()):
            raise ValueError("no tiles, or a corner that is not [x, y]")
    except (KeyError, TypeError, ValueError) as error:
        raise MapvoteError(f"{file}: not Autoware's metadata ({error}); {CONTENT}") from error
    clouds: list[NDArray[np.floating]] = []
    dropped: set[str] = set()
    for name, corner in corners.items():
        tile = next((f for f in (path / name, path / TILES / name) if f.is_file()), None)
        if tile is None:
            raise MapvoteError(f"{path / name}: missing, but {METADATA} lists it; copy the map again")
        cloud = read_pcd(tile)
        outside = ((cloud.points[:, :2] < corner - 0.01) | (cloud.points[:, :2] > corner + size + 0.01)).any(axis=1)
        if outside.any():
            raise MapvoteError(
                f"{tile}: {int(outside.sum())} of {len(outside)} points lie outside its square at {corner.tolist()}; "
                f"are its points relative to the tile, or is the corner wrong?"
            )
        clouds.append(cloud.points)
        dropped.update(cloud.dropped)
    projector = path / PROJECTOR
    georeference = {PROJECTOR: read_text(projector)} if projector.is_file() else {}
    return Cloud(np.concatenate(clouds), tuple(sorted(dropped)), georeference)


def write_autoware(path: Path, points: F64, *, side_m: int = SIDE_M, projector: str | None = None) -> None:
    """Points (n, 3) in map metres as Autoware's folder, whole or not at all; an older one there is replaced.

    ``side_m``: whole metres. ``projector``: the text of map_projector_info.yaml, where the map carries one.
    """
    if len(points) == 0:
        raise MapvoteError(f"{path}: no points to write")
    warn_of_float32(str(path), points)
    stored = points.astype(np.float32)
    corner = np.floor(stored[:, :2].astype(np.float64) / side_m).astype(np.int64) * side_m
    order = np.lexsort((corner[:, 1], corner[:, 0]))
    seams = np.flatnonzero(np.diff(corner[order], axis=0).any(axis=1)) + 1
    with whole_folder(path, sign=METADATA) as folder:
        (folder / TILES).mkdir()
        lines = [f"x_resolution: {side_m:.1f}", f"y_resolution: {side_m:.1f}"]
        for piece in np.split(order, seams):
            x, y = corner[piece[0]].tolist()
            save_pcd(folder / TILES / f"{x}_{y}.pcd", stored[piece])
            lines.append(f"{x}_{y}.pcd: [{x}, {y}]")
        (folder / METADATA).write_text("\n".join(lines) + "\n")
        if projector is not None:
            (folder / PROJECTOR).write_text(projector)


def _read_yaml(file: Path) -> dict[Any, Any]:
    try:
        table = yaml.safe_load(read_text(file))
    except (yaml.YAMLError, ValueError) as error:
        raise MapvoteError(f"{file}: cannot be read ({error})") from error
    if not isinstance(table, dict):
        raise MapvoteError(f"{file}: not Autoware's metadata; {CONTENT}")
    return table
