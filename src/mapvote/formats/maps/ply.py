"""PLY files: written here (a header and numpy's bytes), read through trimesh (extra ``ply``)."""

from __future__ import annotations

from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from mapvote.core.types import MapvoteError
from mapvote.formats.atomic import whole_file
from mapvote.formats.extras import require
from mapvote.formats.maps.cloud import Cloud, other_fields, xyz


def is_ply(path: Path) -> bool:
    return path.is_file() and path.suffix.lower() == ".ply"


def read_ply(path: Path) -> Cloud:
    """The vertices of a PLY file, ascii or binary, float or double; faces are ignored."""
    loader = require("trimesh.exchange.ply", "ply", str(path))
    try:
        with path.open("rb") as stream:
            raw = loader.load_ply(stream)["metadata"]["_ply_raw"]["vertex"]
        columns = {name: np.ravel(raw["data"][name]) for name in raw["properties"]}
    except OSError as error:
        raise MapvoteError(f"{path}: cannot be read ({error.strerror or error})") from error
    except Exception as error:  # trimesh lets through whatever numpy raises
        raise MapvoteError(f"{path}: not a whole PLY file of vertices ({error}); copy or export it again") from error
    table = np.empty(int(raw["length"]), dtype=[(n, c.dtype.newbyteorder("=")) for n, c in columns.items()])
    for name, column in columns.items():
        table[name] = column
    return Cloud(xyz(str(path), table), other_fields(tuple(columns)))


def write_ply(path: Path, points: NDArray[np.floating]) -> None:
    """Points (n, 3) as double x, y, z, binary little-endian: nothing is rounded. Whole or not at all."""
    header = (
        "ply\nformat binary_little_endian 1.0\ncomment mapvote\n"
        f"element vertex {len(points)}\nproperty double x\nproperty double y\nproperty double z\nend_header\n"
    )
    with whole_file(path) as partial, partial.open("wb") as stream:
        stream.write(header.encode("ascii"))
        stream.write(np.ascontiguousarray(points, dtype="<f8").tobytes())
