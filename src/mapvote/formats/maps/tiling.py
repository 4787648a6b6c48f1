"""From the pieces of a cloud to a map. Memory holds one piece, one tile, and the heights of all points.

Points are written to disk twice: first as they come, because the place of the map and the fields of all pieces are
known only at the end; then by tile. The ground needs all heights at once, because it grows from tile to tile. The
temporary files have no name, and vanish with the process, however it ends.
"""

from __future__ import annotations

import hashlib
import logging
import tempfile
import weakref
from collections.abc import Callable, Collection, Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass, field, replace
from itertools import chain
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from mapvote.core.columns import flat_cells
from mapvote.core.grid import Lattice, TileIndex
from mapvote.core.ground import Heights, lay_ground
from mapvote.core.point_map import LazyTiles, PointMap, check_extent, cut_tiles, held_points, lattice_of
from mapvote.core.tile import Tile
from mapvote.core.types import F32, F64, Bool, MapvoteError
from mapvote.formats.drives.point_fields import POINT_RULE
from mapvote.formats.geo.frame import MapFrame
from mapvote.formats.geo.units import settle
from mapvote.formats.maps.cloud import READ_SIZES, Cloud, ReadSizes, joined
from mapvote.formats.maps.field_names import kept_fields
from mapvote.formats.maps.laz_subprocess import LasClass
from mapvote.formats.reading import FILE_LIMITS

Columns = dict[str, NDArray[Any]]


def on_earth(points: NDArray[np.floating]) -> Bool:
    """(n,) which of the points (n, 3) are coordinates at all: finite, and no damaged number such as 1e30."""
    return np.asarray((np.abs(points) < FILE_LIMITS.coordinate_m).all(axis=1))


class Spill:
    """Blocks of columns, written once, read back in any order."""

    def __init__(self, folder: Path | None = None, sizes: ReadSizes = READ_SIZES) -> None:
        """``folder``: where there is room; else the system's place for temporary files."""
        self._folder = folder
        place = str(folder) if folder else None
        self._file = tempfile.SpooledTemporaryFile(max_size=sizes.in_memory_bytes, dir=place)  # noqa: SIM115
        self.close = weakref.finalize(self, self._file.close)
        """Let go of the file."""
        self._blocks: list[tuple[int, dict[str, tuple[np.dtype[Any], tuple[int, ...]]]]] = []
        self._end = 0

    def __len__(self) -> int:
        """How many blocks there are."""
        return len(self._blocks)

    def add(self, columns: Mapping[str, NDArray[Any]]) -> int:
        """Write a block; returns its number. MapvoteError if the disk is full."""
        self._blocks.append((self._end, {name: (c.dtype, c.shape) for name, c in columns.items()}))
        try:
            self._file.seek(self._end)
            for column in columns.values():
                self._end += self._file.write(np.ascontiguousarray(column).reshape(-1).view(np.uint8).data)
        except OSError as error:
            folder = self._folder or tempfile.gettempdir()
            raise MapvoteError(f"{folder}: temporary files cannot be written ({error.strerror or error})") from error
        return len(self._blocks) - 1

    def read(self, number: int) -> Columns:
        """The columns of a block."""
        start, kinds = self._blocks[number]
        self._file.seek(start)
        out = {}
        for name, (dtype, shape) in kinds.items():
            out[name] = np.empty(shape, dtype=dtype)
            self._file.readinto(out[name].reshape(-1).view(np.uint8).data)
        return out

    def joined(self, numbers: Sequence[int]) -> Columns:
        """The columns of several blocks of the same kinds, one after another."""
        parts = [self.read(number) for number in numbers]
        return {name: np.concatenate([part[name] for part in parts]) for name in parts[0]}


log = logging.getLogger("mapvote.formats")

_XYZ = "xyz"
GPS_TIMES = "gps_times"
"""Key of a map's georeference: times of its points, as ``Cloud.gps_times``."""

Pieces = Callable[[], Iterator[NDArray[np.floating]]]
"""Points (n, 3) of a map, metres, from the start, piece by piece: as often as it is called."""
Look = Callable[[Pieces, Pieces], None]
"""Given all points of a map, and those that the file classifies as ground; raises MapvoteError to stop."""
UNCHECKED = "unchecked"
"""Key of a map's georeference if its points were taken although a check refused them."""


