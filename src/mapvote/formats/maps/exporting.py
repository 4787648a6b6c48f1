"""A map's points on their way to others: in the frame that they are wanted in, tile by tile."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from mapvote.core.point_map import PointMap
from mapvote.core.tile import Tile
from mapvote.core.types import F64, U8, MapvoteError
from mapvote.formats.geo.frame import MapFrame
from mapvote.formats.geo.projector import PROJECTOR, autoware_frame, frame_of, frame_wanted
from mapvote.formats.geo.units import settle
from mapvote.formats.maps.cloud import GROUND, KEPT, UNCLASSIFIED, Cloud, CloudPieces
from mapvote.formats.registry import WRITERS

Convert = Callable[[NDArray[np.floating]], NDArray[np.floating]]

Offset = tuple[float, float, float]


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
    Returns the format's name and the frame of what was written.
    """
    path = Path(path)
    writer = WRITERS.get(path.suffix.lower())
    if writer is None:
        suffixes = ", ".join(suffix for suffix in WRITERS if suffix)
        raise MapvoteError(f"{path}: no format for {path.suffix}; use {suffixes}, or a folder for Autoware")
    stated, corners = frame_of(point_map.georeference), _corners(path, point_map)
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
    writer.write(path, _pieces(point_map, frame, convert, offset, classes=writer.classes))
    return writer.name, frame


def autoware_pieces(point_map: PointMap, folder: Path, projector: str | None) -> CloudPieces:
    """A map's points in a frame that Autoware supports: ``projector``'s, else the one that ``folder`` has already."""
    stated, corners, chosen = frame_of(point_map.georeference), _corners(folder, point_map), folder / PROJECTOR
    wanted = projector or (str(chosen) if chosen.is_file() and not stated.is_local else None)
    frame, convert = settle(str(folder), stated, autoware_frame(stated, corners, wanted), corners, sure=True)
    return _pieces(point_map, frame, convert)


def _pieces(
    point_map: PointMap, frame: MapFrame, convert: Convert, offset: Offset = (0.0, 0.0, 0.0), *, classes: bool = False
) -> CloudPieces:
    """One piece a tile, less ``offset``; ``classes``: with ASPRS classes where the map has none. Fields that only
    mapvote reads (scans, sources) stay behind."""

    def pieces() -> Iterator[Cloud]:
        for index in sorted(point_map.tiles):
            tile = point_map.tiles[index]
            fields: dict[str, NDArray[Any]] = {name: tile.fields[name] for name in KEPT if name in tile.fields}
            if classes and "classification" not in fields:
                fields["classification"] = ground_classes(tile)
            points = convert(tile.points_map)
            yield Cloud(points - np.array(offset) if any(offset) else points, frame=frame, fields=fields)

    return CloudPieces.gathered(pieces, frame)


def _corners(where: Path, point_map: PointMap) -> F64:
    """(2, 3) the lowest and the highest coordinates of a map's points; MapvoteError if it has none to write there."""
    boxes = [(t.points_map.min(axis=0), t.points_map.max(axis=0)) for t in point_map.tiles.values() if len(t.points)]
    if not boxes:
        raise MapvoteError(f"{where}: the map holds no points, so there is nothing to export")
    low, high = np.array(boxes).transpose(1, 0, 2)
    return np.array([low.min(axis=0), high.max(axis=0)])


def ground_classes(tile: Tile) -> U8:
    """(n,) ASPRS class of every point of a tile: ground, or unclassified."""
    return np.where(tile.has_ground & ~tile.columns[1], GROUND, UNCLASSIFIED).astype(np.uint8)
