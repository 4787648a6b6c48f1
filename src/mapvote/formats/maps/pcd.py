"""PCD files: ascii, binary and binary_compressed (LZF)."""

from __future__ import annotations

import os
import re
import struct
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from itertools import chain, islice, pairwise
from pathlib import Path
from typing import BinaryIO

import lzf
import numpy as np
from numpy.typing import NDArray

from mapvote.core.record import record
from mapvote.core.types import F64, Bool, MapvoteError
from mapvote.formats.atomic import whole_file
from mapvote.formats.listing import files_like, is_recording, require_all_tiles
from mapvote.formats.maps.cloud import (
    READ_SIZES,
    Cloud,
    CloudPieces,
    ReadSizes,
    cloud_of_table,
    log,
    table_of,
    warn_of_float32,
)
from mapvote.formats.maps.pcd_header import PcdHeader, compose_header, read_header
from mapvote.formats.reading import FILE_LIMITS, reading


@record()
@dataclass(frozen=True, slots=True)
class TileRule:
    """When files that may be tiles or scans lie side by side, and so are tiles."""

    tiles: int = 6
    """Tiles whose boxes are compared with the next one's."""
    points: int = 20_000
    """Points of each tile that are read."""
    most_common: float = 0.2
    """Share of the smaller box of two tiles in turn that may lie in the other one's; scans of a drive share most."""


TILE_RULE = TileRule()


def is_pcd_tiles(path: Path) -> bool:
    """A folder whose PCD files are tiles of a map, in whatever tiling; with stamps or poses it is a drive.

    X_Y.pcd are tiles by their names; with coordinates of six or seven digits, or with a word before them, they are if
    their points lie side by side.
    """
    names = [file.stem for file in files_like(path, "*.pcd")]
    if not names or is_recording(path):
        return False
    if all(re.fullmatch(r"-?\d{1,5}_-?\d{1,5}", name) for name in names):  # X_Y: scans have no such names
        return True
    # By metres of UTM or Gauss-Krueger (412340_5423980), or with a word before them (map_0_0). So may scans be named.
    by_metres = r"(?:[a-z][a-z0-9]*[_-])*-?\d{1,7}(?:\.0+)?[_-]-?\d{1,7}(?:\.0+)?"
    return all(re.fullmatch(by_metres, name, re.IGNORECASE) for name in names) and _lie_side_by_side(
        files_like(path, "*.pcd")
    )


def _lie_side_by_side(files: list[Path], rule: TileRule = TILE_RULE) -> bool:
    """Whether the first points of files in turn lie in boxes that hardly overlap, seen from above. False if the files
    cannot be read: a reader says why."""
    boxes = []
    for file in files[: rule.tiles + 1]:
        try:
            points = next(stream_pcd(file)).points[: rule.points, :2]
        except (MapvoteError, StopIteration):
            return False
        points = points[np.isfinite(points).all(axis=1)]
        if len(points):
            boxes.append((points.min(axis=0), points.max(axis=0)))
    return hardly_overlap(boxes, rule)


def hardly_overlap(boxes: Sequence[tuple[F64, F64]], rule: TileRule = TILE_RULE) -> bool:
    """Whether boxes in turn, each its lowest and its highest (x, y), have little in common: scans of a drive have."""
    common = []
    for (low_a, high_a), (low_b, high_b) in pairwise(boxes):
        both = np.maximum(np.minimum(high_a, high_b) - np.maximum(low_a, low_b), 0.0).prod()
        smaller = min((high_a - low_a).prod(), (high_b - low_b).prod())
        common.append(float(both / max(smaller, 1e-9)))
    return bool(common) and float(np.median(common)) < rule.most_common


def stream_pcd_tiles(path: Path) -> Iterator[Cloud]:
    """The points of all tiles, one file after the other: points are in map metres, names say nothing about places.
    MapvoteError if clouds of another kind lie beside them."""
    files = files_like(path, "*.pcd")
    require_all_tiles(path, files)
    for file in files:
        yield from stream_pcd(file)


def read_pcd_table(path: Path) -> NDArray[np.void]:
    """Every field of a PCD file as a structured array (n,).

    MapvoteError if the file is not a PCD, cut off, or says more points than it holds.
    """
    with reading(path, "PCD file"), path.open("rb") as file:
        header = read_header(str(path), file)
        tables = list(_tables(path, file, header, READ_SIZES.block))
    return tables[0] if len(tables) == 1 else np.concatenate(tables)


