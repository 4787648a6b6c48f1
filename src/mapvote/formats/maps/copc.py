"""COPC: a LAZ file whose points lie in an octree, so that a viewer reads a place, and as much detail, as it shows.

copc.io, version 1.0: LAZ 1.4 of point format 6 or 7, one chunk of LAZ for each node, the place of each chunk in a
hierarchy. A node of level L is a cube of 2^-L of the side of the root. Its points are one for each of its 128^3 voxels
that a coarser node has not; a node with few points left takes all of them.

Memory is bounded: points go to a temporary file by the cube of some 100 m that holds them, and cubes are written one
by one. Cubes and voxels are counted in the steps of the coordinates, which are integers: no point is on a border.
"""

from __future__ import annotations

import struct
import tempfile
from collections import defaultdict
from collections.abc import Iterator
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, BinaryIO

import numpy as np
from numpy.typing import NDArray

from mapvote.core.extras import require
from mapvote.core.record import record
from mapvote.core.types import I64, MapvoteError
from mapvote.formats.atomic import whole_file
from mapvote.formats.maps.cloud import Cloud, CloudPieces
from mapvote.formats.maps.las import las_header, las_record

Node = tuple[int, int, int, int]
"""(level, x, y, z) of a cube of the octree."""


@record()
@dataclass(frozen=True, slots=True)
class Octree:
    """Numbers of the octree."""

    voxel_levels: int = 7
    """Levels of the octree below a node at which its voxels lie: 2^7 = 128 voxels on a side."""
    few_points: int = 8192
    """Points up to which a node takes all that are left in its cube."""
    cube_m: float = 100.0
    """Side of a cube that is sorted in memory, at most twice this, metres."""


OCTREE = Octree()


@dataclass(slots=True)
class _Spill:
    """Point records by cube, in a file without a name."""

    file: BinaryIO
    parts: defaultdict[Node, list[tuple[int, int]]] = field(default_factory=lambda: defaultdict(list))
    """(place in the file, bytes) of the parts of each cube."""

    def put(self, node: Node, points: NDArray[np.void]) -> None:
        self.parts[node].append((self.file.seek(0, 2), points.nbytes))
        self.file.write(points.tobytes())

    def take(self, node: Node, dtype: np.dtype[np.void]) -> NDArray[np.void]:
        content = []
        for place, size in self.parts[node]:
            self.file.seek(place)
            content.append(self.file.read(size))
        return np.frombuffer(b"".join(content), dtype)


@dataclass(frozen=True, slots=True)
class _Root:
    """The cube of the whole cloud, in steps of the coordinates."""

    corner: I64
    """(3,) its low corner."""
    bits: int
    """Its side is 2^bits steps."""
    cube_level: int
    """Level of the cubes that are sorted in memory."""

    def places(self, points: NDArray[np.void]) -> I64:
        """(n, 3) steps from the corner."""
        return np.column_stack([points[axis].astype(np.int64) for axis in "XYZ"]) - self.corner


def write_copc(path: Path, cloud: Cloud | CloudPieces) -> None:
    """A cloud as COPC, with all that :func:`write_las` keeps. Whole or not at all.

    MapvoteError if its coordinates are degrees: the cubes of COPC have one unit along x, y and z.
    """
    laspy = require("laspy", "las", str(path))
    lazrs = require("lazrs", "las", str(path))
    clouds = CloudPieces.of(cloud)
    header, shift = las_header(laspy, path, clouds)
    if np.ptp(header.scales) > 0:
        if header.scales[0] < header.scales[2]:
            raise MapvoteError(f"{path}: COPC has cubes, and x, y are degrees; name a projection: --crs EPSG:326..")
        header.scales = np.full(3, header.scales.max())
    root = _root_of(header, clouds.corners + shift)
    with tempfile.TemporaryFile(dir=path.absolute().parent) as spilled, whole_file(path) as partial:
        cubes = _Spill(spilled)
        for piece in clouds:
            _put_by_cube(cubes, root, las_record(laspy, header, piece, clouds.brightness, shift).array)
        with partial.open("w+b") as stream:
            _write(laspy, lazrs, header, root, cubes, stream)


