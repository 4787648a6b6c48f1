"""Read a LAS or LAZ file with laspy; as a script, in a process of its own that a damaged file may end.

    python laz_apart.py FILE        # one line of JSON (Head), then the points as float64, to stdout

lazrs panics on some damaged files, and aborts its process when a chunk table makes it ask for terabytes. So that the
process starts fast, nothing of mapvote is imported here.
"""

from __future__ import annotations

import sys

import msgspec
import numpy as np
from numpy.typing import NDArray

_CHUNK = 1_000_000


class Head(msgspec.Struct):
    """What there is besides points, or why they cannot be read."""

    points: int = 0
    promised: int = 0
    """What the file's header says."""
    dimensions: tuple[str, ...] = ()
    wkt: str = ""
    refusal: str = ""


def read_points(path: str) -> tuple[Head, NDArray[np.float64]]:
    """The points of a file (n, 3) and what is known of them; whatever laspy and lazrs raise, panics included."""
    import laspy

    with laspy.open(path) as file:
        points = np.empty((file.header.point_count, 3))
        done = 0
        for chunk in file.chunk_iterator(_CHUNK):
            points[done : done + len(chunk)] = np.column_stack([chunk.x, chunk.y, chunk.z])
            done += len(chunk)
        wkt = [v.string for v in file.header.vlrs if type(v).__name__ == "WktCoordinateSystemVlr"]
        names = tuple(file.header.point_format.dimension_names)
    return Head(done, len(points), names, wkt[0] if wkt else ""), points[:done]


def main() -> None:
    points = np.empty((0, 3))
    try:
        head, points = read_points(sys.argv[1])
    except BaseException as error:  # a panic of lazrs is no Exception
        head = Head(refusal=str(error) or type(error).__name__)
    sys.stdout.buffer.write(msgspec.json.encode(head) + b"\n")
    sys.stdout.buffer.write(points.data)


if __name__ == "__main__":
    main()
