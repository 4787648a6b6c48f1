"""Maps and drives in everybody's file formats: open a drive; read or import a map, in whatever coordinates; write or
export one.

Formats are listed in :mod:`mapvote.formats.registry`; each is recognised by what lies at the path, never by asking.
"""

from __future__ import annotations

from collections.abc import Collection, Iterator
from dataclasses import replace
from pathlib import Path
from typing import Any, Unpack

import numpy as np
from numpy.typing import NDArray

from mapvote.core.geometry import corners
from mapvote.core.point_map import PointMap
from mapvote.core.types import F64, Drive, MapvoteError
from mapvote.formats.drives.options import SaidOfDrive, drive_options
from mapvote.formats.drives.point_fields import POINT_RULE
from mapvote.formats.drives.scan_folder import DriveWriter
from mapvote.formats.drives.trajectory import read_T_map_lidar
from mapvote.formats.geo.frame import (
    ENU,
    LOCAL,
    PROJECTOR,
    MapFrame,
    autoware_frame,
    frame_of,
    frame_wanted,
    read_crs,
    utm_of,
)
from mapvote.formats.geo.units import Convert, settle_out
from mapvote.formats.maps.cloud import READ_SIZES, Cloud, CloudPieces, ReadSizes
from mapvote.formats.maps.field_names import kept_fields
from mapvote.formats.maps.laz_subprocess import LasClass
from mapvote.formats.maps.mapvote_folder import is_map_folder, read_map_folder, write_map
from mapvote.formats.maps.marked_points import DROPPED, MarkedPoints, without_marked
from mapvote.formats.maps.pcd import write_pcd
from mapvote.formats.maps.tiling import GPS_TIMES, UNCHECKED, Look, grounded, in_map_metres, map_of
from mapvote.formats.registry import DRIVES, MAPS, WRITERS, MapWriter, drive_format

__all__ = [
    "DriveWriter",
    "box_of",
    "export_map",
    "is_cloud",
    "open_drive",
    "open_drive_on",
    "read_T_map_lidar",
    "read_map",
    "write_map",
    "write_pcd",
]
Offset = tuple[float, float, float]


def open_drive(path: Path | str, **said: Unpack[SaidOfDrive]) -> Drive:
    """A recorded drive of any known format; its scans are read one by one at access.

    ``scans``: comma-separated START:STOP:STEP slices. ``prior``: a file of 3 x 4 rows T_map_lidar (a topic, for bags),
    or "none". ``rate_hz``, ``sensor``, ``vehicle`` and ``mount`` (T_base_lidar: 12 numbers, or x, y, z, roll, pitch,
    yaw in metres and degrees) win over drive.toml. ``topic``: the PointCloud2 topic of a bag (several
    with commas), the scene of a nuScenes folder. ``columns``, ``dtype``: of .bin and .npy scans, "x,y,z,intensity,ring"
    and "float32". ``motion_compensated``, ``time_field`` (or "none"), ``time_unit``: what is known of the times of
    points. ``frame``: the map's, into which latitudes and longitudes of a prior go.

    Raises MapvoteError if there is no drive at ``path`` or it cannot be used as it is, saying why.
    """
    path = Path(path)
    layout = drive_format(path)
    if layout is not None:
        return layout.open(path, drive_options(path, **said))
    raise MapvoteError(f"{path}: {_what_is_there(path)}; a drive is one of: {', '.join(DRIVES)}")


def open_drive_on(point_map: PointMap | None, path: Path | str, **said: Unpack[SaidOfDrive]) -> Drive:
    """:func:`open_drive` of a drive that is compared with a map: latitudes and longitudes of its prior go into the
    map's frame."""
    if point_map is not None:
        said["frame"] = frame_of(point_map.georeference)
    return open_drive(path, **said)


def read_map(path: Path | str, look: Look | None = None, *, sizes: ReadSizes = READ_SIZES) -> PointMap:
    """A map of any known format. A format that has only points gets its ground measured and a map_id from its content.

    ``look`` gets the points before the ground is computed. ``sizes``: points held in memory. Raises MapvoteError if
    there is no map at ``path`` or it is damaged.
    """
    path = Path(path)
    if is_map_folder(path):
        point_map = read_map_folder(path, sizes)
        if look is not None and UNCHECKED not in point_map.georeference:
            tiles = sorted(point_map.tiles)
            look(
                lambda: (point_map.tiles[index].points_map for index in tiles),
                lambda: (grounded(point_map.tiles[index].fields, point_map.tiles[index].points_map) for index in tiles),
            )
        return point_map
    sound = without_marked(path, stream_cloud(path))
    return map_of(str(path), in_map_metres(str(path), sound), look=look, sizes=sizes)


