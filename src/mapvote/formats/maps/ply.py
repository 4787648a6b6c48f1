"""PLY files: written here (a header and numpy's bytes, piece by piece), read through plyfile (extra ``ply``)."""

from __future__ import annotations

import io
from collections.abc import Iterator
from pathlib import Path
from typing import Any, BinaryIO

import numpy as np
from numpy.typing import NDArray

from mapvote.core.extras import require
from mapvote.core.types import MapvoteError
from mapvote.formats.atomic import whole_file
from mapvote.formats.maps.cloud import READ_SIZES, Cloud, CloudPieces, ReadSizes, cloud_of_table, table_of
from mapvote.formats.reading import FILE_LIMITS, reading

_TYPES = {
    "f8": "double", "f4": "float", "u1": "uchar", "i1": "char", "u2": "ushort", "i2": "short", "u4": "uint", "i4": "int"
}  # fmt: skip


def stream_ply(path: Path, sizes: ReadSizes = READ_SIZES) -> Iterator[Cloud]:
    """The vertices of a PLY file with the fields that a map keeps, piece by piece. MapvoteError as
    :func:`stream_ply_tables`."""
    for table in stream_ply_tables(path, sizes):
        yield cloud_of_table(str(path), table)


def stream_ply_tables(path: Path, sizes: ReadSizes = READ_SIZES) -> Iterator[NDArray[np.void]]:
    """The vertices of a PLY file, ascii or binary, float or double, as structured arrays with every property; faces are
    ignored. Binary vertices without lists stay on disk until their piece is read. MapvoteError if the file is damaged
    or holds no element "vertex"."""
    library = require("plyfile", "ply", str(path))
    with reading(path, "PLY file of vertices"):
        with path.open("rb") as stream:
            is_text = b"ascii" in stream.readline() + stream.readline()
            stream.seek(0)
            source: Any = _full_lines(stream) if is_text else _ascii_header(stream)
            file = library.PlyData.read(source)
            more = source.read() if is_text else source.read().strip(b"\0\r\n ")
        if more and file.elements[-1].name == "vertex":  # faces too many are nothing to a map
            raise MapvoteError(
                f"{path}: data follow the elements that its header counts ({_counts(file)}); correct the numbers of "
                "elements in the header, or export it again"
            )
        if "vertex" not in file:
            raise ValueError("it holds no element vertex")
        vertices = file["vertex"].data
        vertices = vertices[[name for name in vertices.dtype.names if not vertices.dtype[name].hasobject]]  # no lists
        for start in range(0, max(len(vertices), 1), sizes.block):
            part = np.array(vertices[start : start + sizes.block])
            yield part.astype(part.dtype.newbyteorder("="))


def _full_lines(stream: BinaryIO) -> io.StringIO:
    """The lines of a text that hold something, as plyfile wants them."""
    return io.StringIO("".join(line.decode("latin-1").rstrip() + "\n" for line in stream if line.strip()))


def _ascii_header(stream: BinaryIO) -> BinaryIO:
    """The file from its start, with "?" for signs of its header's comments that are not ASCII: plyfile refuses them."""
    header = b""
    for line in stream:
        header += line
        if line.strip() == b"end_header" or len(header) > FILE_LIMITS.ply_header_bytes:
            break
    if header.isascii():
        stream.seek(0)
        return stream
    return io.BytesIO(bytes(byte if byte < 128 else ord("?") for byte in header) + stream.read())


def _counts(file: Any) -> str:
    return ", ".join(f"{element.count} {element.name}" for element in file.elements)


def write_ply(path: Path, cloud: Cloud | CloudPieces) -> None:
    """A cloud as double x, y, z and its fields, binary little-endian: nothing is rounded. Whole or not at all.

    The frame is not written: PLY has no place for it.
    """
    clouds = CloudPieces.of(cloud)
    kinds = [(axis, np.dtype("<f8")) for axis in "xyz"]
    kinds += [
        (name, kind.newbyteorder("<") if kind.str[1:] in _TYPES else np.dtype("<f8"))
        for name, kind in clouds.kinds.items()
    ]
    properties = "".join(f"property {_TYPES[kind.str[1:]]} {name}\n" for name, kind in kinds)
    start = f"ply\nformat binary_little_endian 1.0\ncomment mapvote\nelement vertex {clouds.n}\n"
    with whole_file(path) as partial, partial.open("wb") as stream:
        stream.write(f"{start}{properties}end_header\n".encode("ascii"))
        for piece in clouds:
            stream.write(table_of(piece, kinds).tobytes())
