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
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from enum import IntEnum
from pathlib import Path
from typing import Any

import msgspec
import numpy as np
from numpy.typing import NDArray

from mapvote.core.brightness import Brightness, shares
from mapvote.core.extras import require
from mapvote.core.record import record
from mapvote.core.types import F64, MapvoteError
from mapvote.formats.atomic import whole_file
from mapvote.formats.geo.frame import ENU, MapFrame, pyproj, read_crs
from mapvote.formats.geo.units import METRES, with_units
from mapvote.formats.listing import files_like, is_recording, require_all_tiles
from mapvote.formats.maps import laz_subprocess
from mapvote.formats.maps.cloud import SCALED, Cloud, CloudPieces
from mapvote.formats.maps.field_names import kept_fields, known_fields, other_fields
from mapvote.formats.maps.laz_subprocess import FIELDS, FLAGS, Head, Piece, read_head, read_pieces
from mapvote.formats.maps.pcd import TILE_RULE, TileRule, hardly_overlap
from mapvote.formats.reading import FILE_LIMITS, reading

log = logging.getLogger("mapvote.formats")


class GeoKey(IntEnum):
    """Keys of GeoTIFF."""

    MODEL = 1024
    GEODETIC = 2048
    PROJECTED = 3072
    UNIT = 3076
    VERTICAL = 4096
    VERTICAL_UNIT = 4099


_USER_DEFINED = 32767


def frame_of_keys(source: str, keys: Mapping[int, int]) -> MapFrame:
    """The frame that the keys name; local if they name none, with a warning if they describe one of their own.

    MapvoteError if a code is none that pyproj knows.
    """
    code = keys.get(GeoKey.PROJECTED) or 0
    if code in (0, _USER_DEFINED) and keys.get(GeoKey.MODEL) == 2:  # longitude and latitude
        code = keys.get(GeoKey.GEODETIC) or 0
    if code == _USER_DEFINED or (keys.get(GeoKey.PROJECTED) == _USER_DEFINED):
        raise MapvoteError(
            f"{source}: describes a coordinate system of its own in GeoTIFF keys, without a code; name the one it "
            f"means with --from-crs EPSG:n, or --from-crs local for metres from somewhere"
        )
    if not code:
        return MapFrame()
    vertical = keys.get(GeoKey.VERTICAL, 0)
    text = f"EPSG:{code}"
    if 0 < vertical < _USER_DEFINED:
        try:  # files often hold a code of a vertical datum, or of an ellipsoid, where that of a vertical CRS belongs
            text += f"+{vertical}" if read_crs(f"EPSG:{vertical}").is_vertical else ""
        except MapvoteError:
            log.warning("heights: EPSG:%d is no vertical coordinate system; ignored", vertical)
    plane, up = (METRES.get(keys.get(key, 0)) for key in (GeoKey.UNIT, GeoKey.VERTICAL_UNIT))
    return MapFrame(with_units(_known(source, text), plane, up))


_DECODER = msgspec.json.Decoder(Head)


def stream_las(path: Path, *, extra: bool = False) -> Iterator[Cloud]:
    """The points of a LAS, LAZ or COPC file as float64, piece by piece, in the coordinate system that it names.

    One piece without points if the file has none. ``extra``: with the columns that the file defines itself.
    MapvoteError if it is damaged or cut off.
    """
    laspy = require("laspy", "las", str(path))
    brought = [name for name in kept_fields() if name not in FIELDS]
    with reading(path, "LAS or LAZ file"):
        if _check_counts(path):
            pieces = _apart(path, extra=extra or bool(brought))
        else:
            pieces = _beside(laspy, path, extra=extra or bool(brought))
        for piece in pieces:
            yield piece if extra else _only(piece, brought)


def is_las_tiles(path: Path, rule: TileRule = TILE_RULE) -> bool:
    """A folder of LAS or LAZ files whose boxes, by their headers, lie side by side; with stamps or poses a drive."""
    files = tile_files(path)
    if len(files) < 2 or is_recording(path):
        return False
    laspy = require("laspy", "las", str(path))
    boxes = []
    for file in files[: rule.tiles + 1]:
        try:
            with laspy.open(file) as reader:
                boxes.append((np.array(reader.header.mins[:2]), np.array(reader.header.maxs[:2])))
        except Exception:  # a reader says why the file cannot be read
            return False
    return hardly_overlap(boxes, rule)


def tile_files(path: Path) -> list[Path]:
    """The LAS and LAZ files of a folder, by name."""
    return sorted([*files_like(path, "*.las"), *files_like(path, "*.laz")])


