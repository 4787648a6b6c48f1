"""Changed cells -> change objects: what was built, what was demolished, as GeoJSON in map metres.

What changed is read off the two maps themselves, so it holds between any two versions, rollbacks included. The
decisions in between say who voted for it. Objects are found on the lattice, not in tiles.
"""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from typing import Literal

import numpy as np

from mapvote.core.grid import CELL_SIZE, TILE_CELLS
from mapvote.core.tile import Tile
from mapvote.core.types import F32, F64, I32, I64, U8, Bool, CellState
from mapvote.core.voting import VOTE_UNIT
from mapvote.server.insight.polygons import Ring, pieces, rings

Kind = Literal["built", "demolished"]
KINDS: dict[int, Kind] = {CellState.CHANGED_OCCUPIED: "built", CellState.CHANGED_EMPTY: "demolished"}
_NEVER = np.iinfo(np.int64).max
_UNTIL = np.iinfo(np.int64).min


@dataclass(frozen=True, slots=True)
class Decided:
    """What one version decided about one tile, and which drives had said so."""

    version: int
    states: U8
    """(256, 256) CellState or NO_VOTE."""
    tally: I32
    """(256, 256, 5) in VOTE_UNITs."""
    drives: Sequence[tuple[int, U8]] = ()
    """(end_ns, (256, 256) states) of every vote that was counted."""


@dataclass(frozen=True, slots=True)
class ChangedCells:
    """The cells of one tile whose points differ, (n,) each, by row, then column."""

    rows: I64
    """On the lattice of the map, not of the tile."""
    cols: I64
    states: U8
    """CHANGED_OCCUPIED or CHANGED_EMPTY."""
    top_m: F64
    """Highest point that came or went, above ground."""
    points: I64
    """Points that came or went."""
    votes: I32
    """Votes for the change in the version that made it; 0 where no decision is known."""
    first_ns: I64
    """End of the first drive that voted for it; a very large number where none is known."""
    last_ns: I64
    versions: I64
    """The last version that decided this change; 0 where none is known."""


@dataclass(frozen=True, slots=True)
class ChangeObject:
    """One thing that was built or demolished."""

    id: str
    kind: Kind
    outline: list[list[Ring]]
    """Polygons, each an outer ring and its holes, in lattice corners (col, row)."""
    cells: int
    height_m: float
    points: int
    votes_min: int
    votes_median: float
    first_seen_ns: int | None
    last_seen_ns: int | None
    versions: list[int]
    """The versions that made it, ascending; empty where no decision is known."""

    @property
    def area_m2(self) -> float:
        return self.cells * CELL_SIZE * CELL_SIZE


def changed_cells(before: Tile, after: Tile, decided: Iterable[Decided] = ()) -> ChangedCells:
    """Which cells of a tile gained points (built) or lost some (demolished); both at once goes by the larger number.

    ``decided`` are the decisions on this tile between the two, in ascending order of version.
    """
    old, new, index = before.points, after.points, before.index
    old_cell, new_cell = before.cells, after.cells
    cell = np.concatenate([new_cell, old_cell])
    z = np.concatenate([new[:, 2], old[:, 2]]).astype(np.float64)
    came = _missing_from(new, old)
    went = _missing_from(old, new)
    n_came = np.bincount(new_cell[came], minlength=TILE_CELLS**2)
    n_went = np.bincount(old_cell[went], minlength=TILE_CELLS**2)
    flat = np.flatnonzero(n_came + n_went)
    built = n_came >= n_went
    states = np.where(built[flat], np.uint8(CellState.CHANGED_OCCUPIED), np.uint8(CellState.CHANGED_EMPTY))
    is_new = np.arange(len(cell)) < len(new)
    tells = np.concatenate([came, went]) & (built[cell] == is_new)
    top = np.full(TILE_CELLS**2, -np.inf)
    bottom = np.full(TILE_CELLS**2, np.inf)
    np.maximum.at(top, cell[tells], z[tells])
    np.minimum.at(bottom, cell[tells], z[tells])
    ground = np.where(np.isnan(after.ground_z), before.ground_z, after.ground_z).reshape(-1).astype(np.float64)
    ground = np.where(np.isnan(ground), bottom, ground)
    votes, first, last, version = _evidence(flat, states, decided)
    return ChangedCells(
        rows=index[0] * TILE_CELLS + flat // TILE_CELLS,
        cols=index[1] * TILE_CELLS + flat % TILE_CELLS,
        states=states,
        top_m=top[flat] - ground[flat],
        points=np.maximum(n_came, n_went)[flat],
        votes=votes,
        first_ns=first,
        last_ns=last,
        versions=version,
    )


