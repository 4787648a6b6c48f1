"""LAS, LAZ and COPC files through laspy (extra ``las``): read piece by piece, with their coordinate system.

LAS up to 1.3 names it by GeoTIFF keys (GeoTIFF 1.1, OGC 19-008).
"""

from __future__ import annotations

import io
import logging
import os
import struct
import subprocess
import sys
from collections.abc import Iterator, Mapping
from pathlib import Path
from typing import Any

import msgspec
import numpy as np
from numpy.typing import NDArray

from mapvote.core.types import MapvoteError
from mapvote.formats.atomic import whole_file
from mapvote.formats.extras import reading, require
from mapvote.formats.geo.frame import ENU, MapFrame, read_crs
from mapvote.formats.geo.units import METRES, with_units
from mapvote.formats.maps import laz_subprocess
from mapvote.formats.maps.cloud import SCALED, Cloud, CloudPieces, other_fields
from mapvote.formats.maps.laz_subprocess import FIELDS, Head, Piece, read_head, read_pieces

log = logging.getLogger("mapvote.formats")

_MODEL, _GEODETIC, _PROJECTED, _UNIT, _VERTICAL, _VERTICAL_UNIT = 1024, 2048, 3072, 3076, 4096, 4099
_USER_DEFINED = 32767
_MODEL_GEOGRAPHIC = 2


def frame_of_keys(where: str, keys: Mapping[int, int]) -> MapFrame:
    """The frame that the keys name; local if they name none, with a warning if they describe one of their own.

    MapvoteError if a code is none that pyproj knows.
    """
    code = keys.get(_PROJECTED) or 0
    if code in (0, _USER_DEFINED) and keys.get(_MODEL) == _MODEL_GEOGRAPHIC:
        code = keys.get(_GEODETIC) or 0
    if code == _USER_DEFINED or (keys.get(_PROJECTED) == _USER_DEFINED):
        raise MapvoteError(
            f"{where}: describes a coordinate system of its own in GeoTIFF keys, without a code; name the one it "
            f"means with --from-crs EPSG:n, or --from-crs local for metres from somewhere"
        )
    if not code:
        return MapFrame()
    vertical, text = keys.get(_VERTICAL, 0), f"EPSG:{code}"
    if 0 < vertical < _USER_DEFINED:
        try:  # files often hold a code of a vertical datum, or of an ellipsoid, where that of a vertical CRS belongs
            text += f"+{vertical}" if read_crs(f"EPSG:{vertical}").is_vertical else ""
        except MapvoteError:
            log.warning("heights: EPSG:%d is no vertical coordinate system; ignored", vertical)
    plane, up = (METRES.get(keys.get(key, 0)) for key in (_UNIT, _VERTICAL_UNIT))
    return MapFrame(with_units(_known(where, text), plane, up))


STEP_M = 0.0001
"""Coordinates are whole multiples of this from the file's offset: exact to 0.05 mm over 400 km."""
MAX_POINTS_PER_BYTE = 16
"""Real LAZ files need a byte or more for a point."""

_HEAD = msgspec.json.Decoder(Head)


def stream_las(path: Path) -> Iterator[Cloud]:
    """The points of a LAS, LAZ or COPC file as float64, piece by piece, in the coordinate system that it names.

    One piece without points if the file has none. MapvoteError if it is damaged or cut off.
    """
    laspy = require("laspy", "las", str(path))
    with reading(path, "LAS or LAZ file"):
        if _check_counts(path):
            yield from _apart(path)
        else:
            with laspy.open(path) as file:
                head = read_head(file)
                yield from _clouds(path, head, read_pieces(file, head))


def _clouds(path: Path, head: Head, pieces: Iterator[Piece]) -> Iterator[Cloud]:
    frame = MapFrame(_known(str(path), head.wkt)) if head.wkt else frame_of_keys(str(path), head.geo_keys)
    others = tuple(n for n in other_fields(tuple(n.lower() for n in head.dimensions)) if n not in FIELDS)
    done = 0
    for points, fields in pieces:
        done += len(points)
        yield Cloud(points, others, frame, fields)
    if done != head.promised:
        raise MapvoteError(f"{path}: cut off: {done} points, but its header says {head.promised}; copy it again")
    if not done:
        yield Cloud(np.empty((0, 3)), others, frame)


def _known(where: str, crs: str) -> str:
    try:
        read_crs(crs)
    except MapvoteError as error:
        raise MapvoteError(f"{where}: {error}; say what it is with --from-crs") from error
    return crs


