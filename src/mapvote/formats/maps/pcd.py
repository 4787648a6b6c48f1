"""PCD files (ascii, binary, binary_compressed) through pypcd4."""

from __future__ import annotations

import os
import re
import struct
from collections.abc import Iterator
from itertools import islice
from pathlib import Path
from typing import BinaryIO

import numpy as np
from numpy.typing import NDArray
from pypcd4 import Encoding, MetaData, PointCloud

from mapvote.core.types import F64, MapvoteError
from mapvote.formats.atomic import whole_file
from mapvote.formats.extras import reading
from mapvote.formats.maps.cloud import Cloud, CloudPieces, cloud_of_table, table_of, warn_of_float32

_BLOCK = 500_000
"""Points read at a time."""
_PAGE = 4096
"""Bytes that PCL up to 1.7 reserved for the header: what the header leaves of them follows the points, as zeros."""
_TILE = re.compile(r"-?\d{1,5}_-?\d{1,5}\.pcd")


def is_pcd_tiles(path: Path) -> bool:
    """A folder whose PCD files are all called X_Y.pcd, in whatever tiling; with stamps or poses it is a drive."""
    names = [file.name for file in path.glob("*.pcd")] if path.is_dir() else []
    recorded = any((path / name).exists() for name in ("times.txt", "prior.txt", "drive.toml"))
    return bool(names) and not recorded and all(_TILE.fullmatch(name) for name in names)


def stream_pcd_tiles(path: Path) -> Iterator[Cloud]:
    """The points of all tiles, one file after the other: points are in map metres, names say nothing about places."""
    for file in sorted(path.glob("*.pcd")):
        yield from stream_pcd(file)


def read_pcd_table(path: Path) -> NDArray[np.void]:
    """Every field of a PCD file as a structured array (n,).

    MapvoteError if the file is not a PCD, cut off, or says more points than it holds.
    """
    with reading(path, "PCD file"):
        table = np.atleast_1d(PointCloud.from_path(path).pc_data)
        with path.open("rb") as file:
            about = _header(file)
            _check_count(path, len(table), about, _rest(file, about, skip=True))
    return table


def read_viewpoint(path: Path) -> F64:
    """tx ty tz qw qx qy qz (7,) of the header alone; no point is read."""
    with reading(path, "PCD file"), path.open("rb") as file:
        return np.array(_header(file).viewpoint, dtype=np.float64)


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


def stream_pcd(path: Path) -> Iterator[Cloud]:
    """The points of a PCD file, piece by piece (binary_compressed, one block by its nature, in one); its VIEWPOINT is
    not applied: map points are in map metres already. MapvoteError as :func:`read_pcd_table`."""
    with reading(path, "PCD file"), path.open("rb") as file:
        about = _header(file)
        compressed = about.points and about.data == Encoding.BINARY_COMPRESSED
        tables = iter([read_pcd_table(path)]) if compressed else _blocks(file, about)
        found = 0
        for table in tables:
            found += len(table)
            yield cloud_of_table(str(path), table)
        _check_count(path, found, about, 0 if compressed else _rest(file, about))


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
    columns = [np.empty(1, dtype=kind) for kind in kinds.values()]
    one = PointCloud.from_points(columns, tuple(kinds), tuple(kind.type for kind in kinds.values())).metadata
    with path.open("wb") as stream:
        stream.write(one.derive(points=clouds.n, width=clouds.n).compose_header(Encoding.BINARY).encode())
        for piece in clouds:
            stream.write(table_of(piece, list(kinds.items())).tobytes())
