"""E57 files through pye57 (extra ``e57``): every scan of the file, brought to the file's frame by its pose.

Colours and intensities have the limits that the scan names (ASTM E2807): 8 or 16 bits, or reals.
"""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import suppress
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from mapvote.core.extras import require
from mapvote.core.types import F64, MapvoteError
from mapvote.formats.geo.frame import MapFrame
from mapvote.formats.maps.cloud import READ_SIZES, Cloud, ReadSizes
from mapvote.formats.reading import FILE_LIMITS, reading

_CARTESIAN = ("cartesianX", "cartesianY", "cartesianZ")
_SPHERICAL = ("sphericalRange", "sphericalAzimuth", "sphericalElevation")
_E57_FIELDS = {"intensity": "intensity", "colorRed": "red", "colorGreen": "green", "colorBlue": "blue"}


def stream_e57(path: Path, sizes: ReadSizes = READ_SIZES) -> Iterator[Cloud]:
    """The points of a file, scan by scan, in the coordinate system that it names; rays without return are left out.

    MapvoteError if it is damaged, or holds no scan of cartesian or spherical points.
    """
    library = require("pye57", "e57", str(path))
    with reading(path, "E57 file"):
        file = library.E57(str(path))
        size = path.stat().st_size * FILE_LIMITS.e57_points_per_byte
        counts = [file.get_header(i).point_count for i in range(file.scan_count)]
        if sum(counts) > size:
            raise ValueError(f"its header promises {sum(counts)} points, more than it has room for")
        if not any(counts):
            raise MapvoteError(f"{path}: holds no scan with points")
        wkt = ""
        with suppress(Exception):  # libE57's own, for a file that names no coordinate system
            wkt = str(file.root["coordinateMetadata"].value()).strip()
        frame = MapFrame(wkt) if wkt else MapFrame()
        for i in range(file.scan_count):
            if counts[i]:
                yield from _scan(library, file, file.get_header(i), frame, sizes.block)


def _scan(library: Any, file: Any, header: Any, frame: MapFrame, block: int) -> Iterator[Cloud]:
    """One scan, block by block."""
    # The fields that are read: places, kept fields, and whether a ray returned.
    names = list(header.point_fields)
    axes = next((kind for kind in (_CARTESIAN, _SPHERICAL) if set(kind) <= set(names)), None)
    if axes is None:
        raise ValueError(f"a scan has neither cartesian nor spherical points, but {', '.join(names)}")
    state = f"{axes[0][:-1] if axes is _CARTESIAN else 'spherical'}InvalidState"
    kept = [name for name in _E57_FIELDS if name in names]
    others = tuple(n for n in names if n not in (*_CARTESIAN, *_SPHERICAL, *kept) and not n.endswith("InvalidState"))
    wanted = [*axes, *kept, *([state] if state in names else [])]
    # One buffer for each field, filled again and again.
    columns = {name: np.empty(min(header.point_count, block)) for name in wanted}
    buffers = library.libe57.VectorSourceDestBuffer()
    for name, column in columns.items():
        buffers.append(library.libe57.SourceDestBuffer(file.image_file, name, column, len(column), True, True))
    reader = header.points.reader(buffers)
    # Block by block: rays without return left out, points in the frame of the file.
    scales = {name: _limits(header, name) for name in kept}
    while n := reader.read():
        valid = columns[state][:n] == 0 if state in columns else np.ones(n, np.bool_)
        xyz = np.column_stack([columns[axis][:n][valid] for axis in axes])
        if axes is _SPHERICAL:
            xyz = library.utils.convert_spherical_to_cartesian(xyz)
        if header.has_pose():
            xyz = library.E57.to_global(xyz, header.rotation, header.translation)
        fields = {_E57_FIELDS[name]: _column(columns[name][:n][valid], *scales[name]) for name in kept}
        yield Cloud(xyz, others, frame, fields)


def _limits(header: Any, name: str) -> tuple[float, float]:
    """(least, largest) value of a field, as the scan's limits name them, or else the type that it is stored in."""
    group = "intensityLimits" if name == "intensity" else "colorLimits"
    with suppress(Exception):  # libE57's own exceptions, for missing nodes
        limits = header[group]
        return float(limits[f"{name}Minimum"].value()), float(limits[f"{name}Maximum"].value())
    with suppress(Exception):
        kind = header.points.prototype()[name]
        return float(kind.minimum()), float(kind.maximum())
    return 0.0, 1.0


def _column(values: F64, least: float, largest: float) -> NDArray[Any]:
    """Values as a map holds them: from 0 on, in 8 or 16 bits if they are whole numbers within such limits."""
    values = values - min(least, 0.0)
    largest = max(largest - min(least, 0.0), float(values.max(initial=0.0)))
    whole = bool((values == np.floor(values)).all()) and largest > 1.0
    if whole and largest <= 65535.0:
        return values.astype(np.uint8 if largest <= 255.0 else np.uint16)
    return values.astype(np.float32)