def stream_las_tiles(path: Path) -> Iterator[Cloud]:
    """The points of all tiles, one file after the other, each in the coordinates that its file names. MapvoteError if
    clouds of another kind lie beside them."""
    files = tile_files(path)
    require_all_tiles(path, files)
    for file in files:
        yield from stream_las(file)


def _only(piece: Cloud, brought: Sequence[str]) -> Cloud:
    """The piece with LAS's own fields, and of those that the file defines itself the ones that are ``brought``."""
    map_fields = known_fields(list(piece.fields))
    fields = {name: column for name, column in piece.fields.items() if name in FIELDS}
    own = {name: piece.fields[map_fields[name]] for name in brought if name in map_fields}
    return replace(piece, fields=fields | own)


def _beside(laspy: Any, path: Path, *, extra: bool) -> Iterator[Cloud]:
    """Facts of a LAS file."""
    with laspy.open(path) as file:
        head = read_head(file, extra=extra)
        yield from _clouds(path, head, read_pieces(file, head))


def _clouds(path: Path, head: Head, pieces: Iterator[Piece]) -> Iterator[Cloud]:
    if head.held is not None:
        _check_held(path, head.promised, head.held)
        _check_whole(path, head.promised, min(head.held, head.promised))
    frame = _frame(str(path), head)
    others = tuple(name for name in other_fields(head.dimensions) if name not in (*FLAGS, *"XYZ"))
    times = "" if "gps_time" not in head.dimensions else "adjusted standard" if head.adjusted_time else "week"
    done = 0
    low = np.full(3, np.inf)
    high = np.full(3, -np.inf)
    for points, fields in pieces:
        done += len(points)
        low = np.fmin(low, points.min(axis=0, initial=np.inf))
        high = np.fmax(high, points.max(axis=0, initial=-np.inf))
        yield Cloud(points, others, frame, fields, times)
    _check_whole(path, head.promised, done)
    beside = beside_its_box(path, low, high)
    if beside:
        log.warning("%s: %s", path, beside)
    if not done:
        yield Cloud(np.empty((0, 3)), others, frame)


def beside_its_box(path: Path, low: F64, high: F64) -> str:
    """How far the points from ``low`` (3,) to ``high`` (3,) lie beside the box that the file's header states; "" if
    they share a part of it, or if it states none. So an offset shows that was lost."""
    layout = struct.Struct("<6d")  # highest and lowest x, y, z
    with path.open("rb") as file:
        file.seek(179)
        numbers = file.read(layout.size)
    if len(numbers) < layout.size or not np.isfinite(low).all():
        return ""
    box = np.array(layout.unpack(numbers)).reshape(3, 2)
    stated_high = box[:, 0]
    stated_low = box[:, 1]
    stated = bool(np.isfinite(box).all()) and bool((stated_high > stated_low).any())
    margin_m = 1.0 + (high - low)
    if not stated or not ((low > stated_high + margin_m) | (high < stated_low - margin_m)).any():
        return ""
    x, y, z = (stated_low + stated_high - low - high) / 2.0
    return (
        f"the points lie beside the box of the file's header: {x:+.2f}, {y:+.2f}, {z:+.2f} m would bring them into it. "
        "Was the header's offset lost? Write it anew; if the points are right, the box is stale (lasinfo -repair)"
    )


def _frame(source: str, head: Head) -> MapFrame:
    """The frame that the file names; where it is unclear, one with a refusal."""
    try:
        return MapFrame(_known(source, head.wkt)) if head.wkt else frame_of_keys(source, head.geo_keys)
    except MapvoteError as error:
        return MapFrame(refusal=str(error))


def _known(source: str, crs: str) -> str:
    try:
        read_crs(crs)
    except MapvoteError as error:
        raise MapvoteError(f"{source}: {error}; say what it is with --from-crs") from error
    return crs


def _apart(path: Path, *, extra: bool) -> Iterator[Cloud]:
    """Content of the file, read by a process of its own, which a damaged LAZ file may end; ValueError if it does."""
    command = [sys.executable, laz_subprocess.__file__, str(path), *(["extra"] if extra else [])]
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
    head = _DECODER.decode(line)
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
        points = np.empty((n, 3))
        fields = {name: np.empty(n, dtype=kind) for name, kind in head.fields.items()}
        for column in (points.reshape(-1), *fields.values()):
            if stream.readinto(column.data.cast("B")) != column.nbytes:
                raise ValueError("the LAZ reader stopped half way; is there enough memory?")
        yield points, fields