def _apart(path: Path) -> Iterator[Cloud]:
    """What the file holds, read by a process of its own, which a damaged LAZ file may end; ValueError if it does."""
    command = [sys.executable, laz_subprocess.__file__, str(path)]
    environment = os.environ | {"PYTHONPATH": os.pathsep.join(p for p in sys.path if p)}
    with subprocess.Popen(command, stdout=subprocess.PIPE, stderr=subprocess.DEVNULL, env=environment) as child:
        try:
            assert isinstance(child.stdout, io.BufferedReader)
            head = _decoded(child.stdout.readline())
            yield from _clouds(path, head, _pieces_of(child.stdout, head))
        finally:
            child.kill()  # where the caller wants no more


def _decoded(line: bytes) -> Head:
    if not line:
        raise ValueError("the LAZ reader crashed on it")
    head = _HEAD.decode(line)
    if head.refusal:
        raise ValueError(head.refusal)
    return head


def _pieces_of(stream: io.BufferedReader, head: Head) -> Iterator[Piece]:
    while True:
        line = stream.readline()
        if line[:1] == b"{":
            _decoded(line)
        if not line:
            raise ValueError("the LAZ reader stopped half way; is there enough memory?")
        n = int(line)
        if n == 0:
            return
        points, fields = np.empty((n, 3)), {name: np.empty(n, dtype=FIELDS[name]) for name in head.fields}
        for column in (points.reshape(-1), *fields.values()):
            if stream.readinto(column.data.cast("B")) != column.nbytes:
                raise ValueError("the LAZ reader stopped half way; is there enough memory?")
        yield points, fields


def _check_counts(path: Path) -> bool:
    """Whether the points are compressed (LAZ). MapvoteError if the header counts more than the file has room for:
    laspy would believe it and hang.

    Offsets of the LAS 1.4 specification: 25 minor version, 96 start of the points, 100 VLRs, 104 point format (LAZ
    sets a high bit), 107 points (to 1.3), 243 EVLRs and 247 points (1.4).
    """
    size = path.stat().st_size
    with path.open("rb") as stream:
        header = stream.read(255).ljust(255, b"\0")
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


def las_fields(fields: Mapping[str, NDArray[Any]], full: Mapping[str, float]) -> dict[str, NDArray[Any]]:
    """Columns as LAS holds them: 16 bits of intensity and colour, from the ``full`` scale that they have."""
    out = {}
    for name, kind in FIELDS.items():
        if name not in fields:
            continue
        values = fields[name]
        if name in SCALED and values.dtype != np.uint16:
            values = np.rint(np.clip(values.astype(np.float64) / full[name], 0.0, 1.0) * 65535.0)
        out[name] = values.astype(kind)
    return out


def write_las(path: Path, cloud: Cloud | CloudPieces) -> None:
    """A cloud as LAS 1.4, or LAZ if the name ends so; float64 kept to 0.05 mm, with its coordinate system and fields.

    Every point is return 1 of 1 where nothing else is known. Whole or not at all.
    """
    laspy = require("laspy", "las", str(path))
    clouds = CloudPieces.of(cloud)
    header = laspy.LasHeader(point_format=7 if "red" in clouds.kinds else 6, version="1.4")
    header.scales = np.full(3, STEP_M)
    shift = np.zeros(3)
    if not clouds.frame.is_local and not clouds.frame.crs.startswith(ENU):
        shift = np.array(clouds.frame.offset_m)  # back to the coordinates that the CRS means
        header.vlrs.append(laspy.vlrs.known.WktCoordinateSystemVlr(read_crs(clouds.frame.crs).to_wkt("WKT1_GDAL")))
        header.global_encoding.wkt = True
    header.offsets = np.floor(clouds.corners.mean(axis=0) + shift)
    compressed = path.suffix.lower() == ".laz"
    with (
        whole_file(path) as partial,
        partial.open("wb") as stream,
        laspy.open(stream, mode="w", header=header, do_compress=compressed, closefd=False) as out,
    ):
        for piece in clouds:
            record = laspy.ScaleAwarePointRecord.zeros(len(piece.points), header=header)
            record.x, record.y, record.z = (piece.points.astype(np.float64, copy=False) + shift).T
            record.return_number = record.number_of_returns = np.ones(len(record), dtype=np.uint8)
            for name, values in las_fields(piece.fields, clouds.full).items():
                record[name] = values
            out.write_points(record)
