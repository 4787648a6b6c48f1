"""LAS and LAZ files through laspy (extra ``las``)."""

from __future__ import annotations

from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from mapvote.core.types import MapvoteError
from mapvote.formats.cloud import Cloud, other_fields
from mapvote.formats.extras import require
from mapvote.formats.whole import whole_file

STEP_M = 0.0001
"""Coordinates are whole multiples of this from the file's offset: exact to 0.05 mm over 400 km."""
_CHUNK = 1_000_000


def is_las(path: Path) -> bool:
    return path.is_file() and path.suffix.lower() in (".las", ".laz")


def read_las(path: Path) -> Cloud:
    """The points of a LAS or LAZ file as float64, and its coordinate system as WKT where it has one."""
    laspy = require("laspy", "las", str(path))
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
