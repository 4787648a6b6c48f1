"""Removal of moving objects as a short sentence has it ([9], read literally): a yardstick for our filter.

A cell of the world's 2D grid that has been occupied for less than a time belongs to a moving object. Nobody asks who
could have seen the cell: what has only just come into view is moving, and what comes by again after a while too.
"""

from __future__ import annotations

import numpy as np

from mapvote.core.grid import CELL_SIZE
from mapvote.core.types import F64, I64, Bool
from mapvote.perception.frontend import Movers

BRIEF_S = 1.0
"""Occupied for less than this: moving."""
GAP_S = 0.25
"""A cell that no scan hit for longer than this was empty in between: two scans of 10 Hz may miss it."""


class OccupiedBriefly(Movers):
    """Decides each scan at once. Memory: the cells that were hit within the last GAP_S."""

    def __init__(self, brief_s: float = BRIEF_S, gap_s: float = GAP_S) -> None:
        self._brief_ns, self._gap_ns = round(brief_s * 1e9), round(gap_s * 1e9)
        self._cells: I64 = np.zeros(0, dtype=np.int64)
        """Keys, ascending; with each since when it has been occupied, and when it was last hit."""
        self._since: I64 = np.zeros(0, dtype=np.int64)
        self._last: I64 = np.zeros(0, dtype=np.int64)

    def push(self, points_map: F64, origin_map: F64, obstacle: Bool, stamp_ns: int) -> list[Bool]:
        """The mask of moving points (n,) of this scan; see :class:`mapvote.perception.frontend.Movers`."""
        cells = np.floor(points_map[obstacle, :2] / CELL_SIZE).astype(np.int64)
        hit, of_point = np.unique((cells[:, 0] << 32) + cells[:, 1], return_inverse=True)
        since = np.full(len(hit), stamp_ns, dtype=np.int64)
        at = np.searchsorted(self._cells, hit).clip(max=max(len(self._cells) - 1, 0))
        if len(self._cells):
            known = (self._cells[at] == hit) & (stamp_ns - self._last[at] <= self._gap_ns)
            since[known] = self._since[at[known]]
        self._remember(hit, since, stamp_ns)
        moving = np.zeros(len(points_map), dtype=np.bool_)
        moving[obstacle] = (stamp_ns - since < self._brief_ns)[of_point]
        return [moving]

    def _remember(self, hit: I64, since: I64, stamp_ns: int) -> None:
        """What was hit now, and what was hit a moment ago."""
        fresh = (stamp_ns - self._last <= self._gap_ns) & ~np.isin(self._cells, hit)
        cells = np.concatenate([self._cells[fresh], hit])
        order = np.argsort(cells)
        self._cells = cells[order]
        self._since = np.concatenate([self._since[fresh], since])[order]
        self._last = np.concatenate([self._last[fresh], np.full(len(hit), stamp_ns)])[order]

    def flush(self) -> list[Bool]:
        """Nothing waits."""
        return []
