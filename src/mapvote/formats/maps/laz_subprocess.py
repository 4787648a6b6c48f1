"""Read a LAS or LAZ file with laspy, piece by piece; as a script, in a process that a damaged file may end.

    python laz_subprocess.py FILE   # a line of JSON (Head), then pieces: a line with the number of points, the columns

lazrs panics on some damaged files, and aborts its process when a chunk table makes it ask for terabytes. So that the
process starts fast, nothing of mapvote is imported here.
"""

from __future__ import annotations

import sys
from collections.abc import Iterator
from typing import Any

import msgspec
import numpy as np
from numpy.typing import NDArray

CHUNK = 1_000_000
FIELDS = {
    "intensity": "<u2",
    "classification": "|u1",
    "return_number": "|u1",
    "number_of_returns": "|u1",
    "gps_time": "<f8",
    "red": "<u2",
    "green": "<u2",
    "blue": "<u2",
}
"""What a map keeps of a point besides x, y, z."""


class Head(msgspec.Struct):
    """What there is besides points, or why they cannot be read."""

    promised: int = 0
    """The content of the file's header."""
    dimensions: tuple[str, ...] = ()
    wkt: str = ""
    geo_keys: dict[int, int] = {}
    """GeoTIFF keys that hold a number."""
    refusal: str = ""

    @property
    def fields(self) -> list[str]:
        """The columns that follow x, y, z in every piece."""
        return [name for name in FIELDS if name in self.dimensions]


Piece = tuple[NDArray[np.float64], dict[str, NDArray[Any]]]
"""Points (n, 3) and the columns (n,) of ``Head.fields``."""


def read_head(file: Any) -> Head:
    """The head of an opened LAS file."""
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
    return Head(file.header.point_count, names, text, {} if text else keys)


def read_pieces(file: Any, head: Head) -> Iterator[Piece]:
    """The points of an opened LAS file and their fields; whatever laspy and lazrs raise, panics included."""
    for chunk in file.chunk_iterator(CHUNK):
        points = np.column_stack([np.asarray(chunk.x), np.asarray(chunk.y), np.asarray(chunk.z)])
        yield points, {name: np.ascontiguousarray(chunk[name], dtype=FIELDS[name]) for name in head.fields}


def main() -> None:
    out = sys.stdout.buffer
    try:
        import laspy

        with laspy.open(sys.argv[1]) as file:
            head = read_head(file)
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
