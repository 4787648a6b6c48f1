"""What a voter says of one tile, and what it is on the way to that."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from mapvote.core.types import F64, I32, U8, U64, Bool, CellState, Reference
from mapvote.core.voting import decide, one_hot


@dataclass(slots=True)
class Judged:
    """One tile on its way from evidence to votes. The rules change states, tally and masks in place."""

    here: Reference
    weighed: Weighed
    states: U8
    """(256, 256) decided so far."""
    crowded: U64
    """(256, 256) voxels next to which something new was struck."""
    remnants: U64
    """(256, 256) map voxels that are there no more though the rest of the cell stands."""

    def overrule(self, cells: Bool, state: CellState) -> None:
        """Let all votes of ``cells`` (256, 256) be for ``state``."""
        self.states[cells] = state
        self.weighed.tally[cells] = one_hot(np.array(state, dtype=np.uint8))


@dataclass(frozen=True, slots=True)
class Weighed:
    """What a drive says of a window."""

    tally: I32
    """(rows, cols, 5) votes in VOTE_UNITs."""
    gone: U64
    """(rows, cols) mapped voxels that are there no more, should the cell be changed-empty."""
    new: U64
    """(rows, cols) voxels of new surface, should it be changed-occupied."""
    beside: Bool
    """(rows, cols) cells all of whose new voxels lie next to mapped ones (rule C)."""
    adrift: Bool
    """(rows, cols) mapped cells whose voxels no ray struck and hardly any crossed, while rays passed below (rule H)."""
    loose: U64
    """(rows, cols) mapped voxels into which no hit ever fell, and through which rays went (rule I)."""

    def states(self) -> U8:
        return decide(self.tally)


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