def stream_cloud(path: Path | str) -> Iterator[Cloud]:
    """The points of a file or folder of any format of ``MAPS`` as they stand, piece by piece where the format allows.

    Raises MapvoteError if there is none at ``path``, or when a damaged part is read.
    """
    path = Path(path)
    for layout in MAPS.values():
        if layout.recognised(path):
            return layout.stream(path)
    raise MapvoteError(f"{path}: {_what_is_there(path)}; a map is one of: mapvote map, {', '.join(MAPS)}")


def is_cloud(path: Path | str) -> bool:
    """Whether a map or cloud lies at ``path``, and no recorded drive."""
    path = Path(path)
    held = is_map_folder(path) or any(layout.recognised(path) for layout in MAPS.values())
    return held and drive_format(path) is None


def import_cloud(
    path: Path,
    wanted: MapFrame | None = None,
    from_crs: str | None = None,
    folder: Path | None = None,
    look: Look | None = None,
    drop: Collection[str] = DROPPED,
    *,
    unchecked: bool = False,
    sizes: ReadSizes = READ_SIZES,
) -> tuple[PointMap, list[str]]:
    """(the map, lines that say what became of the file's coordinates, classes and fields).

    ``wanted``: the frame to project to. ``from_crs``: the file's coordinate system, where the file states none or a
    wrong one. ``folder``: where temporary files may lie. ``look``: sees the points, in metres, before a map is made of
    them. ``drop``: the ``MARKS`` whose points are left out. ``unchecked``: the points are right whatever they look
    like; the map says so to every verb that checks maps. ``sizes``: points held in memory.
    """
    if is_map_folder(path):
        if wanted is not None or from_crs is not None or not unchecked:
            raise MapvoteError(f"{path}: is a mapvote map already; mapvote export writes it in another system")
        point_map = read_map_folder(path)
        about = {**point_map.georeference, UNCHECKED: "import"}
        return replace(point_map, georeference=about), ["its points are not checked any more"]
    pieces = stream_cloud(path)
    if from_crs is not None:
        said = MapFrame(LOCAL if from_crs.lower() == LOCAL else from_crs)
        pieces = (replace(piece, frame=said) for piece in pieces)
    dropped: dict[str, None] = {}
    sieve = MarkedPoints(drop)

    def kept() -> Iterator[Cloud]:
        metric = in_map_metres(str(path), pieces, wanted, sure=from_crs is not None)
        for piece in sieve.without(metric):
            dropped.update(dict.fromkeys(piece.dropped))
            yield piece

    point_map = map_of(str(path), kept(), folder, look, 1.0 if unchecked else POINT_RULE.most_bad_share, sizes)
    if unchecked:
        point_map = replace(point_map, georeference={**point_map.georeference, UNCHECKED: "import"})
    lines = [f"coordinates: {frame_of(point_map.georeference).told()}", *sieve.told()]
    if dropped:
        lines.append(f"dropped fields: {', '.join(dropped)}")
    return point_map, lines


