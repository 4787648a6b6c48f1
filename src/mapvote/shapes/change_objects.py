"""Changed cells -> change objects: things that were built or demolished.

The changed cells follow from the points of the two maps, so they are right between any two versions, rollbacks
included. Votes and times come from the decision records in between. Objects are found on the lattice, not in tiles.
"""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from dataclasses import dataclass, fields
from typing import Any, Literal

import numpy as np

from mapvote.codec.ballot import UNSAID
from mapvote.core.grid import CELL_SIZE, TILE_CELLS
from mapvote.core.record import record
from mapvote.core.tile import Tile
from mapvote.core.types import F64, I8, I32, I64, U8, Bool, CellState
from mapvote.core.voxels import found_among
from mapvote.fusion.decision_record import Record
from mapvote.fusion.loss_budget import alike_beside, change_probability
from mapvote.shapes.outlines import PIECE_RULE, Ring, buildings, group, members, rings, widths_m

Kind = Literal["built", "demolished"]
Size = Literal["large", "vehicle", "small"]


@record()
@dataclass(frozen=True, slots=True)
class ObjectSizes:
    """Sizes by which changed objects are told apart: the largest bus or lorry (Directive 96/53/EC) is listed as a
    vehicle or the trail of one. Each connected piece is measured, so several vehicles side by side are no larger
    object."""

    small_area_m2: float = 1.0
    """Area below which an object is small, square metres."""
    vehicle_length_m: float = 12.0
    """Length of the largest vehicle, metres."""
    vehicle_width_m: float = 2.55
    """Width of the largest vehicle, metres."""
    vehicle_height_m: float = 4.0
    """Height of the largest vehicle, metres."""
    border_m: float = 2 * CELL_SIZE * 2**0.5
    """Excess of an object's cells over the object: a cell's diagonal on either side, metres."""


OBJECT_SIZES = ObjectSizes()
KINDS: dict[int, Kind] = {CellState.CHANGED_OCCUPIED: "built", CellState.CHANGED_EMPTY: "demolished"}
_NEVER = np.iinfo(np.int64).max
_UNTIL = np.iinfo(np.int64).min
Decided = tuple[Record, Sequence[tuple[int, U8]]]
"""The decision of one version on one tile, and (end_ns, (256, 256) states) of every ballot that counted."""


@dataclass(frozen=True, slots=True)
class ChangedCells:
    """The cells of one tile whose points differ, (n,) each, by row, then column."""

    rows: I64
    """On the lattice of the map, not of the tile."""
    cols: I64
    states: U8
    """CHANGED_OCCUPIED or CHANGED_EMPTY."""
    top_m: F64
    """Highest point that was added or deleted, metres above ground."""
    points: I64
    """Points that were added or deleted."""
    bottom_m: F64
    """Lowest point that was added or deleted, metres above ground."""
    votes: I32
    """Votes for the change in the version that made it; 0 where no decision is known."""
    against: I32
    """Votes for other states in that version, undetermined ones excepted."""
    first_ns: I64
    """End of the first drive that voted for it; a very large number where none is known."""
    last_ns: I64
    versions: I64
    """The last version that decided this change; 0 where none is known."""
    odds: I8
    """Confidence of the votes for it in that version; UNSAID where no vote states one."""
    stands: Bool
    """Whether the cell is decided to stand: only some of its voxels went."""
    fell: Bool
    """Whether its points fell with those of other cells (fusion/gravity.py): no vote is needed for them."""


@dataclass(frozen=True, slots=True)
class ChangeObject:
    """One thing that was built or demolished."""

    id: str
    kind: Kind
    outline: list[list[Ring]]
    """Polygons, each an outer ring and its holes, in lattice corners (col, row)."""
    cells: int
    where: tuple[I64, I64]
    """(rows, cols) of its cells on the lattice."""
    box: tuple[float, float, float, float]
    """Lowest column and row, highest column and row, in lattice corners."""
    longest_m: float
    """The longer side of the box around the longest of its connected pieces."""
    width_m: float
    """Width of its widest connected piece: of the narrowest gate that the piece fits through."""
    height_m: float
    volume_m3: float
    """Sum over its columns, each from the lowest to the highest voxel that was added or deleted."""
    points: int
    votes_min: int
    votes_median: float
    against_median: float
    first_seen_ns: int | None
    last_seen_ns: int | None
    versions: list[int]
    """The versions that made it, ascending; empty where no decision is known."""
    probability: float | None
    """Mean over its cells that each of them did change (fusion/loss_budget.py); None where no decision is known, or
    where all its cells stand."""
    trimmed: int
    """Number of its cells that stand and lost only some voxels, beside what stays."""
    fell: int
    """Number of its cells whose points fell with those of the others, because nothing holds them."""

    @property
    def area_m2(self) -> float:
        return self.cells * CELL_SIZE * CELL_SIZE

    @property
    def size(self) -> Size:
        """Size class, for lists that begin with the large changes."""
        if self.area_m2 < OBJECT_SIZES.small_area_m2:
            return "small"
        fits = self.height_m <= OBJECT_SIZES.vehicle_height_m and self.longest_m <= OBJECT_SIZES.vehicle_length_m
        return "vehicle" if fits and self.width_m <= OBJECT_SIZES.vehicle_width_m + OBJECT_SIZES.border_m else "large"

    @property
    def share_for(self) -> float | None:
        """Votes for it over all votes on it, undetermined ones excepted; None where no decision is known."""
        total = self.votes_median + self.against_median
        return self.votes_median / total if total else None


