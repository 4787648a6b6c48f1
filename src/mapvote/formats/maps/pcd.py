"""PCD files (ascii, binary, binary_compressed) through pypcd4."""

from __future__ import annotations

import os
import re
import struct
from collections.abc import Iterator, Mapping
from itertools import islice
from pathlib import Path
from types import MappingProxyType
from typing import Any, BinaryIO

import numpy as np
from numpy.typing import NDArray
from pypcd4 import Encoding, MetaData, PointCloud

from mapvote.core.types import F64, MapvoteError
from mapvote.formats.atomic import whole_file
from mapvote.formats.extras import first_line
from mapvote.formats.maps.cloud import (
    Cloud,
    CloudPieces,
    joined,
    kept_fields,
    other_fields,
    table_of,
    warn_of_float32,
    xyz,
)

_BLOCK = 500_000
"""Points read at a time."""
_PAGE = 4096
"""Bytes that PCL up to 1.7 reserved for the header: what the header leaves of them follows the points, as zeros."""
_TILE = re.compile(r"-?\d{1,5}_-?\d{1,5}\.pcd")
NO_FIELDS: Mapping[str, NDArray[Any]] = MappingProxyType({})
ENCODINGS = tuple(e.value for e in (Encoding.ASCII, Encoding.BINARY, Encoding.BINARY_COMPRESSED))


def is_pcd(path: Path) -> bool:
    return path.is_file() and path.suffix.lower() == ".pcd"


def is_pcd_tiles(path: Path) -> bool:
    """A folder whose PCD files are all called X_Y.pcd, in whatever tiling; with stamps or poses it is a drive."""
    names = [file.name for file in path.glob("*.pcd")] if path.is_dir() else []
    recorded = any((path / name).exists() for name in ("times.txt", "prior.txt", "drive.toml"))
    return bool(names) and not recorded and all(_TILE.fullmatch(name) for name in names)


def stream_pcd_tiles(path: Path) -> Iterator[Cloud]:
    """The points of all tiles, one file after the other: points are in map metres, names say nothing about places."""
    for file in sorted(path.glob("*.pcd")):
        yield from stream_pcd(file)


def read_pcd_table(path: Path) -> tuple[NDArray[np.void], F64]:
    """Every field of a PCD file as a structured array (n,), and its VIEWPOINT (tx ty tz qw qx qy qz).

    MapvoteError if the file is not a PCD, cut off, or says more points than it holds.
    """
    try:
        cloud = PointCloud.from_path(path)
    except Exception as error:
        raise _unreadable(path, error) from error
    table = np.atleast_1d(cloud.pc_data)
    with path.open("rb") as file:
        about = _header(file)
        _check_count(path, len(table), about, _rest(file, about, skip=True))
    return table, np.array(cloud.metadata.viewpoint, dtype=np.float64)


def _unreadable(path: Path, error: Exception) -> MapvoteError:
    if isinstance(error, OSError):
        return MapvoteError(f"{path}: cannot be read ({error.strerror or error})")
    # pypcd4 lets through whatever numpy, struct, lzf and pydantic raise
    return MapvoteError(f"{path}: not a whole PCD file ({first_line(error)}); copy or export it again")


def _check_count(path: Path, found: int, about: MetaData, beyond: int = 0) -> None:
    """``beyond``: bytes that follow the points that the header promises."""
    if beyond >= about.build_dtype().itemsize:
        more = beyond // about.build_dtype().itemsize
        raise MapvoteError(
            f"{path}: its header says {about.points} points, but data for {more} more follow; correct WIDTH, "
            "HEIGHT and POINTS, or export it again"
        )
    if found != about.points:
        raise MapvoteError(f"{path}: cut off: {found} points, but its header says {about.points}; copy it again")


def read_pcd(path: Path) -> Cloud:
    """The whole file; see :func:`stream_pcd`."""
    return joined(list(stream_pcd(path)))


def stream_pcd(path: Path) -> Iterator[Cloud]:
    """The points of a PCD file, piece by piece (binary_compressed, one block by its nature, in one); its VIEWPOINT is
    not applied: map points are in map metres already. MapvoteError as :func:`read_pcd_table`."""
    try:
        with path.open("rb") as file:
            about = _header(file)
            compressed = about.points and about.data == Encoding.BINARY_COMPRESSED
            tables = iter([read_pcd_table(path)[0]]) if compressed else _blocks(file, about)
            found = 0
            for table in tables:
                found += len(table)
                yield Cloud(xyz(str(path), table), other_fields(table.dtype.names or ()), fields=kept_fields(table))
            _check_count(path, found, about, 0 if compressed else _rest(file, about))
    except MapvoteError:
        raise
    except Exception as error:
        raise _unreadable(path, error) from error


