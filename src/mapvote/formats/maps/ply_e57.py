"""PLY files: written here (a header and numpy's bytes, piece by piece), read through plyfile (extra ``ply``).
E57 files through pye57 (extra ``e57``): every scan of the file, brought to the file's frame by its pose.
"""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import suppress
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from mapvote.core.types import MapvoteError
from mapvote.formats.atomic import whole_file
from mapvote.formats.extras import reading, require
from mapvote.formats.geo.frame import MapFrame
from mapvote.formats.maps.cloud import Cloud, CloudPieces, cloud_of_table, table_of

_BLOCK = 500_000
"""Vertices handed on at a time."""
_TYPES = {
    "f8": "double", "f4": "float", "u1": "uchar", "i1": "char", "u2": "ushort", "i2": "short", "u4": "uint", "i4": "int"
}  # fmt: skip
MAX_POINTS_PER_BYTE = 16
_FIELDS = {"intensity": "intensity", "colorRed": "red", "colorGreen": "green", "colorBlue": "blue"}


def stream_ply(path: Path) -> Iterator[Cloud]:
    """The vertices of a PLY file, ascii or binary, float or double; faces are ignored. Binary vertices without lists
    stay on disk until their piece is read. MapvoteError if the file is damaged or holds no element "vertex"."""
    library = require("plyfile", "ply", str(path))
    with reading(path, "PLY file of vertices"):
        with path.open("rb") as stream:  # a file that plyfile opens stays open where it is damaged
            file = library.PlyData.read(stream)
        if "vertex" not in file:
            raise ValueError("it holds no element vertex")
        vertices = file["vertex"].data
        vertices = vertices[[name for name in vertices.dtype.names if not vertices.dtype[name].hasobject]]  # no lists
        for start in range(0, max(len(vertices), 1), _BLOCK):
            part = np.array(vertices[start : start + _BLOCK])
            part = part.astype(part.dtype.newbyteorder("="))
            yield cloud_of_table(str(path), part)


def write_ply(path: Path, cloud: Cloud | CloudPieces) -> None:
    """A cloud as double x, y, z and its fields, binary little-endian: nothing is rounded. Whole or not at all.

    The frame is not written: PLY has no place for it.
    """
    clouds = CloudPieces.of(cloud)
    kinds = [(axis, np.dtype("<f8")) for axis in "xyz"]
    kinds += [(name, kind.newbyteorder("<")) for name, kind in clouds.kinds.items()]
    properties = "".join(f"property {_TYPES[kind.str[1:]]} {name}\n" for name, kind in kinds)
    start = f"ply\nformat binary_little_endian 1.0\ncomment mapvote\nelement vertex {clouds.n}\n"
    with whole_file(path) as partial, partial.open("wb") as stream:
        stream.write(f"{start}{properties}end_header\n".encode("ascii"))
        for piece in clouds:
            stream.write(table_of(piece, kinds).tobytes())


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
        wkt = ""
        with suppress(Exception):  # libE57's own, for a file that names no coordinate system
            wkt = str(file.root["coordinateMetadata"].value()).strip()
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
