"""LAS and LAZ files through laspy (extra ``las``)."""

from __future__ import annotations

import struct
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from mapvote.core.types import MapvoteError
from mapvote.formats.cloud import Cloud, other_fields
from mapvote.formats.extras import require
from mapvote.formats.whole import whole_file

STEP_M = 0.0001
"""Coordinates are whole multiples of this from the file's offset: exact to 0.05 mm over 400 km."""
MAX_POINTS_PER_BYTE = 16
"""Real LAZ files need a byte or more for a point."""
_CHUNK = 1_000_000


def is_las(path: Path) -> bool:
    return path.is_file() and path.suffix.lower() in (".las", ".laz")


def read_las(path: Path) -> Cloud:
    """The points of a LAS or LAZ file as float64, and its coordinate system as WKT where it has one."""
    laspy = require("laspy", "las", str(path))
    _check_counts(path)
    try:
        with laspy.open(path) as file:
            points = np.empty((file.header.point_count, 3))
            done = 0
            for chunk in file.chunk_iterator(_CHUNK):
                points[done : done + len(chunk)] = np.column_stack([chunk.x, chunk.y, chunk.z])
                done += len(chunk)
            wkt = [v.string for v in file.header.vlrs if type(v).__name__ == "WktCoordinateSystemVlr"]
            names = tuple(file.header.point_format.dimension_names)
    except OSError as error:
        raise MapvoteError(f"{path}: cannot be read ({error.strerror or error})") from error
    except Exception as error:  # laspy and lazrs raise their own, numpy's and struct's
        raise MapvoteError(f"{path}: not a whole LAS or LAZ file ({error}); copy or export it again") from error
    if done != len(points):
        raise MapvoteError(f"{path}: cut off: {done} points, but its header says {len(points)}; copy it again")
    others = other_fields(tuple(n.lower() for n in names))
    return Cloud(points, others, {"wkt": wkt[0]} if wkt else {})


def _check_counts(path: Path) -> None:
    """MapvoteError if the header counts more than the file has room for: laspy would believe it and hang.

    Offsets of the LAS 1.4 specification: 25 minor version, 96 start of the points, 100 VLRs, 107 points (to 1.3),
    243 EVLRs and 247 points (1.4).
    """
    try:
        size = path.stat().st_size
        with path.open("rb") as stream:
            header = stream.read(255).ljust(255, b"\0")
    except OSError as error:
        raise MapvoteError(f"{path}: cannot be read ({error.strerror or error})") from error
    start, vlrs = struct.unpack_from("<II", header, 96)
    evlrs, points = (
        struct.unpack_from("<IQ", header, 243) if header[25] >= 4 else (0, struct.unpack_from("<I", header, 107)[0])
    )
    room = max(size - start, 0) * MAX_POINTS_PER_BYTE
    if header[:4] != b"LASF" or start > size or vlrs * 54 > size or evlrs * 60 > size or points > room:
        raise MapvoteError(
            f"{path}: not a whole LAS or LAZ file (its header promises more than it holds); copy it again"
        )


def write_las(path: Path, points: NDArray[np.floating], *, wkt: str | None = None) -> None:
    """Points (n, 3) as LAS 1.4, or LAZ if the name ends so; float64 kept to 0.05 mm. Whole or not at all."""
    laspy = require("laspy", "las", str(path))
    exact = points.astype(np.float64, copy=False)
    header = laspy.LasHeader(point_format=6, version="1.4")
    header.offsets = np.floor(exact.mean(axis=0)) if len(exact) else np.zeros(3)
    header.scales = np.full(3, STEP_M)
    if wkt is not None:
        header.vlrs.append(laspy.vlrs.known.WktCoordinateSystemVlr(wkt))
        header.global_encoding.wkt = True
    las = laspy.LasData(header)
    las.x, las.y, las.z = exact[:, 0], exact[:, 1], exact[:, 2]
    with whole_file(path) as partial, partial.open("wb") as stream:
        las.write(stream, do_compress=path.suffix.lower() == ".laz")
