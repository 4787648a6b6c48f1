"""PLY files: written here (a header and numpy's bytes), read through trimesh (extra ``ply``)."""

from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path
from typing import Any, BinaryIO

import numpy as np

from mapvote.core.types import MapvoteError
from mapvote.formats.atomic import whole_file
from mapvote.formats.extras import require
from mapvote.formats.maps.cloud import Cloud, joined, kept_fields, other_fields, table_of, xyz
from mapvote.formats.maps.cloud_pieces import CloudPieces

_BLOCK = 500_000
"""Vertices read at a time."""
_TYPES = {
    "f8": "double", "f4": "float", "u1": "uchar", "i1": "char", "u2": "ushort", "i2": "short", "u4": "uint", "i4": "int"
}  # fmt: skip


def is_ply(path: Path) -> bool:
    return path.is_file() and path.suffix.lower() == ".ply"


def read_ply(path: Path) -> Cloud:
    """The whole file; see :func:`stream_ply`."""
    return joined(list(stream_ply(path)))


def stream_ply(path: Path) -> Iterator[Cloud]:
    """The vertices of a PLY file, ascii or binary, float or double; faces are ignored. Binary files that begin with
    their vertices come piece by piece, others in one."""
    loader = require("trimesh.exchange.ply", "ply", str(path))
    try:
        with path.open("rb") as stream:
            table = _table_of_vertices(loader, stream)
            if table is None:
                stream.seek(0)
                yield _whole(path, loader, stream)
                return
            n, dtype = table
            while n > 0:
                raw = stream.read(min(n, _BLOCK) * dtype.itemsize)
                if len(raw) < min(n, _BLOCK) * dtype.itemsize:
                    raise ValueError(f"cut off: {n - len(raw) // dtype.itemsize} vertices are missing")
                n -= min(n, _BLOCK)
                part = np.frombuffer(raw, dtype=dtype).astype(dtype.newbyteorder("="))
                yield Cloud(xyz(str(path), part), other_fields(dtype.names or ()), fields=kept_fields(part))
    except MapvoteError:
        raise
    except OSError as error:
        raise MapvoteError(f"{path}: cannot be read ({error.strerror or error})") from error
    except Exception as error:  # trimesh lets through whatever numpy raises
        raise MapvoteError(f"{path}: not a whole PLY file of vertices ({error}); copy or export it again") from error


def _table_of_vertices(loader: Any, stream: BinaryIO) -> tuple[int, np.dtype[Any]] | None:
    """(how many, their type) of a binary file whose vertices come first and are plain numbers; the stream is left where
    they begin. None for any other."""
    elements, is_ascii, _ = loader._parse_header(stream)
    first = next(iter(elements), "")
    kinds = elements[first]["properties"] if first == "vertex" else {}
    if is_ascii or not kinds or not elements[first]["length"] or any("LIST" in kind for kind in kinds.values()):
        return None
    return elements[first]["length"], np.dtype(list(kinds.items()))


def _whole(path: Path, loader: Any, stream: BinaryIO) -> Cloud:
    raw = loader.load_ply(stream)["metadata"]["_ply_raw"]["vertex"]
    columns = {name: np.ravel(raw["data"][name]) for name in raw["properties"]}
    table = np.empty(int(raw["length"]), dtype=[(n, c.dtype.newbyteorder("=")) for n, c in columns.items()])
    for name, column in columns.items():
        table[name] = column
    return Cloud(xyz(str(path), table), other_fields(tuple(columns)), fields=kept_fields(table))


def write_ply(path: Path, cloud: Cloud | CloudPieces) -> None:
    """A cloud as double x, y, z and its fields, binary little-endian: nothing is rounded. Whole or not at all.

    The frame is not written: PLY has no place for it.
    """
    clouds = CloudPieces.of(cloud)
    kinds = [(axis, np.dtype("<f8")) for axis in "xyz"]
    kinds += [(name, kind.newbyteorder("<")) for name, kind in clouds.kinds.items()]
    properties = "".join(f"property {_TYPES[kind.str[1:]]} {name}\n" for name, kind in kinds)
    start = f"ply\nformat binary_little_endian 1.0\ncomment mapvote\nelement vertex {clouds.n}\n"
    with whole_file(path) as partial, partial.open("wb") as stream:
        stream.write(f"{start}{properties}end_header\n".encode("ascii"))
        for piece in clouds:
            stream.write(table_of(piece, kinds).tobytes())
