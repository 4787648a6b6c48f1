"""The interface of a change rule: it takes the scans of a drive and gives the votes on each tile."""

from __future__ import annotations

from collections.abc import Collection, Iterator
from dataclasses import dataclass
from typing import Protocol

from mapvote.core.grid import TileIndex
from mapvote.core.types import F64, I32, U8, U64
from mapvote.perception.frontend import Observation


@dataclass(frozen=True, slots=True)
class TileVotes:
    """The votes of one drive on one tile."""

    tally: I32
    """(256, 256, 5) votes in VOTE_UNITs."""
    states: U8
    """(256, 256) decided by this vehicle alone."""
    gone: U64 | None
    """(256, 256) words of the map voxels that are gone: of changed-empty cells, and of cells that stand. None: all of
    changed-empty cells."""
    new: U64
    """(256, 256) words of the voxels whose points are new in changed-occupied cells."""
    free: U64 | None
    """(256, 256) words of the voxels that rays showed to be free and the map did not know to be; None: the rule has
    none."""
    looked: F64 | None = None
    """(m, k) features of each changed cell, ascending (detection/confidence.py); None: the rule has none."""


class Voter(Protocol):
    """The paper's votes of each scan (detection/paper.py), or surfaces (detection/surfaces.py)."""

    def observe(self, seen: Observation) -> U64:
        """Count one scan; returns (rows, cols) words of the voxels of its view whose points may be new."""

    def votes(self) -> dict[TileIndex, TileVotes]:
        """The votes of the scans so far, for every tile with votes, in ascending order. The call changes nothing."""

    def each(self, only: Collection[TileIndex] | None = None) -> Iterator[tuple[TileIndex, TileVotes]]:
        """The same tile by tile, in any order: so that no drive is too long for memory. ``only``: of these tiles."""