def export_map(
    point_map: PointMap,
    path: Path | str,
    offset: Offset = (0.0, 0.0, 0.0),
    *,
    crs: str | None = None,
    projector: str | None = None,
) -> tuple[str, MapFrame]:
    """Write a map's points for others, by the suffix of ``path`` (``WRITERS``); without one as an Autoware folder.

    ``crs`` ("EPSG:32654", WKT) or ``projector`` (a map_projector_info.yaml, "MGRS", ...) name another frame than the
    map's. ``offset`` (metres) is subtracted from every point, for formats of float32. Whole or not at all.
    Returns the format's name and the frame of the file.
    """
    path = Path(path)
    if path.name.lower().endswith(".copc.las"):
        raise MapvoteError(f"{path}: COPC is compressed; name it {path.stem}.laz")
    ending = next((e for e in WRITERS if e.count(".") > 1 and path.name.lower().endswith(e)), path.suffix.lower())
    writer = WRITERS.get(ending)
    if writer is None:
        suffixes = ", ".join(suffix for suffix in WRITERS if suffix)
        raise MapvoteError(f"{path}: no format for {path.suffix}; use {suffixes}, or a folder for Autoware")
    stated = frame_of(point_map.georeference)
    corners = box_of(path, point_map)
    if not path.suffix or projector in ("MGRS", "LocalCartesianUTM"):
        wanted: MapFrame | None = autoware_frame(stated, corners, projector)
        if crs is not None:
            raise MapvoteError(f"{path}: Autoware takes no --crs, but --projector")
    else:
        wanted = frame_wanted(crs, projector)
    frame, convert = settle_out(str(path), stated, wanted, corners)
    _check_degrees(path, frame, convert(corners).astype(np.float64), writer, offset)
    if any(offset):
        x, y, z = (float(a + b) for a, b in zip(frame.offset_m, offset, strict=True))
        frame = MapFrame(frame.crs, (x, y, z), frame.heights)
    writer.write(path, _pieces(point_map, frame, convert, offset, classes=writer.classes))
    return writer.name, frame


def _check_degrees(path: Path, frame: MapFrame, corners: F64, writer: MapWriter, offset: Offset) -> None:
    """MapvoteError if degrees are wanted in float32, which holds them to some decimetres, or less an offset in metres.
    ``corners`` (2, 3): what the file would hold."""
    if frame.is_local or frame.crs.startswith(ENU) or not read_crs(frame.crs).is_geographic:
        return
    if writer.single:
        zone = utm_of(float(corners[0, 0]), float(corners[0, 1]))
        raise MapvoteError(
            f"{path}: a {writer.name} holds float32, which rounds degrees to 0.1 m and more; write .las, .laz or .ply, "
            f"or project: --crs {zone}"
        )
    if any(offset):
        raise MapvoteError(f"{path}: --offset is in metres, and the file would be in degrees; leave it out")


def autoware_pieces(point_map: PointMap, folder: Path, projector: str | None) -> CloudPieces:
    """A map's points in a frame that Autoware supports: ``projector``'s, else the one that ``folder`` has already."""
    stated = frame_of(point_map.georeference)
    corners = box_of(folder, point_map)
    chosen = folder / PROJECTOR
    wanted = projector or (str(chosen) if chosen.is_file() and not stated.is_local else None)
    frame, convert = settle_out(str(folder), stated, autoware_frame(stated, corners, wanted), corners)
    return _pieces(point_map, frame, convert)


def _pieces(
    point_map: PointMap, frame: MapFrame, convert: Convert, offset: Offset = (0.0, 0.0, 0.0), *, classes: bool = False
) -> CloudPieces:
    """One piece a tile, less ``offset``; ``classes``: with ASPRS classes where the map has none. Fields that only
    mapvote reads (scans, sources) stay behind."""

    def pieces() -> Iterator[Cloud]:
        for index in sorted(point_map.tiles):
            tile = point_map.tiles[index]
            names = (*kept_fields(), "source_version", "votes")  # the last two a store adds
            fields: dict[str, NDArray[Any]] = {n: tile.fields[n] for n in names if n in tile.fields}
            if classes and "classification" not in fields:
                on_ground = tile.has_ground & ~tile.columns[1]
                fields["classification"] = np.where(on_ground, LasClass.GROUND, LasClass.UNCLASSIFIED).astype(np.uint8)
            points = convert(tile.points_map)
            shifted = points - np.array(offset) if any(offset) else points
            yield Cloud(shifted, frame=frame, fields=fields, gps_times=point_map.georeference.get(GPS_TIMES, ""))

    return CloudPieces.gathered(pieces, frame)


def box_of(source: Path, point_map: PointMap) -> F64:
    """(2, 3) the lowest and the highest coordinates of a map's points; MapvoteError if it has none to write there."""
    boxes = [corners(tile.points_map) for tile in point_map.tiles.values() if len(tile.points)]
    if not boxes:
        raise MapvoteError(f"{source}: the map holds no points, so there is nothing to export")
    low, high = np.array(boxes).transpose(1, 0, 2)
    return np.array([low.min(axis=0), high.max(axis=0)])


def _what_is_there(path: Path) -> str:
    if not path.exists():
        return "nothing is there; check the path"
    return "a folder of no known layout" if path.is_dir() else f"a file of no known kind ({path.suffix or 'no suffix'})"