def _root_of(header: Any, corners: NDArray[np.float64], numbers: Octree = OCTREE) -> _Root:
    low, high = np.floor((corners - header.offsets) / header.scales + [[-1.0], [1.0]]).astype(np.int64)
    bits = max(int((high - low).max()).bit_length(), numbers.voxel_levels + 1)
    side_m = float(header.scales[0]) * 2.0**bits
    # A cube of memory holds whole voxels of every coarser node: at most voxel_levels below the root.
    level = int(np.clip(np.floor(np.log2(side_m / numbers.cube_m)), 0, numbers.voxel_levels))
    return _Root(low, bits, level)


def _put_by_cube(cubes: _Spill, root: _Root, points: NDArray[np.void]) -> None:
    where = root.places(points) >> (root.bits - root.cube_level)
    for node, chosen in _by_node(root.cube_level, where):
        cubes.put(node, points[chosen])


def _by_node(level: int, where: I64) -> Iterator[tuple[Node, I64]]:
    """(node, indices of its points, ascending) for the cubes (n, 3) of points at one level, in ascending order."""
    keys = _packed(where)
    order = np.argsort(keys, kind="stable")
    ordered = keys[order]
    starts = np.flatnonzero(np.r_[len(keys) > 0, ordered[1:] != ordered[:-1]])
    for start, end in zip(starts, [*starts[1:], len(ordered)], strict=True):
        x, y, z = where[order[start]].tolist()
        yield (level, x, y, z), order[start:end]


def _packed(where: I64) -> I64:
    """(n,) one number for each cube (n, 3): the difference to the least one, in bits as few as it needs.

    These are 51 at most: coordinates have 31 bits, and the finest nodes lie 2^17 on a side of a cube of memory.
    """
    if len(where) == 0:
        return np.zeros(0, np.int64)
    offset = where - where.min(axis=0)
    bits = [int(v).bit_length() for v in offset.max(axis=0).tolist()]
    packed: I64 = (offset[:, 0] << (bits[1] + bits[2])) | (offset[:, 1] << bits[2]) | offset[:, 2]
    return packed


def _leveled(root: _Root, places: I64, numbers: Octree = OCTREE) -> Iterator[tuple[Node, I64]]:
    """(node, indices) for all points (n, 3) of one cube of memory, from the coarsest level to the finest."""
    left = np.arange(len(places))
    for level in range(root.bits + 1):
        remaining: list[I64] = []
        for node, of_node in _by_node(level, places[left] >> (root.bits - level)):
            members = left[of_node]
            shift = root.bits - level - numbers.voxel_levels
            if (level >= root.cube_level and len(members) <= numbers.few_points) or shift <= 0:
                yield node, members
                continue
            _, first = np.unique(_packed(places[members] >> shift), return_index=True)
            yield node, members[np.sort(first)]
            remaining.append(np.delete(members, first))
        left = np.sort(np.concatenate(remaining)) if remaining else left[:0]
        if len(left) == 0:
            return


_INFO_BYTES, _ENTRY = 160, struct.Struct("<iiiiQii")
"""Size of the VLR copc_info; an entry of the hierarchy: level, x, y, z, place, bytes, points (-1: of a page)."""


@dataclass(slots=True)
class _Chunks:
    """The nodes that were written: their points and, after the end, their places."""

    nodes: list[Node] = field(default_factory=list)
    points: list[int] = field(default_factory=list)
    times: list[float] = field(default_factory=lambda: [np.inf, -np.inf])
    """The least and the greatest GPS time."""