def in_map_metres(
    source: str, pieces: Iterator[Cloud], wanted: MapFrame | None = None, *, sure: bool = False
) -> Iterator[Cloud]:
    """Pieces of one file in map metres, in the frame ``wanted`` where one is; see ``geo.units.settle``."""
    first: list[Cloud] = []
    for piece in pieces:
        first.append(piece)
        if sum(len(p.points) for p in first) >= READ_SIZES.piece:
            break
    if not first:
        return
    frame, convert = settle(source, first[0].frame, wanted, joined(first).points[: READ_SIZES.piece], sure=sure)
    for piece in chain(first, pieces):
        yield replace(piece, points=convert(piece.points), frame=frame)


def grounded(columns: Mapping[str, NDArray[Any]], points: NDArray[np.floating]) -> NDArray[np.floating]:
    """Those of a block's ``points`` (n, 3) that its file classifies as ground; none if it has no classes."""
    classes = columns.get("classification")
    return points[:0] if classes is None else points[classes == LasClass.GROUND]


def map_of(
    source: str,
    pieces: Iterable[Cloud],
    folder: Path | None = None,
    look: Look | None = None,
    most_bad: float = POINT_RULE.most_bad_share,
    sizes: ReadSizes = READ_SIZES,
) -> PointMap:
    """The map of a cloud in pieces: tiles cut, ground computed, map_id from the content. Broken points are dropped and
    counted. Points that the file classifies as ground are ground.

    ``folder``: where temporary files may lie. A map larger than memory reads its tiles from them. ``look`` gets the
    points before tiles are cut and the ground is computed. MapvoteError if the cloud is empty or more than ``most_bad``
    of it is not finite.
    """
    taken = _Taken(source, Spill(folder, sizes), most_bad)
    for piece in pieces:
        taken.take(piece)
    lattice = taken.lattice()
    if look is not None:
        look(
            lambda: (block[_XYZ] for block in taken.blocks()),
            lambda: (grounded(block, block[_XYZ]) for block in taken.blocks()),
        )
    parts = _Parts(lattice, Spill(folder, sizes))
    digest = hashlib.sha256(np.array([lattice.x0, lattice.y0]).tobytes())
    done = 0
    for block in taken.blocks():
        points: F64 = np.ascontiguousarray(block[_XYZ], dtype=np.float64)
        check_extent(points, done)
        done += len(points)
        digest.update(points.tobytes())
        parts.cut(block)
    taken.spill.close()
    ground = lay_ground(parts.heights(), parts.heights(of_ground=True), parts.points)
    tiles: Mapping[TileIndex, Tile] = LazyTiles(lambda i: parts.tile(i, ground[i]), parts.points, sizes.kept_points)
    if sum(map(held_points, parts.points.values())) <= sizes.kept_points:
        tiles = {index: parts.tile(index, ground[index]) for index in parts.points}
    return PointMap(digest.hexdigest()[:16], lattice, tiles, taken.georeference())


