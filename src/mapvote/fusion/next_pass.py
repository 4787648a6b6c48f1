"""Where one more pass would decide something: cells in which a change lacks one vote, and the road to see them from.

A vehicle that saw a change is the witness of where it can be seen from. One more vehicle that drives the same road in
the same direction most likely sees the same, and its vote decides the cell.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
import scipy
from numpy.typing import NDArray

from mapvote.core.grid import Grid, TileIndex
from mapvote.core.types import F64, NO_VOTE, U8, Bool, CellState

SECTORS = 8
"""Directions of road, 45 deg each."""


@dataclass(frozen=True, slots=True)
class Witness:
    """The votes of one vehicle on a tile, and its path."""

    states: U8
    """(256, 256) CellState or NO_VOTE."""
    paths_m: Sequence[F64]
    """(n, 2) map metres of each of its drives, in the order driven."""


@dataclass(frozen=True, slots=True)
class Stretch:
    """A piece of road on which one more vehicle would decide cells of one tile."""

    tile: TileIndex
    heading_rad: float
    """Direction of the drive, from the x axis of the map towards y: a multiple of 45 deg."""
    built: int
    """Cells that one more vote would decide changed-occupied."""
    gone: int
    """Cells that one more vote would decide changed-empty."""
    path_m: F64
    """(n, 2) map metres, in the direction to drive."""

    @property
    def cells(self) -> int:
        """All of them."""
        return self.built + self.gone


@dataclass(frozen=True, slots=True)
class Waiting:
    """Changes that only the quorum prevents: all that have seen them agree, and they are one vote too few."""

    cells: int
    drives: int
    """Drives that vote for them."""
    vehicles: Sequence[str]
    """Vehicles of these drives, by name."""
    quorum: int

    def __str__(self) -> str:
        noun, verb = ("cell", "waits") if self.cells == 1 else ("cells", "wait")
        drives = f"{self.drives} drive{'s say' if self.drives > 1 else ' says'} so"
        alone = len(self.vehicles) == 1
        by = f"{'all ' if self.drives > 1 and alone else ''}by {' and '.join(self.vehicles)}"
        another = {2: "a second", 3: "a third"}.get(self.quorum, "another")
        way_out = f"{another} vehicle or `fuse.min_votes = {self.quorum - 1}` decides"
        return f"{self.cells} {noun} {verb}: {drives}, {by}; {way_out}"


def lacks_quorum_only(states: Sequence[U8], quorum: int) -> U8:
    """(rows, cols) the change that ``quorum`` - 1 of the vehicles and more than half of those that determined the cell
    vote for; NO_VOTE in all other cells. ``states``: (rows, cols) of each vehicle."""
    determined = _count([said < CellState.UNDETERMINED for said in states])
    out = np.full(determined.shape, NO_VOTE, dtype=np.uint8)
    for change in (CellState.CHANGED_EMPTY, CellState.CHANGED_OCCUPIED) if quorum > 1 else ():
        votes = _count([said == change for said in states])
        out[(votes == quorum - 1) & (2 * votes > determined)] = change
    return out


def one_vote_short(states: Sequence[U8], quorum: int) -> U8:
    """(rows, cols) the change that one more vote for it would decide; NO_VOTE in all other cells.

    ``states``: (rows, cols) of each vehicle. The rule is that of ``fuse.count``: a change needs ``quorum`` votes and a
    majority of the vehicles that determined the cell. A change without any vote is not listed.
    """
    determined = _count([said < CellState.UNDETERMINED for said in states])
    out = np.full(determined.shape, NO_VOTE, dtype=np.uint8)
    for change in (CellState.CHANGED_EMPTY, CellState.CHANGED_OCCUPIED):
        votes = _count([said == change for said in states])
        decided = (votes >= quorum) & (2 * votes > determined)
        would = (votes + 1 >= quorum) & (2 * (votes + 1) > determined + 1)
        out[(votes > 0) & would & ~decided] = change
    return out


def _count(claims: Sequence[Bool]) -> NDArray[np.int16]:
    """(rows, cols) how many of the claims hold."""
    count = np.zeros(claims[0].shape, dtype=np.int16)
    for claim in claims:
        count += claim
    return count


def stretches(window: Grid, witnesses: Sequence[Witness], quorum: int) -> list[Stretch]:
    """The roads of one tile's ``window`` on which one more pass would decide cells, the most cells first.

    A cell is counted for each direction in which a vehicle drove that voted for the change.
    """
    if not witnesses:
        return []
    short = one_vote_short([witness.states for witness in witnesses], quorum)
    counted: dict[int, Bool] = {}
    roads: dict[int, tuple[int, F64]] = {}
    for witness in witnesses:
        rows, cols = np.nonzero((short != NO_VOTE) & (witness.states == short))
        paths = [path for path in witness.paths_m if len(path) > 1]
        if not len(rows) or not paths:
            continue
        at = np.concatenate([path[:-1] for path in paths])
        heading = np.concatenate([np.diff(p, axis=0) for p in paths])
        x, y = window.centres()
        nearest = scipy.spatial.cKDTree(at).query(np.column_stack([x[cols], y[rows]]))[1]
        sector = np.round(np.arctan2(*heading[nearest].T[::-1]) * SECTORS / (2 * np.pi)).astype(np.int64) % SECTORS
        for k in np.unique(sector).tolist():
            in_sector = sector == k
            counted.setdefault(k, np.zeros(short.shape, dtype=np.bool_))[rows[in_sector], cols[in_sector]] = True
            if in_sector.sum() > roads.get(k, (0, at))[0]:
                road = at[nearest[in_sector].min() : nearest[in_sector].max() + 1]
                roads[k] = int(in_sector.sum()), np.concatenate([road, road[-1:] + heading[nearest[in_sector].max()]])
    out = [
        Stretch(
            window.tile_index,
            2 * np.pi * k / SECTORS,
            int((short[cells] == CellState.CHANGED_OCCUPIED).sum()),
            int((short[cells] == CellState.CHANGED_EMPTY).sum()),
            roads[k][1],
        )
        for k, cells in counted.items()
    ]
    return sorted(out, key=lambda stretch: (-stretch.cells, stretch.heading_rad))
