"""What a voter says of one tile."""

from __future__ import annotations

from dataclasses import dataclass

from mapvote.core.types import F64, I32, U8, U64


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
    """(m, k) what speaks for each changed cell, ascending (detection/surface_looks.py); None: not asked."""
