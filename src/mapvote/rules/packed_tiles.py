"""Counters of voxels by tile: open around the vehicle, packed where it has left. A long road needs little memory.

A counter has COUNT_PLANES bit planes: plane k of a cell is a 64-bit word with bit k of the counts of the cell's 64
voxels, so that one scan is added to a whole column with a few word operations.

Packed tiles lie on a shelf to the end of the drive, and are read once or twice: up to ``memory_bytes`` in memory, more
in an unnamed file.
"""

from __future__ import annotations

import tempfile
import weakref
from collections import defaultdict
from collections.abc import Iterator, Mapping
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np

from mapvote.codec.planes import compress, unpack_bytes
from mapvote.core.grid import CELLS, TILE_CELLS, Grid, Lattice, TileIndex
from mapvote.core.kernel import kernel
from mapvote.core.process_memory import give_back_free_pages, zero_pages
from mapvote.core.record import record
from mapvote.core.types import I32, I64, U64, Bool, MapvoteError

COUNT_PLANES = 7
"""Bit planes of a counter: counts up to 127 scans."""


@record()
@dataclass(frozen=True, slots=True)
class TilePacking:
    """Numbers of the packing of tiles that the vehicle has left."""

    memory_bytes: int = 8 << 20
    """Bytes held before a file is opened: a drive of a kilometre writes nothing to disk."""
    zstd_level: int = 1
    """Level of compression: tiles are packed while driving, and read once or twice."""
    far_cells: int = 64
    """Cells between a tile and the view at which the tile is packed: a vehicle that turns round comes back to it."""
    bands: int = 16
    """Bands of rows of a tile, one of which is packed for each scan: a tile at once would take as long as several
    scans."""
    tiles_between_trims: int = 3
    """Tiles that are left between two calls of :func:`give_back_free_pages`, some 200 m: the scans after a call ask for
    3,000 pages again, 10 ms in all."""


TILE_PACKING = TilePacking()


class Slot(NamedTuple):
    """The place of an item on a shelf, in bytes."""

    start: int
    length: int


class Shelf:
    """Bytes are appended, never moved and never removed."""

    def __init__(self, packing: TilePacking = TILE_PACKING) -> None:
        self._file = tempfile.SpooledTemporaryFile(packing.memory_bytes, prefix="mapvote_drive_")  # noqa: SIM115
        weakref.finalize(self, self._file.close)

    def put(self, data: bytes) -> Slot:
        """Store a copy of ``data`` and return its place. MapvoteError if memory is full and no file can be written."""
        try:
            start = self._file.seek(0, 2)
            self._file.write(data)
            self._file.flush()
        except OSError as error:
            raise MapvoteError(
                f"{tempfile.gettempdir()}: the evidence of a long drive, 20 MB a kilometre, could not be written there "
                f"({error.strerror}): make room, or name another folder in TMPDIR"
            ) from error
        return Slot(start, len(data))

    def read(self, place: Slot) -> bytes:
        """The bytes at a place."""
        self._file.seek(place.start)
        return self._file.read(place.length)


class Overlap(NamedTuple):
    """The common part of a window and a tile: rows and columns of the window, from and to, and their offset down and to
    the right in the tile. A kernel takes this and the whole tile: a part of its planes would be another type of array,
    to be compiled for."""

    row: int
    end_row: int
    col: int
    end_col: int
    down: int
    right: int


class OpenTile(NamedTuple):
    """A tile that counts."""

    planes: U64
    """(256, 256, words)."""
    spans: I32
    """(256, 2) of each row the first cell in which anything was counted, and the one behind the last: beside them no
    page was ever asked for, and reading one takes as long as writing it."""


