"""Maps and drives in everybody's file formats: open a drive, read a map, write a map.

``DRIVES`` and ``CLOUDS`` list the formats in the order in which they are tried; each is recognised by what lies at
the path, never by asking.
"""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path

import numpy as np

from mapvote.core.point_map import PointMap, all_points
from mapvote.core.types import Drive, MapvoteError
from mapvote.formats.drives.kitti import DriveWriter, is_kitti_folder, open_kitti, read_T_map_lidar
from mapvote.formats.drives.kitti_raw import is_kitti_raw, open_kitti_raw
from mapvote.formats.drives.options import DriveOptions
from mapvote.formats.drives.pcd_scans import is_pcd_drive, open_pcd_drive
from mapvote.formats.drives.rosbag import is_rosbag, open_rosbag
from mapvote.formats.maps.autoware import PROJECTOR, is_autoware, read_autoware, write_autoware
from mapvote.formats.maps.cloud import Cloud, to_map
from mapvote.formats.maps.las import is_las, read_las, write_las
from mapvote.formats.maps.mapvote_folder import is_map_folder, read_map_folder, write_map_folder
from mapvote.formats.maps.pcd import is_pcd, read_pcd, write_pcd
from mapvote.formats.maps.ply import is_ply, read_ply, write_ply

__all__ = [
    "CLOUDS",
    "DRIVES",
    "DriveWriter",
    "export_map",
    "open_drive",
    "read_T_map_lidar",
    "read_cloud",
    "read_map",
    "write_map",
    "write_pcd",
]

DRIVES: dict[str, tuple[Callable[[Path], bool], Callable[[Path, DriveOptions], Drive]]] = {
    "KITTI drive folder": (is_kitti_folder, open_kitti),
    "KITTI raw recording": (is_kitti_raw, open_kitti_raw),
    "ROS bag": (is_rosbag, open_rosbag),
    "folder of PCD scans": (is_pcd_drive, open_pcd_drive),
}
CLOUDS: dict[str, tuple[Callable[[Path], bool], Callable[[Path], Cloud]]] = {
    "Autoware tile folder": (is_autoware, read_autoware),
    "PCD file": (is_pcd, read_pcd),
    "LAS or LAZ file": (is_las, read_las),
    "PLY file": (is_ply, read_ply),
}
"""Maps that are only points."""


def open_drive(
    path: Path | str,
    *,
    scans: str | None = None,
    prior: str | None = None,
    rate_hz: float | None = None,
    sensor: str | None = None,
    vehicle: str | None = None,
    mount: str | None = None,
    topic: str | None = None,
) -> Drive:
    """A recorded drive of any known format; its scans are read one by one when asked for.

    ``scans``: comma-separated START:STOP:STEP slices. ``prior``: a file of 3 x 4 rows T_map_lidar (a topic, for bags),
    or "none". ``rate_hz``, ``sensor``, ``vehicle`` and ``mount`` (T_base_lidar: 12 numbers, or x, y, z, roll, pitch,
    yaw in metres and degrees) win over drive.toml. ``topic``: the PointCloud2 topic of a bag.

    Raises MapvoteError if there is no drive at ``path`` or it cannot be used as it is, saying why.
    """
    path = Path(path)
    options = DriveOptions(scans, prior, rate_hz, sensor, vehicle, mount, topic)
    for recognised, open_format in DRIVES.values():
        if recognised(path):
            return open_format(path, options)
    raise MapvoteError(f"{path}: {_what_is_there(path)}; a drive is one of: {', '.join(DRIVES)}")


def read_map(path: Path | str) -> PointMap:
    """A map of any known format. A format that has only points gets its ground measured and a map_id from its content.

    Raises MapvoteError if there is no map at ``path`` or it is damaged.
    """
    path = Path(path)
    if is_map_folder(path):
        return read_map_folder(path)
    return to_map(str(path), read_cloud(path))


def read_cloud(path: Path | str) -> Cloud:
    """The points of a PCD, LAS, LAZ or PLY file or an Autoware folder as they stand, and what a map drops of them.

    Raises MapvoteError if there is none at ``path`` or it is damaged.
    """
    path = Path(path)
    for recognised, read_format in CLOUDS.values():
        if recognised(path):
            return read_format(path)
    raise MapvoteError(f"{path}: {_what_is_there(path)}; a map is one of: mapvote map, {', '.join(CLOUDS)}")


def write_map(point_map: PointMap, path: Path | str) -> None:
    """Write a mapvote map folder, whole or not at all. An older mapvote map there is replaced, anything else is not."""
    write_map_folder(point_map, Path(path))


def export_map(point_map: PointMap, path: Path | str, offset: tuple[float, float, float] = (0.0, 0.0, 0.0)) -> str:
    """Write a map's points for others: .pcd, .las, .laz, .ply, else an Autoware folder. Returns the format's name.

    ``offset`` (metres) is subtracted from every point, for formats of float32. Whole or not at all.
    """
    path = Path(path)
    points = all_points(point_map) - np.array(offset)
    suffix = path.suffix.lower()
    if suffix == ".pcd":
        write_pcd(path, points)
        return "PCD file"
    if suffix in (".las", ".laz"):
        write_las(path, points, wkt=point_map.georeference.get("wkt"))
        return "LAS or LAZ file"
    if suffix == ".ply":
        write_ply(path, points)
        return "PLY file"
    if suffix:
        raise MapvoteError(f"{path}: no format for {suffix}; use .pcd, .las, .laz, .ply, or a folder for Autoware")
    write_autoware(path, points, projector=point_map.georeference.get(PROJECTOR))
    return "Autoware tile folder"


def _what_is_there(path: Path) -> str:
    if not path.exists():
        return "nothing is there; check the path"
    return "a folder of no known layout" if path.is_dir() else f"a file of no known kind ({path.suffix or 'no suffix'})"