def change_objects(changed: Iterable[ChangedCells], min_cells: int = 1) -> list[ChangeObject]:
    """8-connected cells of one kind, over all tiles: objects in ascending order of their lowest, leftmost cell.

    The tiles may come in any order. Objects of fewer than ``min_cells`` cells are left out.
    """
    parts = [c for c in changed if len(c.rows)]
    if not parts:
        return []
    rows, cols = np.concatenate([c.rows for c in parts]), np.concatenate([c.cols for c in parts])
    order = np.lexsort((cols, rows))
    rows, cols = rows[order], cols[order]
    states = np.concatenate([c.states for c in parts])[order]
    top = np.concatenate([c.top_m for c in parts])[order]
    points = np.concatenate([c.points for c in parts])[order]
    votes = np.concatenate([c.votes for c in parts])[order]
    first = np.concatenate([c.first_ns for c in parts])[order]
    last = np.concatenate([c.last_ns for c in parts])[order]
    versions = np.concatenate([c.versions for c in parts])[order]
    found = pieces(rows, cols, states.astype(np.int64))
    outlines = rings(rows, cols, found.polygons)
    by_object = np.argsort(found.objects, kind="stable")
    out = []
    for mine in np.split(by_object, np.cumsum(np.bincount(found.objects))[:-1]):
        if len(mine) < min_cells:
            continue
        kind = KINDS[int(states[mine[0]])]
        made_in = sorted({int(v) for v in versions[mine]} - {0})
        told = votes[mine][versions[mine] > 0] if made_in else votes[mine]  # remnants in cells that stand have no votes
        seen_first, seen_last = int(first[mine].min()), int(last[mine].max())
        out.append(
            ChangeObject(
                id=f"{kind}.v{made_in[0] if made_in else 0}.{rows[mine[0]]}.{cols[mine[0]]}",
                kind=kind,
                outline=[outlines[p] for p in np.unique(found.polygons[mine])],
                cells=len(mine),
                height_m=float(top[mine].max()),
                points=int(points[mine].sum()),
                votes_min=int(told.min()),
                votes_median=float(np.median(told)),
                first_seen_ns=None if seen_first == _NEVER else seen_first,
                last_seen_ns=None if seen_last == _UNTIL else seen_last,
                versions=made_in,
            )
        )
    return out


def _missing_from(points: F32, others: F32) -> Bool:
    """(n,) which points are not, bit for bit, among ``others``: edits leave every other point as it was."""
    ours = np.ascontiguousarray(points).view("V12").reshape(-1)
    theirs = np.ascontiguousarray(others).view("V12").reshape(-1)
    _, label = np.unique(np.concatenate([ours, theirs]), return_inverse=True)
    known = np.zeros(len(label) + 1, dtype=np.bool_)
    known[label[len(ours) :]] = True
    return ~known[label[: len(ours)]]


def _evidence(flat: I64, states: U8, decided: Iterable[Decided]) -> tuple[I32, I64, I64, I64]:
    """(votes, first_ns, last_ns, version) of the changed cells; votes are those of the last decision for it."""
    votes = np.zeros(len(flat), dtype=np.int32)
    version = np.zeros(len(flat), dtype=np.int64)
    first = np.full(len(flat), _NEVER)
    last = np.full(len(flat), _UNTIL)
    for decision in decided:
        agrees = decision.states.reshape(-1)[flat] == states
        counted = decision.tally.reshape(TILE_CELLS**2, -1)[flat, states] // VOTE_UNIT
        votes = np.where(agrees, counted, votes)
        version = np.where(agrees, decision.version, version)
        for end_ns, drive in decision.drives:
            said_so = agrees & (drive.reshape(-1)[flat] == states)
            first = np.where(said_so, np.minimum(first, end_ns), first)
            last = np.where(said_so, np.maximum(last, end_ns), last)
    return votes.astype(np.int32), first, last, version
