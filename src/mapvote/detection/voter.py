"""What counts a drive, and what it says of one tile in the end."""

from __future__ import annotations

from collections.abc import Collection, Iterator
from dataclasses import dataclass
from typing import Protocol

from mapvote.core.grid import TileIndex
from mapvote.core.types import F64, I32, U8, U64
from mapvote.perception.frontend import Observation


@dataclass(frozen=True, slots=True)
class TileVotes:
    """What a voter says of one tile."""

    tally: I32
    """(256, 256, 5) votes in VOTE_UNITs."""
    states: U8
    """(256, 256) decided by this vehicle alone."""
    gone: U64 | None
    """(256, 256) map voxels that are there no more where the cell is changed-empty; None: all of them."""
    remnants: U64 | None
    """(256, 256) map voxels that are there no more though the rest of the cell stands; None: not asked."""
    new: U64
    """(256, 256) voxels whose points are new where the cell is changed-occupied."""
    free: U64 | None
    """(256, 256) voxels seen to be free in cells where the map knew of none; None: not asked."""
    looked: F64 | None = None
    """(m, k) what speaks for each changed cell, ascending (detection/confidence.py); None: not asked."""


class Voter(Protocol):
    """The paper's votes of each scan (detection/paper.py), or surfaces (detection/surfaces.py): scan after scan goes
    in, votes come out tile by tile."""

    def observe(self, seen: Observation) -> U64:
        """Take in one scan; returns (rows, cols) words of the voxels of its view whose points may be new."""

    def votes(self) -> dict[TileIndex, TileVotes]:
        """What the scans so far amount to, of every tile that they say anything of, in ascending order. Asking changes
        nothing."""

    def each(self, only: Collection[TileIndex] | None = None) -> Iterator[tuple[TileIndex, TileVotes]]:
        """The same tile by tile, in any order: so that no drive is too long for memory. ``only``: of these tiles."""