def read_viewpoint(path: Path) -> F64:
    """tx ty tz qw qx qy qz (7,) of the header alone; no point is read."""
    with reading(path, "PCD file"), path.open("rb") as file:
        return np.array(read_header(str(path), file).viewpoint, dtype=np.float64)


def stream_pcd(path: Path, sizes: ReadSizes = READ_SIZES) -> Iterator[Cloud]:
    """The points of a PCD file, piece by piece (binary_compressed, one block by its nature, in one); its VIEWPOINT is
    not applied: map points are in map metres already. MapvoteError as :func:`read_pcd_table`.

    In an organised cloud a ray without return is NaN or (0, 0, 0); such rays are left out, with their number."""
    with reading(path, "PCD file"), path.open("rb") as file:
        header = read_header(str(path), file)
        empty_rays = 0
        for table in _tables(path, file, header, sizes.block):
            cloud = cloud_of_table(str(path), table)
            if header.is_organised:
                measured = _measured(cloud.points)
                empty_rays += int((~measured).sum())
                cloud = cloud.where(measured)
            yield cloud
    if empty_rays:
        problem = "%s: an image of %d by %d rays; %d of them without return are left out"
        log.warning(problem, path, header.width, header.height, empty_rays)


def _measured(points: NDArray[np.floating]) -> Bool:
    """Which of the points (n, 3) are no rays without return."""
    return np.asarray(np.isfinite(points).all(axis=1) & points.any(axis=1))


def _tables(path: Path, file: BinaryIO, header: PcdHeader, block: int) -> Iterator[NDArray[np.void]]:
    """The points that follow the header, block by block, their number checked; one empty block if there are none."""
    if header.points == 0:
        yield np.empty(0, header.layouts()[0])
    elif header.encoding == "ascii":
        yield from _ascii(path, file, header, block)
    elif header.encoding == "binary":
        yield from _binary(path, file, header, block)
    else:
        yield _compressed(path, file, header)
        _check_end(path, header, _bytes_left(file))