def changed_cells(before: Tile, after: Tile, decided: Iterable[Decided] = ()) -> ChangedCells:
    """The cells of a tile that gained points (built) or lost some (demolished); of both the larger number decides.

    ``decided`` are the decisions on this tile between the two, in ascending order of version.
    """
    old = before.points
    new = after.points
    index = before.index
    old_cell = before.cells
    new_cell = after.cells
    cell = np.concatenate([new_cell, old_cell])
    z = np.concatenate([new[:, 2], old[:, 2]]).astype(np.float64)
    came = ~found_among(new, old)
    went = ~found_among(old, new)
    n_came = np.bincount(new_cell[came], minlength=TILE_CELLS**2)
    n_went = np.bincount(old_cell[went], minlength=TILE_CELLS**2)
    flat = np.flatnonzero(n_came + n_went)
    built = n_came >= n_went
    states = np.where(built[flat], np.uint8(CellState.CHANGED_OCCUPIED), np.uint8(CellState.CHANGED_EMPTY))
    is_new = np.arange(len(cell)) < len(new)
    relevant = np.concatenate([came, went]) & (built[cell] == is_new)
    top = np.full(TILE_CELLS**2, -np.inf)
    bottom = np.full(TILE_CELLS**2, np.inf)
    np.maximum.at(top, cell[relevant], z[relevant])
    np.minimum.at(bottom, cell[relevant], z[relevant])
    ground = np.where(np.isnan(after.ground_z), before.ground_z, after.ground_z).reshape(-1).astype(np.float64)
    ground = np.where(np.isnan(ground), bottom, ground)
    return ChangedCells(
        rows=index[0] * TILE_CELLS + flat // TILE_CELLS,
        cols=index[1] * TILE_CELLS + flat % TILE_CELLS,
        states=states,
        top_m=top[flat] - ground[flat],
        bottom_m=bottom[flat] - ground[flat],
        points=np.maximum(n_came, n_went)[flat],
        **_evidence(flat, states, decided),
    )


def change_objects(
    changed: Sequence[ChangedCells], min_cells: int = 1, reach_m: float = PIECE_RULE.reach_m
) -> list[ChangeObject]:
    """Things over all tiles, see :func:`mapvote.shapes.outlines.group`; in order of their lowest, leftmost cell.

    The tiles may come in any order. Objects of fewer than ``min_cells`` cells are left out.
    """
    cells = _sorted([c for c in changed if len(c.rows)])
    if cells is None:
        return []
    kinds = cells.states.astype(np.int64)
    cut = buildings(cells.rows, cells.cols, kinds)
    outlines = rings(cells.rows, cells.cols, cut.polygons)
    things = group(cells.rows, cells.cols, kinds, cut.objects, reach_m)
    beside = alike_beside(cells.rows, cells.cols, kinds)
    probability = change_probability(cells.states, cells.votes, cells.against, beside, cells.odds)
    sizes_m = [size(cells.rows, cells.cols, cut.objects)[cut.objects] for size in (_lengths_m, widths_m)]
    return [
        _object(
            cells, probability, members_of_it, sizes_m, [outlines[p] for p in np.unique(cut.polygons[members_of_it])]
        )
        for members_of_it in members(things)
        if len(members_of_it) >= min_cells
    ]


def _sorted(parts: Sequence[ChangedCells]) -> ChangedCells | None:
    """All cells of all tiles, by row, then column."""
    if not parts:
        return None
    whole = {f.name: np.concatenate([getattr(c, f.name) for c in parts]) for f in fields(ChangedCells)}
    order = np.lexsort((whole["cols"], whole["rows"]))
    return ChangedCells(**{name: values[order] for name, values in whole.items()})