def _check_counts(path: Path) -> bool:
    """Whether the points are compressed (LAZ). MapvoteError if the header counts more points than the file has room
    for, which laspy would believe and hang, or fewer than it holds.

    Offsets of the LAS 1.4 specification: 25 minor version, 96 start of the points, 100 VLRs, 104 point format (LAZ
    sets a high bit), 105 bytes of a point, 107 points (to 1.3), 111 points by return, 227 waveforms (1.3), 235 EVLRs'
    start, 243 EVLRs and 247 points (1.4), 255 points by return (1.4).
    """
    size = path.stat().st_size
    with path.open("rb") as stream:
        header = stream.read(375).ljust(375, b"\0")
    version = header[25]
    compressed = bool(header[104] & 0xC0)
    scales = struct.unpack_from("<3d", header, 131)
    if header[:4] == b"LASF" and not all(0.0 < abs(scale) < 1e6 for scale in scales):
        raise MapvoteError(f"{path}: its header scales x, y, z by {scales}: no coordinates; export the file again")
    start, vlrs = struct.unpack_from("<II", header, 96)
    record, legacy = struct.unpack_from("<HI", header, 105)
    evlrs, points = struct.unpack_from("<IQ", header, 243) if version >= 4 else (0, legacy)
    room = max(size - start, 0) * FILE_LIMITS.las_points_per_byte
    if header[:4] != b"LASF" or start > size or vlrs * 54 > size or evlrs * 60 > size or points > room:
        raise MapvoteError(
            f"{path}: not a whole LAS or LAZ file (its header promises more than it holds); copy it again"
        )
    # The size of a LAS file tells how many points there are; the header's count by return may tell it for LAZ.
    if compressed:
        returns = sum(
            struct.unpack_from("<15Q", header, 255) if version >= 4 else struct.unpack_from("<5I", header, 111)
        )
        if returns > points:
            log.warning("%s: its header counts %d points, but %d returns: are points missing?", path, points, returns)
    else:
        waveforms = struct.unpack_from("<Q", header, 227)[0] if version >= 3 else 0
        after = struct.unpack_from("<Q", header, 235)[0] if evlrs else 0
        end = min((place for place in (waveforms, after) if start < place < size), default=size)
        _check_held(path, points, (end - start) // max(record, 1))
    return compressed


def _check_held(path: Path, promised: int, held: int) -> None:
    """MapvoteError if a file holds more points than its header counts."""
    if held > promised:
        raise MapvoteError(
            f"{path}: its header counts {promised} points, but data for {held - promised} more follow; correct the "
            "number of points in the header (lasinfo -repair does), or export it again"
        )


def _check_whole(path: Path, promised: int, held: int) -> None:
    """MapvoteError if a file holds fewer points than its header counts."""
    if held != promised:
        raise MapvoteError(f"{path}: cut off: {held} points, but its header says {promised}; copy it again")


def _as_las(name: str, values: NDArray[Any], brightness: Brightness) -> NDArray[Any]:
    """A column as LAS holds it. Whole numbers from 0 to 65,535 stay as they are; other brightness is scaled so that
    full becomes 65,535; 8-bit colours too, for LAS's colours have 16 bits."""
    kind = np.dtype(FIELDS[name])
    if values.dtype == kind:
        return values
    if kind.kind == "f":
        return values.astype(kind)
    highest = 15 if name in ("return_number", "number_of_returns", "las_flags") else np.iinfo(kind).max
    if name in SCALED and not (brightness.is_count and (name == "intensity" or brightness.full > 255.0)):
        return np.rint(shares(values, brightness.full) * highest).astype(kind)
    return np.rint(np.clip(np.nan_to_num(values.astype(np.float64)), 0, highest)).astype(kind)


def _tell_of_brightness(path: Path, clouds: CloudPieces) -> None:
    """Say what LAS cannot hold of intensities and colours, and on which scale they are written."""
    for name, values in clouds.brightness.items():
        lost = {"negative": values.negative, "not finite": values.undefined, "above the scale": values.above}
        counts = ", ".join(f"{n} {kind}" for kind, n in lost.items() if n)
        if counts:
            log.warning("%s: %s of %d values: %s; LAS holds 0 to 65535", path, name, values.n, counts)
        if not values.is_count:
            log.warning("%s: %s from 0 to %g is written as 0 to 65535", path, name, values.full)


@record()
@dataclass(frozen=True, slots=True)
class LasSteps:
    """Resolution of coordinates in LAS files, which are whole multiples of a step from the file's offset."""

    length: float = 1e-4
    """Step of metres or feet: exact to 0.05 mm over 400 km."""
    degree: float = 1e-13
    """Least step of degrees; else the finest that 32 bits hold, for a longitude is no short decimal."""
    largest: int = 2**31 - 1
    """Greatest number of steps from the offset: 32 bits."""


LAS_STEPS = LasSteps()


def steps_and_offsets(corners: F64, *, degrees: bool) -> tuple[F64, F64]:
    """((3,) steps, (3,) offsets) for coordinates within ``corners`` (2, 3); ``degrees``: of x and y. No coordinate
    takes more than 32 bits: steps grow with the extent, in two decimal digits."""
    decimals = [6, 6, 0] if degrees else [0, 0, 0]
    middle = 0.5 * (corners[0] + corners[1])
    offsets = np.array([np.round(value, digits) for value, digits in zip(middle, decimals, strict=True)])
    needed = np.maximum(np.abs(corners - offsets).max(axis=0), 1e-9) / LAS_STEPS.largest
    digit = 10.0 ** (np.floor(np.log10(needed)) - 1)
    held = (np.floor(needed / digit) + 1.0) * digit
    wanted = np.array([LAS_STEPS.degree if degrees else LAS_STEPS.length] * 2 + [LAS_STEPS.length])
    return np.where(held > wanted, held, wanted), offsets


def _wkt(crs: Any) -> str:
    """A coordinate system in the WKT of LAS 1.4; of one with ellipsoidal heights, which that WKT cannot say, the plane
    part."""
    try:
        return str(crs.to_wkt("WKT1_GDAL"))
    except pyproj().exceptions.CRSError:
        return str(crs.to_2d().to_wkt("WKT1_GDAL"))


def las_header(laspy: Any, path: Path, clouds: CloudPieces) -> tuple[Any, F64]:
    """(laspy's header of LAS 1.4 for a cloud, (3,) metres to add to its points): coordinate system, steps and fields.

    x is east or longitude, y north or latitude, whatever order the coordinate system names. Intensities and colours
    that LAS cannot hold are a warning.
    """
    shift = np.zeros(3)
    geographic = False
    header = laspy.LasHeader(point_format=7 if "red" in clouds.kinds else 6, version="1.4")
    # Back to the coordinates that the CRS means.
    if not clouds.frame.is_local and not clouds.frame.crs.startswith(ENU):
        shift = np.array(clouds.frame.offset_m)
        crs = read_crs(clouds.frame.crs)
        geographic = bool(crs.is_geographic)
        header.vlrs.append(laspy.vlrs.known.WktCoordinateSystemVlr(_wkt(crs)))
        header.global_encoding.wkt = True
    adjusted = clouds.gps_times == "adjusted standard"
    header.global_encoding.gps_time_type = laspy.header.GpsTimeType(int(adjusted))
    header.scales, header.offsets = steps_and_offsets(clouds.corners + shift, degrees=geographic)
    own = [laspy.ExtraBytesParams(name, kind) for name, kind in clouds.kinds.items() if name not in FIELDS]
    if own:
        header.add_extra_dims(own)
    _tell_of_brightness(path, clouds)
    return header, shift


def write_las(path: Path, cloud: Cloud | CloudPieces) -> None:
    """A cloud as LAS 1.4, or LAZ if the name ends so; float64 kept to 0.05 mm, with its coordinate system and fields.

    Every point is return 1 of 1 where nothing else is known. Whole or not at all.
    """
    laspy = require("laspy", "las", str(path))
    clouds = CloudPieces.of(cloud)
    header, shift = las_header(laspy, path, clouds)
    compressed = path.suffix.lower() == ".laz"
    with (
        whole_file(path) as partial,
        partial.open("wb") as stream,
        laspy.open(stream, mode="w", header=header, do_compress=compressed, closefd=False) as out,
    ):
        for piece in clouds:
            out.write_points(las_record(laspy, header, piece, clouds.brightness, shift))


def las_record(laspy: Any, header: Any, piece: Cloud, brightness: Mapping[str, Brightness], shift: F64) -> Any:
    """One piece as laspy's points."""
    record = laspy.ScaleAwarePointRecord.zeros(len(piece.points), header=header)
    record.x, record.y, record.z = (piece.points.astype(np.float64, copy=False) + shift).T
    record.return_number = record.number_of_returns = np.ones(len(record), dtype=np.uint8)
    for name in piece.fields:
        if name not in FIELDS:
            record[name] = piece.fields[name]
            continue
        values = _as_las(name, piece.fields[name], brightness.get(SCALED.get(name, ""), Brightness()))
        if name != "las_flags":
            record[name] = values
            continue
        for flag, bit in FLAGS.items():
            record[flag] = (values & bit) > 0
    return record