class PackedTiles(Mapping[TileIndex, U64]):
    """Planes (256, 256, words) uint64 by tile. Reading one that is packed gives a copy; :meth:`near` opens it, and
    :meth:`within` unpacks a part."""

    def __init__(self, lattice: Lattice, words: int, packing: TilePacking = TILE_PACKING) -> None:
        self.lattice = lattice
        self.words = words
        self.packing = packing
        self._open: dict[TileIndex, OpenTile] = {}
        self._shelf = Shelf(packing)
        self._leaving = defaultdict[TileIndex, list[Slot]](list)
        """Open tiles that lie far away, and those of their bands that are packed already."""
        self._packed = dict[TileIndex, list[Slot]]()
        self._left = 0
        """How often a tile was left."""

    def __getitem__(self, tile: TileIndex) -> U64:
        opened = self._open[tile] if tile in self._open else self._unpacked(self._packed[tile])
        return opened.planes

    def within(self, tile: TileIndex, part: Overlap) -> U64:
        """The planes of a tile, right in its ``part``: of a packed one nothing else is unpacked."""
        if tile in self._open:
            return self._open[tile].planes
        planes = self._new().planes
        tile_rows = slice(part.row + part.down, part.end_row + part.down)
        tile_cols = slice(part.col + part.right, part.end_col + part.right)
        for rows, cols, words in self._cells(self._packed[tile], tile_rows):
            inside = np.flatnonzero(_lie_in(rows, tile_rows) & _lie_in(cols, tile_cols))
            planes[rows.take(inside), cols.take(inside)] = words.take(inside, axis=1).T
        return planes

    def __iter__(self) -> Iterator[TileIndex]:
        yield from self._open
        yield from self._packed

    def __len__(self) -> int:
        return len(self._open) + len(self._packed)

    def __contains__(self, tile: object) -> bool:
        return tile in self._open or tile in self._packed

    def near(self, tile: TileIndex) -> OpenTile:
        """A tile, to be changed in place; zeros if nothing was counted there."""
        self._leaving.pop(tile, None)
        if tile not in self._open:
            packed = self._packed.pop(tile, None)
            self._open[tile] = self._new() if packed is None else self._unpacked(packed)
        return self._open[tile]

    def overlap(self, tile: TileIndex, view: Grid) -> Overlap:
        """The overlap of ``view`` and a tile."""
        down = view.row0 - tile[0] * TILE_CELLS
        right = view.col0 - tile[1] * TILE_CELLS
        row, col = max(-down, 0), max(-right, 0)
        end_row, end_col = min(TILE_CELLS - down, view.rows), min(TILE_CELLS - right, view.cols)
        return Overlap(row, max(row, end_row), col, max(col, end_col), down, right)

    def leave(self, view: Grid) -> None:
        """Pack a band of each tile that lies far from ``view``: for every scan, so that none has it all."""
        around = view.padded(self.packing.far_cells)
        for tile, opened in list(self._open.items()):
            part = self.overlap(tile, around)
            if part.row == part.end_row or part.col == part.end_col:
                bands = self._leaving[tile]
                rows = TILE_CELLS // self.packing.bands
                band = slice(len(bands) * rows, (len(bands) + 1) * rows)
                packed = _packed(opened.planes[band], opened.spans[band], self.packing.zstd_level)
                bands.append(self._shelf.put(packed))
                if len(bands) == self.packing.bands:
                    self._packed[tile] = self._leaving.pop(tile)
                    del self._open[tile]
                    self._left += 1
                    if self._left % self.packing.tiles_between_trims == 0:
                        give_back_free_pages()

    def _new(self) -> OpenTile:
        """Zeros in pages of their own: all go back once the tile is left, no holes stay in the heap."""
        planes = np.frombuffer(zero_pages(8 * CELLS * self.words), np.uint64)
        spans = np.zeros((TILE_CELLS, 2), np.int32)
        spans[:, 0] = TILE_CELLS
        return OpenTile(planes.reshape(TILE_CELLS, TILE_CELLS, self.words), spans)

    def _unpacked(self, bands: list[Slot]) -> OpenTile:
        """The tile of these bands."""
        planes, spans = opened = self._new()
        for rows, cols, words in self._cells(bands, slice(0, TILE_CELLS)):
            planes[rows, cols] = words.T
            np.minimum.at(spans[:, 0], rows, cols)
            np.maximum.at(spans[:, 1], rows, cols + 1)
        return opened

    def _cells(self, bands: list[Slot], wanted: slice) -> Iterator[tuple[I64, I64, U64]]:
        """(rows (n,), columns (n,), words (words, n)) of the cells of each band that has any of the ``wanted`` rows."""
        height = TILE_CELLS // self.packing.bands
        for k, place in enumerate(bands):
            if k * height < wanted.stop and (k + 1) * height > wanted.start:
                data = unpack_bytes(self._shelf.read(place), height * TILE_CELLS * 8 * (self.words + 1), "evidence")
                numbers, *words = np.frombuffer(data, dtype=np.uint64).reshape(self.words + 1, -1)
                rows, cols = np.divmod(numbers.astype(np.int64) + k * height * TILE_CELLS, TILE_CELLS)
                yield rows, cols, np.array(words)


