"""Read a LAS or LAZ file with laspy, piece by piece; as a script, in a process that a damaged file may end.

    python laz_subprocess.py FILE [extra]   # a line of JSON (Head), then pieces: a line with the number of points, the
                                            # columns; "extra": those that the file defines itself (extra bytes) too

lazrs panics on some damaged files, and aborts its process when a chunk table makes it ask for terabytes. So that the
process starts fast, nothing of mapvote is imported here.
"""

from __future__ import annotations

import struct
import sys
from collections.abc import Iterator
from contextlib import suppress
from enum import IntEnum
from typing import Any

import msgspec
import numpy as np
from numpy.typing import NDArray

FIELDS = {
    "intensity": "<u2",
    "classification": "|u1",
    "return_number": "|u1",
    "number_of_returns": "|u1",
    "gps_time": "<f8",
    "red": "<u2",
    "green": "<u2",
    "blue": "<u2",
    "las_flags": "|u1",
}
"""Fields of a point that a map keeps besides x, y, z."""
FLAGS = {"synthetic": 1, "key_point": 2, "withheld": 4, "overlap": 8}
"""Bits of ``las_flags``."""


class LasClass(IntEnum):
    """Classes of points of the ASPRS."""

    UNCLASSIFIED = 1
    GROUND = 2
    LOW_NOISE = 7
    OVERLAP = 12
    """Up to LAS 1.3, and in point formats 0 to 5; later a flag."""
    HIGH_NOISE = 18


class Head(msgspec.Struct):
    """Facts of a file besides its points, or why these cannot be read."""

    promised: int = 0
    """Points that the file's header counts."""
    held: int | None = None
    """Points that the chunks of a LAZ file hold, where they tell."""
    point_format: int = 0
    adjusted_time: bool = False
    """Whether gps_time is adjusted standard GPS time; else it counts from the start of a GPS week."""
    dimensions: tuple[str, ...] = ()
    wkt: str = ""
    geo_keys: dict[int, int] = {}
    """GeoTIFF keys that hold a number."""
    refusal: str = ""
    extra: dict[str, str] = {}
    """Numbers of a point that the file defines itself, by name and type; empty unless they were asked for."""

    @property
    def fields(self) -> dict[str, str]:
        """The columns that follow x, y, z in every piece, with their types."""
        own = {name: kind for name, kind in FIELDS.items() if name in self.dimensions or name == "las_flags"}
        return own | self.extra


Piece = tuple[NDArray[np.float64], dict[str, NDArray[Any]]]
"""Points (n, 3) and the columns (n,) of ``Head.fields``."""


def read_head(file: Any, *, extra: bool = False) -> Head:
    """The head of an opened LAS file; ``extra``: with what it defines of a point itself."""
    vlrs = [*file.header.vlrs, *(file.header.evlrs or ())]
    wkt = [v.string for v in vlrs if type(v).__name__ == "WktCoordinateSystemVlr"]
    keys = {
        int(k.id): int(k.value_offset)
        for v in vlrs
        if type(v).__name__ == "GeoKeyDirectoryVlr"
        for k in v.geo_keys
        if k.tiff_tag_location == 0
    }
    names = tuple(file.header.point_format.dimension_names)
    text = wkt[0].replace("\0", "").strip() if wkt else ""
    adjusted = int(file.header.global_encoding.gps_time_type) == 1
    form = file.header.point_format
    own = {d.name: np.dtype(d.dtype).str for d in form.extra_dimensions if extra and np.dtype(d.dtype).shape == ()}
    return Head(
        promised=file.header.point_count,
        point_format=form.id,
        adjusted_time=adjusted,
        dimensions=names,
        wkt=text,
        geo_keys={} if text else keys,
        extra=own,
    )


def read_pieces(file: Any, head: Head, points_a_piece: int = 1_000_000) -> Iterator[Piece]:
    """The points of an opened LAS file and their fields; whatever laspy and lazrs raise, panics included."""
    stored = [name for name in head.fields if name != "las_flags"]
    for chunk in file.chunk_iterator(points_a_piece):
        points = np.column_stack([np.asarray(chunk.x), np.asarray(chunk.y), np.asarray(chunk.z)])
        fields = {name: np.array(chunk[name], dtype=head.fields[name]) for name in stored}
        flags = np.zeros(len(points), np.uint8)
        for name, bit in FLAGS.items():
            if name in head.dimensions:
                flags |= np.asarray(chunk[name]).astype(np.uint8) * np.uint8(bit)
        if head.point_format < 6:
            overlapping = fields["classification"] == LasClass.OVERLAP
            flags[overlapping] |= FLAGS["overlap"]
            fields["classification"][overlapping] = LasClass.UNCLASSIFIED
        yield points, {**fields, "las_flags": flags}


def points_in_chunks(path: str, start: int) -> int | None:
    """Points that a LAZ file holds; None if its chunks do not tell, or LASzip's record is damaged. Chunks of varying
    size say how many points each holds. If chunks are equal, all but the last are full; in the point formats from 6 on
    the last one counts its own.

    ``start``: where the point data begin. LASzip's VLR: 12 chunk size, 32 number of items, from 34 on type and size of
    each (2 + 2 + 2 bytes).
    """
    import laspy
    import lazrs

    with open(path, "rb") as stream:
        header = laspy.LasHeader.read_from(stream)
        record = next(v for v in header.vlrs if type(v).__name__ == "LasZipVlr").record_data
        stream.seek(start)
        chunks = lazrs.read_chunk_table(stream, lazrs.LazVlr(record))
        size = struct.unpack_from("<I", record, 12)[0]
        if size == 0xFFFFFFFF:
            return sum(points for points, _ in chunks)
        layered = 3  # LASzip's compressor of the point formats from 6 on
        if struct.unpack_from("<H", record, 0)[0] != layered or not chunks:
            return None
        point_bytes = sum(struct.unpack_from("<H", record, 36 + 6 * i)[0] for i in range(record[32]))
        if point_bytes != header.point_format.size:
            return None  # the items are damaged, so the number of points would be wrong
        stream.seek(start + 8 + sum(n for _, n in chunks[:-1]) + point_bytes)
        return (len(chunks) - 1) * int(size) + int(struct.unpack("<I", stream.read(4))[0])


def main() -> None:
    out = sys.stdout.buffer
    try:
        import laspy

        with laspy.open(sys.argv[1]) as file:
            head = read_head(file, extra="extra" in sys.argv[2:])
            with suppress(Exception):  # a file without chunk table, which lazrs reads all the same
                head.held = points_in_chunks(sys.argv[1], file.header.offset_to_point_data)
            out.write(msgspec.json.encode(head) + b"\n")
            for points, fields in read_pieces(file, head):
                out.write(b"%d\n" % len(points))
                out.write(np.ascontiguousarray(points).data)
                for name in head.fields:
                    out.write(fields[name].data)
        out.write(b"0\n")
    except BaseException as error:  # a panic of lazrs is no Exception
        out.write(msgspec.json.encode(Head(refusal=str(error) or type(error).__name__)) + b"\n")


if __name__ == "__main__":
    main()