def _write(laspy: Any, lazrs: Any, header: Any, root: _Root, cubes: _Spill, stream: BinaryIO) -> None:
    """The file: header, chunks, hierarchy; the header once more, when counts and places are known."""
    laz = lazrs.LazVlr.new_for_compression(header.point_format.id, header.point_format.num_extra_bytes, True)
    info = laspy.VLR("copc", 1, "copc info", bytes(_INFO_BYTES))
    header.vlrs.insert(0, info)  # must be the first one
    header.vlrs.append(laspy.VLR("laszip encoded", 22204, "http://laszip.org", bytes(laz.record_data())))
    header.are_points_compressed = True
    header.global_encoding.wkt = True  # which LAS 1.4 wants of these point formats, with or without a WKT
    header.partial_reset()
    header.write_to(stream)
    chunks = _compressed(laspy, lazrs, header, root, cubes, laz, stream)
    stream.seek(header.offset_to_point_data)
    sizes = [size for _, size in lazrs.read_chunk_table(stream, laz)]
    starts = header.offset_to_point_data + 8 + np.cumsum([0, *sizes[:-1]])
    entries = {
        node: _ENTRY.pack(*node, int(start), size, count)
        for node, start, size, count in zip(chunks.nodes, starts, sizes, chunks.points, strict=True)
    }
    hierarchy, root_place, root_size = _pages(root, entries, stream.seek(0, 2) + 60)
    header.start_of_first_evlr = stream.tell()
    header.number_of_evlrs = 1
    stream.write(struct.pack("<H16sHQ32s", 0, b"copc", 1000, len(hierarchy), b"copc hierarchy") + hierarchy)
    half = 2.0 ** (root.bits - 1) * float(header.scales[0])
    center = (root.corner * header.scales + header.offsets + half).tolist()
    times = chunks.times if chunks.times[0] <= chunks.times[1] else [0.0, 0.0]
    spacing = 2.0 * half / 2**OCTREE.voxel_levels
    info.record_data = struct.pack("<5d2Q2d88x", *center, half, spacing, root_place, root_size, *times)
    stream.seek(0)
    header.write_to(stream, ensure_same_size=True)


def _compressed(laspy: Any, lazrs: Any, header: Any, root: _Root, cubes: _Spill, laz: Any, stream: BinaryIO) -> _Chunks:
    """One chunk for each node. Nodes coarser than the cubes of memory gather in a second file, and come last."""
    dtype = header.point_format.dtype()
    compressor = lazrs.LasZipCompressor(stream, laz)
    chunks = _Chunks()

    def add(node: Node, points: NDArray[np.void]) -> None:
        if chunks.nodes:  # the end finishes the last one
            compressor.finish_current_chunk()
        compressor.compress_many(np.ascontiguousarray(points).view(np.uint8).reshape(-1))
        chunks.nodes.append(node)
        chunks.points.append(len(points))
        header.grow(laspy.PackedPointRecord(points, header.point_format))
        times = points["gps_time"]
        chunks.times = [min(chunks.times[0], float(times.min())), max(chunks.times[1], float(times.max()))]

    with tempfile.TemporaryFile() as file:
        coarse = _Spill(file)
        for cube in sorted(cubes.parts):
            points = cubes.take(cube, dtype)
            for node, members in _leveled(root, root.places(points)):
                if node[0] < root.cube_level:
                    coarse.put(node, points[members])
                else:
                    add(node, points[members])
        for node in sorted(coarse.parts):
            add(node, coarse.take(node, dtype))
    compressor.done()
    return chunks


def _pages(root: _Root, entries: dict[Node, bytes], place: int) -> tuple[bytes, int, int]:
    """(the pages of the hierarchy, which begin at ``place`` of the file; place and size of the root's page).

    A page for each cube of memory, which holds what lies below it, and the root's with the coarser nodes.
    """
    below: defaultdict[Node, list[bytes]] = defaultdict(list)
    top: list[bytes] = []
    for (level, *xyz), entry in sorted(entries.items()):
        if level < root.cube_level or root.cube_level == 0:
            top.append(entry)
        else:
            x, y, z = (v >> (level - root.cube_level) for v in xyz)
            below[root.cube_level, x, y, z].append(entry)
    pages: list[bytes] = []
    for cube, members in below.items():
        top.append(_ENTRY.pack(*cube, place, _ENTRY.size * len(members), -1))
        pages.append(b"".join(members))
        place += len(pages[-1])
    pages.append(b"".join(top))
    return b"".join(pages), place, len(pages[-1])
