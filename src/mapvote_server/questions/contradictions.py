"""Where one vehicle says the opposite of all others: objects of cells, found tile by tile and joined over borders.

A vote is compared only where other vehicles agree both before it and after it, as a cell that differs before and after
a drive may have changed. Each tile keeps the number of its objects, the largest of them and those that touch its
border: a vehicle that contradicts everywhere costs kilobytes a tile.
"""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from dataclasses import dataclass, field

import numpy as np
import scipy

from mapvote.core.grid import CELL_SIZE, TILE_CELLS, Lattice, TileIndex
from mapvote.core.record import record
from mapvote.core.types import F64, I64, U8, Bool, CellState
from mapvote.fusion.tile_vote import Vote
from mapvote.shapes.outlines import pieces
from mapvote_server.questions.explain import said_by


@record()
@dataclass(frozen=True, slots=True)
class Contradictions:
    """Sizes of objects that a vehicle sees differently from all others."""

    least_cells: int = 4
    """Objects of fewer cells are noise, and not counted."""
    told_a_tile: int = 100
    """Objects wholly on one tile whose places are kept, the largest first; all are counted."""
    told: int = 1_000
    """Objects of one vehicle whose places are told, the largest first."""


CONTRADICTIONS = Contradictions()
_SILENT, _OCCUPIED, _EMPTY = range(3)
_CLAIMS = np.full(256, _SILENT, dtype=np.uint8)
"""By state: what it says of the cell now."""
_CLAIMS[[CellState.UNCHANGED_OCCUPIED, CellState.CHANGED_OCCUPIED]] = _OCCUPIED
_CLAIMS[[CellState.UNCHANGED_EMPTY, CellState.CHANGED_EMPTY]] = _EMPTY
_ROW = 1 << 32
"""Between the keys of two cells above one another: keys ascend by row, then column, also below zero."""
_AROUND = ((0, 1), (1, -1), (1, 0), (1, 1))
"""Four of the eight cells around one; the others find it."""


@dataclass(frozen=True, slots=True)
class Objects:
    """Objects, or parts of some; (n,) each."""

    cells: I64
    row_sum: F64
    """Sum of the rows of its cells on the lattice of the map."""
    col_sum: F64
    occupied: U8
    """1 where the vehicle says occupied, 0 where it says empty."""

    @classmethod
    def none(cls) -> Objects:
        """No object."""
        return cls(np.zeros(0, np.int64), np.zeros(0), np.zeros(0), np.zeros(0, np.uint8))

    @classmethod
    def all_of(cls, parts: Sequence[Objects]) -> Objects:
        """Those of several tiles."""
        fields = (np.concatenate([getattr(one, name) for one in parts]) for name in cls.__slots__)
        return cls(*fields) if parts else cls.none()

    def __len__(self) -> int:
        return len(self.cells)

    def among(self, chosen: I64 | Bool) -> Objects:
        """Some of them."""
        return Objects(self.cells[chosen], self.row_sum[chosen], self.col_sum[chosen], self.occupied[chosen])

    def largest(self, most: int) -> Objects:
        """The largest, in order; of equal ones the lowest, then leftmost first."""
        return self.among(np.lexsort((self.col_sum, self.row_sum, -self.cells))[:most])

    def places_m(self, lattice: Lattice) -> tuple[F64, F64]:
        """(x, y) of their middles, map metres."""
        cols = self.col_sum / self.cells
        rows = self.row_sum / self.cells
        return lattice.x0 + CELL_SIZE * (cols + 0.5), lattice.y0 + CELL_SIZE * (rows + 0.5)


@dataclass(frozen=True, slots=True)
class Border:
    """Parts of objects that touch the border of a tile, and their cells there, (n,) each."""

    parts: Objects
    part: I64
    """The part that each cell belongs to."""
    rows: I64
    """On the lattice of the map."""
    cols: I64

    @classmethod
    def none(cls) -> Border:
        """Nothing at the border."""
        nothing = np.zeros(0, dtype=np.int64)
        return cls(Objects.none(), nothing, nothing, nothing)


@dataclass(frozen=True, slots=True)
class Compared:
    """One vehicle against the others on one tile."""

    vehicle: str
    cells: int
    """Cells where the others agree before and after it, and it votes too."""
    inside: int = 0
    """Objects wholly on the tile that it sees differently from all others."""
    largest: Objects = field(default_factory=Objects.none)
    """The largest of these."""
    border: Border = field(default_factory=Border.none)
    """Those that may go on in the next tile."""

    @property
    def contradicts(self) -> bool:
        """Whether it sees anything differently."""
        return len(self.largest) > 0 or len(self.border.parts) > 0