@dataclass
class _Taken:
    """The points of a file in its order, on disk, and facts that need the whole file."""

    where: str
    spill: Spill
    most_bad: float = POINT_RULE.most_bad_share
    frame: MapFrame = field(default_factory=MapFrame)
    total: int = 0
    bad: int = 0
    flagged: bool = False
    gps_times: str = ""
    _low: F64 = field(default_factory=lambda: np.full(3, np.inf))
    _high: F64 = field(default_factory=lambda: np.full(3, -np.inf))
    _kinds: list[dict[str, np.dtype[Any]]] = field(default_factory=list)

    def take(self, cloud: Cloud) -> None:
        points = cloud.points
        self.frame = cloud.frame
        self.gps_times = self.gps_times or cloud.gps_times
        self.flagged = self.flagged or bool(cloud.fields.get("las_flags", np.zeros(1)).any())
        self._kinds.append({name: column.dtype for name, column in {**cloud.fields, _XYZ: points}.items()})
        good = on_earth(points)
        self.total += len(points)
        self.bad += len(points) - int(good.sum())
        columns = {_XYZ: points, **cloud.fields}
        if not good.all():
            columns = {name: column[good] for name, column in columns.items()}
        if not good.any():
            return
        self._low = np.minimum(self._low, columns[_XYZ].min(axis=0))
        self._high = np.maximum(self._high, columns[_XYZ].max(axis=0))
        for start in range(0, len(columns[_XYZ]), READ_SIZES.piece):
            self.spill.add({name: column[start : start + READ_SIZES.piece] for name, column in columns.items()})

    def georeference(self) -> dict[str, str]:
        """The georeference of the map: its coordinates and times."""
        times = {GPS_TIMES: self.gps_times} if self.gps_times else {}
        return self.frame.georeference() | times

    def lattice(self) -> Lattice:
        """Lattice of the map. MapvoteError if the points that were taken make no map."""
        if not self.total:
            raise MapvoteError(f"{self.where}: holds no points; a map needs at least one")
        if self.bad == self.total or self.bad > self.most_bad * self.total:
            raise MapvoteError(
                f"{self.where}: {self.bad} of {self.total} points are not finite or no coordinates, more than "
                f"{self.most_bad:.0%}; "
                f"export the file again, or leave them out: mapvote import '{self.where}' MAP --unchecked"
            )
        if self.bad:
            log.warning("%s: dropped %d of %d points that are not finite", self.where, self.bad, self.total)
        return lattice_of(np.array([self._low, self._high]))

    def blocks(self) -> Iterator[Columns]:
        """Blocks of points in their order, with the fields that all pieces have, each in one type. Flags only if one is
        set."""
        names = [name for name in (_XYZ, *kept_fields()) if all(name in kinds for kinds in self._kinds)]
        if not self.flagged and "las_flags" in names:
            names.remove("las_flags")
        types = {name: np.result_type(*(kinds[name] for kinds in self._kinds)) for name in names}
        for number in range(len(self.spill)):
            block = self.spill.read(number)
            yield {name: block[name].astype(types[name], copy=False) for name in names}


class _Parts:
    """Points by tile, on disk: of every tile the blocks that hold some of it, in the order in which they came."""

    def __init__(self, lattice: Lattice, spill: Spill) -> None:
        self.points: dict[TileIndex, int] = {}
        """How many each tile holds."""
        self._lattice = lattice
        self._spill = spill
        self._blocks: dict[TileIndex, list[int]] = {}
        self._grounded: set[TileIndex] = set()

    def cut(self, block: Columns) -> None:
        """Take in a block of points in map metres and their fields."""
        for index, chosen in cut_tiles(block[_XYZ], self._lattice):
            part = {name: column[chosen] for name, column in block.items()}
            part[_XYZ] = self._lattice.tile(index).from_map(part[_XYZ])
            if (part.get("classification", np.empty(0)) == LasClass.GROUND).any():
                self._grounded.add(index)
            self._blocks.setdefault(index, []).append(self._spill.add(part))
            self.points[index] = self.points.get(index, 0) + len(chosen)

    def read(self, index: TileIndex) -> Columns:
        """The points of a tile, from its corner, and their fields."""
        return self._spill.joined(self._blocks[index])

    def tile(self, index: TileIndex, ground_z: F32) -> Tile:
        columns = self.read(index)
        points = columns.pop(_XYZ)
        return Tile(self._lattice.tile(index), points, ground_z, fields=columns)

    def heights(self, *, of_ground: bool = False) -> Mapping[TileIndex, Heights]:
        """Heights of all points, or of those that the file classifies as ground, if it does."""

        def ask(index: TileIndex) -> Heights:
            columns = self.read(index)
            points = columns[_XYZ][columns["classification"] == LasClass.GROUND] if of_ground else columns[_XYZ]
            return flat_cells(self._lattice.tile(index), points), points[:, 2]

        return _Asked(self._grounded if of_ground else self.points, ask)


class _Asked(Mapping[TileIndex, Heights]):
    """A mapping that computes a value at every access."""

    def __init__(self, keys: Collection[TileIndex], ask: Callable[[TileIndex], Heights]) -> None:
        self._keys = keys
        self._ask = ask

    def __getitem__(self, index: TileIndex) -> Heights:
        return self._ask(index)

    def __contains__(self, index: object) -> bool:
        return index in self._keys

    def __iter__(self) -> Iterator[TileIndex]:
        return iter(self._keys)

    def __len__(self) -> int:
        return len(self._keys)
