"""Maps and drives in everybody's file formats: open a drive, read a map, write a map.

``DRIVES`` and ``MAPS`` list the formats in the order in which they are tried; each is recognised by what lies at
the path, never by asking.
"""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path

from mapvote.core.types import Drive, MapvoteError, PointMap
from mapvote.formats.drive import DriveOptions
from mapvote.formats.kitti import DriveWriter, is_kitti_folder, open_kitti, read_T_map_lidar
from mapvote.formats.mapfolder import is_map_folder, read_map_folder, write_map_folder

__all__ = ["DRIVES", "MAPS", "DriveWriter", "open_drive", "read_T_map_lidar", "read_map", "write_map"]

DRIVES: dict[str, tuple[Callable[[Path], bool], Callable[[Path, DriveOptions], Drive]]] = {
    "KITTI drive folder": (is_kitti_folder, open_kitti),
}
MAPS: dict[str, tuple[Callable[[Path], bool], Callable[[Path], PointMap]]] = {
    "mapvote map": (is_map_folder, read_map_folder),
}


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
    for recognised, read_format in MAPS.values():
        if recognised(path):
            return read_format(path)
    raise MapvoteError(f"{path}: {_what_is_there(path)}; a map is one of: {', '.join(MAPS)}")


def write_map(point_map: PointMap, path: Path | str) -> None:
    """Write a mapvote map folder, whole or not at all. An older mapvote map there is replaced, anything else is not."""
    write_map_folder(point_map, Path(path))


def _what_is_there(path: Path) -> str:
    if not path.exists():
        return "nothing is there; check the path"
    return "a folder of no known layout" if path.is_dir() else f"a file of no known kind ({path.suffix or 'no suffix'})"
