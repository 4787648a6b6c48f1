"""E57 files through pye57 (extra ``e57``): every scan of the file, brought to the file's frame by its pose."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from mapvote.core.types import MapvoteError
from mapvote.formats.extras import reading, require
from mapvote.formats.geo.frame import MapFrame
from mapvote.formats.maps.cloud import Cloud

MAX_POINTS_PER_BYTE = 16
_FIELDS = {"intensity": "intensity", "colorRed": "red", "colorGreen": "green", "colorBlue": "blue"}


def is_e57(path: Path) -> bool:
    return path.is_file() and path.suffix.lower() == ".e57"


def stream_e57(path: Path) -> Iterator[Cloud]:
    """The points of a file, scan by scan, in the coordinate system that it names; rays without return are left out.

    MapvoteError if it is damaged, or holds no scan of cartesian or spherical points.
    """
    library = require("pye57", "e57", str(path))
    with reading(path, "E57 file"):
        file = library.E57(str(path))
        size = path.stat().st_size * MAX_POINTS_PER_BYTE
        counts = [file.get_header(i).point_count for i in range(file.scan_count)]
        if sum(counts) > size:
            raise ValueError(f"its header promises {sum(counts)} points, more than it has room for")
        if not any(counts):
            raise MapvoteError(f"{path}: holds no scan with points")
        wkt = _coordinate_metadata(file)
        frame = MapFrame(wkt) if wkt else MapFrame()
        for i in range(file.scan_count):
            if counts[i]:
                yield replace(_scan(file, i), frame=frame)


def _scan(file: Any, index: int) -> Cloud:
    names = file.get_header(index).point_fields
    color = {"colorRed", "colorGreen", "colorBlue"} <= set(names)
    raw = file.read_scan(index, intensity="intensity" in names, colors=color, ignore_missing_fields=True)
    points = np.column_stack([raw["cartesianX"], raw["cartesianY"], raw["cartesianZ"]]).astype(np.float64)
    fields: dict[str, NDArray[Any]] = {
        ours: np.asarray(raw[theirs]).astype(np.uint8 if theirs.startswith("color") else np.float32)
        for theirs, ours in _FIELDS.items()
        if theirs in raw
    }
    known = ("cartesianX", "cartesianY", "cartesianZ", "sphericalRange", "sphericalAzimuth", "sphericalElevation")
    others = tuple(n for n in names if n not in (*known, *_FIELDS) and not n.endswith("InvalidState"))
    return Cloud(points, others, fields=fields)


def _coordinate_metadata(file: Any) -> str:
    """The file's coordinate system as WKT, "" where it names none that can be read."""
    try:
        return str(file.root["coordinateMetadata"].value()).strip()
    except Exception:  # libE57's own, for a file without it
        return ""