def _binary(path: Path, file: BinaryIO, header: PcdHeader, block: int) -> Iterator[NDArray[np.void]]:
    there = path.stat().st_size - file.tell()
    sizes = {layout.itemsize * header.points: layout for layout in header.layouts()}
    dtype = sizes.get(there, header.layouts()[0])
    left = header.points
    while left > 0:
        raw = file.read(min(left, block) * dtype.itemsize)
        table = np.frombuffer(raw[: len(raw) // dtype.itemsize * dtype.itemsize], dtype=dtype)
        left -= len(table)
        if not len(table):
            raise _cut_off(path, header.points - left, header)
        yield table
    _check_end(path, header, _bytes_left(file) // dtype.itemsize)


def _ascii(path: Path, file: BinaryIO, header: PcdHeader, most: int) -> Iterator[NDArray[np.void]]:
    lines = _DataLines(file, header.lines)
    rows = iter(lines)
    first = next(rows, b"")
    layouts = {_elements(layout): layout for layout in reversed(header.layouts())}
    dtype = layouts.get(len(first.split()), header.layouts()[0])
    left = header.points
    rows = chain([first] if first else [], rows)
    while left > 0:
        block = list(islice(rows, min(left, most)))
        if not block:
            raise _cut_off(path, header.points - left, header)
        left -= len(block)
        yield _parsed(f"{path}:{lines.number - len(block) + 1}", block, dtype)
    _check_end(path, header, sum(1 for _ in rows))


class _DataLines:
    """The lines of an ascii file that hold something; ``number`` of the last one read."""

    def __init__(self, file: BinaryIO, number: int) -> None:
        self._file = file
        self.number = number

    def __iter__(self) -> Iterator[bytes]:
        for line in self._file:
            self.number += 1
            if line.strip():
                yield line.replace(b",", b" ")


def _elements(dtype: np.dtype[np.void]) -> int:
    """Numbers of one point."""
    return sum(int(np.prod(dtype[name].shape)) for name in dtype.names or ())


def _parsed(source: str, lines: list[bytes], dtype: np.dtype[np.void]) -> NDArray[np.void]:
    """Lines of numbers as a table. Where a whole number is written "1.0" or "nan" it is read as PCL does: 1, 0.
    MapvoteError names the first line that has too few or too many numbers, or something else."""
    try:
        return np.atleast_1d(np.loadtxt(lines, dtype, comments=None))
    except (ValueError, OverflowError):
        pass
    width = _elements(dtype)
    rows = np.empty((len(lines), _elements(dtype)))
    path, _, start = source.rpartition(":")
    for number, line in enumerate(lines):
        words = line.split()
        try:
            rows[number] = [float(word) for word in words] if len(words) == width else ()
        except ValueError:
            cause = f"{len(words)} values, but FIELDS and COUNT make {width}"
            if len(words) == width:
                cause = f"{line[:60].decode('utf-8', 'replace').strip()!r} is no row of numbers"
            raise MapvoteError(f"{path}:{int(start) + number}: {cause}; correct the line, or export again") from None
    table = np.empty(len(lines), dtype)
    column = 0
    for name in dtype.names or ():
        shape = dtype[name].shape
        values = rows[:, column : column + int(np.prod(shape))].reshape(len(lines), *shape)
        column += int(np.prod(shape))
        table[name] = values if dtype[name].base.kind == "f" else np.nan_to_num(values)
    return table


def _compressed(path: Path, file: BinaryIO, header: PcdHeader) -> NDArray[np.void]:
    """The points of a binary_compressed file: LZF, field after field."""
    packed_bytes, whole_bytes = struct.unpack("<II", file.read(8).ljust(8, b"\0"))
    layouts = {layout.itemsize * header.points: layout for layout in reversed(header.layouts())}
    if whole_bytes not in layouts:
        raise MapvoteError(
            f"{path}: its data unpack to {whole_bytes} bytes, but its header says {header.points} points of "
            f"{header.layouts()[0].itemsize} bytes; FIELDS, SIZE, COUNT or POINTS is wrong: export it again"
        )
    packed = file.read(packed_bytes)
    if len(packed) < packed_bytes or whole_bytes > FILE_LIMITS.lzf_expansion * max(packed_bytes, 1):
        raise MapvoteError(f"{path}: cut off: {len(packed)} of {packed_bytes} packed bytes; copy it again")
    raw = lzf.decompress(packed, whole_bytes)
    if raw is None or len(raw) != whole_bytes:
        raise MapvoteError(f"{path}: its packed data are damaged; copy it again")
    dtype = layouts[whole_bytes]
    table = np.empty(header.points, dtype)
    start = 0
    for name in dtype.names or ():
        table[name] = np.frombuffer(raw, dtype[name], header.points, start)
        start += dtype[name].itemsize * header.points
    return table


def _bytes_left(file: BinaryIO) -> int:
    """Bytes that follow, zeros that fill a page at most not counted."""
    start = file.tell()
    left = max(0, file.seek(0, os.SEEK_END) - start)
    page = 4096  # bytes that PCL up to 1.7 reserved for the header; those left over follow the points, as zeros
    if left > page:
        return left
    file.seek(start)
    return len(file.read().rstrip(b"\0"))


def _cut_off(path: Path, there: int, header: PcdHeader) -> MapvoteError:
    return MapvoteError(f"{path}: cut off: {there} points, but its header says {header.points}; copy it again")


def _check_end(path: Path, header: PcdHeader, more: int) -> None:
    """MapvoteError if the file holds ``more`` than its header says."""
    if more > 0:
        raise MapvoteError(
            f"{path}: its header says {header.points} points, but data for {more} more follow; correct WIDTH, "
            "HEIGHT and POINTS, or export it again"
        )


def write_pcd(path: Path, cloud: Cloud | CloudPieces, *, double: bool = False) -> None:
    """A cloud and its fields, binary, x, y, z as float32, which is all that PCL reads, or float64 if ``double``.

    The frame is not written: PCD has no place for it. Whole or not at all.
    """
    clouds = CloudPieces.of(cloud)
    if not double:
        warn_of_float32(str(path), clouds)
    with whole_file(path) as partial:
        save_pcd(partial, clouds, np.float64 if double else np.float32)


def save_pcd(path: Path, cloud: Cloud | CloudPieces, xyz_type: type[np.floating] = np.float32) -> None:
    """A cloud and its fields straight to ``path``. PCL's intensity is a float, and so is written as one."""
    clouds = CloudPieces.of(cloud)
    kinds = dict.fromkeys("xyz", np.dtype(xyz_type)) | dict(clouds.kinds)
    if "intensity" in kinds:
        kinds["intensity"] = np.dtype(np.float32)
    dtype = np.dtype(list(kinds.items()))
    with path.open("wb") as stream:
        stream.write(compose_header(dtype, clouds.n))
        for piece in clouds:
            stream.write(table_of(piece, list(kinds.items())).tobytes())