def _lie_in(places: I64, part: slice) -> Bool:
    return (places >= part.start) & (places < part.stop)


def _packed(planes: U64, spans: I32, zstd_level: int) -> bytes:
    """The flat numbers of the cells of a band (rows, 256, words), with its ``spans``, in which anything was counted,
    and their words plane by plane: most of the higher ones are empty."""
    cols = np.arange(TILE_CELLS)
    near = np.flatnonzero((cols >= spans[:, :1]) & (cols < spans[:, 1:]))
    words = planes.reshape(-1, planes.shape[2]).take(near, axis=0)
    counted = np.flatnonzero(np.bitwise_or.reduce(words, axis=1))
    out = np.empty((1 + words.shape[1], len(counted)), np.uint64)
    out[0] = near.take(counted)
    out[1:] = words.take(counted, axis=0).T
    return compress(out.data, zstd_level)


@kernel
def add_four(cell: U64, first: int, a: np.uint64, b: np.uint64, c: np.uint64, d: np.uint64) -> np.uint64:
    """Add to a counter of a cell (words,), whose first plane is ``first``, 1 for each of four words that has the
    voxel: bits are summed to numbers of three bits, these are added by full adders. Returns the voxels whose count
    exceeds its planes; the others, and these modulo 2 ** COUNT_PLANES, are right."""
    odd = a ^ b ^ c
    pair = a & b | c & (a ^ b)
    ones = odd ^ d
    carry = odd & d
    twos = pair ^ carry
    fours = pair & carry
    plane = cell[first]
    cell[first] = plane ^ ones
    carry = plane & ones
    plane = cell[first + 1]
    either = twos ^ carry
    cell[first + 1] = plane ^ either
    carry = twos & carry | plane & either
    plane = cell[first + 2]
    either = fours ^ carry
    cell[first + 2] = plane ^ either
    carry = fours & carry | plane & either
    for k in range(first + 3, first + COUNT_PLANES):  # all, for where the carry ends cannot be predicted
        plane = cell[k]
        cell[k] = plane ^ carry
        carry &= plane
    return carry


@kernel
def add_one(cell: U64, words: tuple[np.uint64, np.uint64, np.uint64]) -> None:
    """Add 1 to the counts that the first, second and third counter of a cell (words,) keep of the voxels of ``words``.
    If one would exceed its planes, all counts of the cell are halved: their ratios stay."""
    none = np.uint64(0)
    full = (
        add_four(cell, 0, words[0], none, none, none),
        add_four(cell, COUNT_PLANES, words[1], none, none, none),
        add_four(cell, 2 * COUNT_PLANES, words[2], none, none, none),
    )
    if full[0] | full[1] | full[2]:
        for counter in range(3):
            first = counter * COUNT_PLANES
            for k in range(first, first + COUNT_PLANES - 1):
                cell[k] = cell[k + 1]
            cell[first + COUNT_PLANES - 1] = full[counter]


@kernel
def count_of(cell: U64, first: int, bit: int) -> int:
    """The count of one voxel of a cell (words,); ``first`` is the counter's first plane."""
    value = 0
    for k in range(COUNT_PLANES):
        value |= int((cell[first + k] >> np.uint64(bit)) & np.uint64(1)) << k
    return value