def _header(file: BinaryIO) -> MetaData:
    """What the lines up to DATA say; the file is left where points begin."""
    lines: list[str] = []
    for raw in file:
        line = raw.decode().strip()
        if line and not line.startswith("#"):
            lines.append(line)
        if line.startswith("DATA") or len(lines) >= 10:
            break
    return MetaData.parse_header(lines)


def _blocks(file: BinaryIO, about: MetaData) -> Iterator[NDArray[np.void]]:
    """The points that follow the header, ascii or binary; fewer than it says if the file is cut off."""
    dtype, left = about.build_dtype(), about.points
    if left <= 0:
        yield np.empty(0, dtype=dtype)
    while left > 0:
        if about.data == Encoding.ASCII:
            lines = list(islice(file, min(left, _BLOCK)))
            table = np.atleast_1d(np.loadtxt(lines, dtype, delimiter=" ")) if lines else np.empty(0, dtype=dtype)
        else:
            raw = file.read(min(left, _BLOCK) * dtype.itemsize)
            table = np.frombuffer(raw[: len(raw) // dtype.itemsize * dtype.itemsize], dtype=dtype)
        if not len(table):
            return
        left -= len(table)
        yield table


def _rest(file: BinaryIO, about: MetaData, *, skip: bool = False) -> int:
    """Bytes left of a file (of text, as many as its lines would be), a page of zeros at most not counted; ``skip``:
    beyond the points that follow."""
    if about.data == Encoding.ASCII:
        lines = (line for line in file if line.strip())
        return about.build_dtype().itemsize * sum(1 for _ in islice(lines, about.points if skip else 0, None))
    if skip and about.data == Encoding.BINARY:
        file.seek(about.points * about.build_dtype().itemsize, os.SEEK_CUR)
    elif skip:
        file.seek(struct.unpack("<I", file.read(8)[:4].ljust(4, b"\0"))[0], os.SEEK_CUR)
    start = file.tell()
    left = max(0, file.seek(0, os.SEEK_END) - start)
    if left > _PAGE:
        return left
    file.seek(start)
    return len(file.read().rstrip(b"\0"))


def write_pcd(path: Path, cloud: Cloud | CloudPieces, *, encoding: str = "binary", double: bool = False) -> None:
    """A cloud as x, y, z, float32, which is all that PCL reads, or float64 if ``double``; and its fields.

    The frame is not written: PCD has no place for it. ``encoding`` other than binary takes the whole cloud into memory.
    Whole or not at all.
    """
    clouds, kind = CloudPieces.of(cloud), np.float64 if double else np.float32
    if not double:
        warn_of_float32(str(path), clouds.corners)
    with whole_file(path) as partial:
        if encoding != Encoding.BINARY:
            whole = joined(list(clouds))
            save_pcd(partial, whole.points.astype(kind), whole.fields, encoding=encoding)
            return
        about = _as_header({**dict.fromkeys("xyz", np.dtype(kind)), **clouds.kinds}, clouds.n)
        kinds = list(zip(about.fields, (about.build_dtype()[name] for name in about.fields), strict=True))
        with partial.open("wb") as stream:
            stream.write(about.compose_header(Encoding.BINARY).encode())
            for piece in clouds:
                stream.write(table_of(piece, kinds).tobytes())


def _as_header(kinds: Mapping[str, np.dtype[Any]], n: int) -> MetaData:
    """PCL's intensity is a float, and so is written as one."""
    kinds = {name: np.dtype(np.float32) if name == "intensity" else kind for name, kind in kinds.items()}
    columns = [np.empty(1, dtype=kind) for kind in kinds.values()]
    one = PointCloud.from_points(columns, tuple(kinds), tuple(kind.type for kind in kinds.values())).metadata
    return one.derive(points=n, width=n)


def save_pcd(
    path: Path,
    points: NDArray[np.floating],
    fields: Mapping[str, NDArray[Any]] = NO_FIELDS,
    *,
    encoding: str = "binary",
) -> None:
    """Points (n, 3) and fields (n,) as they are, in their own precision, straight to ``path``.

    PCL's intensity is a float, and so is written as one.
    """
    columns = {axis: np.ascontiguousarray(points[:, i]) for i, axis in enumerate("xyz")} | dict(fields)
    if "intensity" in columns:
        columns["intensity"] = columns["intensity"].astype(np.float32)
    kinds: Any = tuple(column.dtype.type for column in columns.values())
    PointCloud.from_points(list(columns.values()), tuple(columns), kinds).save(path, Encoding(encoding))
