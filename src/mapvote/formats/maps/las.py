"""LAS and LAZ files through laspy (extra ``las``)."""

from __future__ import annotations

import io
import os
import struct
import subprocess
import sys
from pathlib import Path

import msgspec
import numpy as np
from numpy.typing import NDArray

from mapvote.core.types import MapvoteError
from mapvote.formats.atomic import whole_file
from mapvote.formats.extras import require
from mapvote.formats.maps import laz_subprocess
from mapvote.formats.maps.cloud import Cloud, other_fields
from mapvote.formats.maps.laz_subprocess import Head, read_points

STEP_M = 0.0001
"""Coordinates are whole multiples of this from the file's offset: exact to 0.05 mm over 400 km."""
MAX_POINTS_PER_BYTE = 16
"""Real LAZ files need a byte or more for a point."""


def is_las(path: Path) -> bool:
    return path.is_file() and path.suffix.lower() in (".las", ".laz")


def read_las(path: Path) -> Cloud:
    """The points of a LAS or LAZ file as float64, and its coordinate system as WKT where it has one."""
    require("laspy", "las", str(path))
    compressed = _check_counts(path)
    try:
        head, points = _read_apart(path) if compressed else read_points(str(path))
    except OSError as error:
        raise MapvoteError(f"{path}: cannot be read ({error.strerror or error})") from error
    except Exception as error:  # laspy and lazrs raise their own, numpy's and struct's
        raise MapvoteError(f"{path}: not a whole LAS or LAZ file ({error}); copy or export it again") from error
    if head.points != head.promised:
        raise MapvoteError(f"{path}: cut off: {head.points} points, but its header says {head.promised}; copy it again")
    others = other_fields(tuple(n.lower() for n in head.dimensions))
    return Cloud(points, others, {"wkt": head.wkt} if head.wkt else {})


def _read_apart(path: Path) -> tuple[Head, NDArray[np.float64]]:
    """:func:`read_points` in a process of its own, which a damaged LAZ file may end; ValueError if it does."""
    command = [sys.executable, laz_subprocess.__file__, str(path)]
    environment = os.environ | {"PYTHONPATH": os.pathsep.join(p for p in sys.path if p)}
    with subprocess.Popen(command, stdout=subprocess.PIPE, stderr=subprocess.DEVNULL, env=environment) as child:
        assert isinstance(child.stdout, io.BufferedReader)
        line = child.stdout.readline()
        if not line:
            raise ValueError("the LAZ reader crashed on it")
        head = msgspec.json.decode(line, type=Head)
        if head.refusal:
            raise ValueError(head.refusal)
        points = np.empty((head.points, 3))
        if child.stdout.readinto(points.reshape(-1).data) != points.nbytes:
            raise ValueError("the LAZ reader stopped half way; is there enough memory?")
    return head, points


def _check_counts(path: Path) -> bool:
    """Whether the points are compressed (LAZ). MapvoteError if the header counts more than the file has room for:
    laspy would believe it and hang.

    Offsets of the LAS 1.4 specification: 25 minor version, 96 start of the points, 100 VLRs, 104 point format (LAZ
    sets a high bit), 107 points (to 1.3), 243 EVLRs and 247 points (1.4).
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
    return bool(header[104] & 0xC0)


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
