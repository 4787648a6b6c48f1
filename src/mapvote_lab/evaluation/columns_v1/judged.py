"""What is known of a tile on the way from its evidence to its votes."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from mapvote.core.types import I32, U8, U64, Bool, CellState, Reference
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