def _lengths_m(rows: I64, cols: I64, pieces: I32) -> F64:
    """(k,) metres along the longer side of the box around each piece."""
    k = int(pieces.max()) + 1
    sides = []
    for along in (rows, cols):
        low = np.full(k, _NEVER)
        high = np.full(k, _UNTIL)
        np.minimum.at(low, pieces, along)
        np.maximum.at(high, pieces, along)
        sides.append(high - low + 1)
    return np.maximum(*sides) * CELL_SIZE


def _object(
    cells: ChangedCells, probability: F64, own: I64, sizes_m: Sequence[F64], outline: list[list[Ring]]
) -> ChangeObject:
    """``own``: the cells of one thing; ``sizes_m``: of every cell, how long and how wide its piece is."""
    longest_m, width_m = (float(of_piece[own].max()) for of_piece in sizes_m)
    rows = cells.rows[own]
    cols = cells.cols[own]
    versions = cells.versions[own]
    kind = KINDS[int(cells.states[own[0]])]
    made_in = sorted({int(v) for v in versions} - {0})
    by_vote = (versions > 0) & ~cells.fell[own]
    voted = own[by_vote] if by_vote.any() else own
    judged = voted[~cells.stands[voted]]
    seen_first = int(cells.first_ns[own].min())
    seen_last = int(cells.last_ns[own].max())
    columns = np.maximum(cells.top_m[own] - cells.bottom_m[own], 0.0) + CELL_SIZE
    return ChangeObject(
        id=f"{kind}.v{made_in[0] if made_in else 0}.{rows[0]}.{cols[0]}",
        kind=kind,
        outline=outline,
        cells=len(own),
        where=(rows, cols),
        box=(float(cols.min()), float(rows.min()), float(cols.max() + 1), float(rows.max() + 1)),
        longest_m=longest_m,
        width_m=width_m,
        height_m=float(cells.top_m[own].max()),
        volume_m3=float(columns.sum() * CELL_SIZE**2),
        points=int(cells.points[own].sum()),
        votes_min=int(cells.votes[voted].min()),
        votes_median=float(np.median(cells.votes[voted])),
        against_median=float(np.median(cells.against[voted])),
        first_seen_ns=None if seen_first == _NEVER else seen_first,
        last_seen_ns=None if seen_last == _UNTIL else seen_last,
        versions=made_in,
        probability=float(probability[judged].mean()) if made_in and len(judged) else None,
        trimmed=int(cells.stands[own].sum()),
        fell=int(cells.fell[own].sum()),
    )


def _evidence(flat: I64, states: U8, decided: Iterable[Decided]) -> dict[str, Any]:
    """Votes, times, version and confidence of the changed cells, as the last decision for them counted them."""
    n = len(flat)
    votes, against, versions = (np.zeros(n, dtype=np.int64) for _ in range(3))
    odds = np.full(n, UNSAID, dtype=np.int8)
    first = np.full(n, _NEVER)
    last = np.full(n, _UNTIL)
    stands = np.zeros(n, dtype=np.bool_)
    fell = np.zeros(n, dtype=np.bool_)
    for decision, drives in decided:
        said = decision.states.reshape(-1)[flat]
        every_state = decision.votes[flat // TILE_CELLS, flat % TILE_CELLS].astype(np.int64)
        counted = every_state[np.arange(n), states]
        others = every_state[:, : CellState.UNDETERMINED].sum(axis=1) - counted
        # Cells that the version edited though it states no change of them have votes of their own.
        edits = decision.edit_votes
        _, row, edit = np.intersect1d(flat, edits.cells, assume_unique=True, return_indices=True)
        own = edits.states[edit] == states[row]
        row = row[own]
        edit = edit[own]
        counted[row] = edits.votes[edit]
        others[row] = edits.against[edit]
        agrees = said == states
        agrees[row] = True
        # That version's statement on the cell replaces those of earlier versions.
        votes = np.where(agrees, counted, votes)
        against = np.where(agrees, others, against)
        versions = np.where(agrees, decision.version, versions)
        stands = np.where(agrees, said == CellState.UNCHANGED_OCCUPIED, stands)
        fell = np.where(agrees, np.isin(flat, decision.fell[0]), fell)
        odds = np.where(agrees, decision.odds.at(flat), odds)
        for end_ns, drive in drives:
            said_so = agrees & (drive.reshape(-1)[flat] == states)
            first = np.where(said_so, np.minimum(first, end_ns), first)
            last = np.where(said_so, np.maximum(last, end_ns), last)
    counts = {"votes": votes.astype(np.int32), "against": against.astype(np.int32), "versions": versions}
    return counts | {"first_ns": first, "last_ns": last, "odds": odds, "stands": stands, "fell": fell}
