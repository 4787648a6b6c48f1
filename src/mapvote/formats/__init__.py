"""Maps and drives in everybody's file formats: open a drive, read a map, write a map.

Formats are listed in :mod:`mapvote.formats.registry`; each is recognised by what lies at the path, never by asking.
"""

from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path
from typing import Unpack

import numpy as np

from mapvote.core.point_map import PointMap
from mapvote.core.tile import Tile
from mapvote.core.types import F64, U8, Drive, MapvoteError
from mapvote.formats.drives.kitti import DriveWriter
from mapvote.formats.drives.options import DriveOptions, SaidOfDrive
from mapvote.formats.drives.poses import read_T_map_lidar
from mapvote.formats.geo.frame import MapFrame, frame_of
from mapvote.formats.geo.projector import autoware_frame, frame_wanted
from mapvote.formats.geo.units import settle
from mapvote.formats.maps.cloud import GROUND, UNCLASSIFIED, Cloud, joined
from mapvote.formats.maps.cloud_pieces import CloudPieces
from mapvote.formats.maps.mapvote_folder import is_map_folder, read_map_folder, write_map_folder
from mapvote.formats.maps.pcd import write_pcd
from mapvote.formats.maps.tiling import in_map_metres, map_of
from mapvote.formats.registry import DRIVES, MAPS, WRITERS

__all__ = [
    "DriveWriter",
    "export_map",
    "open_drive",
    "read_T_map_lidar",
    "read_cloud",
    "read_map",
    "write_map",
    "write_pcd",
]


def open_drive(path: Path | str, **said: Unpack[SaidOfDrive]) -> Drive:
    """A recorded drive of any known format; its scans are read one by one when asked for.

    ``scans``: comma-separated START:STOP:STEP slices. ``prior``: a file of 3 x 4 rows T_map_lidar (a topic, for bags),
    or "none". ``rate_hz``, ``sensor``, ``vehicle`` and ``mount`` (T_base_lidar: 12 numbers, or x, y, z, roll, pitch,
    yaw in metres and degrees) win over drive.toml. ``topic``: the PointCloud2 topic of a bag (several
    with commas), the scene of a nuScenes folder. ``columns``, ``dtype``: of .bin and .npy scans, "x,y,z,intensity,ring"
    and "float32". ``frame``: the map's, into which latitudes and longitudes of a prior go.

    Raises MapvoteError if there is no drive at ``path`` or it cannot be used as it is, saying why.
    """
    path = Path(path)
    options = DriveOptions(**said)
    for layout in DRIVES.values():
        if layout.recognised(path):
            return layout.open(path, options)
    raise MapvoteError(f"{path}: {_what_is_there(path)}; a drive is one of: {', '.join(DRIVES)}")


def read_map(path: Path | str) -> PointMap:
    """A map of any known format. A format that has only points gets its ground measured and a map_id from its content.

    Raises MapvoteError if there is no map at ``path`` or it is damaged.
    """
    path = Path(path)
    if is_map_folder(path):
        return read_map_folder(path)
    return map_of(str(path), in_map_metres(str(path), stream_cloud(path)))


def stream_cloud(path: Path | str) -> Iterator[Cloud]:
    """The points of a file or folder of any format of ``MAPS`` as they stand, piece by piece where the format allows.

    Raises MapvoteError if there is none at ``path``, or when it comes to where it is damaged.
    """
    path = Path(path)
    for layout in MAPS.values():
        if layout.recognised(path):
            return layout.stream(path)
    raise MapvoteError(f"{path}: {_what_is_there(path)}; a map is one of: mapvote map, {', '.join(MAPS)}")


def read_cloud(path: Path | str) -> Cloud:
    """The points of a file or folder of any format of ``MAPS`` as they stand, and what a map drops of them.

    Raises MapvoteError if there is none at ``path`` or it is damaged.
    """
    return joined(list(stream_cloud(path)))


def write_map(point_map: PointMap, path: Path | str) -> None:
    """Write a mapvote map folder, whole or not at all. An older mapvote map there is replaced, anything else is not."""
    write_map_folder(point_map, Path(path))


def export_map(
    point_map: PointMap,
    path: Path | str,
    offset: tuple[float, float, float] = (0.0, 0.0, 0.0),
    *,
    crs: str | None = None,
    projector: str | None = None,
) -> tuple[str, MapFrame]:
    """Write a map's points for others, by the suffix of ``path`` (``WRITERS``); without one as an Autoware folder.

    ``crs`` ("EPSG:32654", WKT) or ``projector`` (a map_projector_info.yaml, "MGRS", ...) name another frame than the
    map's. ``offset`` (metres) is subtracted from every point, for formats of float32. Whole or not at all.
    Returns the format's name and the frame of what was written.
    """
    path = Path(path)
    writer = WRITERS.get(path.suffix.lower())
    if writer is None:
        suffixes = ", ".join(suffix for suffix in WRITERS if suffix)
        raise MapvoteError(f"{path}: no format for {path.suffix}; use {suffixes}, or a folder for Autoware")
    if not point_map.n_points:
        raise MapvoteError(f"{path}: the map holds no points, so there is nothing to export")
    stated, corners = frame_of(point_map.georeference), _corners(point_map)
    if not path.suffix or projector in ("MGRS", "LocalCartesianUTM"):
        wanted: MapFrame | None = autoware_frame(stated, corners, projector)
        if crs is not None:
            raise MapvoteError(f"{path}: Autoware takes no --crs, but --projector")
    else:
        wanted = frame_wanted(crs, projector)
    frame, convert = settle(str(path), stated, wanted, corners, sure=True)
    if any(offset):
        x, y, z = (float(a + b) for a, b in zip(frame.offset_m, offset, strict=True))
        frame = MapFrame(frame.crs, (x, y, z), frame.heights)

    def pieces() -> Iterator[Cloud]:
        for index in sorted(point_map.tiles):
            tile = point_map.tiles[index]
            points, fields = convert(tile.points_map), dict(tile.fields)
            if writer.classes and "classification" not in fields:
                fields["classification"] = ground_classes(tile)
            yield Cloud(points - np.array(offset) if any(offset) else points, frame=frame, fields=fields)

    writer.write(path, CloudPieces.gathered(pieces, frame))
    return writer.name, frame


def _corners(point_map: PointMap) -> F64:
    """(2, 3) the lowest and the highest coordinates of a map's points."""
    boxes = [(t.points_map.min(axis=0), t.points_map.max(axis=0)) for t in point_map.tiles.values() if len(t.points)]
    low, high = np.array(boxes).transpose(1, 0, 2)
    return np.array([low.min(axis=0), high.max(axis=0)])


def ground_classes(tile: Tile) -> U8:
    """(n,) ASPRS class of every point of a tile: ground, or unclassified."""
    return np.where(tile.has_ground & ~tile.columns[1], GROUND, UNCLASSIFIED).astype(np.uint8)


def _what_is_there(path: Path) -> str:
    if not path.exists():
        return "nothing is there; check the path"
    return "a folder of no known layout" if path.is_dir() else f"a file of no known kind ({path.suffix or 'no suffix'})"
