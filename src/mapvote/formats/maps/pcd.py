"""PCD files (ascii, binary, binary_compressed) through pypcd4."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path
from types import MappingProxyType
from typing import Any

import numpy as np
from numpy.typing import NDArray
from pypcd4 import Encoding, PointCloud

from mapvote.core.types import F64, MapvoteError
from mapvote.formats.atomic import whole_file
from mapvote.formats.extras import first_line
from mapvote.formats.maps.cloud import Cloud, kept_fields, other_fields, warn_of_float32, xyz

NO_FIELDS: Mapping[str, NDArray[Any]] = MappingProxyType({})
ENCODINGS = tuple(e.value for e in (Encoding.ASCII, Encoding.BINARY, Encoding.BINARY_COMPRESSED))


def is_pcd(path: Path) -> bool:
    return path.is_file() and path.suffix.lower() == ".pcd"


def read_pcd_table(path: Path) -> tuple[NDArray[np.void], F64]:
    """Every field of a PCD file as a structured array (n,), and its VIEWPOINT (tx ty tz qw qx qy qz).

    MapvoteError if the file is not a PCD, cut off, or says more points than it holds.
    """
    try:
        cloud = PointCloud.from_path(path)
    except OSError as error:
        raise MapvoteError(f"{path}: cannot be read ({error.strerror or error})") from error
    except Exception as error:  # pypcd4 lets through whatever numpy, struct, lzf and pydantic raise
        raise MapvoteError(f"{path}: not a whole PCD file ({first_line(error)}); copy or export it again") from error
    table = np.atleast_1d(cloud.pc_data)
    if len(table) != cloud.metadata.points:
        raise MapvoteError(
            f"{path}: cut off: {len(table)} points, but its header says {cloud.metadata.points}; copy it again"
        )
    return table, np.array(cloud.metadata.viewpoint, dtype=np.float64)


def read_pcd(path: Path) -> Cloud:
    """The points of a PCD file; its VIEWPOINT is not applied (map points are in map metres already)."""
    table, _ = read_pcd_table(path)
    return Cloud(xyz(str(path), table), other_fields(table.dtype.names or ()), fields=kept_fields(table))


def write_pcd(path: Path, cloud: Cloud, *, encoding: str = "binary", double: bool = False) -> None:
    """A cloud as x, y, z, float32, which is all that PCL reads, or float64 if ``double``; and its fields.

    The frame is not written: PCD has no place for it. Whole or not at all.
    """
    if not double:
        warn_of_float32(str(path), cloud.points)
    points: NDArray[np.floating] = cloud.points.astype(np.float64) if double else cloud.points.astype(np.float32)
    with whole_file(path) as partial:
        save_pcd(partial, points, cloud.fields, encoding=encoding)


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
