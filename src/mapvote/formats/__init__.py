"""Maps and drives in everybody's file formats: open a drive, read a map, write a map.

Formats are listed in :mod:`mapvote.formats.registry`; each is recognised by what lies at the path, never by asking.
"""

from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path
from typing import Any, Unpack

import numpy as np
from numpy.typing import NDArray

from mapvote.core.point_map import PointMap
from mapvote.core.types import F64, Drive, MapvoteError
from mapvote.formats.drives.kitti import DriveWriter
from mapvote.formats.drives.options import SaidOfDrive, drive_options
from mapvote.formats.drives.trajectory import read_T_map_lidar
from mapvote.formats.maps.cloud import Cloud, joined
from mapvote.formats.maps.exporting import export_map
from mapvote.formats.maps.mapvote_folder import is_map_folder, read_map_folder, write_map_folder
from mapvote.formats.maps.pcd import write_pcd
from mapvote.formats.maps.tiling import Look, in_map_metres, map_of
from mapvote.formats.registry import DRIVES, MAPS

__all__ = [
    "DriveWriter",
    "export_map",
    "is_cloud",
    "open_drive",
    "read_T_map_lidar",
    "read_cloud",
    "read_map",
    "write_map",
    "write_pcd",
]


def open_drive(path: Path | str, **said: Unpack[SaidOfDrive]) -> Drive:
    """A recorded drive of any known format; its scans are read one by one at access.

    ``scans``: comma-separated START:STOP:STEP slices. ``prior``: a file of 3 x 4 rows T_map_lidar (a topic, for bags),
    or "none". ``rate_hz``, ``sensor``, ``vehicle`` and ``mount`` (T_base_lidar: 12 numbers, or x, y, z, roll, pitch,
    yaw in metres and degrees) win over drive.toml. ``topic``: the PointCloud2 topic of a bag (several
    with commas), the scene of a nuScenes folder. ``columns``, ``dtype``: of .bin and .npy scans, "x,y,z,intensity,ring"
    and "float32". ``frame``: the map's, into which latitudes and longitudes of a prior go.

    Raises MapvoteError if there is no drive at ``path`` or it cannot be used as it is, saying why.
    """
    path = Path(path)
    for layout in DRIVES.values():
        if layout.recognised(path):
            return layout.open(path, drive_options(path, **said))
    raise MapvoteError(f"{path}: {_what_is_there(path)}; a drive is one of: {', '.join(DRIVES)}")


def read_map(path: Path | str, look: Look | None = None) -> PointMap:
    """A map of any known format. A format that has only points gets its ground measured and a map_id from its content.

    ``look`` gets the points before the ground is computed. Raises MapvoteError if there is no map at ``path`` or it is
    damaged.
    """
    path = Path(path)
    if is_map_folder(path):
        point_map = read_map_folder(path)
        if look is not None:
            look(lambda: (point_map.tiles[index].points_map for index in sorted(point_map.tiles)))
        return point_map
    return map_of(str(path), in_map_metres(str(path), stream_cloud(path)), look=look)


def stream_cloud(path: Path | str) -> Iterator[Cloud]:
    """The points of a file or folder of any format of ``MAPS`` as they stand, piece by piece where the format allows.

    Raises MapvoteError if there is none at ``path``, or when a damaged part is read.
    """
    path = Path(path)
    for layout in MAPS.values():
        if layout.recognised(path):
            return layout.stream(path)
    raise MapvoteError(f"{path}: {_what_is_there(path)}; a map is one of: mapvote map, {', '.join(MAPS)}")


def read_cloud(path: Path | str) -> tuple[F64, dict[str, NDArray[Any]]]:
    """All points of a map or cloud of any known format, and their fields: no tiles are cut, no ground is computed.

    Returns points (n, 3), float64, map metres (feet become metres), and columns (n,) in the type that the file has, by
    LAS's names: intensity, red, classification ... Points that are not finite stay. Of a map in pieces only the fields
    that all pieces have are returned.

    Raises MapvoteError if there is no map at ``path``, it is damaged, or its coordinates cannot be made metres.
    """
    path = Path(path)
    if is_map_folder(path):
        tiles = read_map_folder(path).tiles
        cloud = joined([Cloud(tiles[index].points_map, fields=tiles[index].fields) for index in sorted(tiles)])
    else:
        cloud = joined(stream_cloud(path)).in_metres(str(path))
    return cloud.points.astype(np.float64, copy=False), dict(cloud.fields)


def is_cloud(path: Path | str) -> bool:
    """Whether a map or cloud lies at ``path``, and no recorded drive."""
    path = Path(path)
    held = is_map_folder(path) or any(layout.recognised(path) for layout in MAPS.values())
    return held and not any(layout.recognised(path) for layout in DRIVES.values())


def write_map(point_map: PointMap, path: Path | str) -> None:
    """Write a mapvote map folder, whole or not at all. An older mapvote map there is replaced, anything else is not."""
    write_map_folder(point_map, Path(path))


def _what_is_there(path: Path) -> str:
    if not path.exists():
        return "nothing is there; check the path"
    return "a folder of no known layout" if path.is_dir() else f"a file of no known kind ({path.suffix or 'no suffix'})"