def compare(index: TileIndex, votes: Iterable[Vote]) -> list[Compared]:
    """Each vehicle's vote on a tile, all its drives as one, against the others'; one entry each, in order of name.

    In a cell the others agree if more of them vote one way (occupied or empty now) than the other, and at least one
    of these passed before the vehicle and one after it. Undetermined cells and cells without a vote are left out.
    """
    ordered = sorted(votes, key=lambda vote: (vote.end_ns, vote.vehicle))
    if not ordered:
        return []
    claims = np.stack([_CLAIMS[said_by(vote).reshape(-1)] for vote in ordered])
    occupied = claims == _OCCUPIED
    empty = claims == _EMPTY
    all_occupied, all_empty = (claim.sum(axis=0, dtype=np.int16) for claim in (occupied, empty))
    before_occupied = np.zeros_like(all_occupied)
    before_empty = np.zeros_like(all_empty)
    out = []
    for i, vote in enumerate(ordered):
        others_occupied = all_occupied - occupied[i]
        others_empty = all_empty - empty[i]
        # A side that has the majority, and a vote both before this one and after it.
        agree_occupied = (others_occupied > others_empty) & (before_occupied > 0) & (others_occupied > before_occupied)
        agree_empty = (others_empty > others_occupied) & (before_empty > 0) & (others_empty > before_empty)
        before_occupied += occupied[i]
        before_empty += empty[i]
        opposed = np.flatnonzero((agree_occupied & empty[i]) | (agree_empty & occupied[i]))
        compared = int(((agree_occupied | agree_empty) & (claims[i] != _SILENT)).sum())
        out.append(Compared(vote.vehicle, compared, *_objects_on(index, opposed, occupied[i][opposed])))
    return sorted(out, key=lambda entry: entry.vehicle)


def _objects_on(index: TileIndex, flat: I64, occupied: Bool) -> tuple[int, Objects, Border]:
    """The 8-connected objects of flat cells (n,) of a tile: how many lie wholly on it, the largest of these, and what
    touches its border."""
    if not len(flat):
        return 0, Objects.none(), Border.none()
    rows, cols = np.divmod(flat, TILE_CELLS)
    label = pieces(rows, cols, occupied.astype(np.int64)).objects
    at_border = (rows % (TILE_CELLS - 1) == 0) | (cols % (TILE_CELLS - 1) == 0)
    rows += index[0] * TILE_CELLS
    cols += index[1] * TILE_CELLS
    says = np.zeros(label.max() + 1, dtype=np.uint8)
    says[label] = occupied
    row_sum, col_sum = (np.bincount(label, weights=values).astype(np.float64) for values in (rows, cols))
    objects = Objects(np.bincount(label), row_sum, col_sum, says)
    touches = np.zeros(len(objects), dtype=np.bool_)
    touches[label[at_border]] = True
    inside = objects.among(~touches & (objects.cells >= CONTRADICTIONS.least_cells))
    part = np.cumsum(touches)[label[at_border]] - 1
    border = Border(objects.among(touches), part, rows[at_border], cols[at_border])
    return len(inside), inside.largest(CONTRADICTIONS.told_a_tile), border


def over_borders(borders: Sequence[Border]) -> Objects:
    """The objects of at least ``least_cells`` cells that lie on several tiles, or touch the border of one."""
    if not borders:
        return Objects.none()
    parts = Objects.all_of([border.parts for border in borders])
    first = np.cumsum([0, *(len(border.parts) for border in borders[:-1])])
    part = np.concatenate([border.part + k for border, k in zip(borders, first, strict=True)])
    rows, cols = (np.concatenate([getattr(border, name) for border in borders]) for name in ("rows", "cols"))
    order = np.lexsort((cols, rows))
    part = part[order]
    key = (rows * _ROW + cols)[order]
    pairs = []
    for row, col in _AROUND:
        beside = key + (row * _ROW + col)
        at = np.minimum(np.searchsorted(key, beside), len(key) - 1)
        pairs.append(np.stack([part, part[at]])[:, key[at] == beside])
    one, other = np.concatenate(pairs, axis=1)
    alike = parts.occupied[one] == parts.occupied[other]
    one = one[alike]
    other = other[alike]
    graph = scipy.sparse.coo_array((np.ones(len(one)), (one, other)), shape=(len(parts), len(parts)))
    number, label = scipy.sparse.csgraph.connected_components(graph, directed=False)
    cells = np.bincount(label, weights=parts.cells, minlength=number).astype(np.int64)
    says = np.zeros(number, dtype=np.uint8)
    says[label] = parts.occupied
    row_sum, col_sum = (
        np.bincount(label, weights=values).astype(np.float64) for values in (parts.row_sum, parts.col_sum)
    )
    whole = Objects(cells, row_sum, col_sum, says)
    return whole.among(whole.cells >= CONTRADICTIONS.least_cells)
